"""The dodgeball task as Gymnasium environments, registered by importing this module.

    import gymnasium
    import egoskin.gym

    env = gymnasium.make("egoskin/Dodgeball-v0", sensor={"signal": "binary"})
    envs = gymnasium.make_vec("egoskin/Dodgeball-v0", num_envs=1024)

The name ``egoskin.gym:egoskin/Dodgeball-v0`` imports this module by itself.

Contract: an observation is the concatenated input of the actor, in the order of an
exported policy (`egoskin.policies.export`); seeds mean the same as in
`egoskin.make_env`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from egoskin.make import EnvConfig, check_num_workers, make_env, make_worker_env
from egoskin.parallel import WorkerPool
from egoskin.rng import check_seed
from egoskin.storage.serialization import from_plain, to_plain

ENV_ID = "egoskin/Dodgeball-v0"
"""Name of the environment."""
# Entries of an info, besides the privileged observation.
_FLAGS = ("hit", "fallen", "diverged")


def _config(settings: dict[str, Any]) -> EnvConfig:
    """Return the configuration for keyword arguments (dataclasses or dictionaries).

    Raises:
        TypeError: If `EnvConfig` has no such field.
        ValueError: If a value is not valid.
    """
    fields = {field.name for field in dataclasses.fields(EnvConfig)}
    for name in settings.keys() - fields:
        # Gymnasium's wrappers try out arguments and look for these words.
        raise TypeError(
            f"{ENV_ID} got an unexpected keyword argument {name!r}; it takes the "
            f"fields of EnvConfig: {', '.join(sorted(fields))}"
        )
    plain = {name: to_plain(value) for name, value in settings.items()}
    return from_plain(EnvConfig, plain, ENV_ID)


class _Rows:
    """Spaces and conversion to arrays, shared by both environments.

    Args:
        settings: Fields of `EnvConfig`.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        self.config = config = _config(settings)
        self.skin = config.skin.build(config.robot_config)
        one = make_worker_env(config, self.skin, num_envs=1, seed=0)
        specs = [one.observation_spec[key] for key in config.actor_keys]
        low, high = (
            np.concatenate([_bound(spec, side) for spec in specs])
            for side in ("low", "high")
        )
        self.observation_space = Box(low, high)
        robot, task = config.robot_config, config.task
        kp, _ = robot.joint_gains(task.physics.gains)
        # Beyond these targets, a joint within its range already gets full torque.
        reach = robot.torque_limit / kp
        sides = np.array([[-1], [1]])
        # Trainers need finite bounds: half a turn for joints without a range.
        limits = robot.joint_range
        bounds = np.where(np.isfinite(limits), limits, sides * np.pi) + sides * reach
        bounds = (bounds - robot.default_joint_pos) / (task.action_scale * reach)
        self.action_space = Box(*bounds.astype(np.float32))

    def observations(self, td: TensorDictBase) -> np.ndarray:
        """Return a fresh array of the observations of all rows, ``[B, N]``."""
        parts = [_rows(td, key) for key in self.config.actor_keys]
        return np.concatenate(parts, -1)

    def info(self, td: TensorDictBase) -> dict[str, np.ndarray]:
        """Return the infos of all rows, ``[B, ...]`` each."""
        flags = {key: _column(td, key) for key in _FLAGS}
        key = "privileged_observation"
        return {**flags, key: _rows(td, key).copy()}


def _bound(spec: TensorSpec, side: Literal["low", "high"]) -> np.ndarray:
    """Return the lower or upper bound of one row of features, ``[F]``."""
    if isinstance(spec, Bounded):
        return getattr(spec.space, side).flatten().numpy()
    infinite = -np.inf if side == "low" else np.inf
    return np.full(spec.shape[-1], infinite, dtype=np.float32)


def _rows(td: TensorDictBase, key: str) -> np.ndarray:
    """Return an entry with all batch dimensions flattened, ``[B, F]``."""
    value = td[key]
    assert isinstance(value, Tensor)
    return value.reshape(-1, value.shape[-1]).numpy()


