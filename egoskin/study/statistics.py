"""Statistics over seeds: estimates, tests, power.

The unit is the seed, never the episode: an interval over thousands of throws shows how
precisely one policy is measured, but not how much policies differ between seeds.

Contract: nothing is decided if the spread is zero, or unknown as there is one seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

ALPHA = 0.05
"""Significance level of every test, and of all together after Holm's correction."""
POWER = 0.8
"""Power at which a number of seeds is considered enough."""
# Values that differ by less than this share of the largest are equal.
_ROUNDING = 1e-12
# Numbers of seeds beyond this are not considered.
_MOST_SEEDS = 1000

Table = Mapping[str, Mapping[int, float]]
"""Values of a metric by cell and seed."""


def interquartile_mean(values: Sequence[float] | np.ndarray) -> float:
    """Return the mean without the top and bottom 25 %.

    If the number of values is not a multiple of 4, the values at the bounds have
    fractional weights: of three values, the outer two have a weight of 1/4 each.
    """
    x, n = np.sort(np.asarray(values, dtype=float)), len(values)
    index = np.arange(n)
    weight = np.minimum(index + 1, 0.75 * n) - np.maximum(index, 0.25 * n)
    weight = weight.clip(min=0)
    return float((weight * x).sum() / weight.sum())


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Summary of values over the seeds of a cell, as in the paper."""

    iqm: float
    """Interquartile mean."""
    low: float
    """Quantile at 25 %."""
    high: float
    """Quantile at 75 %."""
    seeds: int
    """Number of seeds."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """An estimate with its standard error."""

    mean: float
    """Estimate."""
    error: float
    """Standard error; NaN if it is unknown."""
    df: float
    """Degrees of freedom of the standard error."""
    seeds: int
    """Seeds it is based on: pairs, or the fewest of any cell."""
    sd: float = math.nan
    """Standard deviation of the effect of one seed per cell; NaN if it is unknown."""

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return a two-sided t interval; NaN if the error is unknown."""
        half = float(stats.t.ppf(0.5 + level / 2, self.df)) * self.error
        return self.mean - half, self.mean + half

    def p_above(self, bound: float) -> float:
        """Return the p-value of "the effect is above a bound"."""
        if not self.error > 0:
            return 1.0
        return float(stats.t.sf((self.mean - bound) / self.error, self.df))

    def p_below(self, bound: float) -> float:
        """Return the p-value of "the effect is below a bound"."""
        if not self.error > 0:
            return 1.0
        return float(stats.t.cdf((self.mean - bound) / self.error, self.df))


@dataclass(frozen=True, kw_only=True)
class Region:
    """Open interval in which an effect is claimed to lie."""

    low: float = -math.inf
    """Lower end."""
    high: float = math.inf
    """Upper end."""

    @property
    def bounds(self) -> list[float]:
        """Its finite ends."""
        return [x for x in (self.low, self.high) if math.isfinite(x)]

    def __contains__(self, value: float) -> bool:
        """Return whether a value lies inside."""
        return self.low < value < self.high

    def p_inside(self, effect: Effect) -> float:
        """Return the p-value of "the effect lies inside".

        With two ends this is an equivalence test by two one-sided tests (TOST).
        """
        ends = [effect.p_above(self.low)] if math.isfinite(self.low) else []
        ends += [effect.p_below(self.high)] if math.isfinite(self.high) else []
        return max(ends)

    def p_outside(self, effect: Effect) -> float:
        """Return the p-value of "the effect lies outside, beyond one of the ends"."""
        ends = [effect.p_below(self.low)] if math.isfinite(self.low) else []
        ends += [effect.p_above(self.high)] if math.isfinite(self.high) else []
        # Bonferroni over the ends.
        return min(1.0, len(ends) * min(ends))


def spread(values: Sequence[float]) -> Spread:
    """Return the interquartile mean and range of values over seeds."""
    # Interpolated between values.
    low, high = np.quantile(values, [0.25, 0.75]).tolist()
    return Spread(iqm=interquartile_mean(values), low=low, high=high, seeds=len(values))


def mean_effect(values: Sequence[float]) -> Effect:
    """Return the mean of values over seeds."""
    n = len(values)
    sd = _sd(values) if n > 1 else math.nan
    return Effect(
        mean=float(np.mean(values)),
        error=sd / math.sqrt(n),
        df=max(n - 1, 1),
        seeds=n,
        sd=sd,
    )


