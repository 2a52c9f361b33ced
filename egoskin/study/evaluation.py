"""Evaluation of a study's policies on its throw set."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from egoskin.evaluation.throw_set import play_throws, standard_task, summarize
from egoskin.parallel import default_num_workers
from egoskin.policies.policy import Policy
from egoskin.sensors import MASK_ALL
from egoskin.study.manifest import EvaluationPlan


def evaluate_policy(
    policy: Policy,
    plan: EvaluationPlan,
    on_step: Callable[[int, int], None] | None = None,
    cores: int = 1,
) -> dict[str, Any]:
    """Evaluate a policy on a study's throw set; return the results as JSON values.

    Args:
        policy: The policy.
        plan: The throw set and how to evaluate on it.
        on_step: Called with (steps done, episodes still running).
        cores: Number of cores to use; the results do not depend on it.
    """
    config = standard_task(policy.env_config, plan.standard)
    play = partial(
        play_throws,
        config=config,
        skin=policy.skin,
        throw_set=plan.throw_set,
        episodes=plan.episodes,
        num_workers=default_num_workers(plan.episodes, cores),
        on_step=on_step,
    )
    rigid = play(None, hold=True)
    result = summarize(play(policy), rigid, config.task)
    masked = None
    if plan.masked and config.sensor.coverage != "none":
        masked = summarize(play(policy, mask=MASK_ALL), rigid, config.task)
    return {
        **dataclasses.asdict(result),
        "masked": None if masked is None else dataclasses.asdict(masked),
        "standard": plan.standard,
        "trained_on": policy.env_config.standard,
        "throw_set": plan.throw_set,
        "frames": policy.policy_spec.frames,
    }
