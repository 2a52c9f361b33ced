"""Common representation of the sensors in GenTact's files, for all dialects."""

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
"""Radius that GenTact writes for a sensor without one [m]."""
# Names below a link in GenTact's paths, from Isaac Sim's URDF importer.
_BELOW_LINK = re.compile(r"(visuals|collisions|geometry)([._]?\d+)?")


# Number of invalid sensors after which reading stops, and number listed in the error.
_MOST_INVALID, _SHOWN = 1000, 100


class SensorError(ValueError):
    """A sensor is invalid or ambiguous.

    Args:
        what: Place in the file, expected and actual value.
        remedy: How to fix it; the same text for all sensors with the same problem.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what}; {remedy}" if remedy else what)
        self.what, self.remedy = what, remedy


class Problems:
    """Collects the errors of invalid sensors, to report all of them at once."""

    def __init__(self) -> None:
        self.found: list[SensorError] = []

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Record a SensorError raised in the block, and continue after it.

        Raises:
            ValueError: If there are too many.
        """
        try:
            yield
        except SensorError as error:
            self.found.append(error)
            if len(self.found) > _MOST_INVALID:
                raise ValueError(
                    f"more than {_MOST_INVALID:,} sensors cannot be read; first error: "
                    f"{self.found[0]}"
                ) from None

    def raise_all(self) -> None:
        """Raise ValueError if any sensor was invalid."""
        if len(self.found) == 1:
            raise ValueError(
                f"{self.found[0]}; or leave it out with skip_invalid (--skip-invalid)"
            )
        if self.found:
            remedies = dict.fromkeys(e.remedy for e in self.found if e.remedy)
            rest = len(self.found) - _SHOWN
            lines = [
                f"{len(self.found)} sensors cannot be read; fix them, or leave them "
                "out with skip_invalid (--skip-invalid):",
                *(f"  {error.what}" for error in self.found[:_SHOWN]),
                *([f"  and {rest} more"] if rest > 0 else []),
                *remedies,
            ]
            raise ValueError("\n".join(lines))


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """One sensor as given in the file."""

    where: str
    name: str
    link: str
    # In the frame of the link, in the unit of the file.
    position: np.ndarray
    normal: np.ndarray | None
    # x axis of the sensor's frame; None if not in the file.
    x_axis: np.ndarray | None = None
    radius: float = math.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """The sensors of a file, and properties of its dialect."""

    dialect: str
    sensors: list[Sensor]
    # Unit of the positions [m]; None if unknown.
    unit: float | None = 1.0
    # Whether the header states that unit.
    unit_is_given: bool = False
    # Unit of the radii [m]; None if it is that of the positions.
    radius_unit: float | None = None
    # Number of skipped entries, which are not proximity sensors, by kind.
    skipped: dict[str, int] = field(default_factory=dict)


class Links:
    """Mapping from names and paths in the file to links of the robot.

    Args:
        robot_name: Name of the robot, for error texts.
        links: Links of the robot.
        link_map: User's map from a name, a component of a path or a whole path to a
            link.
        parent: User's link for sensors whose link is not in the file.

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
        """Names in the user's map that have not been used yet, in order."""
        self._needs_parent = False
        for target in (*link_map.values(), *(() if parent is None else (parent,))):
            if target not in self.links:
                hint = did_you_mean(target, self.links)
                raise ValueError(f"no link {target!r}{hint}; {self.known()}")

    def known(self) -> str:
        """List of the robot's links, for the end of an error text."""
        return f"the links of {self.robot_name} are {', '.join(self.links)}"

    def match(self, name: str) -> str | None:
        """Return the link for a name from the user's map or of that name, else None."""
        if name in self._link_map:
            self.unused.pop(name, None)
            return self._link_map[name]
        return name if name in self.links else None

    def of_path(self, path: str, where: str) -> str:
        """Return the link of a Parent path.

        Raises:
            SensorError: If no component of the path is a link, or it is ambiguous.
        """
        if path in self._link_map:
            return self.found.setdefault(path, str(self.match(path)))
        parts = path.strip("/").split("/")
        for last in range(len(parts) - 1, -1, -1):
            # Blender numbers objects of the same name: visuals.004.
            plain = re.sub(r"\.\d{3,}$", "", parts[last])
            link = self.match(parts[last]) or self.match(plain)
            if link is None:
                continue
            # GenTact sometimes puts the names of several siblings with sensors into one
            # path by mistake, and a path may continue to a link this robot lacks.
            rest = [p for p in parts[last + 1 :] if not _BELOW_LINK.fullmatch(p)]
            if rest:
                raise SensorError(
                    f"{where}: {'/'.join(rest)!r} of the Parent {path!r} may be a part "
                    f"of {parts[last]!r}, or a link that {self.robot_name} lacks; set "
                    f"its link with link_map (--link-map {rest[-1]}=...)",
                    self.known(),
                )
            return self.found.setdefault(path, link)
        held = [link for link in self.links if link in path]
        close = held or difflib.get_close_matches(parts[-1], self.links, n=2)
        hint = f" (did you mean {' or '.join(close)}?)" if close else ""
        raise SensorError(
            f"{where}: no part of the Parent {path!r} names a link{hint}; map a part "
            "or all of it with link_map (--link-map)",
            self.known(),
        )

    def default(self, where: str, name: str = "") -> str:
        """Return the user's link for sensors whose link is not in the file.

        Args:
            where: File and line.
            name: Name of the skin in the file, which the user's map may contain.

        Raises:
            SensorError: If the user gave none.
        """
        if name in self._link_map:
            return self.found.setdefault(name, str(self.match(name)))
        if self._parent is not None:
            self._needs_parent = True
            return self._parent
        raise SensorError(
            f"{where}: the file does not name the link of its sensors; give it as "
            f"parent (--parent){did_you_mean(name, self.links)}",
            self.known(),
        )

    def check_parent(self) -> None:
        """Raise ValueError if the user gave a parent that no sensor needs."""
        if self._parent is not None and not self._needs_parent:
            found = ", ".join(sorted(set(self.found.values())))
            raise ValueError(
                "parent has no effect: the files name the links themselves "
                f"({found}); leave it out, or use link_map (--link-map)"
            )


def number(text: str, where: str, what: str) -> float:
    """Return a finite number, or raise a SensorError with its place in the file."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SensorError(f"{where}: {what} must be a finite number, got {text!r}")
    return value


def read_radius(text: str, where: str) -> float:
    """Return the radius in the file's unit; NaN for the exporter's placeholders."""
    if text in ("", "REPLACE_ME"):
        return math.nan
    value = number(text, where, "the radius")
    if value < 0:
        raise SensorError(f"{where}: the radius must not be negative, got {text}")
    return math.nan if value in (0.0, NO_RADIUS) else value