def contrast(weights: Mapping[str, float], table: Table) -> Effect | None:
    """Return a weighted sum of cells, paired by seed if they share two or more seeds.

    Otherwise it is a weighted sum of their means, with the error of Welch's test.

    Args:
        weights: Weight of each cell.
        table: Values of a metric.

    Returns:
        The effect, None if a cell has no value.
    """
    own = {name: table.get(name, {}) for name in weights}
    if not all(own.values()):
        return None
    shared = sorted(set.intersection(*(set(x) for x in own.values())))
    if len(shared) > 1 or (shared and min(map(len, own.values())) == 1):
        return mean_effect(
            [sum(w * own[name][seed] for name, w in weights.items()) for seed in shared]
        )
    mean = sum(w * float(np.mean(list(own[k].values()))) for k, w in weights.items())
    fewest = min(map(len, own.values()))
    if fewest == 1:
        return Effect(mean=mean, error=math.nan, df=1, seeds=1)
    terms = [
        (w**2 * _sd(list(own[k].values())) ** 2, len(own[k]))
        for k, w in weights.items()
    ]
    variance = sum(v / n for v, n in terms)
    # Welch and Satterthwaite: v^2 / sum_i v_i^2 / (n_i - 1)
    below = sum((v / n) ** 2 / (n - 1) for v, n in terms)
    return Effect(
        mean=mean,
        error=math.sqrt(variance),
        df=variance**2 / below if below else 1.0,
        seeds=fewest,
        sd=math.sqrt(sum(v for v, _ in terms)),
    )


def assumed_sd(effect: Effect, weights: Mapping[str, float], table: Table) -> float:
    """Return the standard deviation of a contrast of one seed per cell.

    If it is unknown or zero, unpaired seeds are assumed. The spread of a cell without
    two seeds that differ is then taken to be the largest of any cell: cells near 0 or
    100 % hardly vary. NaN if no cell has two seeds that differ.

    Args:
        effect: The contrast.
        weights: Weight of each of its cells.
        table: Values of the metric.
    """
    if effect.sd > 0:
        return effect.sd
    each = {name: seed_sd({name: values}) for name, values in table.items()}
    known = {name: sd for name, sd in each.items() if sd > 0}
    largest = max(known.values(), default=math.nan)
    return math.hypot(*(w * known.get(name, largest) for name, w in weights.items()))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number, by Holm's step-down method."""
    m, result, running = len(p_values), [0.0] * len(p_values), 0.0
    for rank, i in enumerate(np.argsort(p_values, kind="stable")):
        running = max(running, min(1.0, (m - rank) * p_values[i]))
        result[i] = running
    return result


def seeds_needed(distances: Sequence[float], alpha: float = ALPHA) -> int | None:
    """Return the number of seeds with which all of some one-sided t tests succeed.

    Their joint power is at least `POWER`; seeds are assumed to be paired.

    Args:
        distances: Distance of each effect from its bound, in standard deviations
            between seeds; NaN if unknown.
        alpha: Level of each test.

    Returns:
        Total number of seeds; None if a distance is unknown or no number is enough.
    """
    if any(math.isnan(d) for d in distances):
        return None

    def power(n: int) -> float:
        critical = float(stats.t.ppf(1 - alpha, n - 1))
        missed = _noncentral_t(critical, n - 1, np.array(distances) * math.sqrt(n))
        # For several tests, a lower bound.
        return 1 - float(missed.sum())

    if power(_MOST_SEEDS) < POWER:
        return None
    low, high = 1, _MOST_SEEDS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high


def _noncentral_t(t: float, df: int, noncentrality: np.ndarray) -> np.ndarray:
    """Return the distribution function of the noncentral t distribution."""
    exact = stats.nct.cdf(t, df, noncentrality)
    # SciPy 1.17 gives NaN near a noncentrality of 39. Abramowitz and Stegun, 26.7.10:
    z = (t * (1 - 1 / (4 * df)) - noncentrality) / math.sqrt(1 + t**2 / (2 * df))
    return np.where(np.isnan(exact), stats.norm.cdf(z), exact)


def separation(table: Table) -> float:
    """Return how well a metric separates cells, relative to the spread of seeds.

    This is the standard deviation of the cells' true means (estimated by subtracting
    the part due to seeds) divided by that of the seeds of a cell, pooled. At 1, two
    cells differ about as much as two seeds. NaN if no cell has two seeds or there are
    fewer than two cells.
    """
    groups = [np.array(list(x.values())) for x in table.values() if len(x)]
    within = seed_sd(table) ** 2
    if len(groups) < 2 or not within > 0:
        return math.nan
    means = np.array([g.mean() for g in groups])
    noise = within * float(np.mean([1 / len(g) for g in groups]))
    between = max(float(means.var(ddof=1)) - noise, 0.0)
    return math.sqrt(between / within)


def seed_sd(table: Table) -> float:
    """Return the standard deviation between seeds of a cell, pooled over the cells.

    NaN if no cell has two seeds.
    """
    groups = [list(x.values()) for x in table.values() if len(x) > 1]
    df = sum(len(g) - 1 for g in groups)
    squares = sum((len(g) - 1) * _sd(g) ** 2 for g in groups)
    return math.sqrt(squares / df) if df else math.nan


def _sd(values: Sequence[float]) -> float:
    """Return the standard deviation of two or more values; 0 if only rounding differs.

    The mean of equal values is rounded: that of three times 0.1 is not 0.1.
    """
    sd = float(np.std(values, ddof=1))
    return sd if sd > _ROUNDING * float(np.abs(values).max()) else 0.0
