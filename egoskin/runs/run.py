"""The folder of a training run: configuration, metrics, checkpoints, policies.

    config.json              the resolved configuration
    skin.json                the sensors
    versions.json            packages, machine, git state, command of each start
    metrics.csv              one line for each rollout; TensorBoard files beside it
    checkpoint.safetensors   everything needed to resume, every checkpoint_interval
    policies/<frames>.safetensors   self-contained policies, from the start on
    films/<frames>.mp4, .png   films of the policies, if requested
    not-finite-<frames>.safetensors   a failed update, for ``egoskin replay``
    lock                     locked by the training process

Contract: checkpoints are written atomically, metrics written after the checkpoint are
dropped on resume, and only one process trains at a time, so that logs have no gaps or
repetitions. A checkpoint contains the configuration of the training, a hash of the skin
and both logs. A run whose files were edited, exchanged or damaged either continues as
if they were unchanged, or does not continue.
"""

from __future__ import annotations

import csv
import datetime
import errno
import io
import itertools
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from egoskin.make import EnvConfig
from egoskin.policies.policy import CHECKPOINT_NAME, load_networks
from egoskin.runs.checks import check_effect, check_fits, check_repeats
from egoskin.runs.config import (
    CALL_FIELDS,
    INIT_HASH,
    RESUME_FIELDS,
    SKIN_HASH,
    TrainConfig,
    load_config,
    read_config,
)
from egoskin.runs.events import EventFile
from egoskin.runs.starts import describe_start
from egoskin.runs.wandb_log import WandbLog
from egoskin.sensors import Skin
from egoskin.storage.files import PARTIAL, append, read_regular, write_file
from egoskin.storage.formats import content_hash, sealed_json, unseal
from egoskin.storage.locks import try_lock
from egoskin.storage.serialization import (
    changed_fields,
    read_json,
    to_plain,
)
from egoskin.storage.tensor_file import load_tensors, save_tensors

T = TypeVar("T")

# Name of the metrics tensor in a checkpoint.
_METRICS = "log/metrics"


class RunLockedError(ValueError):
    """Raised if another process is training a run."""