def _checked(action: np.ndarray, shape: tuple[int, ...]) -> Tensor:
    """Return actions as a tensor, or raise ValueError if they are not valid."""
    tensor = torch.as_tensor(action, dtype=torch.float32)
    if tensor.shape != shape:
        raise ValueError(
            f"an action must have the shape {list(shape)}, got {list(tensor.shape)}"
        )
    if not tensor.isfinite().all():
        raise ValueError("an action must be finite, got NaN or infinite values")
    return tensor


def _column(td: TensorDictBase, key: str) -> np.ndarray:
    """Return a copy of an entry with one number per row, ``[B]``."""
    return _rows(td, key)[:, 0].copy()


class DodgeballGym(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot that has to dodge thrown balls.

    **Action** ``[J]``: position targets q* = q_default + scale x action, as in
    `egoskin.envs.dodgeball.DodgeballEnv`; the bounds are the targets beyond which the
    torque no longer increases.

    **Observation** ``[N]``: the input of the actor, ``observation`` and ``signal``.

    **Info**: ``hit``, ``fallen``, ``diverged``: how the episode ended;
    ``privileged_observation``: extra input of the critic in training
    (`egoskin.envs.observations.Privileged`).

    Reward, start and end of episodes are those of `DodgeballEnv`.

    Args:
        render_mode: ``rgb_array`` to render images, for example with Gymnasium's
            ``RecordVideo``; None for no rendering.
        settings: Fields of `egoskin.EnvConfig`, as its dataclasses or as dictionaries.

    Raises:
        TypeError: If `EnvConfig` has no such field.
        ValueError: If the settings are not valid.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's)

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be 'rgb_array', got {render_mode!r}")
        self._rows = _Rows(settings)
        self.config = self._rows.config
        """Configuration of the environment."""
        self.observation_space = self._rows.observation_space
        self.action_space = self._rows.action_space
        self.render_mode = render_mode
        hz = self.config.task.physics.control_hz
        self.metadata = {**self.metadata, "render_fps": round(hz)}
        self._env: Any = None
        self._painter: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the first observation of the next episode, and its info.

        Args:
            seed: Start with the first episode of this seed, in [0, 2**32).
            options: Not used.
        """
        super().reset(seed=seed)
        if seed is not None or self._env is None:
            seed = _seed(seed, self.np_random)
            config, skin = self.config, self._rows.skin
            drawn = self.render_mode is not None
            self._env = make_worker_env(
                config, skin, num_envs=1, seed=seed, keep_raw=drawn
            )
        self._root = self._now = self._env.reset()
        self._age = 0
        return self._rows.observations(self._root)[0], self._info(self._root)

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info.

        Raises:
            ResetNeeded: Before the first reset.
            ValueError: If the action has another shape, or a value that is NaN or
                infinite.
        """
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._root["action"] = _checked(action, self._rows.action_space.shape)[None]
        step = self._env.step(self._root)
        self._root, after = self._env.step_mdp(step), step["next"]
        self._now, self._age = after, self._age + 1
        return (
            self._rows.observations(after)[0],
            float(after["reward"]),
            bool(after["terminated"]),
            bool(after["truncated"]),
            self._info(after),
        )

    def render(self) -> np.ndarray | None:
        """Return the current image, ``[360, 640, 3]`` uint8, or None without a mode.

        Raises:
            RenderingError: If no OpenGL context can be created.
        """
        if self.render_mode is None:
            return None
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        if self._painter is None:
            # Imported here: OpenGL is needed only for rendering.
            from egoskin.viewer.offscreen import painter_of

            self._painter = painter_of(self.config, self._rows.skin, size=(640, 360))
            self._sensors = self.config.pipeline(self._rows.skin)
        now, hz = self._now[0], self.config.task.physics.control_hz
        detecting = self._sensors.detecting(now)
        return self._painter.draw(now, detecting, time=self._age / hz).image

    def close(self) -> None:
        """Free the resources of the renderer."""
        if self._painter is not None:
            self._painter.__exit__()
            self._painter = None

    def _info(self, td: TensorDictBase) -> dict[str, Any]:
        info = {key: value[0] for key, value in self._rows.info(td).items()}
        return {**info, **{key: bool(info[key]) for key in _FLAGS}}


class DodgeballVector(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of ``num_envs`` robots that have to dodge thrown balls.

    Actions, observations and infos of each robot are those of `DodgeballGym`. When an
    episode ends, the next one starts in the same step; the last observation and info
    are in ``final_obs`` and ``final_info``. The simulations run in worker processes,
    so use it under ``if __name__ == "__main__":``.

    Args:
        num_envs: Number of robots.
        num_workers: Processes; by default the largest divisor of ``num_envs`` not
            above the number of cores. Results do not depend on it.
        settings: Fields of `egoskin.EnvConfig`, as its dataclasses or as dictionaries.

    Raises:
        TypeError: If `EnvConfig` has no such field.
        ValueError: If the settings are not valid.
    """

    # TorchRL reads the attribute, Gymnasium reads the metadata.
    autoreset_mode = AutoresetMode.SAME_STEP
    metadata = {"render_modes": [], "autoreset_mode": autoreset_mode}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, num_workers: int | None = None, **settings: Any
    ) -> None:
        self.num_envs = num_envs
        self._num_workers = check_num_workers(num_envs, num_workers)
        self._rows = _Rows(settings)
        self.config = self._rows.config
        """Configuration of the environment."""
        self.single_observation_space = self._rows.observation_space
        self.single_action_space = self._rows.action_space
        self.observation_space = batch_space(self._rows.observation_space, num_envs)
        self.action_space = batch_space(self._rows.action_space, num_envs)
        self._env: WorkerPool | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the first observations, ``[num_envs, N]``, and their infos.

        Args:
            seed: Start with the first episodes of this seed, in [0, 2**32).
            options: Not used.
        """
        super().reset(seed=seed)
        if seed is not None or self._env is None:
            self.close_extras()
            self._env = make_env(
                self.config,
                self._rows.skin,
                num_envs=self.num_envs,
                seed=_seed(seed, self.np_random),
                num_workers=self._num_workers,
            )
        self._root = self._env.reset()
        return self._rows.observations(self._root), self._info(self._root)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations and infos.

        Raises:
            ValueError: If they have another shape, or a value that is NaN or infinite.
        """
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        shape = self.num_envs, *self._rows.action_space.shape
        action = _checked(actions, shape).reshape(*self._root.batch_size, -1)
        step, self._root = self._env.step_and_maybe_reset(
            self._root.set("action", action)
        )
        after = step["next"]
        assert isinstance(after, TensorDictBase)
        terminated, truncated = (
            _column(after, "terminated"),
            _column(after, "truncated"),
        )
        done = terminated | truncated
        infos = self._info(self._root)
        if done.any():
            final = np.full(self.num_envs, None, dtype=object)
            observations = self._rows.observations(after)
            for row in done.nonzero()[0]:
                final[row] = observations[row]
            infos["final_obs"], infos["_final_obs"] = final, done
            infos["final_info"], infos["_final_info"] = self._info(after, done), done
        return (
            self._rows.observations(self._root),
            _column(after, "reward").astype(np.float64),
            terminated,
            truncated,
            infos,
        )

    def _info(
        self, td: TensorDictBase, which: np.ndarray | None = None
    ) -> dict[str, Any]:
        """Return the infos of some robots in Gymnasium's format (default: all)."""
        which = np.ones(self.num_envs, dtype=bool) if which is None else which
        infos: dict[str, Any] = {}
        for key, value in self._rows.info(td).items():
            value[~which] = 0
            infos[key], infos[f"_{key}"] = value, which.copy()
        return infos

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the worker processes."""
        if self._env is not None:
            self._env.close()


def _seed(seed: int | None, generator: np.random.Generator) -> int:
    """Return the seed of the task, drawn from Gymnasium's generator if None."""
    if seed is None:
        return int(generator.integers(2**32))
    check_seed(seed)
    return seed


gymnasium.register(
    id=ENV_ID,
    entry_point="egoskin.gym:DodgeballGym",
    vector_entry_point="egoskin.gym:DodgeballVector",
)
