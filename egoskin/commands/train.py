"""Train a robot to dodge: the main job.

egoskin train --sensor.signal localization --sensor.range 2 --seed 1
egoskin train --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from egoskin.agents.ppo import NonFiniteError
from egoskin.interrupts import ENDING, end_next_time, say, take
from egoskin.make import check_num_workers
from egoskin.parallel import WorkerError
from egoskin.progress import ProgressLine, counted
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer, train


class Stop:
    """Notes the first signal that ends a script; a second Ctrl-C ends it at once."""

    def __init__(self) -> None:
        self.requested = False
        take(self._note, *ENDING)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        end_next_time()
        say("stopping after this rollout, with a checkpoint")


def open_run(config: TrainConfig) -> Run:
    """Return the run folder of a configuration, new or to go on with; say what it is.

    Raises:
        ValueError: If no such run can be trained here.
    """
    config.check_machine()
    run = Run.create(config) if config.resume is None else Run(config.resume, config)
    workers = check_num_workers(config.num_envs, config.num_workers)
    print(
        f"run {run.path}: {counted(config.num_envs, 'agent')} on "
        f"{counted(workers, 'worker')}, learner on {config.device} with "
        f"{counted(config.num_learner_threads, 'thread')}"
    )
    return run


@contextmanager
def saying_how_to_go_on(run: Run) -> Iterator[None]:
    """End with what to do next, where training fails."""
    try:
        yield
    except (WorkerError, NonFiniteError, OSError) as error:
        raise SystemExit(f"error: {error}\n{run.how_to_go_on()}") from error


def main(args: list[str]) -> None:
    """Run the command."""
    config = parse_config(args)
    run = open_run(config)
    rollouts = math.ceil(config.total_frames / config.frames_per_batch)
    with saying_how_to_go_on(run), open_trainer(run) as trainer:
        stop = Stop()
        line = ProgressLine(trainer.frames, rollouts * config.frames_per_batch)
        train(trainer, lambda: stop.requested or line.is_unread, line.update)
        line.finish()
    if trainer.frames < config.total_frames:
        print(run.how_to_go_on())
    else:
        print(f"done; evaluate it with: egoskin evaluate {run.path}")
