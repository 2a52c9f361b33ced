"""Survival of agents that are still alive: the Kaplan-Meier estimate.

The mean length of the episodes that have *ended* misleads while training: short ones
end first. The hazard at each age, over all agents of that age, does not.
"""

from __future__ import annotations

import torch
from torch import Tensor


class SurvivalCurve:
    """Running Kaplan-Meier estimate over the latest rollouts.

    Ages count from a moment in the episode, age 0, such as the first throw. What ends
    an episode before or at that moment makes age 0 less than certain.

    Args:
        max_steps: Age at which episodes are truncated [control steps].
        memory: Weight of the past at each `decay`; 0.9 remembers ten rollouts.
    """

    def __init__(self, max_steps: int, memory: float = 0.9) -> None:
        self._memory = memory
        self.at_risk = torch.zeros(max_steps + 1, dtype=torch.float64)
        self.ended = torch.zeros(max_steps + 1, dtype=torch.float64)

    def decay(self) -> None:
        """Let the past fade, once for each rollout."""
        self.at_risk *= self._memory
        self.ended *= self._memory

    def update(self, age: Tensor, terminated: Tensor) -> None:
        """Count one step of some agents.

        Args:
            age: Age after the step [control steps], negative before age 0,
                ``[N]`` int64.
            terminated: Whether the step ended the episode (not by time), ``[N]``.
        """
        size = len(self.at_risk)
        # Of the way to age 0 the steps that get there count, and those that end it.
        counts = (age >= 0) | terminated
        at_risk, ended = age[counts].clamp(min=0), age[terminated].clamp(min=0)
        self.at_risk += torch.bincount(at_risk, minlength=size)
        self.ended += torch.bincount(ended, minlength=size)

    def curve(self) -> Tensor:
        """Return the probability to survive each age, ``[max_steps + 1]``.

        NaN from the first age that no agent has reached.
        """
        # S(t) = prod_{a <= t} (1 - ended(a) / at_risk(a)); age 0 is certain where
        # episodes begin with it.
        hazard = self.ended / self.at_risk
        if not self.at_risk[0]:
            hazard[0] = 0.0
        return (1 - hazard).cumprod(0)

    def probability(self, steps: int) -> float:
        """Return the probability to survive an age; NaN if none has reached it."""
        return float(self.curve()[steps])

    def mean(self) -> float:
        """Return the mean survival [control steps], restricted to the ages reached."""
        # E[min(T, max)] = sum_{t < max} P(T > t)
        return float(self.curve()[:-1].nan_to_num(0.0).sum())
