"""A skin: the poses of the sensors on the links of a robot, and its file format.

The file is human-readable JSON that can be edited by hand: units and conventions at the
top, one sensor per line.
"""

from __future__ import annotations

import itertools
import json
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from egoskin.bounds import is_number
from egoskin.hints import did_you_mean
from egoskin.sensors.skin.coverage import KINDS, Coverage, Ray
from egoskin.storage.files import read_regular, write_file

_FORMAT = "egoskin-skin-1"
_CONVENTIONS = {
    "position": "metres, in the frame of the link",
    "normal": "unit vector out of the surface, in the frame of the link",
    "sensor_frame": "z = normal, x = normalise(z_link x normal), or x_link if those "
    "two are parallel; then turned by roll_deg about z",
    "range": "metres; sensors without range or type take those of the configuration",
    "radius": "metres, of the sensor itself",
}
_FIELDS = ("format", "robot", "conventions", "provenance", "types", "sensors")
_OPTIONAL = ("range", "roll_deg", "radius", "type")
# Former fields of types in older files, and the only value still supported for each.
_DROPPED: dict[str, dict[str, Any]] = {
    "field": {"measure": "surface"},
    "ray": {"fov": "diagonal", "beams": "centres", "sub_beams": 1},
}
# Tolerance of the length of unit normals.
_UNIT_TOLERANCE = 1e-3
FARTHEST = 2.0
"""Largest distance of a sensor from its link's origin [m]; beyond, units are wrong."""


Indices = Sequence[int] | Sequence[bool] | np.ndarray | Tensor
"""Indices of sensors, or one flag for each sensor."""


def indices(sensors: Indices, number: int | None = None) -> list[int]:
    """Return the indices of some sensors, given as such or as flags ``[S]`` bool.

    Args:
        sensors: Indices, or one flag for each sensor.
        number: Number of sensors ``S``, if known.

    Raises:
        ValueError: If there are flags, but not one for each sensor, or an index of no
            sensor.
    """
    array = np.asarray(sensors)
    if array.size and array.dtype.kind not in "biu":
        raise ValueError(f"sensors must be indices or flags, got {sensors!r}")
    if array.dtype == bool:
        if array.ndim != 1 or number not in (None, len(array)):
            raise ValueError(
                f"flags of sensors must be ({number},), one for each, got {array.shape}"
            )
        array = np.flatnonzero(array)
    result = [operator.index(i) for i in array.tolist()]
    for index in result:
        if number is not None and not -number <= index < number:
            raise ValueError(f"no sensor {index}: there are {number}")
    return result


def _is_vector(value: object) -> bool:
    """Whether a JSON value is a list of three numbers."""
    return (
        isinstance(value, Sequence) and len(value) == 3 and all(map(is_number, value))
    )


