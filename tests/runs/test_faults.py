"""Real faults of a training: saved state, messages and leftovers."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import pty
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from calling import BATCH, SMALL, call, fail, limit_file_size, succeed, wait_for
from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.agents.ppo import PPO, NonFiniteError, PPOConfig
from egoskin.commands import train
from egoskin.commands.errors import clear_errors
from egoskin.commands.verify import run_hash
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.kernels import compilation
from egoskin.sparse import SparseRows
from egoskin.storage.formats import read_sealed, sealed_json
from egoskin.storage.tensor_file import load_tensors, save_tensors
from making import blind_run

# Rollouts of the run that tests resume.
DONE = 4

TRAIN = (sys.executable, "-m", "egoskin", "train")

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/maps").exists(), reason="looks for what is left over in /proc"
)


class Training:
    """A training in its own process group and temporary folder."""

    def __init__(self, temporary: Path, *args: str | Path, **options) -> None:
        self.temporary = temporary
        self.output = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [*TRAIN, *map(str, args)],
            stdout=self.output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, "TMPDIR": str(temporary), "OMP_NUM_THREADS": "1"},
            **options,
        )
        self.shared: set[str] = set()

    def processes(self) -> dict[int, str]:
        """Living processes of the session: ids and command lines."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                if int(fields[3]) == self.process.pid and fields[0] not in "ZX":
                    found[int(folder.name)] = (folder / "cmdline").read_text()
            except OSError:
                continue
        return found

    def workers(self) -> list[int]:
        """Process ids of the workers: children of the server they are forked from."""
        servers = {p for p, text in self.processes().items() if "forkserver" in text}
        return sorted(p for p in servers if parent_of(p) in servers)

    def note_shared_memory(self) -> None:
        """Remember the names in shared memory that the session has mapped."""
        for pid in self.processes():
            maps = Path(f"/proc/{pid}/maps")
            with maps.open() as file:
                lines = [line.split(maxsplit=5)[-1].strip() for line in file]
            self.shared |= {line for line in lines if line.startswith("/dev/shm/")}

    def wait_for(self, condition: Callable[[], object], seconds: float = 120) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline, self.text()
            time.sleep(0.01)

    def end(self, seconds: float = 120) -> int:
        return self.process.wait(seconds)

    def text(self) -> str:
        self.output.seek(0)
        return self.output.read()

    def check_nothing_is_left(self) -> None:
        # A server that is still importing reacts to nothing else.
        deadline = time.monotonic() + 60
        while self.processes() or self._files():
            assert time.monotonic() < deadline, (self.processes(), self._files())
            time.sleep(0.1)

    def _files(self) -> list[str]:
        shared = [name for name in self.shared if Path(name).exists()]
        return [*shared, *map(str, self.temporary.iterdir())]


def parent_of(pid: int) -> int:
    stat = Path(f"/proc/{pid}/stat").read_text()
    return int(stat.rpartition(")")[2].split()[1])


@pytest.fixture
def temporary() -> Iterator[Path]:
    # A socket's path must be short: not under tmp_path.
    folder = Path(tempfile.mkdtemp(prefix="ego-"))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def start(temporary: Path) -> Iterator[Callable[..., Training]]:
    """Function that starts trainings, which end with the test."""
    started = []

    def begin(*args: str | Path, **options) -> Training:
        started.append(Training(temporary, *args, **options))
        return started[-1]

    yield begin
    for training in started:
        for pid in training.processes():
            os.kill(pid, signal.SIGKILL)
        training.process.wait()
        training.output.close()


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A finished run of four rollouts, to resume."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def rows(run: Path) -> list[dict[str, str]]:
    file = run / "metrics.csv"
    if not file.exists():
        return []
    with open(file, newline="") as source:
        return list(csv.DictReader(source))


def check_failed_clearly(training: Training, *expected: str, code: int = 1) -> None:
    assert training.end() == code
    for text in expected:
        assert text in training.text()
    assert "Traceback" not in training.text()
    training.check_nothing_is_left()


