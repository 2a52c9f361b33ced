"""The studies that come with the package."""

from __future__ import annotations

import itertools
from typing import Any

from egoskin.runs.config import TrainConfig
from egoskin.study.manifest import EvaluationPlan, Study

RANGES = (0.2, 0.5, 1.0, 2.0)
"""Ranges of the paper [m]."""
SIGNALS = ("localization", "proximity", "binary")
"""Signals of the paper."""
# Frames of an epoch of the paper, taken to be 16 steps at 60 Hz of 4096 agents: 3000 of
# them are its 910 simulated hours.
_EPOCH = 16 * 4096
# A ray sensor reduced to its closest beam; with a binary signal, "any beam".
_REDUCED = {"sensor.reduce": "min"}


def _sensor(coverage: str, signal: str, reach: float, **more: Any) -> dict[str, Any]:
    return {
        "sensor.coverage": coverage,
        "sensor.signal": signal,
        "sensor.range": reach,
        **more,
    }


_BLIND = {"sensor.coverage": "none"}
_PAPER_CELLS = (
    *(
        _sensor(coverage, signal, reach)
        for coverage, signal, reach in itertools.product(
            ("field", "ray"), SIGNALS, RANGES
        )
    ),
    *(
        _sensor("ray", signal, reach, **_REDUCED)
        for signal, reach in itertools.product(("proximity", "binary"), RANGES)
    ),
)


def _paper(name: str, epochs: int) -> Study:
    return Study(
        name=name,
        purpose=f"the paper's 32 permutations x 10 seeds, {epochs} epochs",
        cells=_PAPER_CELLS,
        seeds=tuple(range(10)),
        frames=epochs * _EPOCH,
        standard="paper",
        # The critic's only privileged observation is the velocity.
        base={"privileged": "velocity"},
    )


PAPER = _paper("paper", 3000)
"""The paper's study, where it is silent with the default recipe (docs/paper.md)."""
PAPER_1000 = _paper("paper-1000", 1000)
"""The same with 1000 epochs."""

FINDINGS = Study(
    name="findings",
    purpose="the fewest cells that decide the paper's six findings",
    cells=(
        # The most informative cells first, in case the study is interrupted.
        *(
            _sensor("field", signal, reach)
            for reach, signal in itertools.product(reversed(RANGES), SIGNALS)
        ),
        _BLIND,
        *(_sensor("ray", "localization", reach) for reach in reversed(RANGES)),
        *(
            _sensor("ray", signal, reach, **reduced)
            for reach in (1.0, 2.0, 0.5)
            for reduced in (_REDUCED, {})
            for signal in ("proximity", "binary")
        ),
    ),
    seeds=(0, 1, 2),
    frames=TrainConfig().total_frames,
)
"""The cells that decide the findings, with the default recipe and budget."""

SMOKE = Study(
    name="smoke",
    purpose="whether a study runs here: two cells, two seeds, about a minute",
    cells=(_sensor("field", "proximity", 2.0), _BLIND),
    seeds=(0, 1),
    frames=20 * 16 * 64,
    base={"num_envs": 64},
    evaluation=EvaluationPlan(episodes=64),
)
"""A test study of about a minute, without meaning for the comparison of skins."""

STUDIES = {s.name: s for s in (PAPER, PAPER_1000, FINDINGS, SMOKE)}
"""The studies by name."""
