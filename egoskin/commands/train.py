"""Train a robot to dodge balls.

egoskin train --sensor.signal localization --sensor.range 2 --seed 1
egoskin train --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from shlex import quote
from types import FrameType

from egoskin.agents.ppo import NonFiniteError
from egoskin.commands.errors import check_packages
from egoskin.envs.physics import engine_of
from egoskin.interrupts import ENDING, end_next_time, say, take
from egoskin.make import check_num_workers, device_of
from egoskin.parallel import WorkerError
from egoskin.progress import ProgressLine, counted, duration
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.runs.run import Run
from egoskin.runs.trainer import Trainer, open_trainer, train


class Stop:
    """Records the first terminating signal; a second Ctrl-C ends the script at once."""

    def __init__(self) -> None:
        self.requested = False
        take(self._note, *ENDING)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        end_next_time()
        say("stopping after this rollout, with a checkpoint")


def open_run(config: TrainConfig) -> Run:
    """Return the new or resumed run of a configuration, and print a summary of it.

    Raises:
        ValueError: If the run cannot be trained on this machine.
    """
    device_of(config.device)
    engine_of(config.engine)
    if config.log == "wandb":
        check_packages("--log wandb", "wandb", "wandb")
    if config.engine == "warp":
        print("MuJoCo Warp: the first start compiles for some minutes", flush=True)
    run = Run.create(config) if config.resume is None else Run(config.resume, config)
    print(
        f"run {run.path}: {config.env.robot_config.name}, {config.env.sensor.label()}, "
        f"throws of standard {config.env.standard}, seed {config.seed}",
        flush=True,
    )
    return run


def announce(trainer: Trainer) -> None:
    """Print the amount of work, and how to watch it."""
    config, done = trainer.config, trainer.frames
    to_do = max(config.total_frames - done, 0)
    workers = check_num_workers(config.num_envs, config.num_workers)
    where = counted(workers, "worker")
    if config.engine == "warp":
        where = f"MuJoCo Warp, {config.device}"
    print(
        f"{to_do:,} frames{f' after {done:,}' if done else ''}: "
        f"{counted(config.num_envs, 'agent')} on {where}, "
        f"learner on {config.device} with "
        f"{counted(trainer.ppo.num_threads, 'thread')}\n"
        f"curves while it trains: tensorboard --logdir {quote(str(trainer.run.path))}",
        flush=True,
    )


def summary_of(trainer: Trainer, metrics: Mapping[str, float]) -> str:
    """Return a summary of a finished training, and commands to inspect it.

    Args:
        trainer: Trainer of the finished run.
        metrics: Metrics of its last rollout; empty if no rollout was left to do.
    """
    path, task = quote(str(trainer.run.path)), trainer.config.env.task
    summary = f"done: {trainer.frames:,} frames"
    if metrics:
        summary += f" in {duration(metrics['time/wall_s'])}; with exploration "
        # NaN if no episode could last long enough.
        if not math.isnan(success := metrics["episode/success"]):
            summary += f"{success:.1%} untouched for {task.success_age_s:g} s, "
        summary += f"survival {metrics['episode/survival_s']:.2f} s"
    own = " --standard run" * (trainer.config.env.standard == "custom")
    return (
        f"{summary}\n"
        f"evaluate it with: egoskin evaluate {path}{own}\n"
        f"film it with:     egoskin film {path} --longest-of 16{own}\n"
        f"view it with:     egoskin view {path}"
    )


@contextmanager
def with_resume_advice(run: Run) -> Iterator[None]:
    """Turn a failure of training into an error text that says how to resume."""
    try:
        yield
    except NonFiniteError as error:
        raise SystemExit(
            f"error: {error}\n"
            "a resume would repeat this update; to train on from the last checkpoint, "
            "change an option, for example --ppo.learning-rate: egoskin train --config "
            f"{quote(str(run.path / 'config.json'))} --init-from "
            f"{quote(str(run.path))} --ppo.learning-rate ..."
        ) from error
    except (WorkerError, OSError) as error:
        raise SystemExit(f"error: {error}\n{run.resume_advice()}") from error


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