# --- the trainer is killed --------------------------------------------------------


def written(run: Path) -> bool:
    """Whether a checkpoint is being written at this moment."""
    return any(run.glob(".checkpoint.*.partial"))


def plan(run: Path, end: int) -> None:
    """Let a run end after some frames."""
    config, _ = read_sealed(run / "config.json")
    content = sealed_json({**config, "total_frames": end})
    (run / "config.json").write_bytes(content)


def check_logs_have_no_gap(run: Path) -> None:
    frames = [int(row["frames"]) for row in rows(run)]
    assert frames == [BATCH * (i + 1) for i in range(len(frames))]


@pytest.mark.slow
def test_a_trainer_killed_while_it_writes_a_checkpoint_goes_on(start, tmp_path):
    run = tmp_path / "run"
    often = ("--checkpoint-interval", "0.01")
    training = start(*SMALL, "--run-dir", run, *often)
    training.wait_for(lambda: len(rows(run)) > 3)
    training.note_shared_memory()
    assert len(training.workers()) == 2
    training.wait_for(lambda: written(run))
    # All of them, including multiprocessing's resource tracker.
    os.killpg(training.process.pid, signal.SIGKILL)
    training.end()
    training.check_nothing_is_left()
    saved = load_tensors(run / "checkpoint.safetensors")[1]["frames"]
    assert saved >= 2 * BATCH
    end = saved + 4 * BATCH
    # The planned end of a run cannot be moved earlier, except in a test.
    plan(run, end)
    succeed("train", "--resume", run)
    assert int(rows(run)[-1]["frames"]) == end
    check_logs_have_no_gap(run)
    assert not list(run.rglob("*.partial"))


@pytest.mark.slow
@pytest.mark.parametrize("whole_group", [False, True])
def test_a_trainer_killed_while_it_starts_leaves_nothing(
    whole_group, start, tmp_path, temporary
):
    training = start(*SMALL, "--run-dir", tmp_path / "run")
    # The folder of the server's socket: it exists before any worker does.
    training.wait_for(lambda: list(temporary.glob("*/listener-*")))
    assert not training.workers()
    kill = os.killpg if whole_group else os.kill
    kill(training.process.pid, signal.SIGKILL)
    training.end()
    training.check_nothing_is_left()


def test_ctrl_c_twice_while_workers_start_is_one_line(start, tmp_path, temporary):
    training = start(*SMALL, "--run-dir", tmp_path / "run")
    training.wait_for(lambda: list(temporary.glob("*/listener-*")))
    for _ in range(2):
        os.killpg(training.process.pid, signal.SIGINT)
    assert training.end() == 130
    assert training.text().splitlines()[1:] == ["stopped"]
    training.check_nothing_is_left()


@pytest.mark.slow
def test_a_closed_terminal_leaves_a_checkpoint(tmp_path, temporary):
    run = tmp_path / "run"
    command = [*TRAIN, *SMALL, "--run-dir"]
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ["TMPDIR"] = str(temporary)
        os.execv(sys.executable, [*command, str(run)])
    deadline = time.monotonic() + 120
    while len(rows(run)) < 2:
        assert time.monotonic() < deadline
        # Its output must be read, otherwise it blocks.
        if select.select([terminal], [], [], 0.01)[0]:
            os.read(terminal, 1000)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.WIFEXITED(status)
    saved = load_tensors(run / "checkpoint.safetensors")[1]["frames"]
    assert saved == int(rows(run)[-1]["frames"]) >= 2 * BATCH
    wait_for(lambda: not list(temporary.iterdir()))


