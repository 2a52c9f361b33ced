"""Train a robot to dodge: the main script, to run or to copy from.

python scripts/ppo.py --sensor.signal localization --sensor.range 2 --seed 1
python scripts/ppo.py --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

from egoskin.commands import begin

if __name__ == "__main__":
    begin("train")

# isort: split

import math
import sys

from egoskin.commands.errors import clear_errors
from egoskin.commands.train import (
    Stop,
    announce,
    open_run,
    summary_of,
    with_resume_advice,
)
from egoskin.progress import ProgressLine
from egoskin.runs.config import parse_config
from egoskin.runs.trainer import open_trainer, train


def main(args: list[str]) -> None:
    """Run the command."""
    config = parse_config(args)
    run = open_run(config)
    rollouts = math.ceil(config.total_frames / config.frames_per_batch)
    with with_resume_advice(run), open_trainer(run) as trainer:
        announce(trainer)
        stop = Stop()
        line = ProgressLine(trainer.frames, rollouts * config.frames_per_batch)
        train(trainer, lambda: stop.requested or line.is_unread, line.update)
        line.finish()
    if trainer.frames < config.total_frames:
        print(run.resume_advice())
    else:
        print(summary_of(trainer, line.metrics))


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
