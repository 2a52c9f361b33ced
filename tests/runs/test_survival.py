"""The Kaplan-Meier estimate of survival."""

from __future__ import annotations

import math

import pytest
import torch

from egoskin.runs.survival import SurvivalCurve


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
    curve = SurvivalCurve(max_steps=1)
    ages = torch.ones(4, dtype=torch.int64)
    curve.update(ages, torch.ones(4, dtype=torch.bool))
    curve.decay()
    curve.update(ages, torch.zeros(4, dtype=torch.bool))
    # 3.6 = 0.9 x 4 of weight ended, of 3.6 + 4 at risk.
    assert curve.probability(1) == pytest.approx(1 - 3.6 / 7.6)


def test_what_ends_before_age_zero_makes_it_less_than_certain_by_hand():
    curve = SurvivalCurve(max_steps=2)

    def step(age: int, ended: list[int]) -> None:
        curve.update(torch.full((len(ended),), age), torch.tensor(ended) > 0)

    # Ten agents two steps before age 0: one ends there; nine are one step before: one
    # ends; eight reach age 0: two end at it; six reach 1: three end; three reach 2.
    step(-2, [1, *[0] * 9])
    step(-1, [1, *[0] * 8])
    step(0, [1, 1, *[0] * 6])
    step(1, [1, 1, 1, 0, 0, 0])
    step(2, [0, 0, 0])
    # Of ten, four do not live at age 0, seven not at age 1.
    expected = torch.tensor([6 / 10, 3 / 10, 3 / 10], dtype=torch.float64)
    torch.testing.assert_close(curve.curve(), expected)
    assert curve.probability(0) == pytest.approx(6 / 10)
    # Six live from age 0 to 1, three from 1 to 2.
    assert curve.mean() == pytest.approx(6 / 10 + 3 / 10)


def test_steps_on_the_way_to_age_zero_count_once():
    # However many steps precede age 0, the agent counts once as at risk.
    curve = SurvivalCurve(max_steps=1)
    for age in (-3, -2, -1, 0, 1):
        curve.update(torch.tensor([age]), torch.tensor([False]))
    curve.update(torch.tensor([-3]), torch.tensor([True]))
    assert curve.probability(0) == pytest.approx(1 / 2)
    assert curve.probability(1) == pytest.approx(1 / 2)


def test_age_zero_is_certain_where_episodes_begin_with_it():
    curve = SurvivalCurve(max_steps=1)
    curve.update(torch.tensor([1, 1]), torch.tensor([True, False]))
    assert curve.probability(0) == 1.0
    assert curve.probability(1) == 0.5


def test_an_age_nobody_has_reached_is_unknown_though_some_wait_for_age_zero():
    curve = SurvivalCurve(max_steps=3)
    curve.update(torch.tensor([-5, -4]), torch.tensor([False, False]))
    assert math.isnan(curve.probability(1))
