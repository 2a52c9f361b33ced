"""Build environments from the task, the sensors and the observations."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import (
    Compose,
    EnvBase,
    ExcludeTransform,
    Transform,
    TransformedEnv,
)

from egoskin.bounds import Interval, check_bounds
from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.observations import HideObjects, Oracle, Privileged, Proprioception
from egoskin.envs.physics import Engine, engine_of
from egoskin.envs.standards import standard_of
from egoskin.memory import check_memory, check_shared_memory
from egoskin.parallel import WorkerPool, allow_open_files, default_num_workers
from egoskin.robots.config import RobotConfig
from egoskin.robots.own import Robot, robot_of
from egoskin.sensors import History, Skin
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.sensors.geometry import STATE_KEYS
from egoskin.sensors.pipeline import SensorPipeline, masks_all
from egoskin.storage.tensor_file import part, prefixed
from egoskin.transform import StatefulTransform

# Larger numbers are taken to be typing errors.
AGENTS, _WORKERS = Interval(ge=1, le=2**20), Interval(ge=1, le=1024)
# Memory of the simulation of one agent, and the memory that workers share besides the
# tensors (at least a page for each tensor) [bytes].
_SIMULATION, _SHARED_EXTRA = 12_000, 2**20
Trainable = WorkerPool | TransformedEnv
"""Environment with all rows of a run, in workers or in this process."""
# Outputs of the transforms that the networks read.
_NETWORK_KEYS = ("observation", "privileged_observation", "signal")


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Robot, task, skin and sensors of an environment."""

    robot: Robot = "h1_2"
    """Robot by name, or your own: a folder with robot.toml, or my_robot.py:ROBOT
    (docs/your-robot.md)."""
    task: DodgeballConfig = dataclasses.field(default_factory=DodgeballConfig)
    """The dodgeball task."""
    skin: SkinConfig = dataclasses.field(default_factory=SkinConfig)
    """Placement of the sensors."""
    sensor: SensorConfig = dataclasses.field(default_factory=SensorConfig)
    """Measurement of the sensors."""
    privileged: Literal["objects", "velocity"] = "objects"
    """Extra critic input: velocity, balls and more, or only the velocity (paper)."""
    previous_action: bool = False
    """Whether the actor also observes its previous action."""
    history: Annotated[int, Interval(ge=1, le=256)] = 1
    """Number of observed steps, including the current one."""

    def __post_init__(self) -> None:
        """Raise ValueError if the history or the gains are not valid."""
        check_bounds(self)
        self.robot_config.joint_gains(self.task.physics.gains)

    @property
    def robot_config(self) -> RobotConfig:
        """The robot."""
        return robot_of(self.robot)

    @property
    def standard(self) -> str:
        """Version of the standard throw of the task, or "custom"."""
        return standard_of(self.task)

    def pipeline(self, skin: Skin | None = None) -> SensorPipeline:
        """Return the sensor pipeline: placement, measurement and signal.

        Args:
            skin: The sensors; by default built from ``skin``.

        Raises:
            ValueError: If skin, robot and configuration are not compatible.
        """
        robot = self.robot_config
        if skin is None:
            skin = self.skin.build(robot)
        return SensorPipeline(self.sensor, robot, skin)

    @property
    def actor_keys(self) -> list[str]:
        """Keys that the actor reads."""
        blind = self.sensor.coverage == "none"
        return ["observation"] if blind else ["observation", "signal"]

    @property
    def critic_keys(self) -> list[str]:
        """Keys that the critic reads."""
        return [*self.actor_keys, "privileged_observation"]


