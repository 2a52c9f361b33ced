"""Train a robot to dodge: the main job.

python scripts/ppo.py --sensor.signal localization --sensor.range 2 --seed 1
python scripts/ppo.py --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

import egoskin  # noqa: F401  (before torch: it says how torch's threads wait)

# isort: split

import math
import signal
import sys
from types import FrameType

from egoskin.agents.ppo import NonFiniteError
from egoskin.cli import clear_errors, counted
from egoskin.make import check_num_workers
from egoskin.progress import ProgressLine
from egoskin.runs import Run, parse_config
from egoskin.training import open_trainer, train
from egoskin.workers import WorkerError


class Stop:
    """Notes the first Ctrl-C or SIGTERM; a second one ends the process at once."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        print("\nstopping after this rollout, with a checkpoint", file=sys.stderr)
        for again in (signal.SIGINT, signal.SIGTERM):
            signal.signal(again, signal.SIG_DFL)


def main(args: list[str]) -> None:
    """Run the command."""
    config = parse_config(args)
    config.check_machine()
    run = Run.create(config) if config.resume is None else Run(config.resume, config)
    workers = check_num_workers(config.num_envs, config.num_workers)
    print(
        f"run {run.path}: {counted(config.num_envs, 'agent')} on "
        f"{counted(workers, 'worker')}, learner on {config.device} with "
        f"{counted(config.num_learner_threads, 'thread')}"
    )
    stop = Stop()
    rollouts = math.ceil(config.total_frames / config.frames_per_batch)
    try:
        with open_trainer(run) as trainer:
            line = ProgressLine(trainer.frames, rollouts * config.frames_per_batch)
            train(trainer, lambda: stop.requested, line.update)
            line.finish()
    except (WorkerError, NonFiniteError, OSError) as error:
        raise SystemExit(f"error: {error}\n{run.how_to_go_on()}") from error
    if trainer.frames < config.total_frames:
        print(run.how_to_go_on())
    else:
        print(f"done; evaluate it with: python scripts/evaluate.py {run.path}")


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
