"""Statistics of studies, against scipy and numbers computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from egoskin.study.findings import ABOVE, FINDINGS, SAME, judge_findings
from egoskin.study.statistics import (
    Effect,
    Region,
    assumed_sd,
    contrast,
    holm,
    interquartile_mean,
    mean_effect,
    seed_sd,
    seeds_needed,
    separation,
    spread,
)

A = [61.0, 66.0, 59.0, 70.0, 63.0]
B = [55.0, 63.0, 58.0, 61.0, 60.0]
TABLE = {"a": dict(enumerate(A)), "b": dict(enumerate(B))}
DIFFERENCE = {"a": 1.0, "b": -1.0}


def test_the_spread_is_the_papers():
    # For eight values: the middle four, 3 to 6; quartiles at 2.75 and 6.25.
    own = spread([8, 1, 7, 2, 6, 3, 5, 4])
    assert (own.iqm, own.low, own.high, own.seeds) == (4.5, 2.75, 6.25, 8)
    assert own.iqm == stats.trim_mean(range(1, 9), 0.25)


def test_interquartile_statistics_by_hand():
    assert interquartile_mean([7.0]) == 7.0
    assert interquartile_mean([3.0, 1.0]) == 2.0
    # For three, the outer two count a quarter: (0.25 * 0 + 3 + 0.25 * 9) / 1.5.
    assert interquartile_mean([9.0, 0.0, 3.0]) == pytest.approx(3.5)
    # For four, two are left; for ten, the third and the eighth count half.
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    ten = [0.0, 0, 2, 4, 4, 4, 4, 8, 99, 99]
    assert interquartile_mean(ten) == pytest.approx((1 + 16 + 4) / 5)
    own = spread([0.0, 1, 2, 3, 4])
    assert (own.low, own.high) == (1.0, 3.0)
    own = spread([5.0])
    assert (own.low, own.high) == (5.0, 5.0)


def test_a_mean_has_scipys_t_interval():
    low, high = mean_effect(A).interval()
    own = stats.ttest_1samp(A, 0).confidence_interval()
    assert (low, high) == pytest.approx((own.low, own.high))
    # 1, 2, 3: 2 +- 4.3027 x 1 / sqrt(3).
    assert mean_effect([1, 2, 3]).interval() == pytest.approx(
        (-0.4841, 4.4841), abs=1e-4
    )


def test_shared_seeds_are_compared_in_pairs():
    effect = contrast(DIFFERENCE, TABLE)
    assert effect is not None
    own = stats.ttest_rel(A, B, alternative="greater")
    assert effect.p_above(0) == pytest.approx(own.pvalue)
    assert effect.p_below(0) == pytest.approx(1 - own.pvalue)
    # The order in which the seeds were stored does not matter.
    turned = {"a": TABLE["a"], "b": dict(reversed(TABLE["b"].items()))}
    assert contrast(DIFFERENCE, turned) == effect


def test_pairs_are_those_of_the_seeds_that_all_cells_have():
    some = {"a": TABLE["a"], "b": {k: v for k, v in TABLE["b"].items() if k > 1}}
    effect = contrast(DIFFERENCE, some)
    assert effect is not None
    assert effect.seeds == 3
    assert effect.p_above(0) == pytest.approx(
        stats.ttest_rel(A[2:], B[2:], alternative="greater").pvalue
    )


def test_a_single_seed_is_compared_with_the_same_seed():
    table = {"a": {0: 90.0}, "b": {0: 10.0, 1: 20.0}}
    effect = contrast(DIFFERENCE, table)
    assert effect is not None
    assert (effect.mean, effect.seeds) == (80.0, 1)


def test_cells_that_share_no_seeds_are_compared_by_welch():
    apart = {"a": TABLE["a"], "b": {k + 10: v for k, v in TABLE["b"].items()}}
    effect = contrast(DIFFERENCE, apart)
    assert effect is not None
    own = stats.ttest_ind(A, B, equal_var=False, alternative="greater")
    assert effect.df == pytest.approx(own.df)
    assert effect.p_above(0) == pytest.approx(own.pvalue)
    # Half of a cell is compared as values half as large.
    half = contrast({"a": 0.5, "b": -1.0}, apart)
    assert half is not None
    own = stats.ttest_ind(np.divide(A, 2), B, equal_var=False, alternative="less")
    assert (half.df, half.p_below(0)) == pytest.approx((own.df, own.pvalue))
    # Its spread is that of one seed of each cell, whatever their numbers of seeds.
    few = {"a": TABLE["a"], "b": {10: 55.0, 11: 63.0}}
    effect = contrast(DIFFERENCE, few)
    assert effect is not None
    assert effect.sd == pytest.approx(math.sqrt(np.var(A, ddof=1) + 32.0))


def test_one_seed_or_no_spread_decides_nothing():
    one = contrast(DIFFERENCE, {"a": {0: 90.0}, "b": {0: 10.0}})
    assert one is not None
    assert (one.mean, one.seeds) == (80.0, 1)
    assert math.isnan(one.error)
    equal = mean_effect([5.0, 5.0, 5.0])
    for effect in (one, equal):
        assert ABOVE.p_inside(effect) == ABOVE.p_outside(effect) == 1.0
        assert SAME.p_inside(effect) == 1.0
    assert contrast(DIFFERENCE, {"a": {0: 1.0}}) is None


def test_equal_values_have_no_spread_whatever_their_rounding():
    # The mean of three times 0.1 is not 0.1.
    same = [0.1, 0.1, 0.1]
    assert np.std(same, ddof=1) > 0
    assert mean_effect(same).error == mean_effect(same).sd == 0.0
    assert ABOVE.p_inside(mean_effect(same)) == 1.0
    table = {"a": dict(enumerate(same)), "b": {k + 10: 0.7 for k in range(3)}}
    effect = contrast(DIFFERENCE, table)
    assert effect is not None
    assert effect.error == effect.sd == 0.0
    assert seed_sd(table) == 0.0
    assert math.isnan(separation(table))
    # Paired differences of equal size: 66.3 - 66.2 is not 0.3 - 0.2.
    pairs = {"a": {0: 66.3, 1: 0.3}, "b": {0: 66.2, 1: 0.2}}
    effect = contrast(DIFFERENCE, pairs)
    assert effect is not None
    assert effect.error == 0.0
    # A small spread is one.
    assert mean_effect([50.0, 50.0 + 1e-9]).error > 0


def test_equivalence_is_two_one_sided_tests():
    values = np.subtract(A, B)
    effect = mean_effect(values)
    one = stats.ttest_1samp(values, -5, alternative="greater").pvalue
    other = stats.ttest_1samp(values, 5, alternative="less").pvalue
    assert SAME.p_inside(effect) == pytest.approx(max(one, other))
    assert SAME.p_outside(effect) == pytest.approx(min(1, 2 * min(1 - one, 1 - other)))
    # The test is whether the 90 % interval lies within the margin.
    found = set()
    for values in np.random.default_rng(0).normal(1.0, 3.0, (50, 4)):
        effect = mean_effect(values)
        low, high = effect.interval(0.9)
        inside = low > -5 and high < 5
        assert (SAME.p_inside(effect) <= 0.05) == inside
        found.add(inside)
    assert found == {False, True}


def test_holm_is_that_of_his_paper():
    # Sorted 0.005, 0.01, 0.03, 0.04: x 4, 3, 2, 1, and never decreasing.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_the_seeds_needed_have_the_power_that_is_asked():
    # An effect of one standard deviation, one-sided at 5 %: 8 pairs (tables of Cohen).
    assert seeds_needed([1.0]) == 8
    # If both of two tests must succeed, a few more.
    needed = seeds_needed([1.0, 1.0])
    assert needed is not None
    assert 8 < needed < 12
    # No number decides an effect on its bound, or one whose spread is unknown.
    assert seeds_needed([0.0]) is None
    assert seeds_needed([1.0, math.nan]) is None


@pytest.mark.parametrize("alpha", [0.05, 0.025, 0.05 / 9, 0.05 / 180])
def test_a_larger_effect_never_needs_more_seeds(alpha):
    needed = [seeds_needed([d], alpha) for d in np.arange(0.3, 9, 0.1)]
    assert None not in needed
    assert needed == sorted(needed, reverse=True)
    assert seeds_needed([40.0], alpha) in (2, 3)


def test_the_spread_of_cells_without_repeated_seeds_is_the_largest_of_any_cell():
    table = {"a": {0: 10.0}, "b": {0: 30.0}, "floor": {0: 0.0, 1: 0.1}}
    table["wide"] = {0: 50.0, 1: 54.0}
    weights = {"a": -1.0, "b": 1.0}
    wide = math.sqrt(2) * stats.tstd([50.0, 54.0])
    effect = contrast(weights, table)
    assert effect is not None
    assert assumed_sd(effect, weights, table) == pytest.approx(wide)
    # A cell near 0 % has its own spread, which is not that of the other one.
    weights = {"a": -1.0, "floor": 1.0}
    effect = contrast(weights, table)
    assert effect is not None
    both = math.hypot(stats.tstd([50.0, 54.0]), stats.tstd([0.0, 0.1]))
    assert assumed_sd(effect, weights, table) == pytest.approx(both)
    # Weights count, as do seeds without a spread.
    weights = {"same": 0.5, "a": -1.0}
    table["same"] = {0: 40.0, 1: 40.0}
    effect = contrast(weights, table)
    assert effect is not None
    both = math.hypot(0.5, 1.0) * stats.tstd([50.0, 54.0])
    assert assumed_sd(effect, weights, table) == pytest.approx(both)
    table = {"a": {0: 10.0}, "b": {0: 30.0}}
    assert math.isnan(assumed_sd(effect, {"a": -1.0, "b": 1.0}, table))


def test_a_metric_that_sets_cells_apart_is_told_from_one_that_does_not():
    # Means 0, 10, 20 (variance 100); seeds of variance 2, of which a half is in each
    # mean of two: sqrt((100 - 1) / 2).
    clear = {"a": {0: -1, 1: 1}, "b": {0: 9, 1: 11}, "c": {0: 19, 1: 21}}
    assert seed_sd(clear) == pytest.approx(math.sqrt(2))
    assert separation(clear) == pytest.approx(math.sqrt(99 / 2))
    assert separation({"a": {0: 0, 1: 2}, "b": {0: 1, 1: 1.5}}) == 0
    assert math.isnan(separation({"a": {0: 1.0}, "b": {0: 2.0}}))


# --- the findings -------------------------------------------------------------------


def world(noise: float = 0.3, seeds: int = 5, **changes: float) -> dict:
    """Return tables in which every finding of the paper holds."""
    # In a fixed order: each draws in turn.
    names = sorted({n for f in FINDINGS for c in f.claims for n in c.weights})
    draw = np.random.default_rng(0)
    mean: dict[str, float] = {}
    for name in names:
        coverage, signal, reach = name.split("-")[:3]
        value = 20 * float(reach[:-1]) + 30
        value -= {"localization": 0, "proximity": 1.5, "binary": 3}[signal]
        if signal == "proximity" and reach == "0.5m":
            value -= 4
        if coverage == "ray":
            full = signal != "localization" and "reduce" not in name
            value = value / 4 if full else value - 6 / float(reach[:-1])
        mean[name] = value
    mean |= {name.replace("_", "-"): value for name, value in changes.items()}
    success = {
        name: {s: value + noise * draw.normal() for s in range(seeds)}
        for name, value in mean.items()
    }
    shares = {s: 20 + draw.normal() for s in range(seeds)}
    return {"success_3s": success, "share_to_90": {"field-proximity-2m": shares}}


def test_findings_that_hold_are_confirmed():
    verdicts = {j.finding.label: j.verdict for j in judge_findings(world())}
    assert set(verdicts.values()) == {"confirmed"}
    assert list(verdicts) == ["1a", "1b", "1c", "2", "3", "4", "5", "6a", "6b"]


def test_one_claim_that_does_not_hold_refutes_a_finding():
    tables = world(field_proximity_1m=70.0)
    verdicts = {j.finding.label: j.verdict for j in judge_findings(tables)}
    # Better than localization by 20 points: neither the same nor worse.
    assert (verdicts.pop("1a"), verdicts.pop("2")) == ("refuted", "refuted")
    assert set(verdicts.values()) == {"confirmed"}


@pytest.mark.parametrize(
    ("label", "cell", "value"),
    [
        # In points; field localization has 34, 40, 50 and 70.
        ("1b", "ray-localization-0.5m", 42.0),
        ("3", "field-binary-0.5m", 32.0),
        # Better than half of the field's 48.5, but worse than localization's 44.
        ("4", "ray-proximity-1m", 30.0),
        ("5", "ray-proximity-1m-reduce-min", 20.0),
        ("6a", "ray-binary-1m-reduce-min", 5.0),
    ],
)
def test_a_cell_that_is_not_as_the_paper_says_refutes_its_finding_alone(
    label, cell, value
):
    tables = world()
    row = tables["success_3s"][cell]
    shift = value - np.mean(list(row.values()))
    tables["success_3s"][cell] = {seed: x + shift for seed, x in row.items()}
    judged = judge_findings(tables)
    assert {j.finding.label for j in judged if j.verdict == "refuted"} == {label}
    assert {j.verdict for j in judged if j.finding.label != label} == {"confirmed"}


def test_learning_within_a_third_of_the_budget_is_neither_more_nor_less():
    for share, verdict in ((30.0, "confirmed"), (37.0, "refuted")):
        tables = world()
        values = {seed: share + 0.1 * seed for seed in range(5)}
        tables["share_to_90"] = {"field-proximity-2m": values}
        (judged,) = (j for j in judge_findings(tables) if j.finding.label == "6b")
        assert judged.verdict == verdict


def test_one_of_several_claims_is_refuted_at_its_share_of_the_level():
    # One of finding 4's four claims, by five seeds; nothing else is known.
    (finding,) = (f for f in FINDINGS if f.label == "4")
    field, ray = finding.claims[0].weights
    half_less_ray = [-3.0, -6.0, -2.0, -5.0, -3.5]
    table = {
        field: dict.fromkeys(range(5), 60.0),
        ray: {seed: 30 - value for seed, value in enumerate(half_less_ray)},
    }
    tables = {"success_3s": table, "share_to_90": {}}
    (judged,) = (j for j in judge_findings(tables) if j.finding is finding)
    p_value = stats.ttest_1samp(half_less_ray, 0, alternative="less").pvalue
    # Bonferroni over the claims, Holm over the findings.
    assert judged.p_value == pytest.approx(9 * 4 * p_value)
    assert 9 * p_value < 0.05 < 9 * 4 * p_value
    assert judged.verdict == "undecided"


def test_a_finding_whose_cells_are_missing_is_undecided():
    tables = world()
    del tables["success_3s"]["ray-binary-1m-reduce-min"]
    judged = {j.finding.label: j for j in judge_findings(tables)}
    assert judged["6a"].verdict == judged["1a"].verdict == "undecided"
    assert judged["6a"].claims[0].effect is None
    assert judged["3"].verdict == "confirmed"
    assert (
        judge_findings({"success_3s": {}, "share_to_90": {}})[0].verdict == "undecided"
    )


def test_one_seed_confirms_no_finding_but_says_how_many_would():
    tables = world(noise=2.0)
    for values in tables.values():
        for name, row in values.items():
            if name != "blind" and not name.startswith("field"):
                values[name] = {0: row[0]}
    judged = {j.finding.label: j for j in judge_findings(tables)}
    assert judged["6a"].verdict == "undecided"
    assert 2 < (judged["6a"].seeds_needed or 0) < 10


def test_the_seeds_needed_decide_all_claims_of_a_finding():
    # Each of four claims is one standard deviation above its bound.
    claims = next(f for f in FINDINGS if f.label == "4").claims
    apart = {0: 1 - math.sqrt(0.5), 1: 1 + math.sqrt(0.5)}
    table = {}
    for claim in claims:
        field, ray = claim.weights
        table |= {field: {k: 2 * v for k, v in apart.items()}, ray: {0: 0.0, 1: 0.0}}

    def needed() -> int:
        tables = {"success_3s": table, "share_to_90": {}}
        (judged,) = (j for j in judge_findings(tables) if j.finding.label == "4")
        assert judged.verdict == "undecided"
        assert judged.seeds_needed is not None
        return judged.seeds_needed

    draw, alpha, trials = np.random.default_rng(3), 0.05 / len(FINDINGS), 4000

    def p_values(seeds: int) -> np.ndarray:
        values = draw.normal(1.0, 1.0, (trials, 4, seeds))
        return stats.ttest_1samp(values, 0, axis=2, alternative="greater").pvalue

    confirmed = (p_values(needed()).max(1) <= alpha).mean()
    # Three standard errors below the power; the bound on the power is close to it.
    assert 0.8 - 0.02 < confirmed < 0.9
    # One claim below its bound is enough to refute it, at a fourth of the level.
    field, _ = claims[0].weights
    table[field] = {k: -2 * v for k, v in apart.items()}
    refuted = (p_values(needed())[:, 0] <= alpha / 4).mean()
    assert 0.8 - 0.02 < refuted < 0.9


# --- by simulation ------------------------------------------------------------------


@pytest.mark.slow
def test_intervals_cover_and_tests_err_as_often_as_they_say():
    draw, trials = np.random.default_rng(1), 20_000
    for seeds in (3, 5, 10):
        covered = bootstrap = above = same = 0
        quantile = int(0.025 * 500)
        for _ in range(trials):
            values = draw.normal(0.0, 4.0, seeds)
            effect = mean_effect(values)
            low, high = effect.interval()
            covered += low < 0 < high
            above += ABOVE.p_inside(effect) <= 0.05
            # At the margin, where equivalence is wrong for the first time.
            shifted = Effect(
                mean=effect.mean + 5, error=effect.error, df=effect.df, seeds=seeds
            )
            same += SAME.p_inside(shifted) <= 0.05
        for _ in range(1000):
            values = draw.normal(0.0, 4.0, seeds)
            means = np.sort(draw.choice(values, (500, seeds)).mean(1))
            bootstrap += means[quantile] < 0 < means[-quantile - 1]
        print(
            f"{seeds} seeds: 95 % interval covers {covered / trials:.3f} (bootstrap "
            f"{bootstrap / 1000:.3f}), direction errs {above / trials:.3f}, "
            f"equivalence {same / trials:.3f}"
        )
        # Three standard errors of the simulation: 0.0046.
        assert abs(covered / trials - 0.95) < 0.005
        assert abs(above / trials - 0.05) < 0.005
        assert same / trials < 0.055
    assert bootstrap / 1000 < 0.95


@pytest.mark.slow
def test_the_family_errs_in_five_percent_at_most():
    # A world in which no claim is strictly true: all differences are 0, and 6b is on
    # its bound. "The same" and "not worse" are true there, and cannot err.
    # In a fixed order: each draws in turn.
    names = sorted({n for f in FINDINGS for c in f.claims for n in c.weights})
    draw, trials, wrong = np.random.default_rng(2), 2000, 0
    true = {"2", "5"}
    for _ in range(trials):
        table = {n: dict(enumerate(draw.normal(0.0, 2.0, 3))) for n in names}
        shares = dict(enumerate(draw.normal(100 / 3, 2.0, 3)))
        tables = {"success_3s": table, "share_to_90": {"field-proximity-2m": shares}}
        judged = judge_findings(tables)
        wrong += any(
            j.verdict == ("refuted" if j.finding.label in true else "confirmed")
            for j in judged
        )
    print(f"a wrong verdict in {wrong / trials:.3f} of the studies")
    # 0.05 and three standard errors.
    assert wrong / trials < 0.05 + 3 * math.sqrt(0.05 * 0.95 / trials)


def test_a_region_with_one_end_tests_that_end_alone():
    effect = mean_effect(np.subtract(A, B))
    assert Region(low=-5).p_inside(effect) == effect.p_above(-5)
    assert Region(high=30).p_inside(effect) == effect.p_below(30)
    assert Region(high=30).p_outside(effect) == effect.p_above(30)