def test_a_training_that_nobody_reads_ends_with_a_checkpoint(run, monkeypatch):
    read, write = os.pipe()

    def read_what_it_will_be() -> None:
        # As `head -n 3` does.
        with open(read) as source:
            starts = [source.readline().split()[0] for _ in range(3)]
        assert starts[::2] == ["run", "curves"]

    reader = threading.Thread(target=read_what_it_will_be)
    reader.start()
    args = ["--resume", str(run), "--total-frames", str(10**6)]
    with open(write, "w", buffering=1) as output:
        monkeypatch.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit) as ended, clear_errors():
            train.main(args)
    reader.join()
    assert ended.value.code == 128 + signal.SIGPIPE
    saved = load_tensors(run / "checkpoint.safetensors")[1]["frames"]
    assert saved == int(rows(run)[-1]["frames"]) > DONE * BATCH


@pytest.mark.slow
def test_a_trainer_killed_twenty_times_loses_at_most_an_interval_each(start, tmp_path):
    run, interval = tmp_path / "run", 1.0
    draw = random.Random(0)
    args: tuple = (*SMALL, "--run-dir", run, "--checkpoint-interval", str(interval))
    for number in range(20):
        begun = time.monotonic()
        training = start(*args)
        if number % 2:
            # While a checkpoint is being written; fewer and fewer are waited for.
            training.wait_for((run / "versions.json").exists)
            before = len(rows(run))
            training.wait_for(lambda before=before: len(rows(run)) != before)
            training.wait_for(lambda: written(run))
        else:
            time.sleep(draw.uniform(2, 12))
        assert training.process.poll() is None, training.text()
        training.note_shared_memory()
        training.process.kill()
        training.end()
        training.check_nothing_is_left()
        print(f"killed after {time.monotonic() - begun:.1f} s: {len(rows(run))} rows")
        if (run / "config.json").exists():
            args = ("--resume", run)
        if rows(run):
            header = load_tensors(run / "checkpoint.safetensors")[1]
            lost = [
                float(row["time/steps_per_s"])
                for row in rows(run)
                if None not in row.values() and int(row["frames"]) > header["frames"]
            ]
            # The rollout in which it was killed is in no log.
            assert sum(BATCH / speed for speed in lost) <= interval
    end = load_tensors(run / "checkpoint.safetensors")[1]["frames"] + BATCH
    plan(run, end)
    last = start("--resume", run)
    assert last.end() == 0, last.text()
    check_logs_have_no_gap(run)
    # Identical to an uninterrupted run, bit for bit.
    whole = tmp_path / "whole"
    size = ("--run-dir", whole, "--total-frames", str(end))
    unbroken = start(*SMALL, *size)
    assert unbroken.end(600) == 0, unbroken.text()
    assert run_hash(Run.open(run)) == run_hash(Run.open(whole))


@pytest.mark.slow
def test_a_signal_to_the_whole_group_leaves_a_checkpoint(start, tmp_path):
    # As a batch system does: workers must not end first.
    run = tmp_path / "run"
    training = start(*SMALL, "--run-dir", run)
    training.wait_for(lambda: len(rows(run)) > 1)
    os.killpg(training.process.pid, signal.SIGTERM)
    assert training.end() == 0, training.text()
    assert f"--resume {run}" in training.text()
    _, header = load_tensors(run / "checkpoint.safetensors")
    assert header["frames"] == int(rows(run)[-1]["frames"])
    training.check_nothing_is_left()


# --- a worker fails ---------------------------------------------------------------


@pytest.mark.slow
def test_a_worker_killed_in_training_ends_it_with_its_signal(start, run):
    before = (run / "checkpoint.safetensors").read_bytes()
    training = start("--resume", run, "--total-frames", 10**6)
    training.wait_for(lambda: len(rows(run)) > DONE)
    os.kill(training.workers()[1], signal.SIGKILL)
    begun = time.monotonic()
    message = "of 2 was killed by SIGKILL"
    check_failed_clearly(training, message, f"--resume {run}")
    assert time.monotonic() - begun < 30
    assert (run / "checkpoint.safetensors").read_bytes() == before


# --- numbers that are not finite ----------------------------------------------------


