"""The progress line: on a terminal, in a file, or with a closed output."""

from __future__ import annotations

import os
import sys

import pytest

from egoskin.progress import ProgressLine, StatusLine, duration, note

METRICS = {
    "episode/success": float("nan"),
    "episode/survival_s": 1.0,
    "time/steps_per_s": 1e4,
    "reward/mean": 0.0,
}


def test_durations_are_readable():
    assert duration(None) == "-"
    assert duration(299) == "299 s"
    assert duration(300) == "5 min"
    assert duration(3 * 3600 + 60) == "3 h 01 min"
    assert duration(50 * 3600) == "2 d 02 h"


def test_few_frames_of_many_are_not_none(capsys):
    ProgressLine(0, 65_536_000).update({**METRICS, "frames": 512})
    assert capsys.readouterr().out.startswith("       512 / 65,536,000 frames    0.0%")


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ("xterm", "\rplaying\x1b[K\r\x1b[Kdone\n"),
        # In an editor; TERM says that it knows no control sequences.
        ("dumb", "playing\ndone\n"),
    ],
)
def test_a_terminal_without_control_sequences_gets_plain_lines(
    term, expected, monkeypatch, capsys
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", term)
    StatusLine("playing")
    note("done")
    assert capsys.readouterr().err == expected


def test_a_closed_pipe_is_noted(monkeypatch):
    read, write = os.pipe()
    os.close(read)
    line = ProgressLine(0, 1024)
    with os.fdopen(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert not line.is_unread
        line.update({**METRICS, "frames": 1024})
        assert line.is_unread
        line.update({**METRICS, "frames": 1024})
        line.finish()
        monkeypatch.undo()
        with pytest.raises(BrokenPipeError):
            pipe.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), pipe.fileno())
