"""What a training is made of, and how a command line says it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import torch
import tyro

from egoskin.agents.ppo import PPOConfig
from egoskin.bounds import COUNT, POSITIVE, check_bounds
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import Engine, engine_of
from egoskin.envs.standards import CUSTOM, Standard, training_task
from egoskin.make import EnvConfig, check_num_workers, device_of
from egoskin.parallel import available_cores
from egoskin.rng import check_seed
from egoskin.storage.formats import present_config, read_sealed
from egoskin.storage.serialization import (
    changed_fields,
    from_plain,
    to_plain,
)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train a robot to dodge balls by what its skin feels."""

    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Networks and PPO."""
    standard: Standard | None = None
    """Version of the standard throw: sets throws and ends. None: 2, the defaults. A
    throw or end given beside it makes the task custom."""
    seed: int = 0
    """Seed of everything random: throws, starts, networks, actions."""
    total_frames: Annotated[int, COUNT] = 65_536_000
    """Environment steps of the whole run (the paper's 1000 epochs)."""
    num_envs: int = 4096
    """Agents simulated in parallel."""
    num_workers: int | None = None
    """Processes that simulate; None: the largest divisor of num_envs <= cores. Engine
    warp needs none."""
    engine: Engine = "mujoco"
    """What simulates: MuJoCo on the CPU; MuJoCo Warp on the device, made for a GPU
    (extra gpu)."""
    device: str = "cpu"
    """Device of the learner, and of engine warp ("cpu", "cuda", "cuda:1")."""
    learner_threads: Annotated[int | None, COUNT] = None
    """Threads of the learner; None: one for each core."""
    run_dir: Path | None = None
    """Folder of the run; None: a new one under runs/, named after time and sensor."""
    snapshot_frames: Annotated[int, COUNT] = 5_000_000
    """Environment steps between the policies kept for learning curves."""
    film_every: Annotated[int | None, COUNT] = None
    """Environment steps between small films of the policy, in films/ of the run folder;
    None: none."""
    log: Literal["files", "wandb"] = "files"
    """Where metrics go: metrics.csv and TensorBoard files; wandb: Weights & Biases, too
    (extra wandb)."""
    checkpoint_interval: Annotated[float, POSITIVE] = 60.0
    """A checkpoint is at most this old [s]."""
    config: Path | None = None
    """config.json of a run to repeat: what it holds are the defaults, and the skin must
    come out the same."""
    resume: Path | None = None
    """Run folder to go on with; changed may be --total-frames, to a later end, and what
    changes no result: workers, threads, when checkpoints and policies are kept."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which no run can start."""
        check_bounds(self)
        check_seed(self.seed)
        check_num_workers(self.num_envs, self.num_workers)
        if self.engine == "warp" and self.num_workers not in (None, 1):
            raise ValueError(
                "engine warp simulates all agents in one process: leave out "
                f"num_workers, got {self.num_workers}"
            )
        if self.standard is not None and self.env.standard not in (
            self.standard,
            CUSTOM,
        ):
            raise ValueError(
                f"standard={self.standard} is for the command line, and the task is of "
                f"standard {self.env.standard}: build one with egoskin.envs.standards."
                f"training_task({self.standard!r}, DodgeballConfig())"
            )
        frames = self.num_envs * self.ppo.rollout_steps
        if frames < self.ppo.num_mini_batches:
            raise ValueError(
                f"a rollout of {frames} frames cannot be split into "
                f"{self.ppo.num_mini_batches} minibatches"
            )

    @property
    def frames_per_batch(self) -> int:
        """Environment steps of one rollout."""
        return self.num_envs * self.ppo.rollout_steps

    @property
    def num_learner_threads(self) -> int:
        """Threads of the learner on this machine; results do not depend on it."""
        return self.learner_threads or available_cores()

    def check_machine(self) -> None:
        """Raise ValueError for what this machine lacks: the device, the engine."""
        self.learner_device()
        engine_of(self.engine)

    def learner_device(self) -> torch.device:
        """Return the device of the learner.

        Raises:
            ValueError: If there is no such device.
        """
        return device_of(self.device)


CALL_FIELDS = ("run_dir", "resume", "config", "standard")
"""Fields that say how a run was called: its stored configuration leaves them out."""
MACHINE_FIELDS = frozenset(
    (
        *CALL_FIELDS,
        "num_workers",
        "learner_threads",
        "snapshot_frames",
        "film_every",
        "log",
        "checkpoint_interval",
    )
)
"""Fields that say how a run was called, where it is computed and what is kept of it:
they change no result, to the last bit, and may change at a resume. The device is none
of them: sums on another one round otherwise."""
SKIN_HASH = "skin_sha256"
"""What config.json holds beside the configuration: the hash of the skin."""


def parse_config(args: list[str]) -> TrainConfig:
    """Return the configuration of a command line.

    With ``--config FILE`` a stored configuration is the default. With ``--resume RUN``
    that of the run is, and no field but ``total_frames`` and `MACHINE_FIELDS` may
    differ from it.

    Args:
        args: Arguments, without the program's name.

    Raises:
        ValueError: If a field is changed that may not be, or the end lies before the
            one planned.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("--resume", "--config", "--standard"):
        first.add_argument(name, type=lambda text: None if text == "None" else text)
    given, _ = first.parse_known_args(args)
    if given.resume is None:
        return tyro.cli(TrainConfig, args=args, default=_default_of(given))
    if given.standard is not None:
        raise ValueError("--standard cannot be changed on resume")
    if given.config is not None:
        raise ValueError("--resume goes on with a run, --config repeats one: not both")
    path = Path(given.resume)
    stored = load_config(path)
    # What the file lacks was filled with today's defaults.
    file, before = path / "config.json", to_plain(stored)
    absent = changed_fields(read_config(file)[0], before)
    if lacking := [name for name in absent if name not in MACHINE_FIELDS]:
        raise ValueError(
            f"{file} lacks {', '.join(lacking)}: another version made it. Go on with "
            "that version (its commit is in versions.json)"
        )
    config = tyro.cli(TrainConfig, args=args, default=stored)
    if config.run_dir is not None:
        raise ValueError("--run-dir cannot be changed on resume")
    free = MACHINE_FIELDS | {"total_frames"}
    changed = [n for n in changed_fields(before, to_plain(config)) if n not in free]
    if changed:
        names = ", ".join(n.removeprefix("env.") for n in changed)
        may = sorted(free - set(CALL_FIELDS))
        raise ValueError(
            f"a resumed run keeps its configuration; changed: {names}. Only "
            f"{', '.join(map(_option, may))} may be"
        )
    if config.total_frames < stored.total_frames:
        raise ValueError(
            f"--total-frames {config.total_frames} is before the planned end "
            f"{stored.total_frames}"
        )
    return config


def _default_of(given: argparse.Namespace) -> TrainConfig:
    """Return what a new run is made of where its command line says nothing.

    Args:
        given: What it says of ``config`` and ``standard``, each a text or None.

    Raises:
        ValueError: If there is no such configuration, or both are given.
    """
    if given.config is not None:
        if given.standard is not None:
            raise ValueError("--config brings its own throws: leave out --standard")
        path = Path(given.config)
        if not path.is_file():
            raise ValueError(f"no file {path}: --config takes the config.json of a run")
        return from_plain(TrainConfig, read_config(path)[0], str(path))
    if given.standard not in get_args(Standard):
        return TrainConfig()
    task = training_task(given.standard, DodgeballConfig())
    return TrainConfig(env=EnvConfig(task=task))


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def load_config(path: Path, *, quiet: bool = False) -> TrainConfig:
    """Return the configuration of a run folder.

    Args:
        path: The folder.
        quiet: Whether to say nothing of a file without a seal.

    Raises:
        ValueError: If it is none, or its configuration is damaged.
    """
    file = path / "config.json"
    if not file.is_file():
        raise ValueError(f"{path} is no run folder: it has no config.json")
    return from_plain(TrainConfig, read_config(file, quiet=quiet)[0], str(file))


def read_config(
    file: Path, *, quiet: bool = False
) -> tuple[dict[str, Any], str | None]:
    """Return (configuration in the present format, hash of the skin if it holds one).

    Args:
        file: The file.
        quiet: Whether to say nothing of one without a seal.

    Raises:
        ValueError: If it is damaged, or has options that are no more.
    """
    content, number = read_sealed(file, quiet=quiet)
    skin = content.pop(SKIN_HASH, None)
    return present_config(content, number, str(file)), skin
