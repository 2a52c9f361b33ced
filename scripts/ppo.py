"""Train a robot to dodge: the main job.

python scripts/ppo.py --sensor.signal localization --sensor.range 2 --seed 1
python scripts/ppo.py --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import math
import sys
from types import FrameType

from egoskin.agents.ppo import NonFiniteError
from egoskin.cli import clear_errors, counted
from egoskin.interrupts import ENDING, end_next_time, say, take
from egoskin.make import check_num_workers
from egoskin.parallel import WorkerError
from egoskin.progress import ProgressLine
from egoskin.runs.run import Run, parse_config
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
    rollouts = math.ceil(config.total_frames / config.frames_per_batch)
    try:
        with open_trainer(run) as trainer:
            stop = Stop()
            line = ProgressLine(trainer.frames, rollouts * config.frames_per_batch)
            train(trainer, lambda: stop.requested or line.is_unread, line.update)
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
