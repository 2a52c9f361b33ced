"""Import of GenTact's exports as skins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egoskin.robots import Primitive
from egoskin.sensors.gentact.description import Xml, read_description
from egoskin.sensors.gentact.source import Export, Links, Sensor
from egoskin.sensors.gentact.table import read_table
from egoskin.sensors.skin import FARTHEST, Skin
from egoskin.surface import distance_to

# Lengths of normals: read as they are; normalised; else refused.
_UNIT, _ALMOST_UNIT = 1e-5, 0.05
# Nearer to their links' origins [m] not all sensors of a skin sit: the unit is another.
_NEAREST = 0.002
# Step of the numerical gradient [m]; where it is shorter than this there is no one
# outward direction (it is 1, or 1/sqrt(2) on an edge).
_STEP, _SHORTEST = 1e-6, 0.5
# Less roll than this [deg] is the rounding of the file.
_NO_ROLL = 0.1


def load_gentact(
    path: Path | str,
    *,
    robot_name: str,
    links: Sequence[str],
    primitives: Sequence[Primitive] = (),
    scale: float | None = None,
    link_map: Mapping[str, str] | None = None,
    parent: str | None = None,
) -> Skin:
    """Return the skin that a file exported from GenTact describes.

    A radius of 0.1 m, 0 or none is unknown: NaN. Normals of a file without any are
    those of the robot's nearest primitive on the same link. A xacro or URDF frame
    that is turned about its normal gives the sensor a roll.

    Args:
        path: CSV of any dialect, xacro, or URDF into which the xacro was expanded.
        robot_name: Name of the robot, for the skin.
        links: Links of the robot.
        primitives: The robot's shapes, for files without normals and for the distance
            of the sensors from the surface, which the provenance tells.
        scale: Metres of one unit of the file's positions (and radii, but for the 3-D
            print export, whose radii are in metres); None: that of the dialect.
        link_map: Link of the robot by a component of the Parent path, the whole path,
            or a link of the URDF; goes before the names themselves.
        parent: Link of the sensors in a file that names none.

    Raises:
        ValueError: If the file cannot be read for certain; the text says where in it,
            what was expected, what came and what to do.
        OSError: If there is no such file.
    """
    path = Path(path)
    if scale is not None and not (scale > 0 and math.isfinite(scale)):
        raise ValueError(f"scale must be positive and finite, got {scale}")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 text ({error}); save it as such") from None
    names = Links(robot_name, links, link_map or {}, parent)
    if text.lstrip().startswith("<"):
        export = read_description(Xml(text, path), names)
    else:
        export = read_table(text, path, names)
    names.check_used(path)
    sensors = export.sensors
    _check_unique(sensors)
    position, unit = _metres(path, export, scale)
    outward, distance = _outward(sensors, position, primitives)
    normal, source = _normals(sensors, outward)
    radius = np.array([s.radius for s in sensors])
    provenance: dict[str, Any] = {
        "method": "gentact",
        "file": path.name,
        "dialect": export.dialect,
        "metres_per_unit": unit,
        "normals": source,
        "radius_unknown": int(np.isnan(radius).sum()),
        "skipped": export.skipped,
        "parents": names.found,
    }
    if np.isfinite(distance).all():
        extent = (distance.min(), distance.max())
        provenance["distance_to_primitives"] = [round(float(d), 4) for d in extent]
    skin = Skin(
        robot=robot_name,
        links=tuple(s.link for s in sensors),
        position=position,
        normal=normal,
        radius=radius * (unit if export.scales_radius else 1.0),
        provenance=provenance,
    )
    return replace(skin, roll_deg=_roll_deg(skin, sensors))


def _check_unique(sensors: Sequence[Sensor]) -> None:
    """Raise ValueError if two sensors have one name."""
    first: dict[str, str] = {}
    for sensor in sensors:
        if sensor.name in first:
            raise ValueError(
                f"{sensor.where}: {sensor.name!r} is there already "
                f"({first[sensor.name]}); give each sensor a number of its own"
            )
        first[sensor.name] = sensor.where


def _metres(
    path: Path, export: Export, scale: float | None
) -> tuple[np.ndarray, float]:
    """Positions [m], ``[S, 3]``, and metres of one unit; ValueError if doubtful."""
    unit = export.unit if scale is None else scale
    if unit is None:
        raise ValueError(
            f"{path}: a 3-D print export of an old version, whose unit is unknown; "
            "give scale (--scale 0.001 for millimetres, --scale 1 for metres)"
        )
    position = unit * np.array([s.position for s in export.sensors])
    length = np.linalg.norm(position, axis=-1)
    worst = int(length.argmax())
    if length[worst] > FARTHEST or (
        scale is None and unit != 1.0 and length[worst] < _NEAREST
    ):
        raise ValueError(
            f"{export.sensors[worst].where}: the sensor lies {length[worst]:.3g} m "
            f"from the origin of its link with {unit:g} m to the unit of the file; "
            "give the right one as scale (--scale 0.001 for millimetres, --scale 1 "
            "for metres)"
        )
    return position, unit


def _outward(
    sensors: Sequence[Sensor], position: np.ndarray, primitives: Sequence[Primitive]
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of the distance to the link's primitives, and that distance [m].

    Returns:
        ``[S, 3]`` and ``[S]``; NaN on a link without primitives.
    """
    gradient, distance = np.full_like(position, np.nan), np.full(len(sensors), np.nan)
    for link in {s.link for s in sensors}:
        shapes = [shape for shape in primitives if shape.link == link]
        if not shapes:
            continue
        here = np.array([s.link == link for s in sensors])
        points = position[here]
        # Union of shapes; central differences.
        offsets = _STEP * np.vstack((np.zeros(3), np.eye(3), -np.eye(3)))
        values = np.stack(
            [np.min([distance_to(s, points + d) for s in shapes], 0) for d in offsets]
        )
        distance[here] = values[0]
        gradient[here] = (values[1:4] - values[4:]).T / (2 * _STEP)
    return gradient, distance


