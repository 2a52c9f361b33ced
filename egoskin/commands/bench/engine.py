"""Speed and memory of engine warp against the number of worlds."""

from __future__ import annotations

import dataclasses
import gc
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from operator import truediv
from pathlib import Path
from typing import Annotated

import psutil
import torch
from torchrl.envs import TransformedEnv

from egoskin.agents.ppo import PPO
from egoskin.agents.rollout import collect
from egoskin.bounds import COUNT, check_bounds
from egoskin.commands.bench.report import Row, show
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.physics import engine_of
from egoskin.make import EnvConfig, device_of
from egoskin.policies.policy import PolicySpec, sparse_sources
from egoskin.runs.config import TrainConfig
from egoskin.runs.trainer import make_training_env


@dataclass(frozen=True, kw_only=True)
class EngineBench:
    """Environment steps/s of engine warp against the number of worlds.

    The layers are physics alone; with throws, sensors and the encoding of observations,
    for the field and the full ray grid; and with learning. Memory is that of the
    device or, on the CPU, of the process.
    """

    device: str = "cpu"
    """Device of engine and learner ("cpu", "cuda", "cuda:1")."""
    worlds: Annotated[tuple[int, ...], COUNT] = (1024, 2048, 4096, 8192, 16384, 32768)
    """Numbers of worlds."""
    rounds: Annotated[int, COUNT] = 3
    """How often each layer is measured, in turn; a measurement is a rollout."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for values that cannot be measured on this machine."""
        check_bounds(self)
        device_of(self.device)
        engine_of("warp")


def engine_rows(config: EngineBench) -> list[Row]:
    """Return the rows of the engine benchmark; ratios are to physics alone."""
    return [row for worlds in config.worlds for row in _rows(config, worlds)]


def _rows(config: EngineBench, worlds: int) -> list[Row]:
    """Measure one number of worlds."""
    device, times = device_of(config.device), dict[str, list[float]]()
    steps = TrainConfig().ppo.rollout_steps

    def measure(coverage: str) -> Row:
        layers = _layers(coverage, worlds, config.device)
        # Warm up by a rollout of each: kernels compile, and robots leave their rest.
        for work in layers.values():
            work()
        for _ in range(config.rounds):
            for name, work in layers.items():
                show(f"{worlds} worlds: {name}")
                _synchronize(device)
                begin = time.perf_counter()
                work()
                _synchronize(device)
                times.setdefault(name, []).append(time.perf_counter() - begin)
        name, used = f"memory_{coverage}_{worlds}", _memory(device) / 1e9
        return Row(name=name, value=used, unit="GB", ratio=1.0)

    memory = []
    for coverage in ("field", "ray"):
        memory.append(measure(coverage))
        # Free its memory before the next measurement.
        gc.collect()
        if device.type == "cuda":
            torch.cuda.empty_cache()
    show("")
    return [
        Row(
            name=f"{name}_{worlds}",
            value=worlds * steps / statistics.median(spent),
            unit="environment steps/s",
            ratio=statistics.median(map(truediv, times["physics"], spent)),
        )
        for name, spent in times.items()
    ] + memory


def _layers(coverage: str, worlds: int, device: str) -> dict[str, Callable[[], None]]:
    """Return the functions to measure by name; each runs a rollout."""
    sensor = dataclasses.replace(EnvConfig().sensor, coverage=coverage)
    config = TrainConfig(
        env=EnvConfig(sensor=sensor), engine="warp", device=device, num_envs=worlds
    )
    skin = config.env.skin.build(config.env.robot_config)
    sources = sparse_sources(config.env, skin)
    env = make_training_env(config, skin, bool(sources))
    assert isinstance(env, TransformedEnv)
    task, steps = env.base_env, config.ppo.rollout_steps
    assert isinstance(task, DodgeballEnv)
    torch.manual_seed(0)
    network = config.ppo.network
    spec = PolicySpec.of(config.env, skin, network, env, sources)
    agent = spec.build_agent(sources).to(device)
    ppo = PPO(agent, config.ppo, config.num_learner_threads)
    root = env.reset()

    def physics() -> None:
        # The latest targets are held.
        for _ in range(steps):
            task.physics.step_raw()

    @torch.no_grad()
    def sensors() -> None:
        nonlocal root
        for _ in range(steps):
            agent.encode(agent.sense(root.select(*agent.read_keys)))
            noise = torch.randn(worlds, spec.num_actions, device=device)
            root["action"] = 0.3 * noise
            _, root = env.step_and_maybe_reset(root)

    def rollout() -> None:
        nonlocal root
        rollout, root, _ = collect(env, agent, root, steps)
        ppo.update(rollout)

    layers = {f"sensors_{coverage}": sensors, f"train_{coverage}": rollout}
    if coverage == "field":
        layers = {"physics": physics, **layers}
    return layers


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _memory(device: torch.device) -> int:
    """Return the memory in use [bytes]."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    return psutil.Process(os.getpid()).memory_info().rss
