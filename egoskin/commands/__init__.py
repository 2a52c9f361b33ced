"""The command line: `egoskin NAME`, `python -m egoskin NAME` and the scripts.

Contract: a command is the module of its name, with a function ``main(args)``. Help is
shown at once: nothing heavy is imported before the arguments are checked for it.
"""

from __future__ import annotations

import os
import resource
import sys
from importlib import import_module

from egoskin import __version__
from egoskin.commands import pages
from egoskin.hints import unknown_command
from egoskin.interrupts import end_quietly, unread_output
from egoskin.viewer import draw_without_display

COMMANDS = {
    "train": "train a robot to dodge, or resume a run",
    "evaluate": "evaluate a policy on a fixed set of throws",
    "view": "see a policy in the browser, and throw balls at it",
    "film": "film an episode, with a contact sheet of its moments",
    "skin": "place, import, export and show skins",
    "robot": "check a robot before training, and draw it",
    "visibility": "show what a skin sees; no training is needed",
    "upper-bound": "search for actions that avoid a ball, to compare with a policy",
    "replay": "repeat a training update whose result was NaN or infinite",
    "study": "plan, run and report trainings over seeds",
    "export": "write a policy as ONNX, for a robot without PyTorch",
    "verify": "check that training is reproducible on this machine",
    "bench": "measure speed and accuracy",
}
"""Descriptions of the commands, by name."""
# Other names for suggestions: older scripts, and options.
_OTHER_NAMES = {
    "ppo": "train",
    "render": "film",
    "coverage": "visibility",
    "ceiling": "upper-bound",
    "--help": "--help",
    "--version": "--version",
}

# Address space that importing PyTorch and MuJoCo takes, with a reserve [bytes].
_ADDRESS_SPACE = 1_000_000_000
# Commands that draw the robot.
_PICTURES = ("film", "skin", "robot")


def main() -> None:
    """Run the command named by the first argument of this process."""
    name, *args = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h"):
        _show(_page())
    elif name == "--version":
        print(f"egoskin {__version__}")
    elif name in COMMANDS:
        # Help and the record of a run show the command as it was called.
        sys.argv = [f"egoskin {name}", *args]
        run(name)
    else:
        text = unknown_command(name, COMMANDS, _OTHER_NAMES)
        print(f"error: {text}", file=sys.stderr)
        raise SystemExit(2)


def begin(name: str) -> None:
    """Show the help and exit if it is requested; else prepare to run a command.

    Call this before mujoco and torch are imported. ``--help-all`` is passed on to the
    command's own parser as ``--help``.
    """
    end_quietly()
    # Closed, as of some daemons.
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, "w"))  # noqa: SIM115
    args = sys.argv[1:]
    if "--help-all" in args:
        sys.argv[1:] = ["--help" if arg == "--help-all" else arg for arg in args]
    elif pages.asked_for(name, args):
        _show(pages.page(name))
        raise SystemExit(0)
    _check_address_space()
    if name in _PICTURES:
        draw_without_display()
    _check_opengl()


def run(name: str) -> None:
    """Run a command on the arguments of this process, with clear errors."""
    begin(name)
    command = import_module(f"egoskin.commands.{name.replace('-', '_')}")
    # Imported late, because it imports torch.
    from egoskin.commands.errors import clear_errors

    with clear_errors():
        command.main(sys.argv[1:])


def _show(text: str) -> None:
    """Print help; end without a message if the reader has left, as in `| head -1`."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        raise unread_output() from None


def _check_address_space() -> None:
    """Exit if `ulimit -v` leaves no room for libraries; some would retry for ever."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _ADDRESS_SPACE:
        print(
            f"error: too little memory: PyTorch and MuJoCo need {_ADDRESS_SPACE:,} "
            f"bytes of address space, and the limit (ulimit -v) is {limit:,}",
            file=sys.stderr,
        )
        raise SystemExit(2)


def _check_opengl() -> None:
    """Exit if MuJoCo cannot be imported with the OpenGL that ``MUJOCO_GL`` names.

    MuJoCo loads that library whatever the command; the error text comes from PyOpenGL
    and does not mention it.
    """
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, RuntimeError) as fault:
        backend = os.environ.get("MUJOCO_GL", "")
        print(
            f"error: MuJoCo cannot be imported with MUJOCO_GL={backend!r} ({fault}); "
            "install the library (Debian: `apt-get install libegl1` for egl, `apt-get "
            "install libosmesa6` for osmesa), or unset MUJOCO_GL",
            file=sys.stderr,
        )
        raise SystemExit(2) from None


def _page() -> str:
    """Return the help page that lists all commands."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: egoskin COMMAND [OPTIONS]",
            "",
            "Proximity skins for robots: which skin makes avoidance easy to learn?",
            "",
            *lines,
            "",
            "egoskin COMMAND --help describes a command. For example:",
            "",
            "  egoskin evaluate field_proximity --episodes 256",
            "  egoskin film field_proximity --longest-of 16 --out dodge.mp4",
            "  egoskin train --sensor.signal binary --sensor.range 1 --seed 1",
        ]
    )
