"""One interactive robot: its policy, its sensors, and balls thrown on demand.

Contract: everything is computed by the environment of the task, with one row; only the
throws and their times come from outside, by a `Thrower` that returns requested throws.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose

from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.throws import NUM_AIM_POINTS, Draw, Thrower
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.policy import Policy, load_with_critic
from egoskin.sensors import Binary, Corruption, Proximity, Skin
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.pipeline import SensorGroup
from egoskin.viewer.offscreen import closest_point
from egoskin.viewer.recording import ending_of
from egoskin.viewer.web.body import Body

# The same for all robots: they start alike and receive the same throws.
_SEED = 0
# Time until the next throw [s]: never, as balls are only thrown on demand.
_NEVER = 1e6
_MIN_DISTANCE, _MAX_DISTANCE = 1.5, 8.0
"""Balls clicked nearer or farther than this are released at this distance [m]."""
SPEEDS, HEIGHTS = (1.0, 12.0), (0.3, 4.0)
"""Ranges of the speed [m/s] and height of release [m] of a throw."""


@dataclass(frozen=True, kw_only=True)
class Throw:
    """Requested properties of a throw; None is drawn at random, as in the task."""

    speed: float | None = None
    """Initial speed [m/s]."""
    height: float | None = None
    """Height of release [m]."""
    azimuth: float | None = None
    """Direction the ball comes from, relative to the heading [rad]."""
    distance: float | None = None
    """Horizontal distance of release from the base [m]."""
    target: float | None = None
    """Point aimed at: a number in [0, 1), see `Session.target_near`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """State of one robot to show after a control step."""

    qpos: np.ndarray
    """Base pose and joint positions, ``[7 + J]``."""
    balls: np.ndarray
    """Centres of the balls [m], ``[O, 3]``."""
    active: np.ndarray
    """Which of them are in play, ``[O]`` bool."""
    reading: np.ndarray
    """Reading of each sensor, ``[S]``: 1 is contact, 0 is no detection."""
    line: np.ndarray
    """End of each sensor's line, on the ball it detects [m], ``[S, 3]``; NaN if it
    detects none."""
    masked: Collection[int] = ()
    """Indices of the sensors that are masked."""
    step: int = 0
    """Control steps since the start of the episode."""
    survived: float = 0.0
    """Time since the first throw of the episode [s]."""
    value: float = math.nan
    """Value of the state by the critic; NaN without one."""
    ending: str | None = None
    """Why the episode ends here ("hit", "fall", ...); None while it goes on."""


class ThrownOnDemand(Thrower):
    """Thrower of requested throws; the rest of each is drawn as in the task."""

    wanted = Throw()

    def first_delay(self, seed: int, row: Tensor, episode: Tensor) -> Tensor:
        """Return a time that is never reached [s], ``[n]``."""
        return torch.full(row.shape, _NEVER)

    def draw(self, seed: int, row: Tensor, episode: Tensor, throw: Tensor) -> Draw:
        """Return the requested throw; the one after it is never due."""
        draw = super().draw(seed, row, episode, throw)
        given: dict[str, Tensor] = {"interval": torch.full(row.shape, _NEVER)}
        for name in ("speed", "height", "azimuth", "distance"):
            value = getattr(self.wanted, name)
            if value is not None:
                given[name] = torch.full(row.shape, float(value))
        if self.wanted.target is not None:
            # The second number sets the height in a box. It is made from the further
            # digits of the first: equal numbers would aim along the box's diagonal, and
            # a random number would differ between robots that receive the same throw.
            pair = self.wanted.target, self.wanted.target * NUM_AIM_POINTS % 1
            given["target"] = torch.tensor(pair).float().expand(len(row), 2)
        return dataclasses.replace(draw, **given)


