"""Environment steps/s of the training loop, layer by layer."""

from __future__ import annotations

import ctypes
import os
import statistics
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from operator import truediv
from pathlib import Path
from typing import Annotated, Any, cast

import psutil
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from egoskin.agents.normalizers import RunningNorm
from egoskin.agents.ppo import PPO, PPOConfig
from egoskin.agents.rollout import collect
from egoskin.bounds import COUNT, NOT_NEGATIVE, check_bounds
from egoskin.commands.bench.report import Row, median_row, show
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.physics.mujoco import MujocoPhysics
from egoskin.make import (
    EnvConfig,
    check_num_workers,
    load_env_state,
    make_env,
    save_env_state,
)
from egoskin.parallel import WorkerPool, available_cores
from egoskin.policies.policy import PolicySpec, sparse_sources
from egoskin.sensors import Field
from egoskin.storage.tensor_file import part


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Environment steps/s of the training loop, layer by layer, and where time goes.

    Every layer starts from the same recorded state of a training and replays its
    actions (raw also its throws and resets). Ratios to raw are medians over pairs
    measured in turn, so that other load on the machine does not bias them. The time
    that a layer adds to the previous one is given as wall time and as CPU time of all
    processes.
    """

    num_envs: int = 4096
    """Agents."""
    num_workers: int | None = None
    """Processes; None: the largest divisor of num_envs <= cores."""
    warmup: Annotated[int, NOT_NEGATIVE] = 8
    """Rollouts to train before the recording, so that it is typical."""
    rounds: Annotated[int, COUNT] = 5
    """How often each layer is measured, in turn."""
    seed: int = 0
    """Seed of the training."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Networks and PPO."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        check_num_workers(self.num_envs, self.num_workers)
        sensor = self.env.sensor
        if (sensor.coverage, sensor.reduce) != ("field", "none"):
            raise ValueError(
                "env.sensor.coverage and env.sensor.reduce have no effect: field and "
                "full ray grid are measured"
            )


class Recording(MujocoPhysics):
    """Physics that records its method calls, to replay them with raw MuJoCo steps."""

    written: list[tuple[str, tuple]]

    def set_target(self, target: Tensor) -> None:
        """Set the targets, and record the call."""
        self.written.append(("set_target", (target,)))
        super().set_target(target)

    def park(self, objects: Tensor) -> None:
        """Park objects; record those that were not parked before."""
        fresh = objects & ~self._parked
        self._parked = objects.clone()
        if fresh.any():
            self.written.append(("park", (fresh,)))
        super().park(objects)

    def reset(self, rows: Tensor, base_pose: Tensor, joint_pos: Tensor) -> None:
        """Reset rows, and record the call."""
        self.written.append(("reset", (rows, base_pose, joint_pos)))
        super().reset(rows, base_pose, joint_pos)

    def throw(
        self, rows: Tensor, objects: Tensor, position: Tensor, velocity: Tensor
    ) -> None:
        """Throw, and record the call."""
        self.written.append(("throw", (rows, objects, position, velocity)))
        super().throw(rows, objects, position, velocity)

    def forget(self) -> None:
        """Delete the recorded calls."""
        self.written = []
        self._parked = torch.zeros(self.num_envs, self.num_objects, dtype=torch.bool)


Layer = tuple[Callable[[], Any], Callable[[Any], object]]
"""Function that prepares a layer, and function that is timed."""


def replay_raw(physics: MujocoPhysics, written: list[tuple[str, tuple]]) -> None:
    """Replay recorded calls with only MuJoCo's steps."""
    for method, args in written:
        getattr(MujocoPhysics, method)(physics, *args)
        if method == "set_target":
            physics.step_raw()


def loop(config: LoopConfig) -> list[Row]:
    """Return the rows of the loop benchmark, for the field and the ray grid."""
    rows = []
    for coverage in ("field", "ray"):
        # Options of the field are for the field.
        own = {} if coverage == "field" else {"field": Field()}
        sensor = replace(config.env.sensor, coverage=coverage, **own)
        env = replace(config.env, sensor=sensor)
        rows += _Loop(config, env).rows()
    return rows


