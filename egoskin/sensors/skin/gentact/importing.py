"""Import of GenTact exports as skins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egoskin.robots.config import Primitive
from egoskin.robots.surface import distance_to
from egoskin.sensors.skin.gentact.description import Xml, read_description
from egoskin.sensors.skin.gentact.source import (
    NO_RADIUS,
    Export,
    Links,
    Problems,
    Sensor,
    SensorError,
)
from egoskin.sensors.skin.gentact.table import read_table
from egoskin.sensors.skin.skin import FARTHEST, Skin
from egoskin.storage.files import read_regular

# Largest file [bytes]: 100,000 sensors.
_LARGEST = 16 * 2**20
# Deviation of a normal's length from 1: accepted up to the first, normalised up to the
# second, else an error.
_UNIT, _ALMOST_UNIT = 1e-5, 0.05
# If all sensors are nearer to their links' origins than this [m], the unit is wrong.
_NEAREST = 0.002
# Plausible radii [m]; outside, the unit is wrong.
_SMALLEST, _LARGEST_RADIUS = 1e-4, 0.5
# Step of the numerical gradient [m], and its smallest valid length: below, the outward
# direction is not unique. (The length is 1, or 1/sqrt(2) on an edge.)
_STEP, _SHORTEST = 1e-6, 0.5
# A smaller roll than this [deg] is rounding of the file.
_NO_ROLL = 0.1


def load_gentact(
    path: Path | str | Sequence[Path | str],
    *,
    robot_name: str,
    links: Sequence[str],
    primitives: Sequence[Primitive] = (),
    scale: float | None = None,
    link_map: Mapping[str, str] | None = None,
    parent: str | None = None,
    skip_invalid: bool = False,
) -> Skin:
    """Return the skin described by one or several files exported from GenTact.

    A radius of 0.1 m, 0 or none is unknown: NaN. If a file has no normals, those of the
    nearest primitive on the same link are used. A xacro or URDF frame that is rotated
    about its normal gives the sensor a roll.

    Args:
        path: CSV of any dialect, xacro, or URDF with the xacro expanded; the sensors of
            several files are concatenated.
        robot_name: Name of the robot, for the skin.
        links: Links of the robot.
        primitives: The robot's shapes, usually `RobotConfig.known_primitives`, for
            files without normals and for the distance of the sensors from the surface
            in the provenance.
        scale: Unit of the positions [m], and of the radii except in newer 3-D print
            exports, whose radii are in metres. None: the unit given in brackets in the
            header, or that of the dialect.
        link_map: Link of the robot by a component of the Parent path, the whole path,
            a link of the URDF, or the name of the xacro macro; takes precedence over
            the names themselves. Unused entries are listed in the provenance.
        parent: Link of the sensors in files that do not name any.
        skip_invalid: Leave out invalid or ambiguous sensors and list them in the
            provenance. Otherwise they raise an error that lists all of them.

    Raises:
        ValueError: If a file is invalid or ambiguous; the text gives the place in the
            file, the expected and actual value and the remedy.
        OSError: If a file does not exist.
    """
    paths = [Path(p) for p in ([path] if isinstance(path, (str, Path)) else path)]
    if not paths:
        raise ValueError("load_gentact needs at least one file")
    if scale is not None and not (scale > 0 and math.isfinite(scale)):
        raise ValueError(f"scale must be positive and finite, got {scale}")
    names = Links(robot_name, links, link_map or {}, parent)
    problems = Problems()
    parts = [_load(p, names, primitives, scale, problems) for p in paths]
    if not skip_invalid:
        problems.raise_all()
    names.check_parent()
    skins = [skin for skin in parts if skin is not None]
    if not skins:
        raise ValueError(
            f"no sensor can be read; first error: {problems.found[0]}"
            if problems.found
            else f"{paths[0]}: no sensors found"
        )
    provenance = dict(skins[0].provenance)
    if len(paths) > 1:
        provenance = {"source": "GenTact", "files": [s.provenance for s in skins]}
    if names.unused:
        provenance["unused_link_map"] = list(names.unused)
    if problems.found:
        provenance["left_out"] = [error.what for error in problems.found]
    return Skin(
        robot=robot_name,
        links=tuple(link for skin in skins for link in skin.links),
        position=np.concatenate([s.position for s in skins]),
        normal=np.concatenate([s.normal for s in skins]),
        roll_deg=np.concatenate([s.roll_deg for s in skins]),
        radius=np.concatenate([s.radius for s in skins]),
        provenance=provenance,
    )


def _load(
    path: Path,
    names: Links,
    primitives: Sequence[Primitive],
    scale: float | None,
    problems: Problems,
) -> Skin | None:
    """Return the skin of one file; None if all its sensors are invalid."""
    try:
        text = read_regular(path, _LARGEST).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 text ({error}); save as UTF-8") from None
    names.found = {}
    if text.lstrip().startswith("<"):
        export = read_description(Xml(text, path), names, problems)
    else:
        export = read_table(text, path, names, problems)
    unit = _metres_per_unit(path, export, scale)
    first: dict[str, str] = {}
    sensors = []
    for sensor in export.sensors:
        with problems.collect():
            _check_new(sensor, first)
            _check_near(sensor, unit)
            sensors.append(sensor)
    position = unit * np.array([s.position for s in sensors]).reshape(-1, 3)
    outward, distance = _outward(sensors, position, primitives)
    kept, normals, radii = [], [], []
    num_normalised = 0
    for i, sensor in enumerate(sensors):
        with problems.collect():
            radius = _radius(sensor, export.radius_unit or unit)
            normal, was_changed = _normal(sensor, outward[i])
            kept.append(i)
            normals.append(normal)
            radii.append(radius)
            num_normalised += was_changed
    if not kept:
        return None
    sensors, distance = [sensors[i] for i in kept], distance[kept]
    source = "the file's"
    if any(s.normal is None for s in sensors):
        source = "those of the robot's primitives: the file has none"
    elif num_normalised:
        source += f"; {num_normalised} made unit vectors"
    provenance: dict[str, Any] = {
        "source": "GenTact",
        "file": path.name,
        "dialect": export.dialect,
        "metres_per_unit": unit,
        "normals": source,
        "radius_unknown": int(np.isnan(radii).sum()),
        "skipped": export.skipped,
        "parents": names.found,
    }
    # On links without primitives it is unknown.
    known = distance[np.isfinite(distance)]
    if len(known):
        extent = (known.min(), known.max())
        provenance["distance_to_primitives"] = [round(float(d), 4) for d in extent]
    skin = Skin(
        robot=names.robot_name,
        links=tuple(s.link for s in sensors),
        position=position[kept],
        normal=np.array(normals),
        radius=np.array(radii),
        provenance=provenance,
    )
    return replace(skin, roll_deg=_roll_deg(skin, sensors))


def _check_new(sensor: Sensor, first: dict[str, str]) -> None:
    """Raise SensorError if the sensor's name is a duplicate, else record it."""
    if sensor.name in first:
        raise SensorError(
            f"{sensor.where}: duplicate sensor {sensor.name!r} (first: "
            f"{first[sensor.name]}); give each sensor its own number"
        )
    first[sensor.name] = sensor.where


