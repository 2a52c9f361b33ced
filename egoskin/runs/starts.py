"""What is recorded about each start of a run: versions, machine, git state."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from egoskin.storage.formats import package_version

_PACKAGES = ("egoskin", "torch", "torchrl", "tensordict", "mujoco", "numpy")
_PACKAGES += ("pytorch-kinematics", "gymnasium")
_WARP_PACKAGES = ("mujoco-warp", "warp-lang")


def describe_start(engine: str) -> dict[str, Any]:
    """Return time, command, versions, machine and git state of this process.

    Args:
        engine: Physics engine of the run; it decides which packages are of interest.
    """
    names = _PACKAGES + _WARP_PACKAGES * (engine == "warp")
    packages = {p: package_version(p) for p in names}
    # The version of torch names its build; that of the installed package may not.
    packages["torch"] = str(torch.__version__)
    return {
        "time": datetime.datetime.now(datetime.timezone.utc).isoformat(),
        "command": sys.argv,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "packages": packages,
        "git": git_state(Path(__file__)),
    }


def git_state(source: Path) -> dict[str, Any] | None:
    """Return the commit of a source file, and whether its working tree has changes.

    Returns None if the file is not in a repository.
    """

    def git(*args: str) -> str:
        return subprocess.run(
            ["git", "-C", str(source.parent), *args],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    try:
        # An installed copy may be inside an unrelated repository.
        git("ls-files", "--error-unmatch", str(source))
        return {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.CalledProcessError):
        return None
