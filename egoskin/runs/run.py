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
repetition. A checkpoint holds the configuration it was trained with, a hash of the
skin, and both logs: a run whose files were edited, exchanged or damaged either goes on
as if they had not been, or does not.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import errno
import fcntl
import io
import itertools
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import torch
import tyro
from torch import Tensor

from egoskin.agents.ppo import PPOConfig
from egoskin.cli import check_counts
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.standards import Standard, training_task
from egoskin.make import EnvConfig, check_num_workers
from egoskin.parallel import available_cores
from egoskin.policies.policy import CHECKPOINT_NAME
from egoskin.rng import check_seed
from egoskin.runs.events import EventFile
from egoskin.sensors import Skin
from egoskin.storage.files import read_regular
from egoskin.storage.formats import (
    content_hash,
    package_version,
    present_config,
    read_sealed,
    sealed_json,
    unseal,
)
from egoskin.storage.serialization import (
    changed_fields,
    check_numbers,
    from_plain,
    read_json,
    to_plain,
)
from egoskin.storage.tensor_file import (
    PARTIAL,
    append,
    load_tensors,
    named,
    save_tensors,
    write_file,
)

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
    """Run folder to go on with; changed may be --total-frames, to a later end, and what
    changes no result: workers, threads, when checkpoints and policies are kept."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which no run can start."""
        check_numbers(self, may_be_infinite=("env.sensor.range",))
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
MACHINE_FIELDS = frozenset(
    (
        *_CALL_FIELDS,
        "num_workers",
        "learner_threads",
        "snapshot_frames",
        "checkpoint_interval",
    )
)
"""Fields that say how a run was called, where it is computed and what is kept of it:
they change no result, to the last bit, and may change at a resume. The device is none
of them: sums on another one round otherwise."""
SKIN_HASH = "skin_sha256"
"""What config.json holds beside the configuration: the hash of the skin."""
# Where a checkpoint keeps the metrics.
_METRICS = "log/metrics"


