"""Search for actions that avoid a ball once it is near a sensor.

egoskin upper-bound field_proximity
egoskin upper-bound runs/NAME --throws 64 --ball 2 --json upper-bound.json

A policy plays the first ball of each episode of a throw set (--ball 2: the second)
until the ball is in reach of a sensor. From there on, actions are searched that, added
to the policy's, avoid the ball and, secondly, do not let the robot fall. Whatever the
search finds is possible for the body in the warning time (it may miss solutions). If
the policy does worse, it lacks training, or its sensors lack information.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from egoskin.bounds import COUNT, Interval, check_bounds
from egoskin.evaluation.throw_set import standard_task
from egoskin.evaluation.upper_bound import (
    Outcome,
    SearchConfig,
    UpperBound,
    find_upper_bound,
)
from egoskin.policies.policy import load_policy
from egoskin.progress import counted
from egoskin.rng import check_seed
from egoskin.storage.files import check_output
from egoskin.storage.serialization import write_json

# Bounds of the groups by the height that the throw is aimed at [m].
BOUNDS = (0.0, 0.7, 0.9, 1.1, 1.3, 2.0)


@dataclass(frozen=True, kw_only=True)
class UpperBoundConfig:
    """Search for actions that avoid the balls of a throw set."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package."""
    throw_set: int = 0
    """Seed of the throw set."""
    throws: Annotated[int, COUNT] = 32
    """Episodes of the throw set."""
    ball: Annotated[int, COUNT] = 1
    """Number of the ball in each episode, from 1; it is the last ball thrown."""
    reach: Annotated[float, Interval(ge=1e-3, le=math.inf)] = 2.0
    """Distance from a sensor to the ball's surface at which the search starts [m]."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """The search."""
    json: Path | None = None
    """JSON file to write the results to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_seed(self.throw_set, "throw_set")
        check_bounds(self)
        check_output(self.json, "--json")


def groups(result: UpperBound) -> list[dict[str, float | int]]:
    """Return counts of throws, of avoided balls and of standing robots, by height."""
    return [
        {
            "from_m": low,
            "to_m": high,
            **_counts(result, (result.height >= low) & (result.height < high)),
        }
        for low, high in zip(BOUNDS, BOUNDS[1:], strict=False)
    ]


def _counts(result: UpperBound, member: Tensor) -> dict[str, int]:
    """Return the counts of some throws, ``[throws]``."""
    which = {
        "throws": member,
        "policy_avoids": result.policy.avoided,
        "policy_stands": result.policy.stood,
        "search_avoids": result.best.avoided,
        "search_stands": result.best.stood,
    }
    return {name: int((each & member).sum()) for name, each in which.items()}


def _total(result: UpperBound) -> dict[str, int]:
    """Return the counts of all throws."""
    return _counts(result, torch.ones_like(result.policy.avoided))


def table(result: UpperBound, title: str) -> str:
    """Return the counts as text."""
    lines = [
        title,
        f"  {'':<16} {'':>6}  {'policy':^17}  {'best found':^17}",
        f"  {'height aimed at':<16} {'throws':>6}  {'avoids':>8} {'and stands':>10}"
        f"  {'avoids':>8} {'and stands':>10}",
    ]
    total = _total(result)
    # More than the sum of the groups, if throws are aimed higher than the last.
    for row in [*groups(result), total]:
        name = "all" if row is total else f"{row['from_m']:g} to {row['to_m']:g} m"
        lines.append(
            f"  {name:<16} {row['throws']:>6}  {row['policy_avoids']:>8} "
            f"{row['policy_stands']:>10}  {row['search_avoids']:>8} "
            f"{row['search_stands']:>10}"
        )
    return "\n".join(lines)


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(UpperBoundConfig, args=args)
    policy = load_policy(config.policy)
    began = time.perf_counter()

    def show(iteration: int, best: Outcome) -> None:
        print(
            f"iteration {iteration} of {config.search.iterations}, "
            f"{time.perf_counter() - began:.0f} s: of {len(best.avoided)} throws "
            f"{int(best.avoided.sum())} avoided, {int(best.stood.sum())} and standing",
            file=sys.stderr,
            flush=True,
        )

    result = find_upper_bound(
        policy,
        standard_task(policy.env_config),
        config.search,
        throw_set=config.throw_set,
        throws=config.throws,
        reach=config.reach,
        ball=config.ball,
        on_iteration=show,
    )
    title = (
        f"{config.policy}: {policy.policy_spec.frames:,} frames; "
        f"{counted(len(result.height), 'throw')} (ball {config.ball} of the episodes) "
        f"of throw set {config.throw_set} that came within {config.reach:g} m of a "
        "sensor"
    )
    print(table(result, title))
    if config.json is not None:
        content = {
            "policy": str(config.policy),
            "frames": policy.policy_spec.frames,
            "throw_set": config.throw_set,
            "ball": config.ball,
            "reach_m": config.reach,
            "search": dataclasses.asdict(config.search),
            "all": _total(result),
            "by_height_m": groups(result),
        }
        write_json(config.json, content)