class _Loop:
    """The layers of one training.

    Args:
        config: The benchmark.
        env: Its environment with the coverage to measure.
    """

    def __init__(self, config: LoopConfig, env: EnvConfig) -> None:
        self.config, self._env, self._coverage = config, env, env.sensor.coverage
        self._skin = env.skin.build(env.robot_config)
        self._workers = check_num_workers(config.num_envs, config.num_workers)
        self._sources = sparse_sources(env, self._skin)
        self._steps = config.ppo.rollout_steps

    def rows(self) -> list[Row]:
        """Measure the layers; return their rows."""
        pool = self._pool = self._make_pool()
        pools = [pool]
        try:
            memory = self._train_and_record()
            layers = {"raw": self._raw()}
            again = partial(self._restore, pool)
            if self._coverage == "field":
                bare = self._make_pool(bare=True)
                pools.append(bare)
                layers["task"] = self._task()
                layers["env"] = partial(self._restore, bare), self._replay(bare)
                layers["sensors"] = again, self._replay(pool)
                layers["policy"] = again, self._collect
                layers["train_field"] = again, self._train
                layers["normalisation"] = lambda: None, self._normalise
            else:
                layers["train_ray_grid"] = again, self._train
            return [*self._time(layers), self._serial(), memory]
        finally:
            for each in pools:
                each.close()

    def _make_pool(self, bare: bool = False) -> WorkerPool:
        config = self.config
        return make_env(
            self._env,
            self._skin,
            num_envs=config.num_envs,
            num_workers=self._workers,
            seed=config.seed,
            bare=bare,
            sparse=bool(self._sources),
        )

    def _train_and_record(self) -> Row:
        """Train for a while and record a rollout to replay; return the peak memory."""
        config, env = self.config, self._pool
        torch.manual_seed(config.seed)
        network, sources = config.ppo.network, self._sources
        spec = PolicySpec.of(self._env, self._skin, network, env, sources)
        self._agent = spec.build_agent(sources)
        # As many threads as a training uses.
        self._ppo = PPO(self._agent, config.ppo, available_cores())
        root = env.reset()
        with PeakMemory() as memory:
            for i in range(max(config.warmup, 1)):
                show(f"warming up: rollout {i + 1}/{config.warmup}")
                rollout, root, _ = collect(env, self._agent, root, self._steps)
                self._ppo.update(rollout)
        self._start = save_env_state(env, root)
        self._rollout, _, _ = collect(env, self._agent, root, self._steps)
        self._actions = self._rollout["action"]
        return Row(
            name=f"memory_{self._coverage}",
            value=memory.peak / 1e9,
            unit="GB of PSS, all processes",
            ratio=1.0,
        )

    def _restore(self, pool: WorkerPool) -> TensorDictBase:
        return load_env_state(pool, self._start)

    def _replay(self, env: EnvBase) -> Callable[[TensorDictBase], object]:
        def run(root: TensorDictBase) -> None:
            for action in self._actions:
                root["action"] = action.reshape(*root.batch_size, -1)
                _, root = env.step_and_maybe_reset(root)

        return run

    def _collect(self, root: TensorDictBase) -> None:
        collect(self._pool, self._agent, root, self._steps)

    def _train(self, root: TensorDictBase) -> None:
        self._ppo.update(collect(self._pool, self._agent, root, self._steps)[0])

    def _serial(self) -> Row:
        """Return the serial time, which more threads or processes cannot reduce.

        This is the CPU time of this process's first thread. The ratio is to the CPU
        time of all workers.
        """
        pool, serial, ratios = self._pool, [], []
        frames = self._steps * self.config.num_envs
        for i in range(self.config.rounds):
            show(f"round {i + 1}/{self.config.rounds}: serial share")
            root = self._restore(pool)
            alone, others = time.thread_time(), cpu_time(_processes()[1:])
            self._train(root)
            spent = time.thread_time() - alone
            serial.append(1e6 * spent / frames)
            ratios.append(spent / (cpu_time(_processes()[1:]) - others))
        show("")
        unit = "us of CPU time per environment step, the first thread alone"
        return median_row(f"serial_{self._coverage}", serial, ratios, unit)

    def _normalise(self, _: None) -> None:
        """Update the normalisers with a rollout, as in training, and restore them."""
        norms = self._agent.norms
        before = {k: v.clone() for k, v in norms.state_dict().items()}
        for key, norm in norms.items():
            assert isinstance(norm, RunningNorm)
            norm.update(self._rollout[key])
        norms.load_state_dict(before)

    def _recorder(self) -> DodgeballEnv:
        env = DodgeballEnv(
            self._env.robot_config,
            self._env.task,
            num_envs=self.config.num_envs,
            seed=self.config.seed,
            num_threads=self._workers,
            tactile=False,
            engine=Recording,
        )
        assert isinstance(env.physics, Recording)
        env.physics.forget()
        return env

    def _raw(self) -> Layer:
        """Return the layer of MuJoCo's steps alone, in this process."""
        env, simulation = self._recorder(), part("simulation", self._start)
        physics = env.physics
        assert isinstance(physics, Recording)
        root = env.reset()
        env.load_simulation_state(simulation)
        physics.forget()
        self._replay(env)(root)
        written = physics.written
        return (
            lambda: physics.load_state(simulation["physics"]),
            lambda _: replay_raw(physics, written),
        )

    def _task(self) -> Layer:
        """The task in this process, without workers, observations and sensors."""
        env, simulation = self._recorder(), part("simulation", self._start)
        env.reset()

        def restore() -> TensorDictBase:
            root = env.reset()
            env.load_simulation_state(simulation)
            cast(Recording, env.physics).forget()
            return root

        return restore, self._replay(env)

    def _time(self, layers: dict[str, Layer]) -> list[Row]:
        """Time the layers in turn; return their speeds and the time that each adds."""
        frames = self._steps * self.config.num_envs
        wall: dict[str, list[float]] = {name: [] for name in layers}
        cpu: dict[str, list[float]] = {name: [] for name in layers}
        for i in range(self.config.rounds):
            for name, (prepare, run) in layers.items():
                show(f"round {i + 1}/{self.config.rounds}: {name}")
                prepared = prepare()
                begin, used = time.perf_counter(), cpu_time(_processes())
                run(prepared)
                wall[name].append(1e6 * (time.perf_counter() - begin) / frames)
                cpu[name].append(1e6 * (cpu_time(_processes()) - used) / frames)
        show("")
        raw = wall["raw"]
        rows = [
            Row(
                name=name if name != "raw" or self._coverage == "field" else "raw_ray",
                value=1e6 / statistics.median(values),
                unit="environment steps/s",
                ratio=statistics.median(map(truediv, raw, values)),
            )
            for name, values in wall.items()
            if name != "normalisation"
        ]
        if self._coverage == "field":
            rows += _parts(wall, "wall") + _parts(cpu, "CPU")
        return rows


