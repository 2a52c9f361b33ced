"""Robustness: success of a policy on robots that differ from the model.

Every policy gets the same robots, delays and pushes, drawn with the throw set's seed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import nn

from egoskin.envs.randomization import RandomizationConfig
from egoskin.evaluation.throw_set import Estimate, play_throws, summarize
from egoskin.make import EnvConfig
from egoskin.sensors import Skin

_ALONE: dict[str, dict[str, Any]] = {
    "link masses 0.8 to 1.2": {"link_mass": (0.8, 1.2)},
    "friction 0.4 to 1": {"friction": (0.4, 1.0)},
    "gains 0.8 to 1.2": {"gains": (0.8, 1.2)},
    "torque limits 0.6 to 1": {"torque_limit": (0.6, 1.0)},
    "actions a step late": {"delay_steps": (1, 1)},
    "actions two steps late": {"delay_steps": (2, 2)},
    "pushes of 0.3 to 0.6 m/s": {"push_speed": (0.3, 0.6), "push_interval": (1.0, 3.0)},
}
_TOGETHER = {key: value for alone in _ALONE.values() for key, value in alone.items()}
PERTURBATIONS = {
    "none": RandomizationConfig(),
    **{name: RandomizationConfig(**ranges) for name, ranges in _ALONE.items()},
    "all, 0 to 2 steps late": RandomizationConfig(
        **{**_TOGETHER, "delay_steps": (0, 2)}
    ),
}
"""Perturbations by name; factors are drawn for each link, joint or robot."""


@dataclass(frozen=True, kw_only=True)
class Perturbed:
    """Results of a policy under one perturbation."""

    name: str
    """Key of `PERTURBATIONS`."""
    success: Estimate
    """As `throw_set.Evaluation.success`."""
    success_5s: Estimate
    """As `throw_set.Evaluation.success_5s`."""
    ended_by_fall: float
    """As `throw_set.Evaluation.ended_by_fall`."""


def perturb(
    policy: nn.Module | TensorDictModuleBase | None,
    config: EnvConfig,
    skin: Skin,
    *,
    on_point: Callable[[int, int], None] | None = None,
    **which: Any,
) -> list[Perturbed]:
    """Return the results of a policy under each perturbation.

    Args:
        policy: Writes ``action`` into a TensorDict; None is the zero action.
        config: Robot, task, sensors; its own randomization is replaced.
        skin: The skin.
        on_point: Called with (perturbations done, total perturbations).
        which: Throw set, episodes, workers and mask; passed to `play_throws`.
    """
    found = []
    for number, (name, ranges) in enumerate(PERTURBATIONS.items(), 1):
        task = dataclasses.replace(config.task, randomization=ranges)
        perturbed = dataclasses.replace(config, task=task)
        played = play_throws(policy, perturbed, skin, **which)
        result = summarize(played, played, task)
        found.append(
            Perturbed(
                name=name,
                success=result.success,
                success_5s=result.success_5s,
                ended_by_fall=result.ended_by_fall,
            )
        )
        if on_point is not None:
            on_point(number, len(PERTURBATIONS))
    return found
