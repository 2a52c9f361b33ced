"""The paper's findings as contrasts of cells, fixed before any run.

A finding consists of one or more claims, all of which must hold. A claim states the
region in which a contrast of cells lies. It is *confirmed* by a test that the contrast
lies inside the region, *refuted* by a test that it lies outside, and otherwise
undecided. A finding is confirmed if all of its claims are (the largest p-value) and
refuted if any of them is (Bonferroni). The p-values of all findings are corrected by
Holm's method.

Two findings of the paper refer to its own budget, of 3000 and of 1000 epochs. They are
replaced by a similar statement about our budget, called a stand-in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

from egoskin.study.shipped import RANGES
from egoskin.study.statistics import (
    ALPHA,
    Effect,
    Region,
    Table,
    assumed_sd,
    contrast,
    holm,
    seeds_needed,
)

MARGIN = 5.0
"""Success rates closer than this are equivalent [percentage points]."""
ABOVE, SAME = Region(low=0.0), Region(low=-MARGIN, high=MARGIN)
NOT_BELOW = Region(low=-MARGIN)

Verdict = Literal["confirmed", "refuted", "undecided"]
"""Outcome of the tests of a finding."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Statement that a contrast lies in a region."""

    name: str
    """Description of the contrast."""
    weights: Mapping[str, float]
    """Weight of each cell."""
    region: Region
    """Region in which the contrast is claimed to lie."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A finding of the paper."""

    label: str
    """Our number, with a letter if there are several findings of that number."""
    text: str
    """Statement of the paper, as we read it (docs/paper.md)."""
    claims: tuple[Claim, ...]
    """Its testable claims; all must hold."""
    metric: str = "success_3s"
    """Metric of the contrasts: a name in ``egoskin.study.metrics``."""
    stand_in: str = ""
    """Statement tested instead, if the paper's is about another budget; else ""."""


@dataclass(frozen=True, kw_only=True)
class Tested:
    """A claim and the results of its tests."""

    claim: Claim
    """The claim."""
    effect: Effect | None
    """The contrast; None if one of its cells has no run."""
    p_confirm: float
    """P-value of "it lies inside its region"."""
    p_refute: float
    """P-value of "it lies outside its region"."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A finding and its verdict."""

    finding: Finding
    """The finding."""
    claims: tuple[Tested, ...]
    """Its claims."""
    verdict: Verdict
    """The verdict."""
    p_value: float
    """P-value of the verdict (or of the likelier one), after Holm's correction."""
    seeds_needed: int | None
    """Seeds per cell needed to decide it; None if unknown or if no number is enough."""
    deciding: tuple[Tested, ...]
    """The claims that these seeds are about: all to confirm it, one to refute it."""


def cell(coverage: str, signal: str, reach: float, *, reduced: bool = False) -> str:
    """Return the name of a cell, as `egoskin.study.manifest.cell_name` gives it."""
    return f"{coverage}-{signal}-{reach:g}m" + "-reduce-min" * reduced


def _difference(one: str, other: str, region: Region) -> Claim:
    name = f"{one} - {other}"
    return Claim(name=name, weights={one: 1.0, other: -1.0}, region=region)


def _best(coverage: str, *, reduced: bool, ranges: tuple[float, ...]) -> list[Claim]:
    """Return the claims that localization beats the other signals of a geometry."""
    return [
        _difference(
            cell(coverage, "localization", reach),
            cell(coverage, signal, reach, reduced=reduced),
            ABOVE,
        )
        for reach, signal in product(ranges, ("proximity", "binary"))
    ]


# The study has no pairs of full and reduced rays at 0.2 m.
_RAY_RANGES = RANGES[1:]
_DEFICIT = [
    {cell("field", "localization", r): 1.0, cell("ray", "localization", r): -1.0}
    for r in (RANGES[0], RANGES[-1])
]

