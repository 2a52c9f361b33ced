"""What the scripts share: errors before the work, and in one line."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest

from egoskin.commands.errors import clear_errors
from egoskin.parallel import WorkerError
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
    # Root may write anywhere but there.
    for path in (tmp_path / ("x" * 300), Path("/proc/new.json")):
        with pytest.raises(ValueError, match=rf"--json: {path} cannot be written \("):
            check_output(path, "--json")


def test_a_pipe_that_nobody_reads_is_no_error(monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    # Closing it, as at the end of a process, writes what is left.
    with open(write, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        # What is printed at last is still in a buffer; --help ends by SystemExit.
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


def test_a_worker_that_ends_is_one_line():
    with pytest.raises(SystemExit, match="error: worker 0 died"), clear_errors():
        raise WorkerError("worker 0 died")
