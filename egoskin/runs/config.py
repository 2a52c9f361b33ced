"""Configuration of a training, and its command line."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from egoskin.agents.ppo import PPOConfig
from egoskin.bounds import COUNT, POSITIVE, check_bounds
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import Engine
from egoskin.envs.standards import CUSTOM, Standard, training_task
from egoskin.make import EnvConfig, check_num_workers
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
    """Train a robot to dodge balls with a skin of proximity sensors."""

    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Networks and PPO."""
    standard: Standard | None = None
    """Version of the standard throw: sets throws and ends of episodes. None: 2, the
    defaults. Changing a throw or end in addition makes the task custom."""
    seed: int = 0
    """Seed of all random numbers: throws, starts, networks, actions."""
    total_frames: Annotated[int, COUNT] = 65_536_000
    """Environment steps of the whole run (the default: a third of the paper's)."""
    num_envs: int = 4096
    """Agents simulated in parallel."""
    num_workers: int | None = None
    """Simulation processes; None: the largest divisor of num_envs <= cores. Engine
    warp: leave out (one process)."""
    engine: Engine = "mujoco"
    """Physics engine: MuJoCo on the CPU, or MuJoCo Warp on the device, made for a GPU
    (extra gpu)."""
    device: str = "cpu"
    """Device of the learner, and of engine warp ("cpu", "cuda", "cuda:1")."""
    learner_threads: Annotated[int | None, COUNT] = None
    """Threads of the learner on a CPU, at most 4; None: one per core, up to that."""
    run_dir: Path | None = None
    """Folder of the run; None: a new one under runs/, named after time, robot (if it is
    not the H1-2) and sensor."""
    snapshot_frames: Annotated[int, COUNT] = 5_000_000
    """Environment steps between the policies saved for learning curves."""
    film_every: Annotated[int | None, COUNT] = None
    """Environment steps between small films of the policy, in films/ of the run folder;
    None: no films."""
    log: Literal["files", "wandb"] = "files"
    """Where metrics go: metrics.csv and TensorBoard files; wandb: also Weights & Biases
    (extra wandb)."""
    checkpoint_interval: Annotated[float, POSITIVE] = 60.0
    """Maximum age of the latest checkpoint [s]."""
    init_from: Path | None = None
    """Policy or run whose networks are trained further, as on another task or range.
    Only the networks, with their standard deviation, and normalisers are taken; frames
    and schedules start at 0. None: new networks."""
    config: Path | None = None
    """config.json of a run to repeat: its values are the defaults, and the skin must be
    the same."""
    resume: Path | None = None
    """Run folder to resume. Only --total-frames (to a later end) may change, and what
    changes no result: workers, threads, films, log, intervals of saving."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        check_seed(self.seed)
        check_num_workers(self.num_envs, self.num_workers, engine=self.engine)
        if self.standard is not None and self.env.standard not in (
            self.standard,
            CUSTOM,
        ):
            raise ValueError(
                f"standard={self.standard} is for the command line, but the task has "
                f"standard {self.env.standard}: build it with egoskin.envs.standards."
                f"training_task({self.standard!r}, DodgeballConfig())"
            )
        frames = self.frames_per_batch
        if frames < 2:
            raise ValueError("a rollout must have at least 2 frames, not 1")
        if frames < self.ppo.num_mini_batches:
            raise ValueError(
                f"a rollout of {frames} frames cannot be split into "
                f"{self.ppo.num_mini_batches} minibatches"
            )

    @property
    def frames_per_batch(self) -> int:
        """Number of environment steps per rollout."""
        return self.num_envs * self.ppo.rollout_steps

    @property
    def num_learner_threads(self) -> int:
        """Threads of the learner on this machine; results do not depend on it."""
        return self.learner_threads or available_cores()


CALL_FIELDS = ("run_dir", "resume", "config", "standard")
"""Fields of the command line only; the stored configuration omits their values."""
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
"""Fields for the call, the machine and the saved files of a run. Results do not depend
on them, bit for bit. The device is not included: rounding of sums differs between
devices."""
RESUME_FIELDS = MACHINE_FIELDS | {"total_frames"}
"""Fields that may change on resume."""
SKIN_HASH = "skin_sha256"
"""Key of the hash of the skin in config.json, beside the configuration."""
INIT_HASH = "init_sha256"
"""Key of the hash of the networks that ``init_from`` named, if it did."""


def parse_config(args: list[str]) -> TrainConfig:
    """Return the configuration of a command line.

    With ``--config FILE``, the defaults come from a stored configuration. With
    ``--resume RUN``, they come from the run, and only `RESUME_FIELDS` may differ from
    it.

    Args:
        args: Arguments, without the program's name.

    Raises:
        ValueError: If a field is changed that must not change, or the end is before the
            planned one.
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
        raise ValueError("--resume continues a run, --config repeats one: use one")
    path = Path(given.resume)
    stored = load_config(path)
    # Fields missing in the file were filled with the current defaults.
    file, before = path / "config.json", to_plain(stored)
    absent = changed_fields(read_config(file)[0], before)
    if lacking := [name for name in absent if name not in MACHINE_FIELDS]:
        raise ValueError(
            f"{file} lacks {', '.join(lacking)}: another version wrote it. Resume with "
            "that version (its commit is in versions.json)"
        )
    config = tyro.cli(TrainConfig, args=args, default=stored)
    if config.run_dir is not None:
        raise ValueError("--run-dir cannot be changed on resume")
    changed = changed_fields(before, to_plain(config))
    if changed := [name for name in changed if name not in RESUME_FIELDS]:
        names = ", ".join(n.removeprefix("env.") for n in changed)
        may = sorted(RESUME_FIELDS - set(CALL_FIELDS))
        raise ValueError(
            f"a resumed run keeps its configuration; changed: {names}. Only "
            f"{', '.join(map(_option, may))} may change"
        )
    if config.total_frames < stored.total_frames:
        raise ValueError(
            f"--total-frames {config.total_frames} is before the planned end "
            f"{stored.total_frames}"
        )
    return config


