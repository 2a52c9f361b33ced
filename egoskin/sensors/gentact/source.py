"""What a file of GenTact's says of its sensors, in whatever dialect it says it."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

NO_RADIUS = 0.1
"""What GenTact writes for a sensor that has no radius [m]."""
# Names below a link in GenTact's paths, as Isaac Sim's URDF importer gives them.
_BELOW_LINKS = ("visuals", "collisions", "geometry")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """One sensor as the file has it."""

    where: str
    name: str
    link: str
    # In the frame of the link, in the unit of the file.
    position: np.ndarray
    normal: np.ndarray | None
    # x axis of the sensor's frame; None if the file gives none.
    x_axis: np.ndarray | None = None
    radius: float = math.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """A file's sensors, and what to know of its dialect."""

    dialect: str
    sensors: list[Sensor]
    # Metres of one unit; None if the file does not tell.
    unit: float | None = 1.0
    # The 3-D print export scales positions but not radii.
    scales_radius: bool = True
    # Numbers of entries that are no proximity sensors.
    skipped: dict[str, int] = field(default_factory=dict)


class Links:
    """Which link of the robot the file means.

    Args:
        robot_name: Name of the robot, for error texts.
        links: Its links.
        link_map: The user's: link by a part of a path or by all of it.
        parent: The user's link for sensors whose link the file does not tell.

    Raises:
        ValueError: If the user names a link that the robot does not have.
    """

    def __init__(
        self,
        robot_name: str,
        links: Sequence[str],
        link_map: Mapping[str, str],
        parent: str | None,
    ) -> None:
        self.robot_name, self.links = robot_name, tuple(links)
        self.found: dict[str, str] = {}
        self._link_map, self._parent = dict(link_map), parent
        self._unused = {f"link_map's {name!r}" for name in link_map}
        if parent is not None:
            self._unused.add("parent")
        for target in (*link_map.values(), *(() if parent is None else (parent,))):
            if target not in self.links:
                close = difflib.get_close_matches(target, self.links, n=1)
                hint = f" (did you mean {close[0]!r}?)" if close else ""
                raise ValueError(f"no link {target!r}{hint}; {self.known()}")

    def known(self) -> str:
        """The robot's links, to end an error text with."""
        return f"the links of {self.robot_name} are {', '.join(self.links)}"

    def match(self, name: str) -> str | None:
        """Link that a name stands for, by the user's map or by its own; else None."""
        if name in self._link_map:
            self._unused.discard(f"link_map's {name!r}")
            return self._link_map[name]
        return name if name in self.links else None

    def of_path(self, path: str, others: set[str], where: str) -> str:
        """Link of a Parent path, given all the paths of the file."""
        if path in self._link_map:
            return self.found.setdefault(path, str(self.match(path)))
        parts = path.strip("/").split("/")
        for last in range(len(parts) - 1, -1, -1):
            # Blender numbers objects of the same name: visuals.004.
            plain = re.sub(r"\.\d{3,}$", "", parts[last])
            link = self.match(parts[last]) or self.match(plain)
            if link is not None:
                self._check_siblings(path, last, others, where)
                return self.found.setdefault(path, link)
        held = [link for link in self.links if link in path]
        close = held or difflib.get_close_matches(parts[-1], self.links, n=2)
        hint = f" (did you mean {' or '.join(close)}?)" if close else ""
        raise ValueError(
            f"{where}: no part of the Parent {path!r} names a link{hint}; map a part "
            f"of it or all of it with link_map (--link-map); {self.known()}"
        )

    def _check_siblings(
        self, path: str, last: int, others: set[str], where: str
    ) -> None:
        """Raise ValueError if what follows the link may be a sibling of the link.

        GenTact puts the names of siblings with sensors into one path by mistake, so
        that below a path that is a Parent itself there may be a child or a sibling.
        """
        parts = path.strip("/").split("/")
        owner, rest = "/" + "/".join(parts[: last + 1]), parts[last + 1 :]
        if owner in others and not set(rest) <= set(_BELOW_LINKS):
            raise ValueError(
                f"{where}: {'/'.join(rest)!r} of the Parent {path!r} may be a part of "
                f"{parts[last]!r}, or a sibling whose name GenTact appended, for "
                f"{owner!r} is a Parent too; say which link the path means with "
                "link_map (--link-map)"
            )

    def default(self, where: str, name: str) -> str:
        """The user's link for sensors whose link the file, or ``name``, hides."""
        if self._parent is not None:
            self._unused.discard("parent")
            return self._parent
        close = difflib.get_close_matches(name, self.links, n=1)
        hint = f" ({close[0]}?)" if close else ""
        raise ValueError(
            f"{where}: the file does not say on which link its sensors sit; give it "
            f"as parent (--parent){hint}; {self.known()}"
        )

    def check_used(self, path: Path) -> None:
        """Raise ValueError for what the user gave and the file has no use for."""
        if self._unused:
            found = sorted(set(self.found.values()))
            raise ValueError(
                f"{path}: {sorted(self._unused)[0]} decides nothing, for the file "
                f"itself tells the links ({', '.join(found)}); leave it out"
            )


def number(text: str, where: str, what: str) -> float:
    """A finite number, or an error that says where it should have been."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: {what} must be a finite number, got {text!r}")
    return value


def read_radius(text: str, where: str) -> float:
    """Radius in the file's unit; NaN for what the exporter writes without one."""
    if text in ("", "REPLACE_ME"):
        return math.nan
    value = number(text, where, "the radius")
    if value < 0:
        raise ValueError(f"{where}: the radius must not be negative, got {text}")
    return math.nan if value in (0.0, NO_RADIUS) else value
