"""What a file of GenTact's says of its sensors, in whatever dialect it says it."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from egoskin.hints import did_you_mean

NO_RADIUS = 0.1
"""What GenTact writes for a sensor that has no radius [m]."""
# Names below a link in GenTact's paths, as Isaac Sim's URDF importer gives them.
_BELOW_LINK = re.compile(r"(visuals|collisions|geometry)([._]?\d+)?")


# Of a file with more invalid sensors than this the rest is not read; so many are named.
_MOST_INVALID, _SHOWN = 1000, 100


class SensorError(ValueError):
    """One sensor cannot be read for certain.

    Args:
        what: Where in the file, what was expected and what came.
        remedy: What to do about it, the same for all sensors of whom it is true.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.what, self.remedy = what, remedy


class Problems:
    """The sensors that cannot be read, to name all of them at once."""

    def __init__(self) -> None:
        self.found: list[SensorError] = []

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Note that a sensor is invalid, and go on behind the block."""
        try:
            yield
        except SensorError as error:
            self.found.append(error)
            if len(self.found) > _MOST_INVALID:
                raise ValueError(
                    f"more than {_MOST_INVALID:,} sensors cannot be read; the first: "
                    f"{self.found[0]}"
                ) from None

    def raise_all(self) -> None:
        """Raise ValueError if a sensor was invalid."""
        if len(self.found) == 1:
            raise ValueError(
                f"{self.found[0]}; or leave it out with skip_invalid (--skip-invalid)"
            )
        if self.found:
            remedies = dict.fromkeys(e.remedy for e in self.found if e.remedy)
            rest = len(self.found) - _SHOWN
            lines = [
                f"{len(self.found)} sensors cannot be read; mend them, or leave them "
                "out with skip_invalid (--skip-invalid):",
                *(f"  {error.what}" for error in self.found[:_SHOWN]),
                *([f"  and {rest} more"] if rest > 0 else []),
                *remedies,
            ]
            raise ValueError("\n".join(lines))


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
    # Metres of one unit of the positions; None if the file does not say.
    unit: float | None = 1.0
    # The header itself says that unit.
    unit_is_given: bool = False
    # Metres of one unit of the radii; None if it is that of the positions.
    radius_unit: float | None = None
    # Numbers of entries that are no proximity sensors.
    skipped: dict[str, int] = field(default_factory=dict)


class Links:
    """Which link of the robot the file means.

    Args:
        robot_name: Name of the robot, for error texts.
        links: Its links.
        link_map: The user's: link by a part of a path or by all of it.
        parent: The user's link for sensors whose link the file does not name.

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
        self.unused = dict.fromkeys(link_map)
        """Names in the user's map that decided nothing so far, in their order."""
        self._needs_parent = False
        for target in (*link_map.values(), *(() if parent is None else (parent,))):
            if target not in self.links:
                hint = did_you_mean(target, self.links)
                raise ValueError(f"no link {target!r}{hint}; {self.known()}")

    def known(self) -> str:
        """The robot's links, to end an error text with."""
        return f"the links of {self.robot_name} are {', '.join(self.links)}"

    def match(self, name: str) -> str | None:
        """Link that a name stands for, by the user's map or by its own; else None."""
        if name in self._link_map:
            self.unused.pop(name, None)
            return self._link_map[name]
        return name if name in self.links else None

    def of_path(self, path: str, where: str) -> str:
        """Link of a Parent path."""
        if path in self._link_map:
            return self.found.setdefault(path, str(self.match(path)))
        parts = path.strip("/").split("/")
        for last in range(len(parts) - 1, -1, -1):
            # Blender numbers objects of the same name: visuals.004.
            plain = re.sub(r"\.\d{3,}$", "", parts[last])
            link = self.match(parts[last]) or self.match(plain)
            if link is None:
                continue
            # GenTact puts the names of siblings with sensors into one path by mistake,
            # and a path may go on to a link that this robot lacks.
            rest = [p for p in parts[last + 1 :] if not _BELOW_LINK.fullmatch(p)]
            if rest:
                raise SensorError(
                    f"{where}: {'/'.join(rest)!r} of the Parent {path!r} may be a part "
                    f"of {parts[last]!r}, or a link that {self.robot_name} lacks; say "
                    f"which link it means with link_map (--link-map {rest[-1]}=...)",
                    self.known(),
                )
            return self.found.setdefault(path, link)
        held = [link for link in self.links if link in path]
        close = held or difflib.get_close_matches(parts[-1], self.links, n=2)
        hint = f" (did you mean {' or '.join(close)}?)" if close else ""
        raise SensorError(
            f"{where}: no part of the Parent {path!r} names a link{hint}; map a part "
            "of it or all of it with link_map (--link-map)",
            self.known(),
        )

    def default(self, where: str, name: str = "") -> str:
        """The user's link for sensors whose link the file does not name.

        Args:
            where: File and line.
            name: What the file calls the skin, which the user's map may hold.
        """
        if name in self._link_map:
            return self.found.setdefault(name, str(self.match(name)))
        if self._parent is not None:
            self._needs_parent = True
            return self._parent
        raise SensorError(
            f"{where}: the file does not say on which link its sensors sit; give it "
            f"as parent (--parent){did_you_mean(name, self.links)}",
            self.known(),
        )

    def check_parent(self) -> None:
        """Raise ValueError if the user gave a parent and no sensor has use for it."""
        if self._parent is not None and not self._needs_parent:
            found = ", ".join(sorted(set(self.found.values())))
            raise ValueError(
                "parent decides nothing, for what is read tells the links itself "
                f"({found}); leave it out, or use link_map (--link-map)"
            )


def number(text: str, where: str, what: str) -> float:
    """A finite number, or an error that says where it should have been."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SensorError(f"{where}: {what} must be a finite number, got {text!r}")
    return value


def read_radius(text: str, where: str) -> float:
    """Radius in the file's unit; NaN for what the exporter writes without one."""
    if text in ("", "REPLACE_ME"):
        return math.nan
    value = number(text, where, "the radius")
    if value < 0:
        raise SensorError(f"{where}: the radius must not be negative, got {text}")
    return math.nan if value in (0.0, NO_RADIUS) else value
