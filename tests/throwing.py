"""Throws for tests that need a ball at once."""

from __future__ import annotations

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.throws import ThrowConfig

AT_ONCE = ThrowConfig(first_delay=(0.0, 0.0))
"""The default throws, the first ball at the start of the episode."""
TASK = DodgeballConfig(throws=AT_ONCE)
"""The default task with them."""