class Run:
    """An open run folder.

    Args:
        path: The folder.
        config: Its configuration.
    """

    def __init__(self, path: Path, config: TrainConfig) -> None:
        self.path, self.config = path, config
        self._events: EventFile | None = None
        self._wandb: WandbLog | None = None
        # By `SKIN_HASH` and `INIT_HASH`.
        self._hashes: dict[str, str] = {}
        # Tensors to start from, once they are read.
        self._initial: dict[str, Tensor] | None = None
        # The logs so far: a line for each rollout, an entry for each start.
        self._metrics: list[str] = []
        self._starts: list[dict[str, Any]] = []

    @classmethod
    def create(cls, config: TrainConfig) -> Run:
        """Create a run folder with the configuration and the skin; return the run.

        Raises:
            ValueError: If the folder is not empty, the skin or the networks to start
                from are not valid, do not fit, or are not those of the run to repeat,
                an option has no effect, or there is too little memory.
        """
        skin = config.env.skin.build(config.env.robot_config)
        hashes = {SKIN_HASH: content_hash(skin.to_dict())}
        initial = None
        if config.init_from is not None:
            initial = load_networks(config.init_from)
            hashes[INIT_HASH] = content_hash({}, initial[0])
        check_effect(config.env.sensor, skin)
        check_fits(config, skin, initial)
        check_repeats(config, hashes)
        path = config.run_dir
        if path is None:
            kind = config.env.sensor.label()
            if config.env.robot != EnvConfig().robot:
                # The name of a model may have any characters.
                robot = re.sub(r"[^\w.]+", "-", config.env.robot_config.name)
                kind = f"{robot}-{kind}"
            stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
            path = Path("runs") / f"{stamp}-{kind}-seed{config.seed}"
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            go_on = (path / "config.json").is_file()
            raise ValueError(
                f"{path} already exists; choose another --run-dir"
                + f", or continue it with --resume {quote(str(path))}" * go_on
            )
        run = cls(path, config)
        run._hashes = hashes
        run._initial = None if initial is None else initial[0]
        (path / "policies").mkdir(parents=True)
        try:
            skin.save(run.skin_path)
            # Written last, because a folder with a configuration can be resumed.
            run.write_config()
        except BaseException:
            # A folder without one would only be in the way of another try.
            shutil.rmtree(path, ignore_errors=True)
            raise
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open an existing run folder.

        Raises:
            ValueError: If it is not a run folder.
        """
        return cls(path, load_config(path))

    def write_config(self) -> None:
        """Write the configuration (again with a later end) and hashes of its files."""
        content = to_plain(self.config)
        for name in CALL_FIELDS:
            content[name] = None
        write_file(self.path / "config.json", sealed_json({**content, **self._hashes}))

    def load_skin(self) -> Skin:
        """Return the skin the run was started with.

        Raises:
            ValueError: If it is missing or has changed.
        """
        skin = Skin.load(self.skin_path)
        now = content_hash(read_json(self.skin_path))
        _, written = read_config(self.path / "config.json")
        self._hashes = {**written, SKIN_HASH: now}
        if written.get(SKIN_HASH, now) != now:
            raise ValueError(
                f"{self.skin_path} is damaged or was edited: it is not the skin that "
                "the run was started with; restore the original"
            )
        return skin

    def initial_networks(self) -> dict[str, Tensor] | None:
        """Return the tensors that the training starts from; None: new networks.

        Raises:
            ValueError: If they cannot be read or have changed.
        """
        path = self.config.init_from
        if path is None or self._initial is not None:
            return self._initial
        tensors, _ = load_networks(path)
        _, written = read_config(self.path / "config.json")
        if content_hash({}, tensors) != written[INIT_HASH]:
            raise ValueError(
                f"{path} is not what {self.path} was to start from: restore that file"
            )
        return tensors

    def _trained_with(self) -> dict[str, Any]:
        """Return the configuration and hashes that determine the results."""
        plain = to_plain(self.config)
        content = {k: v for k, v in plain.items() if k not in RESUME_FIELDS}
        return {**content, **self._hashes}

    def _check_trained_with(self, before: Mapping[str, Any]) -> None:
        """Raise ValueError if a checkpoint was trained with another setup."""
        changed = changed_fields(dict(before), self._trained_with())
        if SKIN_HASH in changed:
            raise ValueError(
                f"{self.skin_path} is not the skin that {self.checkpoint_path} was "
                "trained with: restore that file"
            )
        if changed:
            names = ", ".join(name.removeprefix("env.") for name in changed)
            raise ValueError(
                f"{self.path / 'config.json'} is not what {self.checkpoint_path} was "
                f"trained with: restore that file (changed: {names})"
            )

    def starts(self) -> list[dict[str, Any]]:
        """Return versions, machine, git state and command of each start so far.

        Raises:
            ValueError: If the file of this log is damaged.
        """
        if not self._versions_path.exists():
            return []
        content, what = read_json(self._versions_path), str(self._versions_path)
        if isinstance(content, list):
            # Format 1.
            return unseal({"starts": content}, what)[0]["starts"]
        if not isinstance(content, dict) or "sha256" not in content:
            raise ValueError(f"{what} is damaged or was edited")
        starts = unseal(content, what)[0].get("starts")
        return _checked_type(list, starts, "starts", what)

    def record_start(self) -> None:
        """Add versions, machine, git state and command of this start to the log."""
        try:
            # Starts after the latest checkpoint are only in the file.
            starts = self.starts() or self._starts
            if starts[: len(self._starts)] != self._starts:
                raise ValueError(f"{self._versions_path} belongs to another run")
            self._starts = starts
        except ValueError as error:
            self._put_aside(self._versions_path, str(error))
        self._starts.append(describe_start(self.config.engine))
        write_file(self._versions_path, sealed_json({"starts": self._starts}))

    def _put_aside(self, path: Path, why: str) -> None:
        """Rename a damaged log without overwriting a file, and print a note."""
        names = (f"{path.stem}-damaged-{i}{path.suffix}" for i in itertools.count(1))
        free = next(n for n in map(path.with_name, names) if not os.path.lexists(n))
        path.rename(free)
        print(f"note: {why}; renamed to {free.name}", file=sys.stderr)

    @property
    def skin_path(self) -> Path:
        """Path of the skin of the run."""
        return self.path / "skin.json"

    @property
    def checkpoint_path(self) -> Path:
        """Path of the latest checkpoint."""
        return self.path / CHECKPOINT_NAME

    def policy_path(self, frames: int) -> Path:
        """Return the path of the policy saved after a number of environment steps."""
        return self.path / "policies" / f"{frames:012d}.safetensors"

    def dump_path(self, frames: int) -> Path:
        """Return the path for an update that is not finite, after a number of steps."""
        return self.path / f"not-finite-{frames:012d}.safetensors"

    @property
    def _metrics_path(self) -> Path:
        return self.path / "metrics.csv"

    @property
    def _versions_path(self) -> Path:
        return self.path / "versions.json"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the run against training by other processes.

        The operating system releases the lock when this process ends.

        Raises:
            RunLockedError: If another process is training it.
            ValueError: If the lock is a link, or the file system has no locks.
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
            if not try_lock(descriptor, path):
                raise RunLockedError(f"{self.path} is being trained by another process")
            yield
        finally:
            os.close(descriptor)

    def is_new(self) -> bool:
        """Return whether there is nothing to resume, even if the run was started."""
        return not (self.checkpoint_path.exists() or self._metrics_path.exists())

    def resume_advice(self) -> str:
        """Return advice on how to continue after a stop or a failure."""
        if not (self.path / "config.json").is_file():
            return (
                f"{self.path} no longer exists: start a new run or, if it was renamed, "
                "--resume it by its new name"
            )
        return f"continue with: egoskin train --resume {quote(str(self.path))}"

    def save_checkpoint(
        self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]
    ) -> None:
        """Replace the checkpoint, including all logs so far and the training setup."""
        log = np.frombuffer("".join(self._metrics).encode(), np.uint8).copy()
        save_tensors(
            self.checkpoint_path,
            {**tensors, _METRICS: torch.from_numpy(log)},
            {**header, "config": self._trained_with(), "starts": self._starts},
        )

    def load_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the tensors and header of the checkpoint, and load the logs from it.

        Raises:
            ValueError: If it is damaged, or was trained with another configuration or
                skin; the text names the differences.
        """
        self.load_skin()
        tensors, header = load_tensors(self.checkpoint_path)
        what = str(self.checkpoint_path)
        # Checkpoints of format 1 do not contain these.
        if "config" in header:
            config = _checked_type(dict, header.pop("config"), "config", what)
            self._check_trained_with(config)
        self._starts = _checked_type(list, header.pop("starts", []), "starts", what)
        if _METRICS in tensors:
            metrics = _text(tensors.pop(_METRICS), what)
        else:
            metrics = _whole_rows(self._metrics_path, header.get("frames", 0))
        self._metrics = metrics.splitlines(keepends=True)
        return tensors, header

    def metrics(self) -> str:
        """Return the metrics up to the latest checkpoint, as CSV.

        Raises:
            ValueError: If there are none, or the checkpoint is damaged.
        """
        if self.checkpoint_path.exists():
            tensors, _ = load_tensors(self.checkpoint_path)
            if _METRICS in tensors:
                return _text(tensors[_METRICS], str(self.checkpoint_path))
        if not self._metrics_path.is_file():
            raise ValueError(f"{self.path} has not been trained: it has no metrics.csv")
        return self._metrics_path.read_text()

    def tidy(self) -> None:
        """Remove unfinished files; create the policies' folder again if it was removed.

        Raises:
            ValueError: If the folder of the policies is a link.
        """
        policies = self.path / "policies"
        if policies.is_symlink():
            raise ValueError(f"{policies} is a link, which is not followed")
        policies.mkdir(exist_ok=True)
        for folder in (self.path, policies):
            for left in folder.glob(PARTIAL):
                left.unlink()

    def start_metrics(self, frames: int) -> None:
        """Open the logs, dropping entries after a number of frames.

        The log of metrics is created again if it was removed, edited or damaged.
        """
        path, text = self._metrics_path, "".join(self._metrics).encode()
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
        if self.config.log == "wandb":
            plain = to_plain(self.config)
            self._wandb = WandbLog(self.path, self._starts[0], plain)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Append a line of metrics; the first fixes the columns.

        Args:
            metrics: Values by name; "frames" is the x axis.
        """
        assert self._events is not None, "call start_metrics first"
        first, line = not self._metrics, io.StringIO()
        columns = metrics if first else next(csv.reader(self._metrics[:1]))
        writer = csv.DictWriter(line, list(columns))
        if first:
            writer.writeheader()
        writer.writerow(dict(metrics))
        self._metrics += line.getvalue().splitlines(keepends=True)
        try:
            append(self._metrics_path, line.getvalue().encode())
        except FileNotFoundError:
            # This is the first line, or the file was removed.
            write_file(self._metrics_path, "".join(self._metrics).encode())
        self._events.log(metrics)
        if self._wandb is not None:
            self._wandb.log(metrics)

    def close(self) -> None:
        """Close the logs."""
        if self._events is not None:
            self._events.close()
        if self._wandb is not None:
            self._wandb.close()


def _checked_type(kind: type[T], value: Any, name: str, what: str) -> T:
    """Return a value of a file; raise ValueError if it has another type."""
    if not isinstance(value, kind):
        raise ValueError(
            f"{what} is damaged or was edited: its {name} must be a {kind.__name__}, "
            f"not {type(value).__name__}"
        )
    return value


def _text(characters: Tensor, what: str) -> str:
    """Return the text that a checkpoint stores as a tensor of bytes.

    Raises:
        ValueError: If it is not valid text.
    """
    try:
        return characters.numpy().tobytes().decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"{what} is damaged: its metrics are not text") from error


def _whole_rows(path: Path, frames: int) -> str:
    """Return the readable part of a metrics log, up to a number of frames."""
    try:
        text = read_regular(path, sys.maxsize).decode()
        first, *lines = text.splitlines(keepends=True)
        columns = first.strip().split(",")
        # A line truncated by a crash has missing columns.
        rows = [(line, line.strip().split(",")) for line in lines]
        whole = [(line, row) for line, row in rows if len(row) == len(columns)]
        place = columns.index("frames")
        kept = [line for line, row in whole if int(row[place]) <= frames]
    except (OSError, ValueError):
        return ""
    return "".join([first, *kept]) if kept else ""