class Session:
    """A robot with a policy in its task, played step by step.

    Args:
        policy: Name, file, checkpoint or run folder of its policy.
        hz: Control rate that the policy must have [Hz]; None: any.

    Raises:
        ValueError: If there is no such policy, or it has another control rate.
    """

    def __init__(self, policy: str, hz: float | None = None) -> None:
        self.load(policy, hz)

    # --- policy and sensors -----------------------------------------------------

    def load(self, source: str, hz: float | None = None) -> None:
        """Load another policy, with its own robot, task and skin, and reset.

        Args:
            source: Name, file, checkpoint or run folder of the policy.
            hz: Control rate that it must have [Hz]; None: any.

        Raises:
            ValueError: If there is no such policy, or it has another control rate;
                nothing is changed then.
        """
        policy, critic = load_with_critic(source)
        own = policy.env_config.task.physics.control_hz
        if hz is not None and own != hz:
            raise ValueError(
                f"{source} acts at {own:g} Hz and the other robot at {hz:g} Hz: side "
                "by side they need the same control rate"
            )
        body = Body(policy.env_config.robot_config)
        self._build(policy, policy.env_config)
        self.source, self.critic, self.body = source, critic, body
        self.masked: frozenset[int] = frozenset()
        """Indices of the sensors that detect nothing."""
        self.reset()

    def follow(self) -> bool:
        """Continue the episode with the newest version of the policy, if it fits.

        Returns:
            Whether it has the same robot, task, sensors and skin; nothing is changed
            otherwise.
        """
        policy, critic = load_with_critic(self.source)
        new, old = policy.policy_spec, self.policy.policy_spec
        fits = (new.env, new.skin.to_dict()) == (old.env, old.skin.to_dict())
        if fits:
            self.policy, self.critic = policy, critic
        return fits

    def configure(self, sensor: SensorConfig) -> None:
        """Change the sensors, and reset.

        Raises:
            ValueError: If the policy cannot read their signal.
        """
        self._build(self.policy, self._check(sensor))
        # The new sensors are all unmasked: apply the mask again.
        self.mask(self.masked)
        self.reset()

    def _build(self, policy: Policy, config: EnvConfig) -> None:
        """Take a policy and its environment; if this fails, nothing is changed."""
        pipeline, task = config.pipeline(policy.skin), config.task
        env = make_worker_env(
            config, policy.skin, num_envs=1, seed=_SEED, keep_raw=True
        )
        base = env.base_env
        assert isinstance(base, DodgeballEnv)
        thrower = ThrownOnDemand(
            task.throws, config.robot_config, task.physics.timestep
        )
        self.policy, self.config, self.pipeline = policy, config, pipeline
        self.env, self.task, self.hz = env, base, task.physics.control_hz
        self._thrower = base.balls.thrower = thrower

    def readable(self, **changes: Any) -> SensorConfig | None:
        """Return the sensors with changes; None if the policy cannot read them.

        Args:
            changes: Fields of the sensor configuration.
        """
        try:
            sensor = dataclasses.replace(self.config.sensor, **changes)
            self._check(sensor)
        except ValueError:
            return None
        return sensor

    def _check(self, sensor: SensorConfig) -> EnvConfig:
        """Return the configuration; raise ValueError if the policy cannot read it."""
        own, skin = self.policy.env_config, self.policy.skin
        config = dataclasses.replace(own, sensor=sensor)
        size, expected = (c.pipeline(skin).signal_size for c in (config, own))
        if size != expected or config.actor_keys != own.actor_keys:
            raise ValueError(
                f"the policy reads {expected} numbers from its skin, but these sensors "
                f"give {size}"
            )
        return config

    @property
    def skin(self) -> Skin | None:
        """The sensors with coverage and range resolved; None if blind or an oracle."""
        return self.pipeline.skin if self.pipeline.groups else None

    def mask(self, sensors: Collection[int]) -> None:
        """Mask exactly these sensors: they detect nothing from now on."""
        self.masked = frozenset(sensors)
        assert isinstance(self.env.transform, Compose)
        self.pipeline.mask(self.env.transform, self.masked)
        # Copies: the frame may be recorded.
        which, old = list(sensors), self.frame
        reading, line = old.reading.copy(), old.line.copy()
        reading[which], line[which] = 0.0, np.nan
        self.frame = dataclasses.replace(
            old, reading=reading, line=line, masked=self.masked
        )

    # --- time -------------------------------------------------------------------

    def reset(self) -> Frame:
        """Start an episode, always from the same state and without a ball in flight."""
        self.env.set_seed(_SEED, static_seed=True)
        assert isinstance(self.env.transform, Compose)
        for transform in self.env.transform:
            if isinstance(transform, Corruption):
                transform.restart()
        self._root = self.env.reset()
        self.first_throw: int | None = None
        self.frame = self._look(self._root, None)
        return self.frame

    @torch.no_grad()
    def step(self) -> Frame:
        """Advance one control step and return its frame.

        Raises:
            ValueError: If the policy's action is not finite.
        """
        root = self.policy(self._root)
        if not root["action"].isfinite().all():
            raise ValueError(
                "the policy's action is not finite: its weights or its observations "
                "differ from those of training"
            )
        after = self.env.step(root)["next"]
        self.frame = self._look(after, ending_of(after[0]))
        self._root = after.exclude("reward")
        return self.frame

    def throw(self, throw: Throw) -> None:
        """Throw a ball in the next step."""
        self._thrower.wanted = throw
        # The next throw is due immediately.
        self.task.balls.state["next_throw_step"].zero_()
        if self.first_throw is None:
            self.first_throw = self.frame.step

    @property
    def avoided(self) -> tuple[int, int]:
        """Balls avoided and balls that arrived, in this episode."""
        counted = self.task.balls.state
        return int(counted["avoided"].sum()), int(counted["arrived"].sum())

    # --- clicks ---------------------------------------------------------------

    def azimuth_of(self, point: np.ndarray) -> float:
        """Return the direction of a point from the base, relative to the heading [rad].

        Args:
            point: Point in the world [m], ``[3]`` or ``[2]``.
        """
        x, y = point[:2] - self.frame.qpos[:2]
        w, qx, qy, qz = self.frame.qpos[3:7]
        heading = math.atan2(2 * (w * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        angle = math.atan2(y, x) - heading
        return math.remainder(angle, 2 * math.pi)

    def distance_of(self, point: np.ndarray) -> float:
        """Return the planar distance of a point from the base, within limits [m]."""
        away = float(np.hypot(*(point[:2] - self.frame.qpos[:2])))
        return min(max(away, _MIN_DISTANCE), _MAX_DISTANCE)

    @property
    def distances(self) -> tuple[float, float]:
        """Range of release distances of the task [m]."""
        return self.config.task.throws.distance

    def sensor_at(
        self,
        origin: np.ndarray,
        direction: np.ndarray,
        within: float,
        until: float = math.inf,
    ) -> int | None:
        """Return the first sensor on a ray whose normal faces its origin, or None.

        Args:
            origin: Start of the ray in the world [m], ``[3]``.
            direction: Its direction, of length 1, ``[3]``.
            within: Largest distance of the sensor from the ray [m].
            until: Distance along the ray at which something hides what is behind [m].
        """
        if self.skin is None:
            return None
        way = self.body.sensor_points(self.skin) - origin
        ahead = way @ direction
        beside = np.linalg.norm(way - ahead[:, None] * direction, axis=-1)
        faces = self.body.sensor_normals(self.skin) @ direction < 0
        met = (beside < within) & (ahead > 0) & (ahead < until + within) & faces
        return int(np.where(met, ahead, np.inf).argmin()) if met.any() else None

    def target_near(self, point: np.ndarray) -> float | None:
        """Return the `Throw.target` nearest to a point; None if the task aims at a box.

        Args:
            point: Point in the world [m], ``[3]``.
        """
        if self._thrower.config.aim == "box":
            return None
        pose = torch.from_numpy(self.frame.qpos).float()[None]
        every = torch.arange(NUM_AIM_POINTS)
        points = self._thrower.points_w(every, pose[:, :7], pose[:, 7:])
        away = (points - torch.from_numpy(point).float()).square().sum(-1)
        # The middle of the numbers that aim at this point.
        return (int(away.argmin()) + 0.5) / NUM_AIM_POINTS

    # --- readings and lines ---------------------------------------------------

    def _look(self, state: TensorDictBase, ending: str | None) -> Frame:
        """Return the frame of a state, ``[1]``, after all transforms."""
        row = state[0]
        assert isinstance(row, TensorDictBase)
        qpos = np.concatenate((row["base_pose"], row["joint_pos"])).astype(float)
        balls = np.asarray(row["object_pose"], float)
        active = np.asarray(row["object_active"])
        number = len(self.skin) if self.skin else 0
        reading, line = np.zeros(number), np.full((number, 3), np.nan)
        for group in self.pipeline.groups:
            reading[group.index] = self._readings(row, group)
        if self.skin is not None and active.any():
            seeing = self.pipeline.detecting(row)
            self.body.place(qpos)
            points = self.body.sensor_points(self.skin)[seeing]
            flying = [
                closest_point(shape, pose, points)
                for shape, pose, on in zip(
                    self.task.scene.objects, balls, active, strict=True
                )
                if on
            ]
            ends = np.stack(flying)
            nearest = np.linalg.norm(ends - points, axis=-1).argmin(0)
            line[seeing] = ends[nearest, np.arange(len(points))]
        step = int(row["episode_step"])
        since = 0 if self.first_throw is None else step - self.first_throw
        value = math.nan
        if self.critic is not None:
            value = float(self.critic(state)["state_value"])
        return Frame(
            qpos=qpos,
            balls=balls[:, :3],
            active=active,
            reading=reading,
            line=line,
            masked=self.masked,
            step=step,
            survived=since / self.hz,
            value=value,
            ending=ending,
        )

    def _readings(self, row: TensorDictBase, group: SensorGroup) -> np.ndarray:
        """Return the readings of a group of sensors, as in `Frame.reading`."""
        corrupted = f"reading{group.suffix}"
        key = corrupted if corrupted in row.keys() else f"distance{group.suffix}"
        nearest = row[key].reshape(1, len(group.index), -1).amin(-1)
        ranges = group.skin.range.tolist()
        if self.config.sensor.signal == "binary":
            return Binary(ranges).signal(nearest)[0].numpy()
        return Proximity(ranges, closeness=True).signal(nearest)[0].numpy()
