"""Fixtures of the tests of runs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from egoskin.runs.run import Run
from egoskin.runs.trainer import Trainer, open_trainer, train
from making import blind_run


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Iterator[Trainer]:
    """A trainer after one rollout of 64 frames."""
    run = Run.create(blind_run(tmp_path_factory.mktemp("finished") / "run", 64))
    with open_trainer(run) as trainer:
        train(trainer)
        yield trainer
