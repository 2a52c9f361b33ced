"""Small films of a policy during training, each made by a separate process.

Training continues meanwhile; if a film fails, a note is printed to stderr.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from egoskin.progress import note

_SIZE, _FPS = ("480", "270"), 20.0
# A film shows the first seconds of the longest of this many episodes, which is more
# informative than a random one.
_EPISODES, _SECONDS = "4", "5"


class FilmMaker:
    """Makes films in the folder ``films`` of a run, one after another.

    Args:
        folder: The run folder.
        control_hz: Rate of the steps [Hz], which a film cannot exceed.
    """

    def __init__(self, folder: Path, control_hz: float) -> None:
        self._folder = folder / "films"
        self._fps = min(_FPS, control_hz)
        self._process: subprocess.Popen[str] | None = None
        self._film = Path()

    def __enter__(self) -> FilmMaker:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        *_: object,
    ) -> None:
        """Finish the last film if training ended normally; otherwise stop it."""
        if kind is not None:
            self.stop()
        self._finish()

    def stop(self) -> None:
        """Stop the film that is being made, if any."""
        if self._process is not None:
            self._process.terminate()
            self._process.communicate()
            self._process = None

    def start(self, policy: Path) -> None:
        """Start the film of a policy file, after waiting for the previous film."""
        self._finish()
        self._folder.mkdir(exist_ok=True)
        self._film = self._folder / f"{policy.stem}.mp4"
        command = [sys.executable, "-m", "egoskin", "film", str(policy)]
        command += ["--out", str(self._film), "--standard", "run"]
        command += ["--fps", f"{self._fps!r}", "--size", *_SIZE]
        command += ["--longest-of", _EPISODES, "--seconds", _SECONDS]
        # The package may be imported from a clone, in any working directory.
        path = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]
        self._process = subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            # Ctrl-C must only reach the training, which then ends this process.
            start_new_session=True,
        )

    def _finish(self) -> None:
        if self._process is None:
            return
        if self._process.poll() is None:
            note(f"waiting for the film {self._film}")
        _, errors = self._process.communicate()
        if status := self._process.returncode:
            last = errors.strip().splitlines()[-1:] or [f"exit status {status}"]
            note(f"note: film {self._film} failed: {' '.join(last)}")
        self._process = None