def _normals(sensors: Sequence[Sensor], outward: np.ndarray) -> tuple[np.ndarray, str]:
    """Unit normals ``[S, 3]`` and where they come from."""
    normals = np.empty_like(outward)
    num_normalised = 0
    for i, sensor in enumerate(sensors):
        given = outward[i] if sensor.normal is None else sensor.normal
        length = float(np.linalg.norm(given))
        if sensor.normal is not None and not abs(length - 1) <= _ALMOST_UNIT:
            raise ValueError(
                f"{sensor.where}: the normal must have length 1, got {length:.4g}"
            )
        if sensor.normal is None and not length >= _SHORTEST:
            why = (
                f"{sensor.link} has no shape to take it from"
                if math.isnan(length)
                else f"the surface of {sensor.link} is equally near all around"
            )
            raise ValueError(
                f"{sensor.where}: the file has no normals and {why}; export with "
                "normals (the current CSV)"
            )
        # Up to its own digits a unit vector stays as written.
        is_unit = sensor.normal is not None and abs(length - 1) <= _UNIT
        normals[i] = given if is_unit else given / length
        num_normalised += sensor.normal is not None and not is_unit
    if any(s.normal is None for s in sensors):
        return normals, "those of the robot's primitives: the file has none"
    if num_normalised:
        return normals, f"the file's; {num_normalised} made unit vectors"
    return normals, "the file's"


def _roll_deg(skin: Skin, sensors: Sequence[Sensor]) -> np.ndarray:
    """Turn about the normal from the skin's frames to the file's [deg], ``[S]``."""
    roll = np.zeros(len(skin))
    for i, (frame, sensor) in enumerate(zip(skin.rotation(), sensors, strict=True)):
        if sensor.x_axis is not None:
            x, y = frame[:, 0] @ sensor.x_axis, frame[:, 1] @ sensor.x_axis
            roll[i] = round(math.degrees(math.atan2(y, x)), 3)
    return np.where(np.abs(roll) < _NO_ROLL, 0.0, roll)
