"""Differences of a study's cells to its first cell, against scipy."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from egoskin.study.differences import differences
from egoskin.study.statistics import holm, seeds_needed

FIRST = [55.0, 63.0, 58.0, 61.0, 60.0]
BETTER = [61.0, 66.0, 59.0, 70.0, 63.0]
SAME = [54.0, 64.0, 58.5, 61.5, 59.5]


def test_cells_are_compared_with_the_first_by_paired_two_sided_tests():
    values = {"a": FIRST, "b": BETTER, "c": SAME}
    table = {name: dict(enumerate(x)) for name, x in values.items()}
    better, same = differences(["a", "b", "missing", "c"], table)
    assert (better.cell, same.cell) == ("b", "c")
    tests = [stats.ttest_rel(x, FIRST) for x in (BETTER, SAME)]
    interval = tests[0].confidence_interval()
    assert better.effect.interval() == pytest.approx((interval.low, interval.high))
    assert [better.p_value, same.p_value] == pytest.approx(
        holm([float(t.pvalue) for t in tests])
    )
    # Two tests in two directions: a fourth of the level each.
    distance = better.effect.mean / better.effect.sd
    assert better.seeds_needed == seeds_needed([distance], 0.05 / 4)


def test_a_cell_with_one_seed_has_no_p_value_but_the_spread_of_the_others():
    (new,) = differences(["a", "b"], {"a": dict(enumerate(FIRST)), "b": {0: 75.0}})
    assert (new.p_value, new.effect.seeds) == (1.0, 1)
    # 75 - 55, and the standard deviation of a difference of two unpaired seeds.
    distance = 20 / (math.sqrt(2) * stats.tstd(FIRST))
    assert new.seeds_needed == seeds_needed([distance], 0.05 / 2)
    # As much as a cell that varies, even if the first cell hardly does.
    table = {"blind": {0: 0.0, 1: 0.0488, 2: 0.0}, "x": {0: 3.0}}
    table["y"] = {0: 50.0, 1: 60.0, 2: 41.0}
    new, _ = differences(["blind", "x", "y"], table)
    wide = seeds_needed([3 / stats.tstd([50.0, 60.0, 41.0])], 0.05 / 4)
    assert new.seeds_needed is not None
    assert wide is not None
    assert new.seeds_needed >= wide > 50
    assert differences(["a", "b"], {"b": {0: 75.0}}) == []
    assert differences(["a"], {"a": {0: 75.0}}) == []