FINDINGS = (
    Finding(
        label="1a",
        text="Localization is the best signal at every range and geometry",
        claims=(
            *_best("field", reduced=False, ranges=RANGES),
            *_best("ray", reduced=False, ranges=_RAY_RANGES),
            *_best("ray", reduced=True, ranges=_RAY_RANGES),
        ),
    ),
    Finding(
        label="1b",
        text="With rays localization is worse than with fields",
        claims=tuple(
            _difference(
                cell("field", "localization", r), cell("ray", "localization", r), ABOVE
            )
            for r in RANGES
        ),
    ),
    Finding(
        label="1c",
        text="... most at short range",
        claims=(
            Claim(
                name="deficit of rays at 0.2 m - at 2 m",
                weights={**_DEFICIT[0], **{k: -w for k, w in _DEFICIT[1].items()}},
                region=ABOVE,
            ),
        ),
    ),
    Finding(
        label="2",
        text="Field proximity matches localization at 1 m and more",
        claims=tuple(
            _difference(
                cell("field", "proximity", r), cell("field", "localization", r), SAME
            )
            for r in (1.0, 2.0)
        ),
    ),
    Finding(
        label="3",
        text="Field binary beats field proximity at 0.5 m",
        claims=(
            _difference(
                cell("field", "binary", 0.5), cell("field", "proximity", 0.5), ABOVE
            ),
        ),
    ),
    Finding(
        label="4",
        text="Proximity and binary of the full ray grid do not converge in 3000 epochs",
        stand_in="at our budget each has less than half of the success of the field "
        "with the same signal, at 1 and 2 m",
        claims=tuple(
            Claim(
                name=f"{cell('field', signal, r)} / 2 - {cell('ray', signal, r)}",
                weights={
                    cell("field", signal, r): 0.5,
                    cell("ray", signal, r): -1.0,
                },
                region=ABOVE,
            )
            for r, signal in product((1.0, 2.0), ("proximity", "binary"))
        ),
    ),
    Finding(
        label="5",
        text="The closest beam of each ray sensor recovers nearly all of "
        "localization's performance at 1 m",
        claims=(
            _difference(
                cell("ray", "proximity", 1.0, reduced=True),
                cell("ray", "localization", 1.0),
                NOT_BELOW,
            ),
        ),
    ),
    Finding(
        label="6a",
        text='"Any beam" is better than the full binary ray grid at 1 m',
        claims=(
            _difference(
                cell("ray", "binary", 1.0, reduced=True),
                cell("ray", "binary", 1.0),
                ABOVE,
            ),
        ),
    ),
    Finding(
        label="6b",
        text="Field proximity beyond 1 m converges in under 1000 of 3000 epochs",
        stand_in="at 2 m it reaches 90 % of its final success within a third of our "
        "budget",
        metric="share_to_90",
        claims=(
            Claim(
                name=f"share of the budget until 90 %, {cell('field', 'proximity', 2)}",
                weights={cell("field", "proximity", 2.0): 1.0},
                region=Region(high=100 / 3),
            ),
        ),
    ),
)
"""The findings. Values are percentages."""

CELLS = frozenset(name for f in FINDINGS for c in f.claims for name in c.weights)
"""Names of the cells that the findings are about."""


def judge_findings(tables: Mapping[str, Table]) -> list[Judged]:
    """Return the verdict on each finding.

    Args:
        tables: Values by metric, then by cell and seed [%].
    """
    tested = [_test(finding, tables[finding.metric]) for finding in FINDINGS]
    p_confirm = [max(t.p_confirm for t in claims) for claims in tested]
    p_refute = [
        min(1.0, len(claims) * min(t.p_refute for t in claims)) for claims in tested
    ]
    confirms = [c <= r for c, r in zip(p_confirm, p_refute, strict=True)]
    corrected = holm([min(pair) for pair in zip(p_confirm, p_refute, strict=True)])
    result = []
    for finding, claims, p, up in zip(
        FINDINGS, tested, corrected, confirms, strict=True
    ):
        verdict: Verdict = "undecided"
        if p <= ALPHA:
            verdict = "confirmed" if up else "refuted"
        needed, deciding = _needed(claims, tables[finding.metric])
        result.append(
            Judged(
                finding=finding,
                claims=tuple(claims),
                verdict=verdict,
                p_value=p,
                seeds_needed=needed,
                deciding=tuple(deciding),
            )
        )
    return result


def _test(finding: Finding, table: Table) -> list[Tested]:
    result = []
    for claim in finding.claims:
        effect = contrast(claim.weights, table)
        known = effect is not None
        result.append(
            Tested(
                claim=claim,
                effect=effect,
                p_confirm=claim.region.p_inside(effect) if known else 1.0,
                p_refute=claim.region.p_outside(effect) if known else 1.0,
            )
        )
    return result


def _needed(
    claims: Sequence[Tested], table: Table
) -> tuple[int | None, Sequence[Tested]]:
    """Return the seeds that decide a finding in its present direction, and by what.

    Returns:
        Seeds per cell, and the claims whose cells need them.
    """
    # Bonferroni, as if all findings were to be decided at once.
    alpha = ALPHA / len(FINDINGS)
    confirm: list[float] = []
    refute: list[tuple[float, float, Tested]] = []
    for tested in claims:
        effect, region = tested.effect, tested.claim.region
        if effect is None:
            confirm.append(math.nan)
            continue
        sd = assumed_sd(effect, tested.claim.weights, table)
        gaps = [abs(effect.mean - bound) for bound in region.bounds]
        confirm += [gap / sd for gap in gaps]
        if effect.mean not in region:
            # Only the end beyond which it lies; Bonferroni over all ends of all claims.
            level = alpha / len(gaps) / len(claims)
            needed = seeds_needed([min(gaps) / sd], level)
            refute.append((needed or math.inf, -min(gaps), tested))
    if refute:
        # A single refuted claim is enough: the first, or the farthest from its region.
        needed, _, tested = min(refute, key=lambda each: each[:2])
        return (int(needed) if math.isfinite(needed) else None), [tested]
    return seeds_needed(confirm, alpha), claims