def _coverage(name: str, entry: object) -> Coverage:
    """Return the coverage described by a type of a skin file."""
    if not isinstance(entry, Mapping):
        raise ValueError(f"type {name!r} must be an object, got {entry!r}")
    values = dict(entry)
    kind = values.pop("coverage", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(
            f"type {name!r}: 'coverage' must be one of {', '.join(KINDS)}, got {kind!r}"
        )
    default = KINDS[kind]()
    known = [f.name for f in fields(default)]
    for field_name, only in _DROPPED.get(kind, {}).items():
        value = values.pop(field_name, only)
        if value != only:
            raise ValueError(
                f"type {name!r}: {field_name!r} was removed; only {only!r} is "
                f"supported, got {value!r}"
            )
    for field_name, value in values.items():
        _check_known(f"type {name!r}", field_name, known)
        if isinstance(value, list):
            values[field_name] = value = tuple(value)
        wanted = type(getattr(default, field_name))
        if type(value) not in ((float, int) if wanted is float else (wanted,)):
            raise ValueError(
                f"type {name!r}: {field_name!r} must be like "
                f"{json.dumps(getattr(default, field_name))}, got {entry[field_name]!r}"
            )
    try:
        return KINDS[kind](**values)
    except ValueError as error:
        raise ValueError(f"type {name!r}: {error}") from error


def _check_known(where: str, name: str, known: Sequence[str]) -> None:
    """Raise ValueError for an unknown field of a skin file."""
    if name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(f"{where}: unknown field {name!r}{hint}")


def _check_sensor(index: int, sensor: object, types: Mapping[str, Coverage]) -> None:
    """Raise ValueError for an entry that is not a valid sensor."""
    where = f"sensor {index}"
    if not isinstance(sensor, Mapping):
        raise ValueError(f"{where} must be an object, got {sensor!r}")
    required = ("link", "position", "normal")
    for name in required:
        if name not in sensor:
            raise ValueError(f"{where} lacks the field {name!r}")
    for name in sensor:
        _check_known(where, name, (*required, *_OPTIONAL))
    if not isinstance(sensor["link"], str):
        raise ValueError(f"{where}: 'link' must be a name, got {sensor['link']!r}")
    for name in ("position", "normal"):
        if not _is_vector(sensor[name]):
            raise ValueError(
                f"{where}: {name!r} must be three numbers, got {sensor[name]!r}"
            )
    for name in ("range", "roll_deg", "radius"):
        if name == "range" and sensor.get(name) == "inf":
            continue
        if name in sensor and not is_number(sensor[name]):
            raise ValueError(
                f"{where}: {name!r} must be a number, got {sensor[name]!r}"
            )
    if "type" in sensor and sensor["type"] not in list(types):
        raise ValueError(
            f"{where}: there is no type {sensor['type']!r}; the file's types are "
            f"{', '.join(types) or 'none'}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """The ``S`` sensors on a robot.

    Args:
        robot: Name of the robot.
        links: Link of each sensor, ``S`` names.
        position: Positions in the link frames [m], ``[S, 3]``.
        normal: Outward unit normals in the link frames, ``[S, 3]``; not renormalised.
        coverage: Coverage of each sensor, ``S`` entries; None is filled in from the
            configuration.
        range: Range of each sensor [m], ``[S]``; NaN is filled in from the
            configuration.
        roll_deg: Rotation of each sensor frame about its normal [deg], ``[S]``; 0 by
            default.
        radius: Physical radius of each sensor [m], ``[S]``; NaN if unknown.
        types: Names of coverages for the skin file; unnamed ones get a number.
        provenance: How the skin was made, for readers of the skin file.

    Raises:
        ValueError: If the arrays differ in length, positions, normals or rolls are not
            finite, a position is more than `FARTHEST` from its link's origin, ranges
            or radii are not positive, a radius is infinite, normals are not unit
            vectors, or a coverage is none.
    """

    robot: str
    links: tuple[str, ...]
    position: np.ndarray
    normal: np.ndarray
    coverage: tuple[Coverage | None, ...] = ()
    range: np.ndarray = field(default_factory=lambda: np.empty(0))
    roll_deg: np.ndarray = field(default_factory=lambda: np.empty(0))
    radius: np.ndarray = field(default_factory=lambda: np.empty(0))
    types: Mapping[str, Coverage] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in defaults; check shapes and values."""
        if isinstance(self.links, str):
            raise ValueError(f"links must be one name per sensor, got {self.links!r}")
        shape, number = (len(self.links), 3), len(self.links)
        for name in ("position", "normal", "range", "roll_deg", "radius"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), float))
        defaults = {"range": np.nan, "roll_deg": 0.0, "radius": np.nan}
        for name, default in defaults.items():
            array = getattr(self, name)
            if array.size == 0:
                object.__setattr__(self, name, np.full(number, default))
            elif array.shape != (number,):
                raise ValueError(f"{name} must be ({number},), got {array.shape}")
            elif name != "roll_deg" and (array <= 0).any():
                worst = int((array <= 0).argmax())
                raise ValueError(
                    f"{name} of sensor {worst} must be positive, got {array[worst]}"
                )
        if not np.isfinite(self.roll_deg).all():
            raise ValueError("roll_deg holds values that are not finite")
        if isinstance(self.coverage, Coverage) or not all(
            own is None or isinstance(own, Coverage) for own in self.coverage
        ):
            raise ValueError(
                "coverage must hold a Field, a Ray or None for each sensor, got "
                f"{self.coverage!r}"
            )
        if not self.coverage:
            object.__setattr__(self, "coverage", (None,) * number)
        elif len(self.coverage) != number:
            raise ValueError(
                f"coverage must hold {number} entries, got {len(self.coverage)}"
            )
        for name in ("position", "normal"):
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
        if np.isinf(self.radius).any():
            raise ValueError("radius holds values that are infinite")
        if not self.links:
            raise ValueError("a skin needs at least one sensor")
        away = np.linalg.norm(self.position, axis=-1)
        if (away > FARTHEST).any():
            worst = int(away.argmax())
            raise ValueError(
                f"sensor {worst} lies {away[worst]:.3g} m from the origin of its link: "
                "positions must be in metres"
            )
        length = np.linalg.norm(self.normal, axis=-1)
        if (np.abs(length - 1) > _UNIT_TOLERANCE).any():
            worst = int(np.abs(length - 1).argmax())
            raise ValueError(
                f"normal of sensor {worst} has length {length[worst]:.4f}, not 1"
            )

    def __len__(self) -> int:
        """Number of sensors ``S``."""
        return len(self.links)

    def check_robot(self, name: str, links: Sequence[str], what: str = "skin") -> None:
        """Raise ValueError unless the skin was made for a robot.

        Robots of one manufacturer can have the same link names.

        Args:
            name: Name of the robot.
            links: Its links.
            what: The skin or its file, for the error text.
        """
        if self.robot != name:
            raise ValueError(
                f"{what}: made for the robot {self.robot!r}, not {name!r}; if it fits, "
                "change its field 'robot'"
            )
        try:
            self.check_links(links)
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from error

    def check_links(self, known: Sequence[str], robot: str | None = None) -> None:
        """Raise ValueError if a sensor sits on a link the robot does not have.

        Args:
            known: Links of the robot.
            robot: Its name, for the error text; None: that of the skin's robot.
        """
        robot = robot or self.robot
        for index, name in enumerate(self.links):
            if name not in known:
                raise ValueError(
                    f"sensor {index} sits on {name!r}, which {robot} does not "
                    f"have{did_you_mean(name, known)} (links: {', '.join(known)})"
                )

    def rotation(self) -> np.ndarray:
        """Rotations of the sensor frames in the link frames, ``[S, 3, 3]``.

        The columns are the x, y and z axes. Orthonormal up to rounding, even if the
        normals have few digits.
        """
        z = self.normal / np.linalg.norm(self.normal, axis=-1, keepdims=True)
        # x = normalise(z_link x n); parallel to z_link: x_link.
        x = np.cross([0.0, 0.0, 1.0], z)
        length = np.linalg.norm(x, axis=-1, keepdims=True)
        x = np.where(length > 1e-6, x / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
        # If the normal is nearly z_link, x_link is not exactly perpendicular to it.
        x = x - (x * z).sum(-1, keepdims=True) * z
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        y = np.cross(z, x)
        roll = np.radians(self.roll_deg)[:, None]
        c, s = np.cos(roll), np.sin(roll)
        return np.stack((c * x + s * y, c * y - s * x, z), axis=-1)

    def misplaced(self, position_std: float, angle_std_deg: float, seed: int) -> Skin:
        """Return the skin with random mounting errors of every sensor.

        Args:
            position_std: Standard deviation of each coordinate [m].
            angle_std_deg: Standard deviation of the rotation about each axis [deg].
            seed: Seed of the errors.

        Raises:
            ValueError: If a deviation is negative or not finite.
        """
        error = {"position_std": position_std, "angle_std_deg": angle_std_deg}
        for name, std in error.items():
            if not 0 <= std < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {std}")
        rng = np.random.default_rng(seed)
        shift = position_std * rng.standard_normal((len(self), 3))
        turn = np.radians(angle_std_deg) * rng.standard_normal((len(self), 3))
        angle = np.linalg.norm(turn, axis=-1)[:, None, None]
        # Rodrigues: R = cos 1 + sin [k] + (1 - cos) k k^T.
        k = turn / np.maximum(angle[:, 0], 1e-300)
        cross = np.cross(k[:, None], np.eye(3)).transpose(0, 2, 1)
        whole = np.cos(angle) * np.eye(3) + np.sin(angle) * cross
        whole += (1 - np.cos(angle)) * k[:, :, None] * k[:, None]
        x, _, normal = np.moveaxis(whole @ self.rotation(), -1, 0)
        moved = replace(
            self,
            position=self.position + shift,
            normal=normal,
            roll_deg=np.zeros(len(self)),
            provenance={
                **self.provenance,
                "misplaced": {**error, "seed": seed},
            },
        )
        plain = moved.rotation()
        roll = np.arctan2((x * plain[..., 1]).sum(-1), (x * plain[..., 0]).sum(-1))
        return replace(moved, roll_deg=np.degrees(roll))

    def select(self, index: Indices) -> Skin:
        """Return a skin with some of the sensors, in the order given.

        Args:
            index: Indices of the sensors, or ``[S]`` bool.

        Raises:
            ValueError: If there are flags, but not one for each sensor, an index of no
                sensor, or none is chosen.
        """
        index = indices(index, len(self))
        arrays = ("position", "normal", "range", "roll_deg", "radius")
        return replace(
            self,
            links=tuple(self.links[i] for i in index),
            coverage=tuple(self.coverage[i] for i in index),
            **{name: getattr(self, name)[index] for name in arrays},
        )

    @property
    def is_resolved(self) -> bool:
        """Whether every sensor has a coverage and a range."""
        return None not in self.coverage and not np.isnan(self.range).any()

    def resolved(self, coverage: Coverage, max_range: float) -> Skin:
        """Return the skin with a coverage and a range for every sensor.

        Args:
            coverage: Coverage of sensors without one.
            max_range: Range of sensors without one [m].
        """
        return replace(
            self,
            coverage=tuple(c or coverage for c in self.coverage),
            range=np.where(np.isnan(self.range), max_range, self.range),
        )

    def groups(self) -> list[list[int]]:
        """Return the sensor indices of a `resolved` skin, grouped by kind.

        One transform computes a group: all field sensors, or all ray sensors with the
        same grid.
        """
        groups: dict[object, list[int]] = {}
        for index, own in enumerate(self.coverage):
            kind = own.grid if isinstance(own, Ray) else type(own)
            groups.setdefault(kind, []).append(index)
        return list(groups.values())

    def reach(self) -> np.ndarray:
        """Return the largest distance at which each sensor detects [m], ``[S]``.

        The skin must be `resolved`.

        It exceeds the range for slanted beams that measure depth.
        """
        slant = [1.0 if c is None else c.slant for c in self.coverage]
        return self.range * np.array(slant)

    def to_dict(self) -> dict[str, Any]:
        """Return the skin as plain JSON values."""
        names = {c: name for name, c in self.types.items()}
        types: dict[Coverage, str] = {}
        sensors = []
        for i, (link, coverage) in enumerate(
            zip(self.links, self.coverage, strict=True)
        ):
            entry: dict[str, Any] = {
                "link": link,
                "position": [round(float(v), 6) for v in self.position[i]],
                "normal": [round(float(v), 6) for v in self.normal[i]],
            }
            if self.roll_deg[i] != 0:
                entry["roll_deg"] = float(self.roll_deg[i])
            for name in ("range", "radius"):
                value = float(getattr(self, name)[i])
                if not np.isnan(value):
                    # JSON has no infinity.
                    entry[name] = "inf" if value == math.inf else value
            if coverage is not None:
                if coverage not in types:
                    free = (f"type_{i}" for i in itertools.count(1))
                    taken = {*types.values(), *self.types}
                    number = next(name for name in free if name not in taken)
                    types[coverage] = names.get(coverage, number)
                entry["type"] = types[coverage]
            sensors.append(entry)
        used = set(types.values())
        unused = [(c, name) for name, c in self.types.items() if name not in used]
        named = {
            name: {"coverage": type(c).__name__.lower(), **asdict(c)}
            for c, name in (*types.items(), *unused)
        }
        return {
            "format": _FORMAT,
            "robot": self.robot,
            "conventions": _CONVENTIONS,
            # It may hold a path, for example.
            "provenance": json.loads(json.dumps(dict(self.provenance), default=str)),
            **({"types": named} if named else {}),
            "sensors": sensors,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Skin:
        """Return the skin described by the result of `to_dict`.

        Raises:
            ValueError: If the content is not a valid description; the text names the
                sensor and the field.
        """
        if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
            got = content.get("format") if isinstance(content, Mapping) else content
            raise ValueError(f"not a skin: 'format' must be {_FORMAT!r}, got {got!r}")
        for name in content:
            _check_known("a skin", name, _FIELDS)
        for name in ("robot", "sensors"):
            if name not in content:
                raise ValueError(f"a skin needs the field {name!r}")
        entries, sensors = content.get("types", {}), content["sensors"]
        for name, value, kind in (
            ("robot", content["robot"], str),
            ("types", entries, Mapping),
            ("sensors", sensors, list),
            ("provenance", content.get("provenance", {}), Mapping),
        ):
            if not isinstance(value, kind):
                wanted = {str: "a name", list: "a list"}.get(kind, "an object")
                raise ValueError(f"{name!r} must be {wanted}, got {value!r}")
        types = {name: _coverage(name, entry) for name, entry in entries.items()}
        for index, sensor in enumerate(sensors):
            _check_sensor(index, sensor, types)

        def column(name: str, default: float) -> np.ndarray:
            return np.array([float(s.get(name, default)) for s in sensors])

        return cls(
            robot=content["robot"],
            links=tuple(s["link"] for s in sensors),
            position=np.array([s["position"] for s in sensors], float).reshape(-1, 3),
            normal=np.array([s["normal"] for s in sensors], float).reshape(-1, 3),
            coverage=tuple(types.get(s.get("type")) for s in sensors),
            range=column("range", np.nan),
            roll_deg=column("roll_deg", 0.0),
            radius=column("radius", np.nan),
            types=types,
            provenance=content.get("provenance", {}),
        )

    def save(self, path: Path) -> None:
        """Write the skin to a JSON file, one sensor per line.

        Raises:
            OSError: If it cannot be written; the text names the file.
        """
        content = self.to_dict()
        sensors = content.pop("sensors")
        head = json.dumps(content, indent=2)[:-2]
        lines = ",\n".join(f"    {json.dumps(sensor)}" for sensor in sensors)
        text = f'{head},\n  "sensors": [\n{lines}\n  ]\n}}\n'
        write_file(Path(path), text.encode())

    @classmethod
    def load(cls, path: Path) -> Skin:
        """Return the skin of a file.

        Raises:
            ValueError: If the file is missing, not JSON or not a skin; the text names
                the file.
        """
        try:
            return cls.from_dict(json.loads(read_regular(path)))
        except RecursionError:
            raise ValueError(f"skin file {path}: nested too deeply") from None
        except (OSError, ValueError) as error:
            raise ValueError(f"skin file {path}: {error}") from error