def check_fails_not_finite(run: Path, *args: str | Path) -> tuple[str, Path]:
    """Train until a number is not finite; return the message and the dump."""
    done = call("train", *args)
    assert done.returncode == 1
    message = done.stderr
    (dump,) = run.glob("not-finite-*.safetensors")
    assert f"replay it with: egoskin replay {dump}" in message
    return message, dump


def test_a_loss_that_is_not_finite_is_dumped_and_replayed(tmp_path):
    run = tmp_path / "run"
    rate = ("--ppo.learning-rate", "1e15", "--ppo.desired-kl", "None")
    message, dump = check_fails_not_finite(run, *SMALL, "--run-dir", run, *rate)
    assert "actor gradient norm" in message
    # The checkpoint of the start, from before the first update.
    assert load_tensors(run / "checkpoint.safetensors")[1]["frames"] == 0
    lines = succeed("replay", dump).splitlines()
    assert lines[0].removeprefix("recorded: ") == lines[-1].removeprefix("again:    ")
    assert lines[1].startswith("first: output of ")


def test_a_bad_weight_is_named_by_the_replay(run):
    # As after a bit flip in memory: an infinite entry in the optimiser.
    path = run / "checkpoint.safetensors"
    tensors, header = load_tensors(path)
    tensors["optimizer/0/exp_avg"].view(-1)[3] = float("inf")
    save_tensors(path, tensors, header)
    before = path.read_bytes()
    resume = ("--resume", run, "--total-frames", (DONE + 1) * BATCH)
    message, dump = check_fails_not_finite(run, *resume)
    assert "norm of the weights" in message
    # The rate as it was adapted, with which the replay goes on.
    assert header["learning_rate"] != PPOConfig().learning_rate
    assert load_tensors(dump)[1]["learning_rate"] == header["learning_rate"]
    assert path.read_bytes() == before
    assert "first: agent head.log_std [21]" in succeed("replay", dump)


def test_an_infinite_observation_is_met_in_the_normaliser():
    # Normalised and cut off it is 10, and the loss is finite.
    torch.manual_seed(0)
    keys = ["observation"]
    agent = Agent({"observation": 3}, keys, keys, 2, NetworkConfig())
    rollout = TensorDict({"observation": torch.randn(4, 8, 3)}, [4, 8])
    rollout["observation"][1, 2, 0] = float("inf")
    with torch.no_grad():
        rollout.update(agent.critic(agent.actor(agent.encode(rollout))))
    rollout["reward"] = rollout["next_state_value"] = torch.zeros(4, 8, 1)
    rollout["done"] = rollout["terminated"] = torch.zeros(4, 8, 1, dtype=torch.bool)
    with pytest.raises(NonFiniteError, match="normaliser of 'observation'") as error:
        PPO(agent, PPOConfig()).update(rollout)
    assert len(error.value.batch["observation"]) == 1


@pytest.mark.parametrize(
    ("key", "sensor"),
    [
        ("observation", SensorConfig(coverage="none")),
        # Its features are sparse in training, and dense in the dump.
        ("signal", SensorConfig(coverage="ray", reduce="none")),
    ],
)
def test_a_failed_normaliser_is_dumped_and_replayed(key, sensor, tmp_path, monkeypatch):
    config = blind_run(tmp_path / "run", 64)
    env = dataclasses.replace(config.env, sensor=sensor)
    with open_trainer(Run.create(dataclasses.replace(config, env=env))) as trainer:
        sense = trainer.agent.sense

        def spoil(state: TensorDictBase) -> TensorDict:
            features = sense(state)
            value = features[key]
            if isinstance(value, SparseRows):
                offsets = torch.ones(len(value) + 1, dtype=torch.int64)
                offsets[0], column = 0, torch.zeros(1, dtype=torch.int64)
                entry = {"column": column, "value": torch.tensor([torch.inf])}
                spoilt = dataclasses.replace(value, offsets=offsets, **entry)
                features.set_non_tensor(key, spoilt)
            else:
                value[0, 0] = torch.inf
            return features

        monkeypatch.setattr(trainer.agent, "sense", spoil)
        with pytest.raises(NonFiniteError, match=f"normaliser of '{key}'"):
            trainer.iterate()
    (dump,) = (tmp_path / "run").glob("not-finite-*.safetensors")
    lines = succeed("replay", dump).splitlines()
    assert lines[0] == f"recorded: normaliser of '{key}'"
    assert lines[-1] == f"again:    normaliser of '{key}'"
    assert any(f"batch {key} [" in line for line in lines)


