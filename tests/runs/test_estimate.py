"""Estimated duration of a training."""

from __future__ import annotations

import torch

from calling import SMALL
from egoskin.runs.config import parse_config
from egoskin.runs.estimate import estimate_seconds


def test_a_guess_of_the_time_leaves_the_training_as_it_was():
    config = parse_config(list(SMALL))
    skin = config.env.skin.build(config.env.robot_config)
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    torch.set_num_threads(2)
    try:
        seconds = estimate_seconds(config, skin, 10_000)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert seconds > 0
    assert torch.equal(torch.get_rng_state(), state)
