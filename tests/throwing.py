"""Throws, actions and comparisons for tests of the task."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.throws import ThrowConfig
from egoskin.robots.builtin import H1_2

AT_ONCE = ThrowConfig(first_delay=(0.0, 0.0))
"""The default throws, the first ball at the start of the episode."""
TASK = DodgeballConfig(throws=AT_ONCE)
"""The default task with them."""


def wild_actions(rows: int, steps: int = 150) -> torch.Tensor:
    """Return fixed actions, ``[T, rows, J]``: the robots fall, at different times."""
    generator = torch.Generator().manual_seed(0)
    size = 0.7 * torch.rand(rows, 1, generator=generator)
    return size * torch.randn(steps, rows, len(H1_2.joints), generator=generator)


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    """Assert that the same entries are equal bit for bit, and none is NaN."""
    torch.testing.assert_close(one.to_dict(), other.to_dict(), rtol=0, atol=0)


def assert_forgets(used: DodgeballEnv, fresh: DodgeballEnv) -> None:
    """Assert that episode 1 begins as after an episode 0 that never began.

    Args:
        used: Environment in episode 0.
        fresh: The same environment, not reset yet.
    """
    used.reset()
    fresh.reset()
    fresh.reset()
    one, other = used.simulation_state(), fresh.simulation_state()
    for key, value in one.items():
        assert torch.equal(value, other[key]), key
