"""Evaluate a policy on a fixed bank of throws.

python scripts/evaluate.py runs/NAME
python scripts/evaluate.py runs/NAME/policies/000005046272.safetensors --json out.json
"""

from __future__ import annotations

import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from egoskin.cli import clear_errors
from egoskin.evaluation import Estimate, Evaluation, evaluate, standard_task
from egoskin.make import check_num_workers
from egoskin.policies import load_policy


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Play a bank of throws with the mean action of a trained policy."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run folder (its latest checkpoint), checkpoint or policy file."""
    bank_seed: int = 0
    """Seed of the bank of throws."""
    episodes: int = 1024
    """Throw sequences in the bank."""
    throw: Literal["standard", "run"] = "standard"
    """The standard throw whatever the run trained on, or the run's own."""
    num_workers: int | None = None
    """Processes that simulate; None: the largest divisor of episodes <= cores."""
    json: Path | None = None
    """File to write the figures to."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which nothing can be played."""
        if not 0 <= self.bank_seed < 2**32:
            raise ValueError(f"bank_seed must be in [0, 2**32), got {self.bank_seed}")
        check_num_workers(self.episodes, self.num_workers)
        if self.json is not None and not self.json.parent.is_dir():
            raise ValueError(f"--json: there is no folder {self.json.parent}")


def table(result: Evaluation, title: str) -> str:
    """Return the figures as text."""

    def interval(value: Estimate, scale: float, unit: str) -> str:
        mean, low, high = (scale * v for v in (value.mean, value.low, value.high))
        return f"{mean:6.2f} {unit}  ({low:.2f} to {high:.2f})"

    def share(value: float | None) -> str:
        return "     -" if value is None else f"{100 * value:6.2f} %"

    rows = [
        ("success (no contact for 3 s)", interval(result.success, 100, "%")),
        ("  same bank, robot held rigid", share(result.rigid_success)),
        ("survival time (at most 10 s)", interval(result.survival_time, 1, "s")),
        ("ended within 3 s by a ball", share(result.ended_by_ball)),
        ("ended within 3 s by a fall", share(result.ended_by_fall)),
        ("ended within 3 s by divergence", share(result.diverged)),
        ("first balls avoided", share(result.avoided.first_ball)),
        ("later balls avoided", share(result.avoided.later_balls)),
    ]
    lines = [f"  {name:<32} {value}" for name, value in rows]
    return "\n".join([title, *lines, "  (95 % intervals in brackets)"])


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(EvaluateConfig, args=args)
    policy = load_policy(config.policy)
    env_config = policy.env_config
    if config.throw == "standard":
        env_config = standard_task(env_config)

    def show(step: int, running: int) -> None:
        if sys.stderr.isatty():
            text = f"\r{step / env_config.task.physics.control_hz:5.2f} s, "
            print(f"{text}{running} still running \x1b[K", end="", file=sys.stderr)

    result = evaluate(
        policy,
        env_config,
        policy.skin,
        bank_seed=config.bank_seed,
        episodes=config.episodes,
        num_workers=config.num_workers,
        on_step=show,
    )
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    title = (
        f"{config.policy}: {policy.spec.frames:,} frames; bank {config.bank_seed} of "
        f"{config.episodes} episodes, {config.throw} throw"
    )
    print(table(result, title))
    if config.json is not None:
        config.json.write_text(json.dumps(dataclasses.asdict(result), indent=2) + "\n")


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
