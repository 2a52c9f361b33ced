"""Throws: release position, speed, target point on the body, and timing.

The random draws of a throw (direction, distance, height, speed, interval, target point)
depend on the robot only through its size. At release they are turned into a position
and a velocity for the robot's current pose. One throw set can therefore be used for
every policy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import torch
from torch import Tensor

from egoskin.bounds import Interval, check_bounds, check_ranges
from egoskin.envs.physics.contract import GRAVITY
from egoskin.rng import Stream, between, uniform
from egoskin.robots.config import RobotConfig
from egoskin.robots.kinematics import LinkKinematics, axis_vectors, rotate
from egoskin.robots.surface import sample_surface
from egoskin.shapes import NUM_SIZES, Shape, shape_of

# Target points on the body: dense enough that neighbours are 2 cm apart, and fixed, so
# that a throw set is the same in every run.
NUM_AIM_POINTS, _AIM_SEED = 4096, 0
# The aim leads the robot by at most this share of the ball's speed: no throw could
# reach a robot that runs away faster than the ball.
_MAX_LEAD_RATIO = 0.9
# Height of the H1-2 [m], to which the release heights refer.
_REFERENCE_HEIGHT = 1.78
# Bounds that keep every throw finite in float32 and the MuJoCo model valid.
_Delay = Annotated[tuple[float, float], Interval(ge=0, le=1000)]
_Seconds = Annotated[tuple[float, float], Interval(gt=0, le=1000)]
_MetresPerSecond = Annotated[tuple[float, float], Interval(ge=0.01, le=1000)]
_Degrees = Annotated[tuple[float, float], Interval(ge=-360, le=360)]
_Metres = Annotated[tuple[float, float], Interval(gt=0, le=1000)]
_OBJECT = Interval(ge=1e-3, le=10)


@dataclass(frozen=True, kw_only=True)
class ThrowConfig:
    """The balls and how they are thrown; every range is sampled uniformly."""

    shape: Literal["sphere", "box", "capsule", "ellipsoid"] = "sphere"
    """Shape of the thrown objects, called balls. They do not rotate: their axes are
    those of the world."""
    radius: Annotated[float, _OBJECT] = 0.15
    """Radius of spheres [m]."""
    size: Annotated[tuple[float, ...], _OBJECT] = ()
    """Size of any other shape [m]: half lengths of a box along x, y, z; radius and half
    length (along z, without the ends) of a capsule; semi-axes of an ellipsoid."""
    num_balls: Annotated[int, Interval(ge=1, le=100)] = 2
    """Number of balls, thrown in turn; with several, a slow ball can land before its
    next throw."""
    first_delay: _Delay = (0.0, 2.0)
    """Time from the start of an episode to the first throw [s]. A random delay makes
    fixed motions useless; with (0, 0) a blind robot learns to duck at once."""
    interval: _Seconds = (1.0, 2.0)
    """Time from one throw to the next [s]."""
    height: _Metres = (2.0, 3.0)
    """Height of release above ground [m] for the H1-2 (1.78 m tall); scaled with the
    height of other robots."""
    distance: _Metres = (4.0, 6.0)
    """Horizontal distance of release from the base [m]."""
    speed: _MetresPerSecond = (4.0, 8.0)
    """Initial speed [m/s]; if ballistic, only its horizontal component."""
    azimuth_deg: _Degrees = (-180.0, 180.0)
    """Direction the ball comes from, relative to the robot's heading [deg]."""
    aim: Literal["skin", "body", "box"] = "skin"
    """Target: a random point on the outer surface of the robot's ``skin_links``
    (whatever the skin) or of the body (without shins and feet), or in a box."""
    box_half_width: Annotated[float, Interval(ge=0, le=1000)] = 0.45
    """For aim=box: largest sideways offset from the base [m]."""
    box_height: _Metres = (0.3, 1.8)
    """For aim=box: height above ground [m]."""
    lead: Annotated[float, Interval(ge=0, le=10)] = 1.0
    """Share of the base's planar velocity used to lead the aim."""
    flight: Literal["ballistic", "straight"] = "straight"
    """ballistic: under gravity; straight: without gravity, at constant speed. (Of equal
    ``speed``, a straight ball is the slower one: a ballistic one has a vertical
    velocity as well.)"""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values, or options without effect."""
        check_bounds(self)
        check_ranges(self, other=["size"])
        self._check_size()
        for name in ("box_half_width", "box_height"):
            changed = getattr(self, name) != getattr(ThrowConfig, name)
            if changed and self.aim != "box":
                raise ValueError(f"{name} has no effect without aim=box")

    @property
    def gravity(self) -> float:
        """Downward acceleration of the balls [m/s^2]."""
        return GRAVITY if self.flight == "ballistic" else 0.0

    def _check_size(self) -> None:
        """Raise ValueError unless just the sizes of the shape are given."""
        if self.shape == "sphere":
            if self.size:
                raise ValueError("size has no effect with shape=sphere: use radius")
            return
        if self.radius != ThrowConfig.radius:
            raise ValueError(f"radius has no effect with shape={self.shape}: use size")
        shape_of(self.shape, self.size)
        if len(self.size) > NUM_SIZES[self.shape]:
            raise ValueError(
                f"a {self.shape} needs {NUM_SIZES[self.shape]} sizes, got "
                f"{list(self.size)}"
            )

    @property
    def balls(self) -> tuple[Shape, ...]:
        """Shape of each ball."""
        size = (self.radius,) if self.shape == "sphere" else self.size
        return (shape_of(self.shape, size),) * self.num_balls


@dataclass(frozen=True, kw_only=True)
class Draw:
    """The random part of throws, independent of the robot, ``[n]`` each."""

    azimuth: Tensor
    """Direction the ball comes from, relative to the heading [rad]."""
    distance: Tensor
    """Horizontal distance of release from the base [m]."""
    height: Tensor
    """Height of release [m]."""
    speed: Tensor
    """Initial speed [m/s]; if ballistic, only its horizontal component."""
    interval: Tensor
    """Time until the next throw [s]."""
    target: Tensor
    """Two uniform numbers in [0, 1) that select the target point, ``[n, 2]``."""


QUARTERS = ("front", "left", "back", "right")
"""Quarters of azimuth, each centred on its direction."""


def quarter_of(azimuth: Tensor) -> Tensor:
    """Return the index in `QUARTERS` of directions [rad], ``[n]`` int64."""
    # Azimuth is positive to the left.
    return (azimuth / (math.pi / 2)).round().long() % 4


@dataclass(frozen=True, kw_only=True)
class Release:
    """Thrown balls, ``[n, 3]`` each, in the world."""

    position: Tensor
    """Where the ball is released [m]."""
    velocity: Tensor
    """Its velocity [m/s]."""


class Thrower:
    """Draws throws and aims them.

    Args:
        config: The throws.
        robot: The robot they are aimed at.
        timestep: Physics time step [s].
        device: Device of the robots' state tensors.
    """

    def __init__(
        self,
        config: ThrowConfig,
        robot: RobotConfig,
        timestep: float,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = config
        self._timestep = timestep
        self._robot, self._device = robot, device

    @cached_property
    def _size(self) -> float:
        """Height of the robot relative to the H1-2."""
        return self._robot.standing_height / _REFERENCE_HEIGHT

    @cached_property
    def _aim_points(self) -> tuple[LinkKinematics, Tensor, Tensor]:
        """Kinematics of the target links; link index and position of each target."""
        robot = self._robot
        if self.config.aim == "skin":
            aimed_at = set(robot.skin_links)
        else:
            aimed_at = set(robot.links) - set(robot.untargeted_links)
        solid = {shape.link for shape in robot.primitives}
        links = [name for name in robot.links if name in aimed_at & solid]
        points = sample_surface(robot, links, NUM_AIM_POINTS, _AIM_SEED)
        index = [links.index(robot.links[i]) for i in points.link]
        return (
            LinkKinematics(robot.chain, links),
            torch.tensor(index, device=self._device),
            torch.from_numpy(points.position).float().to(self._device),
        )

    def aim_link(self, draw: Draw) -> list[str]:
        """Return the name of the link each throw is aimed at (not for aim=box)."""
        kinematics, link, _ = self._aim_points
        return [kinematics.links[i] for i in link[self._point_index(draw)].tolist()]

    def aim_point(self, draw: Draw) -> Tensor:
        """Return the target point of each throw on its link (not for aim=box).

        Args:
            draw: Draws of ``n`` throws.

        Returns:
            The points in the frames of their links [m], ``[n, 3]``.
        """
        _, _, local = self._aim_points
        return local[self._point_index(draw)]

    def at_standing_robot(self, draw: Draw) -> tuple[Tensor, Tensor]:
        """Return arrival height and speed at the robot standing in its default pose.

        They depend only on the draws, so they are the same for every policy.

        Args:
            draw: Draws of ``n`` throws.

        Returns:
            Height of the target points [m] and speed of the ball there [m/s],
            ``[n]`` each.
        """
        base_pose, joint_pos = self._standing(len(draw.speed))
        side = torch.stack((draw.azimuth.cos(), draw.azimuth.sin()), -1)
        target = self._target(draw, base_pose, joint_pos, side)
        release = self.release_at_standing_robot(draw)
        velocity = release.velocity
        if self.config.flight == "ballistic":
            way = (target - release.position)[:, :2].norm(dim=-1)
            velocity[:, 2] -= GRAVITY * way / draw.speed
        return target[:, 2], velocity.norm(dim=-1)

    def release_at_standing_robot(self, draw: Draw) -> Release:
        """Return balls thrown at the robot standing in its default pose.

        Args:
            draw: Draws of ``n`` throws.

        Returns:
            The balls at release.
        """
        n = len(draw.speed)
        base_pose, joint_pos = self._standing(n)
        return self.release(draw, base_pose, torch.zeros(n, 3), joint_pos)

    def first_delay(self, seed: int, row: Tensor, episode: Tensor) -> Tensor:
        """Return the time from the start of some episodes to their first throw [s].

        Args:
            seed: Seed of the run or of the throw set.
            row: Global agent row, ``[n]`` int64.
            episode: Episode of that row, ``[n]`` int64.

        Returns:
            Delays, a pure function of the arguments, ``[n]``.
        """
        u = uniform(seed, Stream.FIRST_DELAY, row, episode, torch.zeros_like(row), 1)
        return between(self.config.first_delay, u[:, 0])

    def draw(self, seed: int, row: Tensor, episode: Tensor, throw: Tensor) -> Draw:
        """Return the random part of the n-th throws of some episodes.

        Args:
            seed: Seed of the run or of the throw set.
            row: Global agent row, ``[n]`` int64.
            episode: Episode of that row, ``[n]`` int64.
            throw: Index of the throw in the episode, ``[n]`` int64.

        Returns:
            Draws, a pure function of the arguments.
        """
        u = uniform(seed, Stream.THROW, row, episode, throw, 7)
        config = self.config
        return Draw(
            azimuth=torch.deg2rad(between(config.azimuth_deg, u[:, 0])),
            distance=between(config.distance, u[:, 1]),
            height=self._size * between(config.height, u[:, 2]),
            speed=between(config.speed, u[:, 3]),
            interval=between(config.interval, u[:, 4]),
            target=u[:, 5:7],
        )

    def release(
        self, draw: Draw, base_pose: Tensor, base_lin_vel_w: Tensor, joint_pos: Tensor
    ) -> Release:
        """Return position and velocity of balls thrown at robots in a given state.

        A row's result does not depend on the other rows if their total number is a
        multiple of 32 (`egoskin.rounding.pad_rows`).

        Args:
            draw: Draws of ``n`` throws.
            base_pose: Base pose in the world, ``[n, 7]``.
            base_lin_vel_w: Base velocity in the world [m/s], ``[n, 3]``.
            joint_pos: Joint positions [rad], ``[n, J]``.

        Returns:
            The balls at release.
        """
        quat = base_pose[:, 3:]
        forward = rotate(quat, axis_vectors(quat, 0))
        heading = torch.atan2(forward[:, 1], forward[:, 0])
        bearing = heading + draw.azimuth
        side = torch.stack((bearing.cos(), bearing.sin()), -1)
        start = torch.cat(
            (base_pose[:, :2] + draw.distance[:, None] * side, draw.height[:, None]), -1
        )
        target = self._target(draw, base_pose, joint_pos, side)

        ballistic = self.config.flight == "ballistic"
        run = self.config.lead * base_lin_vel_w
        run = torch.cat((run[:, :2], torch.zeros_like(run[:, 2:])), -1)
        run_speed = run.square().sum(-1).sqrt()
        limit = _MAX_LEAD_RATIO * draw.speed / run_speed.clamp(min=1e-6)
        run = run * limit.clamp(max=1.0)[:, None]
        # Time T of arrival at the moving target: |r + v T| = s T, over the plane for
        # a ballistic throw (s is its horizontal speed), in space for a straight one.
        gap = target - start
        used = 2 if ballistic else 3
        r, v = gap[:, :used], run[:, :used]
        rv, rr = (r * v).sum(-1), (r * r).sum(-1)
        a = draw.speed.square() - (v * v).sum(-1)
        time = (rv + (rv * rv + a * rr).sqrt()) / a
        velocity = gap / time[:, None] + run
        if ballistic:
            # z(T) = z0 + vz T - g T (T + dt) / 2 meets the target: the integrator is
            # semi-implicit, it falls g T dt / 2 (4 cm in a second) below the parabola.
            velocity[:, 2] += 0.5 * GRAVITY * (time + self._timestep)
        return Release(position=start, velocity=velocity)

    def _standing(self, n: int) -> tuple[Tensor, Tensor]:
        """Base pose ``[n, 7]`` and joint positions ``[n, J]`` of the standing robot."""
        base_pose = torch.tensor(
            [0.0, 0.0, self._robot.default_base_height, 1.0, 0.0, 0.0, 0.0]
        )
        joint_pos = torch.from_numpy(self._robot.default_joint_pos).float()
        return base_pose.expand(n, -1), joint_pos.expand(n, -1)

    def _point_index(self, draw: Draw) -> Tensor:
        index = (draw.target[:, 0] * NUM_AIM_POINTS).long()
        return index.clamp(max=NUM_AIM_POINTS - 1)

    def _target(
        self, draw: Draw, base_pose: Tensor, joint_pos: Tensor, side: Tensor
    ) -> Tensor:
        """Return the target point of each throw in the world [m], ``[n, 3]``."""
        if self.config.aim == "box":
            offset = (2 * draw.target[:, :1] - 1) * self.config.box_half_width
            across = torch.stack((-side[:, 1], side[:, 0]), -1)
            z = between(self.config.box_height, draw.target[:, 1:])
            return torch.cat((base_pose[:, :2] + offset * across, z), -1)
        return self.points_w(self._point_index(draw), base_pose, joint_pos)

    def points_w(self, index: Tensor, base_pose: Tensor, joint_pos: Tensor) -> Tensor:
        """Return points that can be aimed at, in the world (not for aim=box).

        There is one pose for each point, or one for all, ``[1, ...]``.

        Args:
            index: Indices of the points, in [0, `NUM_AIM_POINTS`), ``[n]`` int64.
            base_pose: Base poses in the world, ``[n, 7]``.
            joint_pos: Joint positions [rad], ``[n, J]``.

        Returns:
            The points [m], ``[n, 3]``.
        """
        kinematics, link, local = self._aim_points
        position, rotation = kinematics.poses_b(joint_pos)
        row = torch.arange(len(joint_pos), device=index.device).expand(len(index))
        turn, shift = rotation[row, link[index]], position[row, link[index]]
        point_b = (turn * local[index][:, None, :]).sum(-1) + shift
        return base_pose[:, :3] + rotate(base_pose[:, 3:], point_b)