def _processes() -> list[psutil.Process]:
    """Return this process and all its descendants."""
    return [psutil.Process(), *psutil.Process().children(recursive=True)]


def cpu_time(processes: list[psutil.Process]) -> float:
    """Return the CPU time of processes so far [s].

    Read from their clocks: `psutil.Process.cpu_times` counts in ticks of 10 ms, within
    which a small layer ends.

    Raises:
        ProcessLookupError: If a process has ended.
    """
    clock, times = ctypes.c_int(), []
    for process in processes:
        error = ctypes.CDLL(None).clock_getcpuclockid(process.pid, ctypes.byref(clock))
        if error:
            raise OSError(error, os.strerror(error), str(process))
        times.append(time.clock_gettime(clock.value))
    return sum(times)


def _pss(process: psutil.Process) -> int:
    """Return the proportional set size of a process, 0 if it has ended."""
    try:
        return process.memory_full_info().pss
    except psutil.NoSuchProcess:
        return 0


def _parts(times: dict[str, list[float]], kind: str) -> list[Row]:
    """Return the time that each layer adds to the previous one [us]."""
    median = {name: statistics.median(values) for name, values in times.items()}
    loss = median["train_field"] - median["policy"] - median["normalisation"]
    parts = {
        "physics": median["raw"],
        "task": median["task"] - median["raw"],
        "transport": median["env"] - median["task"],
        "sensors": median["sensors"] - median["env"],
        "policy": median["policy"] - median["sensors"],
        "normalisation": median["normalisation"],
        "loss": loss,
    }
    return [
        Row(
            name=f"{name}_{kind.lower()}",
            value=value,
            unit=f"us of {kind} time per environment step",
            ratio=value / parts["physics"],
        )
        for name, value in parts.items()
    ]


class PeakMemory:
    """Measures the peak proportional set size of all processes while it is open."""

    def __init__(self) -> None:
        self.peak = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> PeakMemory:
        """Start to watch."""
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop watching."""
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.wait(0.1):
            self.peak = max(self.peak, sum(map(_pss, _processes())))
