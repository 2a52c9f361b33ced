"""A skin: the poses of the sensors on the links of a robot, and its file.

The file is JSON made to be read and edited by people: units and conventions stand at
the top, one sensor on each line.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

_FORMAT = "egoskin-skin-1"
_CONVENTIONS = {
    "position": "metres, in the frame of the link",
    "normal": "unit vector out of the surface, in the frame of the link",
    "sensor_frame": "z = normal, x = normalise(z_link x normal), or x_link if those "
    "two are parallel",
}
# Unit normals must be unit to this.
_UNIT_TOLERANCE = 1e-3


def _is_vector(value: object) -> bool:
    """Whether a JSON value is a list of three numbers."""
    return (
        isinstance(value, Sequence)
        and len(value) == 3
        and all(type(v) in (int, float) for v in value)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """Sensors on a robot.

    Raises:
        ValueError: If the arrays disagree in length, hold values that are not finite
            or normals that are not unit vectors.
    """

    robot: str
    """Name of the robot."""
    links: tuple[str, ...]
    """Link of each sensor, ``S`` names."""
    position: np.ndarray
    """Positions in the link frames [m], ``[S, 3]``."""
    normal: np.ndarray
    """Outward unit normals in the link frames, ``[S, 3]``."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """How the skin was made, for the reader of the file."""

    def __post_init__(self) -> None:
        """Check shapes and values."""
        shape = (len(self.links), 3)
        for name in ("position", "normal"):
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
        if not self.links:
            raise ValueError("a skin needs at least one sensor")
        length = np.linalg.norm(self.normal, axis=-1)
        if (np.abs(length - 1) > _UNIT_TOLERANCE).any():
            worst = int(np.abs(length - 1).argmax())
            raise ValueError(
                f"normal of sensor {worst} has length {length[worst]:.4f}, not 1"
            )

    def __len__(self) -> int:
        """Number of sensors ``S``."""
        return len(self.links)

    def check_links(self, known: Sequence[str]) -> None:
        """Raise ValueError if a sensor sits on a link the robot does not have."""
        for index, name in enumerate(self.links):
            if name not in known:
                close = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else "."
                raise ValueError(
                    f"sensor {index} sits on {name!r}, which {self.robot} does not "
                    f"have{hint} Its links are {', '.join(known)}"
                )

    def rotation(self) -> np.ndarray:
        """Sensor frames in the link frames: columns x, y, z, ``[S, 3, 3]``."""
        z = self.normal
        # x = normalise(z_link x n); parallel to z_link: x_link.
        x = np.cross([0.0, 0.0, 1.0], z)
        length = np.linalg.norm(x, axis=-1, keepdims=True)
        x = np.where(length > 1e-6, x / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
        # A normal a hair off z_link leaves x_link not quite perpendicular.
        x = x - (x * z).sum(-1, keepdims=True) * z
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        return np.stack((x, np.cross(z, x), z), axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Return the skin as plain JSON values."""
        return {
            "format": _FORMAT,
            "robot": self.robot,
            "conventions": _CONVENTIONS,
            "provenance": dict(self.provenance),
            "sensors": [
                {
                    "link": link,
                    "position": [round(float(v), 6) for v in position],
                    "normal": [round(float(v), 6) for v in normal],
                }
                for link, position, normal in zip(
                    self.links, self.position, self.normal, strict=True
                )
            ],
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Skin:
        """Return the skin that `to_dict` described.

        Raises:
            ValueError: If the content is not such a description; the text names the
                sensor and the field.
        """
        if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
            got = content.get("format") if isinstance(content, Mapping) else content
            raise ValueError(f"not a skin: 'format' must be {_FORMAT!r}, got {got!r}")
        for name in ("robot", "sensors"):
            if name not in content:
                raise ValueError(f"a skin needs the field {name!r}")
        for index, sensor in enumerate(content["sensors"]):
            for name in ("link", "position", "normal"):
                if name not in sensor:
                    raise ValueError(f"sensor {index} lacks the field {name!r}")
            for name in ("position", "normal"):
                if not _is_vector(sensor[name]):
                    raise ValueError(
                        f"sensor {index}: {name!r} must be three numbers, got "
                        f"{sensor[name]!r}"
                    )
        sensors = content["sensors"]
        return cls(
            robot=content["robot"],
            links=tuple(s["link"] for s in sensors),
            position=np.array([s["position"] for s in sensors], float).reshape(-1, 3),
            normal=np.array([s["normal"] for s in sensors], float).reshape(-1, 3),
            provenance=content.get("provenance", {}),
        )

    def save(self, path: Path) -> None:
        """Write the skin to a JSON file, one sensor on each line."""
        content = self.to_dict()
        sensors = content.pop("sensors")
        head = json.dumps(content, indent=2)[:-2]
        lines = ",\n".join(f"    {json.dumps(sensor)}" for sensor in sensors)
        Path(path).write_text(f'{head},\n  "sensors": [\n{lines}\n  ]\n}}\n')

    @classmethod
    def load(cls, path: Path) -> Skin:
        """Return the skin of a file.

        Raises:
            ValueError: If the file is missing, no JSON, or no skin; the text names it.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_text()))
        except (OSError, ValueError) as error:
            raise ValueError(f"skin file {path}: {error}") from error
