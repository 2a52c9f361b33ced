"""Logging of metrics to Weights & Biases (extra wandb)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class WandbLog:
    """A run at Weights & Biases, resumed when the training is resumed.

    Args:
        folder: The run folder; its name is the name of the run.
        start: Record of the training's first start; it distinguishes runs with the
            same name.
        config: The configuration.

    Raises:
        ValueError: If it cannot be opened (no network, not logged in, ...).
    """

    def __init__(
        self, folder: Path, start: Mapping[str, Any], config: Mapping[str, Any]
    ) -> None:
        import wandb  # pyright: ignore[reportMissingImports]

        identity = hashlib.sha256(f"{folder.name} {start['time']}".encode())
        try:
            self._run = wandb.init(
                project="egoskin",
                name=folder.name,
                id=identity.hexdigest()[:16],
                resume="allow",
                dir=folder,
                config=dict(config),
            )
        except wandb.Error as error:
            raise ValueError(f"--log wandb: {error}") from error

    def log(self, metrics: Mapping[str, float]) -> None:
        """Append the metrics of a rollout; "frames" is the x axis.

        Metrics logged again after resuming from a checkpoint are dropped by Weights &
        Biases; they are the same.
        """
        self._run.log(dict(metrics), step=int(metrics["frames"]))

    def close(self) -> None:
        """Send the remaining data and end the run."""
        self._run.finish()
