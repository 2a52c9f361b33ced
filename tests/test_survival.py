"""The Kaplan-Meier estimate of survival."""

from __future__ import annotations

import math

import pytest
import torch

from egoskin.survival import SurvivalCurve


def test_survival_by_hand():
    curve = SurvivalCurve(max_steps=3)
    # Four agents reach age 1, one ends there; three reach 2, one ends; two reach 3.
    curve.update(torch.ones(4, dtype=torch.int64), torch.tensor([1, 0, 0, 0]) > 0)
    curve.update(torch.full((3,), 2), torch.tensor([1, 0, 0]) > 0)
    curve.update(torch.full((2,), 3), torch.tensor([0, 0]) > 0)
    expected = torch.tensor([1.0, 3 / 4, 3 / 4 * 2 / 3, 1 / 2], dtype=torch.float64)
    torch.testing.assert_close(curve.curve(), expected)
    assert curve.probability(2) == pytest.approx(1 / 2)
    # One ends at 1, one at 2, two are alive at 3: (1 + 2 + 3 + 3) / 4.
    assert curve.mean() == pytest.approx(9 / 4)


def test_an_age_nobody_has_reached_is_unknown():
    curve = SurvivalCurve(max_steps=10)
    curve.update(torch.ones(4, dtype=torch.int64), torch.zeros(4, dtype=torch.bool))
    assert math.isnan(curve.probability(10))
    assert curve.probability(1) == 1.0


def test_agents_still_alive_are_not_left_out():
    # Half of the agents end at age 1 at once; the others are not seen to end: the
    # mean over ended episodes would be 1.
    curve = SurvivalCurve(max_steps=4)
    curve.update(torch.ones(10, dtype=torch.int64), torch.arange(10) < 5)
    for age in (2, 3, 4):
        curve.update(torch.full((5,), age), torch.zeros(5, dtype=torch.bool))
    assert curve.mean() == pytest.approx(0.5 * 1 + 0.5 * 4)


def test_the_past_fades():
    curve = SurvivalCurve(max_steps=1, memory=0.5)
    ages = torch.ones(4, dtype=torch.int64)
    curve.update(ages, torch.ones(4, dtype=torch.bool))
    curve.decay()
    curve.update(ages, torch.zeros(4, dtype=torch.bool))
    # 2 of weight ended, of 2 + 4 at risk.
    assert curve.probability(1) == pytest.approx(1 - 2 / 6)
