"""Metrics at Weights & Biases, beside those in the run folder (extra wandb)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class WandbLog:
    """A run at Weights & Biases, gone on with where a training is.

    Args:
        folder: The run folder; its name is that of the run.
        start: What is recorded of the training's first start: it tells runs of one
            name apart.
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

        What was logged before and after a checkpoint that is gone on with is dropped
        there: it is the same.
        """
        self._run.log(dict(metrics), step=int(metrics["frames"]))

    def close(self) -> None:
        """Send what is left."""
        self._run.finish()
