"""Reward terms of the dodgeball task; none of them reads a sensor or a ball.

To add a term, add a weight to `RewardConfig` and a line to `reward_terms`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import torch
from torch import Tensor

from egoskin.bounds import Interval, check_bounds

# Width of the upright bonus: exp(-|g_xy|^2 / 0.2), as in common humanoid tasks.
_UPRIGHT_WIDTH = 0.2
# Beyond this, squared returns could overflow float32.
_Weight = Annotated[float, Interval(ge=-1e6, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights of the reward terms, per control step; costs are negative."""

    survival: _Weight = 0.1
    """Reward of a control step without contact or fall."""
    upright: _Weight = 0.01
    """Weight of ``exp(-|gravity_xy|^2 / 0.2)``, gravity in the base frame."""
    posture: _Weight = -0.05
    """Weight of the mean squared deviation from the default pose [rad^2]."""
    energy: _Weight = -5e-7
    """Weight of the mechanical power, sum of ``|torque x velocity|`` [W]."""
    drift_speed: _Weight = -0.01
    """Weight of the squared planar speed of the base [m^2/s^2]."""
    drift_distance: _Weight = -0.1
    """Weight of the squared planar distance from the start [m^2], at most 4."""
    action_rate: _Weight = -5e-4
    """Weight of the mean squared change of the action since the last step."""

    def __post_init__(self) -> None:
        """Raise ValueError for values out of bounds."""
        check_bounds(self)


TERMS = tuple(field.name for field in fields(RewardConfig))
"""Names of the terms, in the order of `reward_terms`."""


def reward_terms(
    config: RewardConfig,
    *,
    gravity_b: Tensor,
    joint_deviation: Tensor,
    power: Tensor,
    base_lin_vel_w: Tensor,
    displacement_w: Tensor,
    action_change: Tensor,
    terminated: Tensor,
) -> Tensor:
    """Return the weighted terms of the reward; the reward is their sum.

    Args:
        config: Weights.
        gravity_b: Unit gravity in the base frame, ``[B, 3]``.
        joint_deviation: q - q_default [rad], ``[B, J]``.
        power: Mechanical power of the joints [W], ``[B]``.
        base_lin_vel_w: Base velocity [m/s], ``[B, 3]``.
        displacement_w: Planar displacement from the start [m], ``[B, 2]``.
        action_change: Action minus the previous action, ``[B, J]``.
        terminated: Whether the episode terminates in this step, ``[B]`` bool.

    Returns:
        Terms in the order of `TERMS`, ``[B, R]``.
    """
    tilt = gravity_b[:, :2].square().sum(-1)
    values = {
        "survival": (~terminated).to(power.dtype),
        "upright": (-tilt / _UPRIGHT_WIDTH).exp(),
        "posture": joint_deviation.square().mean(-1),
        "energy": power,
        "drift_speed": base_lin_vel_w[:, :2].square().sum(-1),
        "drift_distance": displacement_w.square().sum(-1).clamp(max=4.0),
        "action_rate": action_change.square().mean(-1),
    }
    return torch.stack([getattr(config, name) * values[name] for name in TERMS], -1)
