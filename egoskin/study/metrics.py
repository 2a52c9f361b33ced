"""Metrics of runs: a tidy table with a row per run, and a table per metric."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from egoskin.study.folder import Result
from egoskin.study.manifest import Manifest
from egoskin.study.statistics import Table

# Final success is the mean of the learning curve over this last share of the frames;
# below this final success, a run has not learnt.
_END_SHARE, _LEAST_END = 0.05, 0.05


MetricName = Literal[
    "success_3s",
    "success_5s",
    "survival_s",
    "first_avoided",
    "later_avoided",
    "falls",
    "masked_success_3s",
    "m_frames_to_50",
    "m_frames_to_90",
    "share_to_90",
]
"""Names of the metrics."""


@dataclass(frozen=True)
class Metric:
    """A metric of a run."""

    name: MetricName
    """Name of its column."""
    label: str
    """Description."""
    unit: str
    """Its unit."""
    of: Callable[[Result], float | None]
    """Function that computes it; None if a run has no value."""

    @property
    def title(self) -> str:
        """Its description as the beginning of a sentence."""
        return self.label[:1].upper() + self.label[1:]

    @property
    def difference_unit(self) -> str:
        """Unit of differences of its values."""
        return "percentage points" if self.unit == "%" else self.unit

    @property
    def digits(self) -> int:
        """Decimals of its values in texts."""
        return 2 if self.unit == "s" else 1


def has_learnt(result: Result) -> bool:
    """Return whether a run's final success in training is at least 5 %."""
    return _final_success(result) >= _LEAST_END


def _final_success(result: Result) -> float:
    frames, success = result.stored.frames, result.stored.success
    late = frames > (1 - _END_SHARE) * frames[-1:]
    # The curve is empty if no episode was ever long enough to tell.
    return float(success[late].mean()) if len(frames) else 0.0


def frames_to(result: Result, share: float) -> float:
    """Return the frames until success in training reaches a share of its final value.

    A run that has not learnt (final success below 5 %) has used its whole budget: left
    out, it would make its cell look fast.
    """
    frames, success = result.stored.frames, result.stored.success
    end = _final_success(result)
    if end < _LEAST_END:
        return float(result.run.end)
    first = int(np.argmax(success >= share * end))
    if first == 0:
        return float(frames[0])
    # Interpolate linearly between the stored lines.
    x, y = frames[first - 1 : first + 1], success[first - 1 : first + 1]
    return float(x[0] + (share * end - y[0]) / (y[1] - y[0]) * (x[1] - x[0]))


def _percent(*path: str) -> Callable[[Result], float | None]:
    def of(result: Result) -> float | None:
        value: Any = result.stored.evaluation
        for key in path:
            if value is None:
                return None
            value = value[key]
        return None if value is None else 100 * value

    return of


METRICS = (
    Metric("success_3s", "success at 3 s", "%", _percent("success", "mean")),
    Metric("success_5s", "success at 5 s", "%", _percent("success_5s", "mean")),
    Metric(
        "survival_s",
        "mean survival, restricted to 10 s",
        "s",
        lambda result: result.stored.evaluation["survival_time"]["mean"],
    ),
    Metric(
        "first_avoided", "first balls avoided", "%", _percent("avoided", "first_ball")
    ),
    Metric(
        "later_avoided", "later balls avoided", "%", _percent("avoided", "later_balls")
    ),
    Metric("falls", "falls within 3 s", "%", _percent("ended_by_fall")),
    Metric(
        "masked_success_3s",
        "success at 3 s, sensors masked",
        "%",
        _percent("masked", "success", "mean"),
    ),
    Metric(
        "m_frames_to_50",
        "frames to 50 % of its final success",
        "M frames",
        lambda result: frames_to(result, 0.5) / 1e6,
    ),
    Metric(
        "m_frames_to_90",
        "frames to 90 % of its final success",
        "M frames",
        lambda result: frames_to(result, 0.9) / 1e6,
    ),
    Metric(
        "share_to_90",
        "share of the budget to 90 % of its final success",
        "%",
        lambda result: 100 * frames_to(result, 0.9) / result.run.end,
    ),
)
"""Metrics of a run. Success, survival, balls and falls are from the throw set; frames
are from the success in training, with exploration, and are the whole budget for a run
that has not learnt (final success below 5 %)."""


BY_NAME = {metric.name: metric for metric in METRICS}
"""The metrics by name."""


def tables(results: Sequence[Result]) -> Mapping[str, Table]:
    """Return the finite values of each metric by cell and seed."""
    found: dict[str, dict[str, dict[int, float]]] = {m.name: {} for m in METRICS}
    for result in results:
        for each in METRICS:
            value = each.of(result)
            if value is not None and math.isfinite(value):
                row = found[each.name].setdefault(result.run.cell.name, {})
                row[result.run.seed] = value
    return found


def runs_csv(manifest: Manifest, results: Sequence[Result]) -> str:
    """Return a tidy table with a row for each run, in full precision.

    Two executions of one manifest differ only in the columns of wall time and speed
    (``wall_s``, ``frames_per_s``).
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ("study", "run", "cell", "coverage", "signal", "range_m", "reduce", "seed")
    judged = ("trained_on", "judged_on", "throw_set", "throws", "frames")
    names = [m.name for m in METRICS]
    last = ("policy_sha256", "wall_s", "frames_per_s")
    writer.writerow([*head, *judged, *names, *last])
    for result in results:
        run, evaluation = result.run, result.stored.evaluation
        sensor = run.config.env.sensor
        skin = (sensor.signal, sensor.range, sensor.reduce)
        values = (each.of(result) for each in METRICS)
        wall = result.stored.record.wall_s
        writer.writerow(
            [
                manifest.study,
                run.name,
                run.cell.name,
                sensor.coverage,
                *(skin if sensor.uses_skin else ("", "", "")),
                run.seed,
                evaluation["trained_on"],
                evaluation["standard"],
                evaluation["throw_set"],
                evaluation["episodes"],
                run.end,
                *("" if v is None else repr(float(v)) for v in values),
                result.policy_sha256,
                wall,
                run.end / wall if wall else "",
            ]
        )
    return out.getvalue()
