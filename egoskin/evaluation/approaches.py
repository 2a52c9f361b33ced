"""Balls that approach a standing robot, and the sensors that detect them.

The robot stands still in its default pose and a ball moves along a given path. A path
ends where the ball first touches the body; positions below the floor are ignored. The
ball is *seen* from the first step at which any sensor detects it.

Contract: paths are followed in steps, so times and clearances are exact to one step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from egoskin.envs.physics.contract import GRAVITY
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.robots.config import RobotConfig
from egoskin.robots.surface import (
    default_frames,
    distance_to,
    points_b,
    sample_surface,
)
from egoskin.sensors import Ray, SensorPipeline, Skin
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere
from egoskin.transform import RowTransform

THROW_STEP = 0.002
"""Time step of throw paths [s]."""
_STEP = 0.01
"""Step length of straight approach paths [m]."""
_GRID_DEG = 5.0
"""Spacing of the directions of the map [deg]."""
_NUM_SURFACE_POINTS = 1000
# Positions processed at a time; keeps temporaries below 100 MB.
_CHUNK, _BODY_CHUNK = 4096, 2**17

Progress = Callable[[str, float], None]
"""Called with the name of the current task and the share of it that is done."""


class StandingRobot:
    """A robot that stands still in its default pose, facing x, at the origin.

    Args:
        robot: The robot.

    Raises:
        ValueError: If the robot has no collision shapes, or not all are primitives.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self.config = robot
        self.joint_pos = torch.from_numpy(robot.default_joint_pos).float()
        self.origin = np.array([0.0, 0.0, robot.default_base_height])
        self.base_pose = torch.tensor([*self.origin, 1.0, 0.0, 0.0, 0.0]).float()
        position, rotation = default_frames(robot)
        # Of the links, in the world.
        self.frames = position + self.origin, rotation
        # The shapes, with the world as their link frame.
        self._shapes = []
        for shape in robot.primitives:
            i = robot.links.index(shape.link)
            shift, turn = (each[i] for each in self.frames)
            self._shapes.append(
                replace(
                    shape,
                    position=turn @ shape.position + shift,
                    rotation=turn @ shape.rotation,
                )
            )
        if not self._shapes:
            hint = " (collision meshes of a URDF are left out)" if robot.is_urdf else ""
            raise ValueError(
                f"{robot.name} has no collision shapes for balls to touch{hint}: add "
                "spheres, capsules, boxes or cylinders"
            )
        # A capsule's end is at most its radius plus half length from its centre.
        self.reach = max(
            float(np.linalg.norm(s.position - self.origin) + s.size.sum())
            for s in self._shapes
        )
        """Upper bound on the distance of the body's points from the base [m]."""

    def distance(self, points: np.ndarray, within: float = math.inf) -> np.ndarray:
        """Signed distance from points to the body, negative inside.

        Args:
            points: Points in the world [m], ``[n, 3]``.
            within: Beyond this distance, a lower bound above it may be returned [m].

        Returns:
            Distance [m], ``[n]``.
        """
        distance = np.linalg.norm(points - self.origin, axis=-1) - self.reach
        near = distance <= within
        close = points[near]
        distance[near] = np.min([distance_to(s, close) for s in self._shapes], axis=0)
        return distance

    def standoff(self, skin: Skin) -> float:
        """Return the largest distance of a sensor from the body [m], at least 0."""
        link = np.array([self.config.links.index(name) for name in skin.links])
        points = points_b(self.frames, link, skin.position)
        return max(0.0, float(self.distance(points).max()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """Contacts and detections along ``n`` paths of ``T`` steps, in ``C`` cells."""

    gap: Tensor
    """Distance from ball surface to body [m], ``[n, T]``; far away a lower bound."""
    contact: Tensor
    """Step of the contact, ``[n]``; T without one, or if it is below the floor."""
    runway: Tensor
    """Gap below which the ball is above the floor [m], ``[n]``; infinite if always."""
    num_sensors: Tensor
    """Number of sensors that detect the ball at each step before contact,
    ``[C, n, T]``."""

    @property
    def touches(self) -> Tensor:
        """Whether the ball touches the body, ``[n]``."""
        return self.contact < self.gap.shape[1]

    @cached_property
    def first_seen(self) -> Tensor:
        """Step of the first detection, ``[C, n]``; the contact step if never seen."""
        first = (self.num_sensors > 0).to(torch.uint8).argmax(-1)
        return torch.where(self.seen, first, self.contact)

    @cached_property
    def seen(self) -> Tensor:
        """Whether the ball is detected before the contact, ``[C, n]``."""
        return (self.num_sensors > 0).any(-1)

    @property
    def clearance(self) -> Tensor:
        """Gap at the first detection [m], ``[C, n]``; 0 if never seen."""
        last = self.gap.shape[1] - 1
        at_first = self.gap.gather(1, self.first_seen.clamp(max=last).t()).t()
        return torch.where(self.seen, at_first, 0.0)


def pipelines(
    robot: RobotConfig,
    skin: Skin,
    sensors: Mapping[str, SensorConfig],
    max_range: float,
) -> dict[str, SensorPipeline]:
    """Return ideal sensors, by name, that give one distance each.

    Args:
        robot: The robot.
        skin: The sensors.
        sensors: Sensor configurations by name; only coverage and occlusion are used.
        max_range: Range of sensors that have none of their own [m].
    """
    made = {}
    for name, config in sensors.items():
        default = config.default_coverage
        rays = any(isinstance(own or default, Ray) for own in skin.coverage)
        ideal = SensorConfig(
            coverage=config.coverage,
            field=config.field,
            ray=config.ray,
            occlusion=config.occlusion,
            range=max_range,
            reduce="min" if rays else "none",
        )
        made[name] = SensorPipeline(ideal, robot, skin)
    return made


def farthest(sensors: Mapping[str, SensorPipeline]) -> float:
    """Return the largest reach of all sensors of all pipelines [m]."""
    return max(float(each.skin.reach().max()) for each in sensors.values())


def _measure(
    body: StandingRobot, sensors: Sequence[RowTransform], centre: Tensor
) -> Tensor:
    """Return sensor readings [m], ``[m, S]``, for ball centres [m], ``[m, 3]``."""
    m = len(centre)
    upright = centre.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(m, 4)
    state = TensorDict(
        base_pose=body.base_pose.expand(m, -1),
        joint_pos=body.joint_pos.expand(m, -1),
        object_pose=torch.cat((centre, upright), -1)[:, None],
        object_active=torch.ones(m, 1, dtype=torch.bool),
        batch_size=[m],
    )
    return torch.cat([sensor(state)[sensor.out_keys[0]] for sensor in sensors], -1)


def trace(
    body: StandingRobot,
    position: Tensor,
    skin: Skin,
    sensors: Mapping[str, SensorPipeline],
    ranges: Sequence[float],
    ball: Sphere,
    *,
    progress: Progress = lambda what, share: None,
) -> Trace:
    """Return when balls on given paths touch the body and which sensors detect them.

    Args:
        body: The robot.
        position: Centres of the balls along the paths [m], ``[n, T, 3]``.
        skin: The sensors.
        sensors: Result of `pipelines` for the longest of the ranges.
        ranges: Ranges of sensors that have none of their own [m].
        ball: The ball.
        progress: Called with the name of the current pipeline.

    Returns:
        The traces; cells are ordered by pipeline and, within one, by range.
    """
    n, steps, _ = position.shape
    # The standoff of a sensor adds to its range, as seen from the body.
    near = farthest(sensors) + body.standoff(skin)
    flat = position.reshape(-1, 3)
    distance = [
        body.distance(part.double().numpy(), ball.radius + near)
        for part in flat.split(_BODY_CHUNK)
    ]
    gap = torch.from_numpy(np.concatenate(distance)).float() - ball.radius
    gap = gap.reshape(n, steps)
    hit = gap <= 0
    first = torch.where(hit.any(1), hit.to(torch.uint8).argmax(1), steps)
    before = torch.arange(steps) < first[:, None]
    above = position[..., 2] >= ball.radius
    touches = above.gather(1, first.clamp(max=steps - 1)[:, None])[:, 0]
    under = torch.where(before & ~above, gap, torch.inf).amin(1)
    visible = before & above & (gap <= near)

    rows = visible.reshape(-1).nonzero()[:, 0]
    num_sensors = torch.zeros(len(sensors), len(ranges), n * steps, dtype=torch.int16)
    for c, (name, pipeline) in enumerate(sensors.items()):
        order = [index for group in pipeline.groups for index in group.index]
        own = torch.from_numpy(skin.range[order]).float()
        measuring = pipeline.sensors([ball])
        limits = [torch.where(own.isnan(), r, own) for r in ranges]
        # One measurement at the longest range serves all ranges.
        for k, chunk in enumerate(rows.split(_CHUNK)):
            progress(name, k * _CHUNK / max(len(rows), 1))
            reading = _measure(body, measuring, flat[chunk])
            for r, limit in enumerate(limits):
                num_sensors[c, r, chunk] = (reading <= limit).sum(-1).short()
        progress(name, 1.0)
    return Trace(
        gap=gap,
        contact=torch.where(touches, first, steps),
        runway=torch.where(touches, under, 0.0),
        num_sensors=num_sensors.reshape(-1, n, steps),
    )


# --- paths ----------------------------------------------------------------------


def direction_grid() -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation of the map's directions [rad], ``[E, A]`` each.

    Elevation grows along the rows, azimuth (counter-clockwise from above, 0 ahead)
    along the columns from -pi to pi.
    """
    step = math.radians(_GRID_DEG)
    elevation = np.arange(0.5, round(180 / _GRID_DEG)) * step - math.pi / 2
    azimuth = np.arange(0.5, round(360 / _GRID_DEG)) * step - math.pi
    grid = np.meshgrid(elevation, azimuth, indexing="ij")
    return grid[1], grid[0]


def unit_vectors(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Return directions from angles [rad], ``[n, 3]``."""
    flat = np.cos(elevation)
    return np.stack(
        (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), -1
    )


def direction_paths(body: StandingRobot, ball: Sphere, distance: float) -> Tensor:
    """Return straight paths to the base from all directions of the map.

    Args:
        body: The robot.
        ball: The ball.
        distance: Least clearance at the start of the paths [m].

    Returns:
        Centres of the ball [m], ``[n, T, 3]``.
    """
    along = np.arange(body.reach + ball.radius + distance, 0.0, -_STEP)
    azimuth, elevation = direction_grid()
    outward = unit_vectors(azimuth.ravel(), elevation.ravel())
    paths = body.origin + along[None, :, None] * outward[:, None]
    return torch.from_numpy(paths).float()


def surface_paths(
    body: StandingRobot, ball: Sphere, distance: float, seed: int
) -> tuple[Tensor, np.ndarray]:
    """Return straight paths along the normals of points sampled on the body.

    Args:
        body: The robot.
        ball: The ball.
        distance: Clearance at the start of the paths [m].
        seed: Seed of the points.

    Returns:
        Centres of the ball [m], ``[n, T, 3]``, the last at contact with the point; and
        the index of each point's link, ``[n]``.
    """
    links = list(dict.fromkeys(s.link for s in body.config.primitives))
    points = sample_surface(body.config, links, _NUM_SURFACE_POINTS, seed)
    _, turn = body.frames
    start = points_b(body.frames, points.link, points.position)
    outward = (turn[points.link] @ points.normal[..., None])[..., 0]
    along = ball.radius + np.arange(math.ceil(distance / _STEP), -1, -1) * _STEP
    paths = start[:, None] + along[None, :, None] * outward[:, None]
    return torch.from_numpy(paths).float(), points.link


def throw_paths(
    body: StandingRobot, config: ThrowConfig, num_throws: int, seed: int, dt: float
) -> tuple[Tensor, Tensor]:
    """Return the flight paths of the first throws of some episodes.

    Args:
        body: The robot that is aimed at.
        config: The throws.
        num_throws: Number of throws, ``n``.
        seed: Seed of the run or of the throw set.
        dt: Physics time step [s].

    Returns:
        Centres of the ball [m], ``[n, T, 3]``, and the azimuth of each throw [rad],
        ``[n]``.
    """
    thrower = Thrower(config, body.config, dt)
    row, zero = torch.arange(num_throws), torch.zeros(num_throws, dtype=torch.int64)
    draw = thrower.draw(seed, row, zero, zero)
    release = thrower.release_at_standing_robot(draw)
    # Until the slowest ball is past the body.
    way = draw.distance + body.reach + config.radius
    longest = (way / release.velocity[:, :2].norm(dim=-1)).max()
    time = torch.arange(0.0, float(longest), THROW_STEP)[:, None]
    paths = release.position[:, None] + release.velocity[:, None] * time
    if config.flight == "ballistic":
        # z(t) = z0 + vz t - g t (t + dt) / 2, as the integrator computes it.
        paths[..., 2] -= (0.5 * GRAVITY * time * (time + dt))[:, 0]
    return paths, draw.azimuth