def parse_config(args: list[str]) -> TrainConfig:
    """Return the configuration of a command line.

    With ``--resume RUN`` the stored configuration of the run is the default, and no
    field but ``total_frames`` and `MACHINE_FIELDS` may differ from it.

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
    if lacking := changed_fields(_read_config(file)[0], before):
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
        may = sorted(free - set(_CALL_FIELDS))
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


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _read_config(file: Path) -> tuple[dict[str, Any], str | None]:
    """Return (configuration in the present format, hash of the skin if it holds one).

    Raises:
        ValueError: If it is damaged, or has options that are no more.
    """
    content, number = read_sealed(file)
    skin = content.pop(SKIN_HASH, None)
    return present_config(content, number, str(file)), skin


class Run:
    """An open run folder.

    Args:
        path: The folder.
        config: Its configuration.
    """

    def __init__(self, path: Path, config: TrainConfig) -> None:
        self.path, self.config = path, config
        self._events: EventFile | None = None
        self._skin_hash = ""
        # The logs up to now: a line for each rollout, an entry for each start.
        self._metrics = ""
        self._starts: list[dict[str, Any]] = []

    @classmethod
    def create(cls, config: TrainConfig) -> Run:
        """Return a new run folder that holds the configuration and the skin.

        Raises:
            ValueError: If the folder holds anything already, or the skin is none.
        """
        skin = config.env.skin.build(config.env.robot_config)
        # Sensors that do not fit each other are found now, not in a worker.
        config.env.pipeline(skin)
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
        try:
            skin.save(run.skin_path)
        except OSError as error:
            raise named(error, run.skin_path) from error
        run._skin_hash = content_hash(read_json(run.skin_path))
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
        return cls(path, from_plain(TrainConfig, _read_config(file)[0], str(file)))

    def write_config(self) -> None:
        """Write the configuration (again, with a later end) and the skin's hash."""
        content = to_plain(self.config)
        for name in _CALL_FIELDS:
            content[name] = None
        content[SKIN_HASH] = self._skin_hash
        write_file(self.path / "config.json", sealed_json(content))

    def load_skin(self) -> Skin:
        """Return the skin the run was started with.

        Raises:
            ValueError: If there is none, or it is another.
        """
        skin = Skin.load(self.skin_path)
        self._skin_hash = content_hash(read_json(self.skin_path))
        _, written = _read_config(self.path / "config.json")
        if written not in (None, self._skin_hash):
            raise ValueError(
                f"{self.skin_path} is damaged or was edited: it is not the skin that "
                "the run was started with; put it back as it was"
            )
        return skin

    def _trained_with(self) -> dict[str, Any]:
        """Return what decides the run's results: its configuration, the skin's hash."""
        free = MACHINE_FIELDS | {"total_frames"}
        content = {k: v for k, v in to_plain(self.config).items() if k not in free}
        return {**content, SKIN_HASH: self._skin_hash}

    def _check_trained_with(self, before: Mapping[str, Any]) -> None:
        """Raise ValueError if a checkpoint was trained with anything else."""
        changed = changed_fields(dict(before), self._trained_with())
        if SKIN_HASH in changed:
            raise ValueError(
                f"{self.skin_path} is not the skin that {self.checkpoint_path} was "
                "trained with: put that back"
            )
        if changed:
            names = ", ".join(name.removeprefix("env.") for name in changed)
            raise ValueError(
                f"{self.path / 'config.json'} is not what {self.checkpoint_path} was "
                f"trained with: put that back (changed: {names})"
            )

    def starts(self) -> list[dict[str, Any]]:
        """Return versions, machine, git state and command of each start so far.

        Raises:
            ValueError: If the file that says so is damaged.
        """
        if not self._versions_path.exists():
            return []
        content, what = read_json(self._versions_path), str(self._versions_path)
        if isinstance(content, list):
            # So it was in format 1.
            return unseal({"starts": content}, what)[0]["starts"]
        if not isinstance(content, dict) or "sha256" not in content:
            raise ValueError(f"{what} is damaged or was edited")
        return unseal(content, what)[0]["starts"]

    def record_start(self) -> None:
        """Add versions, machine, git state and command of this start to the log."""
        try:
            # What was started after the latest checkpoint is in the file alone.
            starts = self.starts() or self._starts
            if starts[: len(self._starts)] != self._starts:
                raise ValueError(f"{self._versions_path} is that of another run")
            self._starts = starts
        except ValueError as error:
            self._put_aside(self._versions_path, str(error))
        self._starts.append(
            {
                "time": datetime.datetime.now(datetime.timezone.utc).isoformat(),
                "command": sys.argv,
                "python": platform.python_version(),
                "machine": f"{platform.system()} {platform.machine()}",
                "cores": os.cpu_count(),
                "packages": {p: package_version(p) for p in _PACKAGES},
                "git": _git_state(),
            }
        )
        write_file(self._versions_path, sealed_json({"starts": self._starts}))

    def _put_aside(self, path: Path, why: str) -> None:
        """Rename a damaged log, over no other file, and say so."""
        names = (f"{path.stem}-damaged-{i}{path.suffix}" for i in itertools.count(1))
        free = next(n for n in map(path.with_name, names) if not os.path.lexists(n))
        path.rename(free)
        print(f"note: {why}; it is now {free.name}", file=sys.stderr)

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

    @property
    def _versions_path(self) -> Path:
        return self.path / "versions.json"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training this run; the system ends it with ours.

        Raises:
            ValueError: If one does already.
        """
        path = self.path / "lock"
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            raise ValueError(f"{path} is a link, which is not followed") from error
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(
                    f"{self.path} is being trained by another process"
                ) from None
            yield
        finally:
            os.close(descriptor)

    def is_new(self) -> bool:
        """Whether there is nothing to go on from, though it may have been started."""
        return not (self.checkpoint_path.exists() or self._metrics_path.exists())

    def how_to_go_on(self) -> str:
        """Return what to do after a stop or a failure."""
        if not (self.path / "config.json").is_file():
            return (
                f"{self.path} is gone: start a new run or, if it was only renamed, "
                "--resume it by its new name"
            )
        return f"go on with: python scripts/ppo.py --resume {self.path}"

    def save_checkpoint(
        self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]
    ) -> None:
        """Replace the checkpoint; it holds all logs so far, and what was trained."""
        log = np.frombuffer(self._metrics.encode(), np.uint8).copy()
        save_tensors(
            self.checkpoint_path,
            {**tensors, _METRICS: torch.from_numpy(log)},
            {**header, "config": self._trained_with(), "starts": self._starts},
        )

    def load_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return what `save_checkpoint` wrote last, and take the logs from it.

        Raises:
            ValueError: If it is damaged, or was trained with another configuration or
                skin; the text names them.
        """
        self.load_skin()
        tensors, header = load_tensors(self.checkpoint_path)
        # Checkpoints of format 1 hold none of these.
        if "config" in header:
            self._check_trained_with(header.pop("config"))
        self._starts = header.pop("starts", [])
        if _METRICS in tensors:
            self._metrics = _text(tensors.pop(_METRICS))
        else:
            self._metrics = _whole_rows(self._metrics_path, header.get("frames", 0))
        return tensors, header

    def metrics(self) -> str:
        """Return the log of the rollouts up to the latest checkpoint, as CSV.

        Raises:
            ValueError: If there is none, or the checkpoint is damaged.
        """
        if self.checkpoint_path.exists():
            tensors, _ = load_tensors(self.checkpoint_path)
            if _METRICS in tensors:
                return _text(tensors[_METRICS])
        if not self._metrics_path.is_file():
            raise ValueError(f"{self.path} has not been trained: it has no metrics.csv")
        return self._metrics_path.read_text()

    def start_metrics(self, frames: int) -> None:
        """Open the logs, dropping what was logged after a number of frames.

        The folder of the policies, if somebody removed it, is made again, and so is the
        log of metrics if somebody removed, edited or damaged it.
        """
        policies = self.path / "policies"
        if policies.is_symlink():
            raise ValueError(f"{policies} is a link, which is not followed")
        policies.mkdir(exist_ok=True)
        for folder in (self.path, policies):
            for left in folder.glob(PARTIAL):
                left.unlink()
        path, text = self._metrics_path, self._metrics.encode()
        try:
            if not read_regular(path, sys.maxsize).startswith(text):
                raise ValueError(f"{path} is damaged or was edited")
        except FileNotFoundError:
            pass
        except ValueError as error:
            self._put_aside(path, str(error))
        if text:
            write_file(path, text)
        else:
            path.unlink(missing_ok=True)
        self._events = EventFile(self.path, frames)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Append a line of metrics; the first fixes the columns.

        Args:
            metrics: Values by name; "frames" is the x axis.
        """
        assert self._events is not None, "start_metrics first"
        first, line = not self._metrics, io.StringIO()
        columns = metrics if first else next(csv.reader(self._metrics.splitlines()))
        writer = csv.DictWriter(line, list(columns))
        if first:
            writer.writeheader()
        writer.writerow(dict(metrics))
        self._metrics += line.getvalue()
        try:
            append(self._metrics_path, line.getvalue().encode())
        except FileNotFoundError:
            # The first line, or somebody removed the file.
            write_file(self._metrics_path, self._metrics.encode())
        self._events.log(metrics)

    def close(self) -> None:
        """Close the logs."""
        if self._events is not None:
            self._events.close()


def _text(characters: Tensor) -> str:
    """Return the text that a checkpoint keeps as a tensor of bytes."""
    return characters.numpy().tobytes().decode()


def _whole_rows(path: Path, frames: int) -> str:
    """Return a log of metrics up to some frames, as far as it can be read."""
    try:
        text = read_regular(path, sys.maxsize).decode()
        first, *lines = text.splitlines(keepends=True)
        columns = first.strip().split(",")
        # A line that a crash cut short lacks columns.
        rows = [(line, line.strip().split(",")) for line in lines]
        whole = [(line, row) for line, row in rows if len(row) == len(columns)]
        place = columns.index("frames")
        kept = [line for line, row in whole if int(row[place]) <= frames]
    except (OSError, ValueError):
        return ""
    return "".join([first, *kept]) if kept else ""


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