def make_worker_env(
    config: EnvConfig,
    skin: Skin | None = None,
    *,
    num_envs: int,
    seed: int,
    row_offset: int = 0,
    num_threads: int = 1,
    hold: bool = False,
    keep_raw: bool = False,
    bare: bool = False,
    sparse: bool = False,
    mask: Sequence[str] = (),
    engine: Engine = "mujoco",
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """Return the batched environment of one process, with its transforms.

    Args:
        config: Configuration of the environment.
        skin: The sensors; by default built from ``config.skin``.
        num_envs: Number of rows.
        seed: Seed of all random numbers.
        row_offset: Global index of the first row.
        num_threads: Physics threads.
        hold: Whether the robot is held rigid in its default pose.
        keep_raw: Whether to keep the raw state in the output.
        bare: Whether to leave out observations and sensors (to measure their cost).
        sparse: Whether to output the state that the sensors read instead of the
            signal, for the sparse sources of the agent.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.
        engine: Physics engine.
        device: Device of the simulation and of all tensors.

    Raises:
        ValueError: If the skin does not fit the robot, part of ``mask`` has no effect,
            ``sparse`` is combined with a history or a mask of some links, a number is
            out of bounds, or there is no such engine or device.
    """
    if sparse and config.history > 1:
        raise ValueError(
            f"sparse covers only the current state, history {config.history} needs "
            "signals: turn sparse off"
        )
    if sparse and mask and not masks_all(mask):
        raise ValueError("sparse sources cannot mask only some links: turn sparse off")
    sensors = config.pipeline(skin)
    sensors.check_mask(mask)
    # On "meta" there are specs, but no data.
    place = torch.device("meta") if str(device) == "meta" else device_of(str(device))
    env = DodgeballEnv(
        config.robot_config,
        config.task,
        num_envs=num_envs,
        seed=seed,
        row_offset=row_offset,
        num_threads=num_threads,
        hold=hold,
        # Read only from the raw state.
        tactile=keep_raw,
        engine=engine_of(engine),
        device=place,
    )
    transforms: list[Transform] = []
    if not bare:
        transforms += _observations(config, sensors, seed, row_offset, sparse, mask)
    if not keep_raw:
        stateful = [t for t in transforms if isinstance(t, StatefulTransform)]
        kept = {*_NETWORK_KEYS, *(key for t in stateful for key in t.state_keys)}
        written = dict.fromkeys(key for t in transforms for key in t.out_keys)
        raw = [key.name for key in env.state_rows if key.stays_in_worker]
        between = [key for key in written if key not in {*kept, *raw}]
        unread = [key for key in raw if not (sparse and key in STATE_KEYS)]
        transforms.append(ExcludeTransform(*unread, *between))
    return TransformedEnv(env, Compose(transforms).to(env.device))


def _observations(
    config: EnvConfig,
    sensors: SensorPipeline,
    seed: int,
    row_offset: int,
    sparse: bool,
    mask: Sequence[str],
) -> list[Transform]:
    """Return the transforms from the state to what the networks read.

    The arguments are those of `make_worker_env`, and its sensors.
    """
    throws = config.task.throws
    # With a history, the current values have other names.
    suffix = "" if config.history == 1 else "_now"
    default = torch.from_numpy(sensors.robot.default_joint_pos)
    observed = [*Proprioception.STATE_KEYS]
    if config.previous_action:
        observed.append("previous_action")
    transforms: list[Transform] = [
        Proprioception(default, observed, out_keys=[f"observation{suffix}"]),
        Privileged(config.privileged, throws.gravity),
    ]
    if masks_all(mask):
        transforms.append(HideObjects())
    if not sparse:
        transforms += sensors.transforms(
            throws.balls,
            dt=1 / config.task.physics.control_hz,
            seed=seed,
            row_offset=row_offset,
            out_key=f"signal{suffix}",
        )
        sensors.mask(transforms, sensors.masked(mask))
    if config.sensor.coverage == "oracle":
        transforms.append(Oracle(out_keys=[f"signal{suffix}"]))
    if suffix:
        new = [f"{key}{suffix}" for key in config.actor_keys]
        transforms.append(History(config.history, new, config.actor_keys))
    return transforms


def make_env(
    config: EnvConfig,
    skin: Skin | None = None,
    *,
    num_envs: int,
    seed: int,
    num_workers: int | None = None,
    num_threads: int = 1,
    hold: bool = False,
    keep_raw: bool = False,
    bare: bool = False,
    sparse: bool = False,
    mask: Sequence[str] = (),
) -> WorkerPool:
    """Return a ParallelEnv of ``num_workers`` processes, ``[W, num_envs / W]`` rows.

    Args:
        config: Configuration of the environment.
        skin: The sensors; by default built from ``config.skin``.
        num_envs: Total number of agents.
        seed: Seed of all random numbers; results do not depend on the number of
            workers.
        num_workers: Processes; by default the largest divisor of ``num_envs`` not
            above the number of cores.
        num_threads: Physics threads of each worker.
        hold: Whether the robots are held rigid in their default pose.
        keep_raw: Whether to keep the raw state in the output (of `DodgeballEnv`), from
            which transforms of your own compute, say, another reward.
        bare: Whether to leave out observations and sensors.
        sparse: Whether to output the state, not the signal; see `make_worker_env`.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.

    Raises:
        ValueError: If ``num_workers`` does not divide ``num_envs``, memory is too
            small, too few files may be open, MuJoCo cannot build the scene, or as in
            `make_worker_env`.
    """
    workers = check_num_workers(num_envs, num_workers)
    allow_open_files(workers)
    if skin is None:
        # Built once, not in each worker.
        skin = config.skin.build(config.robot_config)
    # Errors in the scene and lack of memory are reported before the workers start.
    options: dict[str, Any] = {
        "seed": seed,
        "keep_raw": keep_raw,
        "bare": bare,
        "sparse": sparse,
        "mask": mask,
    }
    one = make_worker_env(config, skin, num_envs=1, **options)
    assert isinstance(one.base_env, DodgeballEnv)
    one.base_env.check_scene()
    check_env_memory(one, num_envs)
    rows = num_envs // workers
    return WorkerPool(
        [
            partial(
                make_worker_env,
                config,
                skin,
                num_envs=rows,
                row_offset=i * rows,
                num_threads=num_threads,
                hold=hold,
                **options,
            )
            for i in range(workers)
        ]
    )


def check_env_memory(
    one: EnvBase, num_envs: int, others: Mapping[str, int] | None = None
) -> None:
    """Raise ValueError if an environment does not fit into the machine's memory.

    Args:
        one: The same environment with a single row.
        num_envs: Number of agents.
        others: Other memory needs, in the format of `egoskin.memory.check_memory`.
    """
    row = sum(
        spec.shape.numel() * spec.dtype.itemsize
        for spec in one.observation_spec.values(True, True)
    )
    options = "(num_envs or episodes, history, sensors)"
    # The state before and after a step, in the workers and in shared memory.
    agents = num_envs * (_SIMULATION + 4 * row)
    check_memory({f"the agents {options}": agents, **(others or {})})
    exchanged = f"data sent between the processes {options}"
    check_shared_memory(2 * num_envs * row + _SHARED_EXTRA, exchanged)


def check_num_workers(
    num_envs: int,
    num_workers: int | None,
    name: str = "num_envs",
    engine: Engine = "mujoco",
) -> int:
    """Return the number of workers.

    Args:
        num_envs: Number of agents.
        num_workers: Number of workers; None for the default.
        name: Name of the number of agents, for the error text.
        engine: Physics engine.

    Raises:
        ValueError: If it does not divide the number of agents (the text lists valid
            values), if either number is out of bounds, or with engine warp if it is not
            1.
    """
    if engine == "warp" and num_workers not in (None, 1):
        raise ValueError(
            "engine warp simulates in one process: leave out num_workers, got "
            f"{num_workers}"
        )
    agents, processes = (num_envs, AGENTS), (num_workers, _WORKERS)
    for what, (number, valid) in {name: agents, "num_workers": processes}.items():
        if number is not None and (wrong := valid.violation(number)):
            raise ValueError(f"{what} must {wrong}, got {number}")
    if num_workers is None:
        return default_num_workers(num_envs)
    if num_envs % num_workers:
        limit = max(64, num_workers)
        fit = [n for n in range(1, min(num_envs, limit) + 1) if num_envs % n == 0]
        raise ValueError(
            f"num_workers must divide {name} ({num_envs}), got {num_workers}; "
            f"valid: {', '.join(map(str, fit))}"
        )
    return num_workers


def device_of(name: str) -> torch.device:
    """Return a device by name.

    Raises:
        ValueError: If there is no such device.
    """
    valid = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name not in valid and not (name == "cuda" and len(valid) > 1):
        why = ""
        if name.startswith("cuda") and len(valid) == 1:
            why = ": PyTorch finds no GPU, or no driver for it (see nvidia-smi)"
            if not torch.backends.cuda.is_built():
                why = ": this PyTorch is built for the CPU, install one with CUDA"
        raise ValueError(f"no device {name!r}{why}; available: {', '.join(valid)}")
    return torch.device(name)


def print_note(env: Trainable) -> None:
    """Print a note if a limit affected the simulation; see `Physics.note`.

    A note covers the time since the last call. Workers use MuJoCo, which has no such
    limits.
    """
    if isinstance(env, TransformedEnv):
        assert isinstance(env.base_env, DodgeballEnv)
        if (note := env.base_env.physics.note()) is not None:
            print(f"note: {note}", file=sys.stderr)


def save_env_state(env: Trainable, root: TensorDictBase) -> dict[str, Tensor]:
    """Return the state of all rows, from which to continue bit for bit.

    Args:
        env: Result of `make_env` or `make_worker_env`, stepped or reset at least once.
        root: The tensordict from which the next step would start.
    """
    return {
        **prefixed("simulation", env.simulation_state()),
        **prefixed("root", {k: v.clone() for k, v in root.reshape(-1).items()}),
    }


def load_env_state(env: Trainable, state: dict[str, Tensor]) -> TensorDictBase:
    """Load a saved state into an environment; return the root tensordict.

    Args:
        env: A fresh environment with the same rows and any number of workers.
        state: Result of `save_env_state`.
    """
    root = env.reset()
    env.load_simulation_state(part("simulation", state))
    for key in root.keys():
        value, own = state[f"root/{key}"], root[key]
        root.set(key, value.reshape(own.shape).to(own.device, copy=True))
    return root