def _default_of(given: argparse.Namespace) -> TrainConfig:
    """Return the default configuration of a new run.

    Args:
        given: Options ``config`` and ``standard``, each a text or None.

    Raises:
        ValueError: If the configuration does not exist, or both are given.
    """
    if given.config is not None:
        if given.standard is not None:
            raise ValueError("--config has its own throws: leave out --standard")
        path = Path(given.config)
        if not path.is_file():
            folder = f" (a folder: try {path / 'config.json'})" * path.is_dir()
            raise ValueError(
                f"no file {path}{folder}: --config takes the config.json of a run"
            )
        content, _ = read_config(path)
        if not all(isinstance(content.get(part), dict) for part in ("env", "ppo")):
            raise ValueError(
                f"{path} is not the config.json of a run: it has no env or no ppo"
            )
        return from_plain(TrainConfig, content, str(path))
    if given.standard not in get_args(Standard):
        return TrainConfig()
    task = training_task(given.standard, DodgeballConfig())
    return TrainConfig(env=EnvConfig(task=task))


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def load_config(path: Path) -> TrainConfig:
    """Return the configuration of a run folder.

    Args:
        path: The folder.

    Raises:
        ValueError: If it is not a run folder, or its configuration is damaged.
    """
    file = path / "config.json"
    if not file.is_file():
        raise ValueError(f"{path} is not a run folder: it has no config.json")
    return from_plain(TrainConfig, read_config(file)[0], str(file))


def read_config(
    file: Path, *, quiet: bool = False
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return (configuration in the current format, hashes by `SKIN_HASH`, `INIT_HASH`).

    Args:
        file: The file.
        quiet: Whether to accept a file without a seal silently.

    Raises:
        ValueError: If it is damaged, or has options that no longer exist.
    """
    content, number = read_sealed(file, quiet=quiet)
    names = [name for name in (SKIN_HASH, INIT_HASH) if name in content]
    hashes = {name: content.pop(name) for name in names}
    return present_config(content, number, str(file)), hashes