def _metres_per_unit(path: Path, export: Export, scale: float | None) -> float:
    """Return the unit of the file [m]; raise ValueError if it is unknown or wrong."""
    if export.unit_is_given and scale not in (None, export.unit):
        raise ValueError(
            f"{path}: the header gives a unit of {export.unit:g} m, but scale is "
            f"{scale:g}; leave out one of the two (--scale)"
        )
    unit = export.unit if scale is None else scale
    if unit is None:
        raise ValueError(
            f"{path}: the unit of this old 3-D print export is unknown; "
            "give scale (--scale 0.001 for millimetres, --scale 1 for metres)"
        )
    if scale is None and unit != 1.0 and export.sensors:
        length = [unit * math.hypot(*s.position) for s in export.sensors]
        worst = int(np.argmax(length))
        if length[worst] < _NEAREST:
            raise _wrong_unit(export.sensors[worst], length[worst], unit)
    return unit


def _wrong_unit(sensor: Sensor, length: float, unit: float) -> SensorError:
    """Return the error for a sensor at an implausible distance from its link."""
    return SensorError(
        f"{sensor.where}: the sensor lies {length:.3g} m from the origin of its link "
        f"if the unit of the file is {unit:g} m",
        "give the correct unit as scale (--scale 0.001 for millimetres, --scale 1 for "
        "metres)",
    )


def _check_near(sensor: Sensor, unit: float) -> None:
    """Raise SensorError if a sensor is implausibly far from its link's origin."""
    length = unit * math.hypot(*sensor.position)
    if length > FARTHEST:
        raise _wrong_unit(sensor, length, unit)


def _radius(sensor: Sensor, unit: float) -> float:
    """Return the radius [m], NaN if unknown."""
    radius = unit * sensor.radius
    if math.isclose(radius, NO_RADIUS):
        return math.nan
    if not (math.isnan(radius) or _SMALLEST <= radius <= _LARGEST_RADIUS):
        raise SensorError(
            f"{sensor.where}: the radius is {radius:.3g} m if its unit is {unit:g} m",
            "give its unit in the header of the table, as in 'Radius [mm]', or the "
            "correct scale (--scale)",
        )
    return radius


def _outward(
    sensors: Sequence[Sensor], position: np.ndarray, primitives: Sequence[Primitive]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of the distance to the link's primitives, and the distance.

    Returns:
        ``[S, 3]`` and ``[S]`` [m]; NaN on a link without primitives.
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


def _normal(sensor: Sensor, outward: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the unit normal ``[3]``, and whether the file's had to be normalised."""
    if sensor.normal is None:
        length = float(np.linalg.norm(outward))
        if not length >= _SHORTEST:
            why = (
                f"{sensor.link} has no primitive shape to compute one"
                if math.isnan(length)
                else f"the nearest surface point of {sensor.link} is not unique"
            )
            raise SensorError(
                f"{sensor.where}: the file has no normals and {why}",
                "export with normals (the current CSV)",
            )
        return outward / length, False
    length = math.hypot(*sensor.normal)
    if not abs(length - 1) <= _ALMOST_UNIT:
        raise SensorError(
            f"{sensor.where}: the normal must have length 1, got {length:.4g}"
        )
    # A unit vector up to rounding of the file is kept as written.
    if abs(length - 1) <= _UNIT:
        return sensor.normal, False
    return sensor.normal / length, True


def _roll_deg(skin: Skin, sensors: Sequence[Sensor]) -> np.ndarray:
    """Return the roll from the skin's frames to the file's [deg], ``[S]``."""
    roll = np.zeros(len(skin))
    for i, (frame, sensor) in enumerate(zip(skin.rotation(), sensors, strict=True)):
        if sensor.x_axis is not None:
            x, y = frame[:, 0] @ sensor.x_axis, frame[:, 1] @ sensor.x_axis
            roll[i] = round(math.degrees(math.atan2(y, x)), 3)
    return np.where(np.abs(roll) < _NO_ROLL, 0.0, roll)
