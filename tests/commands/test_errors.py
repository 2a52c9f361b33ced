"""What all commands share: errors in one line, before the work starts."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from calling import fail
from egoskin.commands.errors import clear_errors
from egoskin.make import device_of
from egoskin.parallel import WorkerError
from egoskin.progress import StatusLine
from egoskin.runs.config import parse_config
from egoskin.storage.files import check_output


def test_a_file_that_cannot_be_written_is_told_of_before_the_work(tmp_path):
    check_output(None, "--json")
    check_output(tmp_path / "new.json", "--json")
    with pytest.raises(ValueError, match=r"--json: there is no folder .*none"):
        check_output(tmp_path / "none" / "new.json", "--json")
    with pytest.raises(ValueError, match=r"--json: .* is a folder"):
        check_output(tmp_path, "--json")

    kept = tmp_path / "kept.json"
    kept.write_text("before")
    check_output(kept, "--json")
    assert kept.read_text() == "before"
    assert list(tmp_path.iterdir()) == [kept]
    # Even root cannot write there.
    for path in (tmp_path / ("x" * 300), Path("/proc/new.json")):
        with pytest.raises(ValueError, match=rf"--json: {path} cannot be written \("):
            check_output(path, "--json")


def test_a_named_pipe_is_no_file_to_write(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match=r"--json: .*pipe is a named pipe"):
        check_output(tmp_path / "pipe", "--json")
    # As a shell passes `>(gzip > out.gz)`.
    read, write = os.pipe()
    check_output(Path(f"/dev/fd/{write}"), "--json")
    os.close(read)
    os.close(write)


@pytest.mark.parametrize("text", ["1e6", "1_000_000", "1000000", "1.0e6"])
def test_a_whole_number_may_have_an_exponent(text):
    with clear_errors():
        assert parse_config(["--total-frames", text]).total_frames == 10**6


@pytest.mark.parametrize("text", ["1.5", "inf", "nan", "1e400", "1e30", "x"])
def test_what_is_no_whole_number_is_refused(text, capsys):
    with pytest.raises(SystemExit) as ended, clear_errors():
        parse_config(["--total-frames", text])
    assert ended.value.code == 2
    assert f"expected a whole number, got {text}" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["physics", "sensors"])
def test_too_many_agents_are_refused_before_their_memory_is_taken(name):
    told = fail("bench", name, "--num-envs", "1e9")
    assert "num_envs must be at most 1,048,576, got 1000000000" in told


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--ppo.network.hidden", "0"], "ppo.network: hidden must be at least 1"),
        (["--ppo.critic-coeff", "-1"], "ppo: critic_coeff must be positive"),
        (["--num-workers", "1e9"], "num_workers must be at most 1,024"),
    ],
)
def test_a_number_out_of_bounds_is_named_with_its_option(args, message, capsys):
    with pytest.raises(SystemExit) as ended, clear_errors():
        parse_config(args)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (MemoryError(), "too little memory: out of memory"),
        (RuntimeError("can't start new thread"), "too little memory: can't start new"),
        (RuntimeError("Failed to allocate 9 bytes on device 'cpu'"), "too little mem"),
        (OverflowError("int too large to convert"), "int too large to convert"),
        (RecursionError("maximum recursion depth"), "maximum recursion depth"),
    ],
)
def test_what_is_too_much_for_the_machine_is_one_line(error, text, capsys):
    with pytest.raises(SystemExit) as ended, clear_errors():
        raise error
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(f"error: {text}")


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Failed to allocate 85899345920 bytes on device 'cuda:0'"),
        RuntimeError("CUDA error: out of memory\nCompile with TORCH_USE_CUDA_DSA"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 80.00 GiB."),
    ],
)
def test_too_little_memory_of_a_gpu_is_one_line_with_the_cure(error, capsys):
    with pytest.raises(SystemExit) as ended, clear_errors():
        raise error
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: too little memory: ")
    assert "--num-envs" in line


@pytest.mark.parametrize(
    ("built", "why"), [(True, "finds no GPU, or no driver"), (False, "for the CPU")]
)
def test_why_there_is_no_gpu_is_told(built, why, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: built)
    with pytest.raises(ValueError, match=f"no device 'cuda': .*{why}.*available: cpu"):
        device_of("cuda")
    with pytest.raises(ValueError, match="no device 'gpu'; available: cpu"):
        device_of("gpu")


def test_more_than_torch_can_allocate_is_one_line(capsys):
    with pytest.raises(SystemExit), clear_errors():
        torch.empty(2**50)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: too little memory")


def test_a_fault_of_ours_keeps_its_traceback():
    with pytest.raises(RuntimeError, match="ours"), clear_errors():
        raise RuntimeError("ours")


def test_a_pipe_that_nobody_reads_is_no_error(monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    # Closing it, as at the end of a process, flushes the buffer.
    with open(write, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        # The last output is still in the buffer; --help ends with SystemExit.
        print("text")
        with pytest.raises(SystemExit) as ended, clear_errors():
            raise SystemExit(0)
    assert ended.value.code == 141
    assert capfd.readouterr().err == ""


def test_a_broken_pipe_to_a_program_is_an_error(capfd):
    with pytest.raises(SystemExit) as ended, clear_errors():
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert ended.value.code == 2
    assert "Broken pipe" in capfd.readouterr().err


def test_a_worker_that_ends_is_one_line(capfd):
    with pytest.raises(SystemExit) as ended, clear_errors():
        raise WorkerError("worker 0 died")
    assert ended.value.code == 1
    assert capfd.readouterr().err == "error: worker 0 died\n"


@pytest.mark.parametrize("error", [ValueError, WorkerError])
def test_on_a_terminal_an_error_takes_the_place_of_the_progress(error, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", Terminal())
    StatusLine("playing 1 episode")
    with pytest.raises(SystemExit), clear_errors():
        raise error("too many")
    expected = "\rplaying 1 episode\x1b[K\r\x1b[Kerror: too many\n"
    assert sys.stderr.getvalue() == expected


@pytest.mark.parametrize("stream", [1, 2])
def test_a_closed_stream_is_no_fault(stream, tmp_path):
    command = f"{sys.executable} -m egoskin skin place --num-sensors 2 --out a.json"
    done = subprocess.run(
        ["sh", "-c", f"{command} {stream}>&-"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "a.json").is_file()


@pytest.mark.parametrize(
    "args",
    [
        ("evaluate", "blind", "--episodes", "2", "--num-workers", "1"),
        ("upper-bound", "blind", "--throws", "1", "--search.iterations", "1"),
        ("visibility", "--num-throws", "2", "--coverages", "field", "--ranges", "1"),
    ],
    ids=lambda args: args[0],
)
def test_results_that_cannot_be_written_leave_the_old_ones(args, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    old = Path("old.json")
    old.write_text("old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert "No space left on device: 'old.json'" in fail(*args, "--json", "old.json")
    assert old.read_text() == "old"
    assert list(tmp_path.iterdir()) == [tmp_path / "old.json"]