def test_of_a_folder_the_replay_tells_which_file_it_expects(tmp_path):
    error = fail("replay", tmp_path)
    assert f"{tmp_path} is a folder; give the file not-finite-<frames>" in error


def test_a_dump_that_is_none_is_refused(trained):
    assert "is not a dump of an update" in fail(
        "replay", trained / "checkpoint.safetensors"
    )


# --- the disk ---------------------------------------------------------------------


@pytest.mark.slow
def test_a_checkpoint_that_cannot_be_written_leaves_the_previous(start, run):
    path = run / "checkpoint.safetensors"
    before = path.read_bytes()
    training = start(
        *("--resume", run, "--total-frames", (DONE + 1) * BATCH),
        preexec_fn=lambda: limit_file_size(len(before) // 2),
    )
    check_failed_clearly(training, "File too large", str(path), f"--resume {run}")
    assert path.read_bytes() == before
    again = start("--resume", run)
    assert again.end() == 0, again.text()
    check_logs_have_no_gap(run)
    assert len(rows(run)) == DONE + 1


def in_own_mounts(script: str, *args: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a shell script that sees mounts of its own."""
    if shutil.which("unshare") is None:
        pytest.skip("needs unshare, to mount")
    if subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
        pytest.skip("may not mount: not root")
    return subprocess.run(
        ["unshare", "-m", "sh", "-c", script, *map(str, args)],
        capture_output=True,
        text=True,
        timeout=200,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@pytest.mark.slow
def test_a_full_disk_is_one_clear_error(run, tmp_path):
    disk, kept = tmp_path / "disk", tmp_path / "kept"
    disk.mkdir()
    # Room for the metrics, not for another checkpoint.
    script = """
        mount -t tmpfs -o size=16m tmpfs "$1" && cp -r "$0" "$1/run" || exit 99
        cat /dev/zero > "$1/fill" 2> /dev/null
        truncate -s -100K "$1/fill"
        "$2" -m egoskin train --resume "$1/run" --total-frames 2560
        code=$?
        cp "$1/run/checkpoint.safetensors" "$3"
        exit $code
    """
    done = in_own_mounts(script, run, disk, sys.executable, kept)
    assert done.returncode == 1, done.stderr
    path = disk / "run" / "checkpoint.safetensors"
    assert f"No space left on device: '{path}'" in done.stderr
    assert f"--resume {disk}/run" in done.stderr
    assert "Traceback" not in done.stderr
    assert kept.read_bytes() == (run / "checkpoint.safetensors").read_bytes()


@pytest.mark.slow
def test_a_read_only_run_folder_is_one_clear_error(run):
    script = """
        mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" || exit 99
        "$1" -m egoskin train --resume "$0" --total-frames 2560
    """
    before = (run / "checkpoint.safetensors").read_bytes()
    done = in_own_mounts(script, run, sys.executable)
    assert done.returncode == 1, done.stderr
    assert "Read-only file system" in done.stderr
    assert f"--resume {run}" in done.stderr
    assert "Traceback" not in done.stderr
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_a_run_folder_that_cannot_be_made_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    text = fail("train", *SMALL, "--run-dir", tmp_path / "file" / "run")
    assert "error: [Errno 20] Not a directory" in text


@pytest.mark.slow
def test_a_removed_run_folder_is_one_clear_error(start, run):
    training = start("--resume", run, "--total-frames", 10**6)
    training.wait_for(lambda: len(rows(run)) > DONE)
    # Renamed, then removed, so that a row being written does not reappear.
    shutil.rmtree(run.rename(run.with_name("gone")))
    message = f"No such file or directory: '{run}"
    check_failed_clearly(training, message, "start a new run")


# --- compiled kernels -----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [[], ["--sensor.coverage", "ray"]])
def test_compiled_training_is_the_same_and_goes_on_without_a_compiler(
    sensor, start, tmp_path, monkeypatch
):
    size = ("--total-frames", 6 * BATCH, *sensor)
    plain, run = tmp_path / "plain", tmp_path / "run"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for path in (plain, run):
        if path == run:
            monkeypatch.delenv(compilation.SETTING)
        training = start(*SMALL, *size, "--run-dir", path)
        assert training.end(600) == 0, training.text()
        assert training.text().count("compiling kernels.cpp") == (path == run)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    for path in (plain, run):
        training = start("--resume", path, "--total-frames", 8 * BATCH)
        assert training.end() == 0, training.text()
        assert training.text().count("kernels.cpp is not compiled") == 1
    assert run_hash(Run.open(run)) == run_hash(Run.open(plain))


def test_a_run_that_stored_whether_to_compile_goes_on(run):
    file = run / "config.json"
    content = json.loads(file.read_text())
    # As written before there were checksums.
    old = {k: v for k, v in content.items() if k not in ("format", "egoskin", "sha256")}
    del old["skin_sha256"]
    file.write_text(json.dumps({**old, "compile_kernels": True}))
    succeed("train", "--resume", run, "--total-frames", (DONE + 1) * BATCH)
    assert "compile_kernels" not in json.loads(file.read_text())


# --- memory ---------------------------------------------------------------------


def usage(training: Training) -> tuple[int, int, int]:
    """Resident memory [kB], open files, shared memory [kB] of all processes.

    Pages that processes share are counted once; those of libraries not at all: the
    share of them changes with whatever else runs on the machine.
    """
    resident = files = shared = 0
    for pid in training.processes():
        folder = Path("/proc") / str(pid)
        try:
            lines = (folder / "smaps_rollup").read_text().splitlines()
            files += len(list((folder / "fd").iterdir()))
        except OSError:
            continue
        for line in lines:
            if line.startswith(("Pss_Anon:", "Pss_Shmem:")):
                resident += int(line.split()[1])
            if line.startswith("Pss_Shmem:"):
                shared += int(line.split()[1])
    return resident, files, shared


@pytest.mark.slow
def test_memory_stays_flat(start, tmp_path):
    """At the default size; EGOSKIN_MEMORY_MINUTES=30 for the long form."""
    minutes = float(os.environ.get("EGOSKIN_MEMORY_MINUTES", "3"))
    run = tmp_path / "run"
    training = start("--run-dir", run, "--total-frames", 10**9)
    # In rollouts, as another process may slow the training down.
    training.wait_for(lambda: len(rows(run)) > 40, 600)
    samples = []
    end = time.monotonic() + 60 * minutes
    while time.monotonic() < end:
        assert training.process.poll() is None, training.text()
        samples.append(usage(training))
        time.sleep(0.2)
    training.process.send_signal(signal.SIGTERM)
    assert training.end() == 0, training.text()
    part = len(samples) // 3
    resident, files, shared = zip(*samples, strict=True)
    # Within a rollout it rises and falls: compare the lowest of the first and the last
    # third, which every rollout comes back to within some per cent.
    first, last = min(resident[:part]), min(resident[-part:])
    print(
        f"\n{minutes:g} min, {len(rows(run))} rollouts: resident {first / 1e3:.1f} -> "
        f"{last / 1e3:.1f} MB, peak {max(resident) / 1e3:.1f} MB, files "
        f"{max(files[:part])} -> {max(files[-part:])}, shared "
        f"{max(shared[:part])} -> {max(shared[-part:])} kB"
    )
    assert last <= 1.02 * first
    assert max(files[-part:]) <= max(files[:part])
    assert max(shared[-part:]) <= max(shared[:part])
    training.check_nothing_is_left()
