"""Kaplan-Meier estimate of survival, including agents that are still alive.

During training, the mean length of the episodes that have *ended* is biased, because
short ones end first. The hazard at each age, over all agents of that age, is not.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Factor on past counts at each rollout: ten rollouts are remembered.
_MEMORY = 0.9


class SurvivalCurve:
    """Running Kaplan-Meier estimate over the latest rollouts.

    Ages count from a moment in the episode, age 0, such as the first throw. If episodes
    end before or at that moment, the survival at age 0 is below 1.

    Args:
        max_steps: Age at which episodes are truncated [control steps].
    """

    def __init__(self, max_steps: int) -> None:
        self.at_risk = torch.zeros(max_steps + 1, dtype=torch.float64)
        self.ended = torch.zeros(max_steps + 1, dtype=torch.float64)

    def decay(self) -> None:
        """Discount past counts; called once per rollout."""
        self.at_risk *= _MEMORY
        self.ended *= _MEMORY

    def update(self, age: Tensor, terminated: Tensor) -> None:
        """Count one step of some agents.

        Args:
            age: Age after the step [control steps], negative before age 0,
                ``[N]`` int64.
            terminated: Whether the step ended the episode (not by time), ``[N]``.
        """
        size = len(self.at_risk)
        # Up to age 0, only the steps that reach it or end the episode count.
        counts = (age >= 0) | terminated
        at_risk, ended = age[counts].clamp(min=0), age[terminated].clamp(min=0)
        self.at_risk += torch.bincount(at_risk, minlength=size)
        self.ended += torch.bincount(ended, minlength=size)

    def curve(self) -> Tensor:
        """Return the probability of surviving each age, ``[max_steps + 1]``.

        Values are NaN from the first age that no agent has reached.
        """
        # S(t) = prod_{a <= t} (1 - ended(a) / at_risk(a)); S(0) = 1 if episodes begin
        # at age 0.
        hazard = self.ended / self.at_risk
        if not self.at_risk[0]:
            hazard[0] = 0.0
        return (1 - hazard).cumprod(0)

    def probability(self, steps: int) -> float:
        """Return the probability of surviving an age; NaN if none has reached it."""
        return float(self.curve()[steps])

    def mean(self) -> float:
        """Return the mean survival [control steps], restricted to the ages reached."""
        # E[min(T, max)] = sum_{t < max} P(T > t)
        return float(self.curve()[:-1].nan_to_num(0.0).sum())
