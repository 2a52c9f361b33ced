"""Differences of a study's cells to its first cell, for a question of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from egoskin.study.statistics import (
    ALPHA,
    Effect,
    Table,
    assumed_sd,
    contrast,
    holm,
    seeds_needed,
)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A cell compared with the first one."""

    cell: str
    """Its name."""
    effect: Effect
    """Its value minus that of the first cell."""
    p_value: float
    """Two-sided p-value of "they differ", after Holm's correction."""
    seeds_needed: int | None
    """Seeds per cell that would decide it; None if unknown or no number is enough."""


def differences(cells: Sequence[str], table: Table) -> list[Difference]:
    """Return the differences to the first cell, of the cells that have values.

    Args:
        cells: Names of the cells.
        table: Values of a metric.
    """
    first, *others = cells
    weights = {cell: {cell: 1.0, first: -1.0} for cell in others}
    effects = {cell: contrast(own, table) for cell, own in weights.items()}
    known = {cell: effect for cell, effect in effects.items() if effect is not None}
    # Two-sided: Bonferroni over the two directions.
    p_values = holm(
        [min(1.0, 2 * min(e.p_above(0), e.p_below(0))) for e in known.values()]
    )
    result = []
    for (cell, effect), p in zip(known.items(), p_values, strict=True):
        distance = abs(effect.mean) / assumed_sd(effect, weights[cell], table)
        needed = seeds_needed([distance], ALPHA / 2 / len(known))
        result.append(
            Difference(cell=cell, effect=effect, p_value=p, seeds_needed=needed)
        )
    return result
