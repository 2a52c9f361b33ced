"""A training run is a folder: configuration, metrics, checkpoints, policies.

    config.json              the resolved configuration
    skin.json                the sensors
    versions.json            packages, machine, git state, command of each start
    metrics.csv              one line for each rollout; TensorBoard files beside it
    checkpoint.safetensors   everything needed to go on, at most a minute old
    policies/<frames>.safetensors   self-contained policies, from the first on
    not-finite-<frames>.safetensors   an update that failed, for scripts/replay.py
    lock                     held by the process that trains

Contract: a checkpoint is written atomically, metrics written after it are dropped on
resume, and one process trains at a time, so that a log has neither a gap nor a
repetition.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import fcntl
import importlib.metadata
import io
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import torch
import tyro
from torch import Tensor

from egoskin.agents.ppo import PPOConfig
from egoskin.checkpoint import PARTIAL, load_tensors, save_tensors, sync, write_file
from egoskin.cli import check_counts
from egoskin.draws import check_seed
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.standards import Standard, training_task
from egoskin.events import EventFile
from egoskin.make import EnvConfig, check_num_workers
from egoskin.plain import changed_fields, check_numbers, from_plain, read_json, to_plain
from egoskin.policies import CHECKPOINT_NAME
from egoskin.workers import available_cores

_PACKAGES = ("egoskin", "torch", "torchrl", "tensordict", "mujoco", "numpy")
_PACKAGES += ("pytorch-kinematics", "gymnasium")


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
    total_frames: int = 65_536_000
    """Environment steps of the whole run (the paper's 1000 epochs)."""
    num_envs: int = 4096
    """Agents simulated in parallel."""
    num_workers: int | None = None
    """Processes that simulate; None: the largest divisor of num_envs <= cores."""
    device: str = "cpu"
    """Device of the learner ("cpu", "cuda", "cuda:1")."""
    learner_threads: int | None = None
    """Threads of the learner; None: one for each core."""
    run_dir: Path | None = None
    """Folder of the run; None: a new one under runs/, named after time and sensor."""
    snapshot_frames: int = 5_000_000
    """Environment steps between the policies kept for learning curves."""
    checkpoint_interval: float = 60.0
    """A checkpoint is at most this old [s]."""
    resume: Path | None = None
    """Run folder to go on with; only --total-frames may be changed, to a later end."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which no run can start."""
        check_numbers(to_plain(self))
        check_counts(self, "total_frames", "snapshot_frames", "learner_threads")
        check_seed(self.seed)
        if not self.checkpoint_interval > 0:
            raise ValueError(
                f"checkpoint_interval must be positive, got {self.checkpoint_interval}"
            )
        check_num_workers(self.num_envs, self.num_workers)
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
        """Raise ValueError for what this machine lacks: the device."""
        self.learner_device()

    def learner_device(self) -> torch.device:
        """Return the device of the learner.

        Raises:
            ValueError: If there is no such device.
        """
        valid = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        try:
            device = torch.device(self.device)
        except RuntimeError:
            device = None
        if device is None or (
            device.type != "cpu"
            and not (device.type == "cuda" and (device.index or 0) < len(valid) - 1)
        ):
            raise ValueError(
                f"no device {self.device!r} here; available: {', '.join(valid)}"
            )
        return device


# What a run's stored configuration leaves out: it says how a run was called.
_CALL_FIELDS = ("run_dir", "resume", "standard")


def parse_config(args: list[str]) -> TrainConfig:
    """Return the configuration of a command line.

    With ``--resume RUN`` the stored configuration of the run is the default, and no
    field but ``total_frames`` may differ from it.

    Args:
        args: Arguments, without the program's name.

    Raises:
        ValueError: If a field is changed that may not be, or the end lies before the
            one planned.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--resume", type=Path)
    first.add_argument("--standard")
    run, _ = first.parse_known_args(args)
    if run.resume is None or str(run.resume) == "None":
        if run.standard not in get_args(Standard):
            return tyro.cli(TrainConfig, args=args)
        task = training_task(run.standard, DodgeballConfig())
        default = TrainConfig(env=EnvConfig(task=task))
        return tyro.cli(TrainConfig, args=args, default=default)
    if run.standard is not None:
        raise ValueError("--standard cannot be changed on resume")
    stored = Run.open(run.resume).config
    # What the file lacks was filled with today's defaults.
    file, before = run.resume / "config.json", to_plain(stored)
    if lacking := changed_fields(_stored(file), before):
        raise ValueError(
            f"{file} lacks {', '.join(lacking)}: another version made it. Go on with "
            "that version (its commit is in versions.json), or add what it lacks"
        )
    config = tyro.cli(TrainConfig, args=args, default=stored)
    after = to_plain(config)
    for name in _CALL_FIELDS:
        del before[name], after[name]
    if config.run_dir is not None:
        raise ValueError("--run-dir cannot be changed on resume")
    changed = [n for n in changed_fields(before, after) if n != "total_frames"]
    if changed:
        names = ", ".join(n.removeprefix("env.") for n in changed)
        raise ValueError(
            f"a resumed run keeps its configuration; changed: {names}. Only "
            "--total-frames may be, to a later end"
        )
    if config.total_frames < stored.total_frames:
        raise ValueError(
            f"--total-frames {config.total_frames} is before the planned end "
            f"{stored.total_frames}"
        )
    return config


def _stored(file: Path) -> Any:
    """Return the plain values of a stored configuration, without a field of old."""
    content = read_json(file)
    if isinstance(content, dict):
        # Sensors were compiled as it said; now they are where they can be.
        content.pop("compile_kernels", None)
    return content


class Run:
    """An open run folder.

    Args:
        path: The folder.
        config: Its configuration.
    """

    def __init__(self, path: Path, config: TrainConfig) -> None:
        self.path, self.config = path, config
        self._events: EventFile | None = None
        self._columns: list[str] | None = None

    @classmethod
    def create(cls, config: TrainConfig) -> Run:
        """Return a new run folder that holds the configuration and the skin.

        Raises:
            ValueError: If the folder holds anything already, or the skin is none.
        """
        skin = config.env.skin.build(config.env.robot_config)
        # Sensors that do not fit each other are found now, not in a worker.
        config.env.sensor.filled(skin)
        path = config.run_dir
        if path is None:
            kind = config.env.sensor.label()
            stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
            path = Path("runs") / f"{stamp}-{kind}-seed{config.seed}"
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            go_on = (path / "config.json").is_file()
            raise ValueError(
                f"{path} exists already; choose another --run-dir"
                + f", or go on with it by --resume {path}" * go_on
            )
        (path / "policies").mkdir(parents=True)
        run = cls(path, config)
        skin.save(run.skin_path)
        # Last: a folder with a configuration can be resumed.
        run.write_config()
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Return an existing run folder.

        Raises:
            ValueError: If it is none.
        """
        file = path / "config.json"
        if not file.is_file():
            raise ValueError(f"{path} is no run folder: it has no config.json")
        return cls(path, from_plain(TrainConfig, _stored(file), str(file)))

    def write_config(self) -> None:
        """Write the configuration (again, with a later end)."""
        content = to_plain(self.config)
        for name in _CALL_FIELDS:
            content[name] = None
        self._write_json("config.json", content)

    def record_start(self) -> None:
        """Append versions, machine, git state and command of this start."""
        file = self.path / "versions.json"
        starts = read_json(file) if file.exists() else []
        starts.append(
            {
                "time": datetime.datetime.now(datetime.timezone.utc).isoformat(),
                "command": sys.argv,
                "python": platform.python_version(),
                "machine": f"{platform.system()} {platform.machine()}",
                "cores": os.cpu_count(),
                "packages": {p: _version(p) for p in _PACKAGES},
                "git": _git_state(),
            }
        )
        self._write_json(file.name, starts)

    def _write_json(self, name: str, content: Any) -> None:
        write_file(self.path / name, (json.dumps(content, indent=2) + "\n").encode())

    @property
    def skin_path(self) -> Path:
        """The skin the run was started with."""
        return self.path / "skin.json"

    @property
    def checkpoint_path(self) -> Path:
        """The latest checkpoint."""
        return self.path / CHECKPOINT_NAME

    def policy_path(self, frames: int) -> Path:
        """The policy kept after a number of environment steps."""
        return self.path / "policies" / f"{frames:012d}.safetensors"

    def dump_path(self, frames: int) -> Path:
        """Where an update that is not finite is written, after a number of steps."""
        return self.path / f"not-finite-{frames:012d}.safetensors"

    @property
    def _metrics_path(self) -> Path:
        return self.path / "metrics.csv"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training this run; the system ends it with ours.

        Raises:
            ValueError: If one does already.
        """
        with open(self.path / "lock", "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(
                    f"{self.path} is being trained by another process"
                ) from None
            yield

    def is_new(self) -> bool:
        """Whether there is nothing to go on from, though it may have been started."""
        return not (self.checkpoint_path.exists() or self._metrics_path.exists())

    def how_to_go_on(self) -> str:
        """Return what to do after a stop or a failure."""
        if not (self.path / "config.json").is_file():
            return f"{self.path} cannot be gone on with: start a new run"
        return f"go on with: python scripts/ppo.py --resume {self.path}"

    def save_checkpoint(
        self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]
    ) -> None:
        """Replace the checkpoint; all metrics so far are on disk before it."""
        if self._metrics_path.exists():
            sync(self._metrics_path)
        save_tensors(self.checkpoint_path, tensors, header)

    def load_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return what `save_checkpoint` wrote last."""
        return load_tensors(self.checkpoint_path)

    def start_metrics(self, frames: int) -> None:
        """Open the logs, dropping what was logged after a number of frames.

        The folder of the policies, if somebody removed it, is made again.
        """
        (self.path / "policies").mkdir(exist_ok=True)
        for left in self.path.rglob(PARTIAL):
            left.unlink()
        if self._metrics_path.exists():
            with open(self._metrics_path, newline="") as source:
                rows = list(csv.DictReader(source))
            # A line that a crash cut short lacks columns.
            whole = [row for row in rows if None not in row.values()]
            kept = [row for row in whole if int(row["frames"]) <= frames]
            if kept:
                self._columns = list(kept[0])
                text = io.StringIO()
                writer = csv.DictWriter(text, self._columns)
                writer.writeheader()
                writer.writerows(kept)
                write_file(self._metrics_path, text.getvalue().encode())
            else:
                self._metrics_path.unlink()
        self._events = EventFile(self.path, frames)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Append a line of metrics; the first fixes the columns.

        Args:
            metrics: Values by name; "frames" is the x axis.
        """
        assert self._events is not None, "start_metrics first"
        first = self._columns is None
        if self._columns is None:
            self._columns = list(metrics)
        with open(self._metrics_path, "a", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            if first:
                writer.writeheader()
            writer.writerow(dict(metrics))
        self._events.log(metrics)

    def close(self) -> None:
        """Close the logs."""
        if self._events is not None:
            self._events.close()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_state() -> dict[str, Any] | None:
    """Commit of the source tree and whether it was changed; None if git has none."""

    def git(*args: str) -> str:
        return subprocess.run(
            ["git", "-C", str(Path(__file__).parent), *args],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    try:
        # An installed copy may lie inside a repository of something else.
        git("ls-files", "--error-unmatch", str(Path(__file__)))
        return {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.CalledProcessError):
        return None
