"""The report of a study: report.md, index.html, runs.csv and figures in one folder.

Contract: it needs only the manifest and the results, and lists everything that is
missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.figure import Figure

from egoskin.evaluation.visibility import warning_texts
from egoskin.storage.files import write_file
from egoskin.storage.serialization import read_json
from egoskin.study.differences import Difference, differences
from egoskin.study.fields import settings
from egoskin.study.figures import (
    RAYS,
    equivalence,
    forest,
    learning_curves,
    metric_by_cell,
    on_axis,
    places,
    sample_efficiency,
    save,
    success_by_range,
)
from egoskin.study.findings import CELLS, Judged, Tested, judge_findings
from egoskin.study.folder import Result, StudyFolder
from egoskin.study.manifest import Manifest
from egoskin.study.metrics import BY_NAME, METRICS, Metric, runs_csv, tables
from egoskin.study.page import page, table
from egoskin.study.statistics import (
    ALPHA,
    Effect,
    Table,
    mean_effect,
    separation,
    spread,
)

# The budget is the same for all runs: the share of it adds nothing to the frames.
_SHOWN = [m for m in METRICS if m.name != "share_to_90"]
_BUDGET = 1000  # Core-hours. The report says what so many more would decide.
_ASSUMED = (
    "(The spread of cells with one seed is taken to be the largest of any cell, which "
    "is too large for cells near 0 or 100 %.) *Needs more*: a cell has no run, no "
    "spread is known, or 1,000 seeds are not enough."
)


def write_report(
    folder: StudyFolder, out: Path, metric: Metric = BY_NAME["success_3s"]
) -> None:
    """Write the report of a study.

    Args:
        folder: The study.
        out: Folder to write to, created if missing.
        metric: Metric in which cells are compared with the first one. The metrics of
            the paper's findings are fixed.

    Raises:
        ValueError: If a result is damaged or does not match the manifest, or another
            metric is given for the paper's findings.
        OSError: If a file cannot be written.
    """
    manifest = folder.manifest()
    names = [cell.name for cell in manifest.cells]
    of_paper = set(names) >= CELLS
    if of_paper and metric.name != "success_3s":
        raise ValueError(
            f"study {manifest.study} is judged on the paper's findings, whose metrics "
            "are fixed: leave out --metric"
        )
    results = folder.results(manifest)
    out.mkdir(parents=True, exist_ok=True)
    values = tables(results)
    judged: list[Judged] = []
    found: list[Difference] = []
    if of_paper:
        judged = judge_findings(values)
    else:
        found = differences(names, values[metric.name])
    seen = _seen(folder)
    pictures = _pictures(manifest, results, values, metric, judged, found, seen)
    for name, (figure, _) in pictures.items():
        save(figure, out, name)
    shown = {
        name: f"![{caption}]({name}.png)\n\n*{caption}*"
        for name, (_, caption) in pictures.items()
    }
    blocks = _blocks(
        folder, manifest, results, values, metric, judged, found, shown, seen
    )
    text = "\n\n".join(blocks) + "\n"
    contents = {
        "runs.csv": runs_csv(manifest, results),
        "report.md": text,
        "index.html": page(f"Study {manifest.study}", text, out),
    }
    for name, content in contents.items():
        write_file(out / name, content.encode())


def _pictures(
    manifest: Manifest,
    results: Sequence[Result],
    values: Mapping[str, Table],
    metric: Metric,
    judged: Sequence[Judged],
    found: Sequence[Difference],
    seen: Sequence[Mapping[str, Any]],
) -> dict[str, tuple[Figure, str]]:
    """Return the figures for which there are data, with their captions."""
    success = values["success_3s"]
    tested = [j for j in judged if _is_tested(j)]
    warnings = (
        "Below: time from the first detection of a ball to its contact with a standing "
        "robot, median and 5 to 95 %. "
    )
    grid = {(p.geometry, p.signal) for p in places(manifest).values()}
    shared = (
        "With rays localization is one cell, drawn for all beams and the closest one. "
    )
    if not {g for g, _ in grid} >= set(RAYS) or (RAYS[0], "localization") not in grid:
        shared = ""
    drawn = {
        "success-by-range": (
            # One cell alone says nothing about the range.
            success_by_range(manifest, success, seen)
            if len(on_axis(manifest, success)) > 1
            else None,
            "Success against range: interquartile mean (hollow: one seed) and range "
            f"(bars) over seeds; each dot is a seed. {shared}{warnings if seen else ''}"
            "Infinite ranges are left out.",
        ),
        "differences": (
            None
            if judged
            else metric_by_cell(manifest, metric, values[metric.name], found),
            f"{metric.title}. "
            "Left: interquartile mean (hollow: one seed) and range (bars) over seeds; "
            "each dot is a seed. Right: difference to the first cell, with its 90 % "
            "(thick) and 95 % (thin) interval, without correction for the number of "
            "cells; red: p is at most 0.05 after that correction.",
        ),
        "findings": (
            forest(tested) if tested else None,
            "The findings with runs. Shaded: the region claimed for each effect; 90 % "
            "(thick) and 95 % (thin) intervals; hollow: one seed, no interval.",
        ),
        "equivalence": (
            equivalence(manifest, success),
            "Which signals are equivalent. Shaded: the margin of equivalence; 90 % "
            "(thick) and 95 % (thin) intervals; hollow: one seed. Each pair is tested "
            "alone, without correction for their number.",
        ),
        "learning-curves": (
            learning_curves(manifest, results),
            "Success in training, with exploration. Thin: each seed; thick: their "
            f"mean. {shared}".rstrip(),
        ),
        "sample-efficiency": (
            sample_efficiency(manifest, results),
            "Environment steps until a run reaches 50 and 90 % of its final success. "
            "Cross: a run that has not learnt, as that is below 5 %; it counts with "
            "all its steps.",
        ),
    }
    return {k: (f, text) for k, (f, text) in drawn.items() if f is not None}


def _blocks(
    folder: StudyFolder,
    manifest: Manifest,
    results: Sequence[Result],
    values: Mapping[str, Table],
    metric: Metric,
    judged: Sequence[Judged],
    found: Sequence[Difference],
    shown: Mapping[str, str],
    seen: Sequence[Mapping[str, Any]],
) -> Iterator[str]:
    """Yield the parts of the report, in Markdown."""
    plan, total = manifest.evaluation, len(manifest.runs)
    yield f"# Study {manifest.study}"
    end = "" if manifest.purpose.endswith((".", "!", "?")) else "."
    purpose = manifest.purpose and f"{manifest.purpose}{end} "
    yield (
        f"{purpose[:1].upper()}{purpose[1:]}{len(results)} of "
        f"{total} runs are done. Evaluated on standard {plan.standard}, throw set "
        f"{plan.throw_set} of {plan.episodes:,} sequences, with the mean action. "
        "Intervals are over seeds, not over throws."
    )
    if not results:
        yield "There are no results yet."
        yield from _missing_runs(folder, manifest)
        return
    if judged:
        yield _answer(judged)
        yield from _why_undecided(judged, values["success_3s"])
    if "success-by-range" in shown:
        yield shown["success-by-range"]
    if judged:
        yield "## The findings"
        yield (
            "The tests were fixed in code before the runs. A finding is confirmed if "
            "each of its claims lies in its region, and refuted if one lies outside; "
            "p-values are corrected for the number of findings (Holm). The table shows "
            "the deciding claim; an undecided finding has the p-value of the verdict "
            "it is nearer to. *Seeds* is the number it is based on and, if it is "
            "undecided, the total that would decide it with a power of 80 % if effect "
            f"and spread stay as observed. {_ASSUMED} Findings about another budget "
            "are tested by a stand-in."
        )
        needed, hours = _runs_to_decide(judged, results), _core_hours(results)
        yield _finding_rows(judged, needed, hours)
        yield from _next_decisions(needed, hours)
    if "findings" in shown:
        yield shown["findings"]
    first = manifest.cells[0].name
    if not judged and len(manifest.cells) > 1 and not values[metric.name].get(first):
        yield "## Differences to the first cell"
        yield f"Unknown: {first} has no finished run with a value of {metric.label}."
    if found:
        yield "## Differences to the first cell"
        yield (
            f"{metric.title}: each cell minus {first}, "
            "compared seed by seed if they share two or more seeds (others are then "
            "left out). Two-sided p-values, corrected for the number of cells (Holm); "
            "intervals are not corrected. *Seeds* is the number "
            "it is based on and, if p is above 0.05, the total that would decide it "
            f"with a power of 80 % if effect and spread stay as observed. {_ASSUMED}"
        )
        yield _difference_rows(found, metric)
    if "differences" in shown:
        yield shown["differences"]
    yield "## The cells"
    yield (
        "Interquartile mean and range over seeds; in brackets the mean with its 95 % "
        "t interval, which needs two seeds or more and, assuming that they are "
        "normally distributed, may leave 0 to 100 %; n: if only some seeds have a "
        "value. A run that has not learnt (final success in training below 5 %) counts "
        "with all its frames."
    )
    yield _cell_rows(manifest, values)
    for name in ("equivalence", "learning-curves", "sample-efficiency"):
        if name in shown:
            yield shown[name]
    yield "## How well each metric separates the cells"
    yield (
        "Standard deviation between cells divided by that between the seeds of a cell: "
        "at 1, two cells differ about as much as two seeds of one cell. Only cells "
        "with two seeds tell the spread, and those near 0 or 100 % have hardly any."
    )
    ratios = [(separation(values[m.name]), m) for m in _SHOWN]
    known = sorted((r for r in ratios if r[0] >= 0), key=lambda r: -r[0])
    if known:
        yield table(
            ("metric", "sd between cells / sd between seeds"),
            [(m.label, f"{r:.2f}") for r, m in known],
        )
    else:
        yield "Unknown: no cell has two seeds that differ."
    if seen:
        yield "## What the skins see, without training"
        yield _seen_rows(seen)
    yield from _missing_runs(folder, manifest)
    yield "## The runs"
    yield (
        "Settings that differ from the default, in all runs: "
        f"{', '.join(settings(manifest.not_default())) or 'none'}. All values in full "
        "precision: runs.csv."
    )
    yield table(
        ("run", "success at 3 s", "wall time", "workers", "commit", "machine"),
        [
            (
                r.run.name,
                f"{100 * r.stored.evaluation['success']['mean']:.1f} %",
                f"{r.stored.record.wall_s / 3600:.2f} h",
                str(r.stored.config.num_workers or "one per core"),
                r.stored.record.commit,
                r.stored.record.machine,
            )
            for r in results
        ],
    )


def _missing_runs(folder: StudyFolder, manifest: Manifest) -> Iterator[str]:
    """Yield the runs that are not done: their cells, by the seeds that are missing."""
    yield "## Missing runs"
    seeds: dict[str, list[str]] = {}
    for status in folder.status(manifest.runs):
        if status.state != "done":
            note = f" ({status.state})" * (status.state != "missing")
            own = seeds.setdefault(status.run.cell.name, [])
            own.append(f"{status.run.seed}{note}")
    cells: dict[str, list[str]] = {}
    for cell, own in seeds.items():
        cells.setdefault(", ".join(own), []).append(cell)
    if cells:
        rows = [(own, ", ".join(names)) for own, names in cells.items()]
        yield table(("seeds", "cells"), rows)
    else:
        yield "None: all runs are done."


def _is_tested(judged: Judged) -> bool:
    """Return whether any claim of a finding has runs."""
    return any(c.effect is not None for c in judged.claims)


def _answer(judged: Sequence[Judged]) -> str:
    """Return the verdicts in a sentence."""
    labels: dict[str, list[str]] = {
        "confirmed": [],
        "refuted": [],
        "undecided": [],
        "untested": [],
    }
    for j in judged:
        verdict = j.verdict if _is_tested(j) else "untested"
        labels[verdict].append(j.finding.label)
    parts = [f"{verdict}: {', '.join(own)}" for verdict, own in labels.items() if own]
    return f"**Of the paper's findings {'; '.join(parts)}.**"


def _why_undecided(judged: Sequence[Judged], success: Table) -> Iterator[str]:
    """Yield how many cells have too few seeds for any verdict, if there are any."""
    fewer = sum(len(success.get(name, {})) < 2 for name in CELLS)
    if fewer and any(j.verdict == "undecided" for j in judged):
        yield (
            "A verdict needs at least two seeds of the cells it rests on: "
            f"{fewer} of {len(CELLS)} cells have fewer."
        )


def _deciding(judged: Judged) -> Tested:
    """Return the claim that decides a verdict: the least certain or the refuted one."""
    if judged.verdict == "refuted":
        return min(judged.claims, key=lambda c: c.p_refute)
    claims = judged.claims if judged.verdict == "confirmed" else judged.deciding
    known = [(c, c.effect) for c in claims if c.effect is not None]

    def nearness(claim: Tested, effect: Effect) -> float:
        return -min(abs(effect.mean - end) for end in claim.claim.region.bounds)

    # With one seed all p-values are 1: the claim nearest to an end needs most seeds.
    claim, _ = max(known, key=lambda each: (each[0].p_confirm, nearness(*each)))
    return claim


def _core_hours(results: Sequence[Result]) -> float | None:
    """Return the mean core-hours of a run, if they are known."""
    # Its workers are as many as its cores. None means all cores of its machine, whose
    # number the stored configuration does not hold.
    hours = [
        r.stored.record.wall_s / 3600 * r.stored.config.num_workers
        for r in results
        if r.stored.config.num_workers is not None
    ]
    return fmean(hours) if hours else None


def _runs_to_decide(
    judged: Sequence[Judged], results: Sequence[Result]
) -> dict[str, Counter[str]]:
    """Return how many more runs of each cell would decide a finding, where known."""
    have = Counter(result.run.cell.name for result in results)
    needed = {}
    for j in judged:
        if j.verdict == "undecided" and j.seeds_needed is not None:
            cells = {name for c in j.deciding for name in c.claim.weights}
            runs = Counter({c: max(j.seeds_needed - have[c], 0) for c in cells})
            if runs.total():  # Zero: the seeds so far have no spread.
                needed[j.finding.label] = runs
    return needed


def _next_decisions(
    needed: Mapping[str, Counter[str]], hours: float | None
) -> Iterator[str]:
    """Yield which findings `_BUDGET` more core-hours would decide, if that is known."""
    if hours is None or not needed:
        return
    left = dict(needed)
    runs: Counter[str] = Counter()
    decided = []
    while left:
        # The cheapest after those before it, with which it may share runs.
        label = min(left, key=lambda each: (runs | left[each]).total())
        more = runs | left.pop(label)
        if more.total() * hours > _BUDGET:
            break
        runs = more
        decided.append(label)
    if not decided:
        yield f"The next {_BUDGET:,} core-hours would decide none of them."
        return
    yield (
        f"The next {_BUDGET:,} core-hours would decide, cheapest first, "
        f"{', '.join(decided)}: {runs.total():,} runs, {runs.total() * hours:,.0f} "
        "core-hours. Runs that several findings need are counted once."
    )


def _finding_rows(
    judged: Sequence[Judged], needed: Mapping[str, Counter[str]], hours: float | None
) -> str:
    rows = []
    for j in judged:
        text = j.finding.text
        if j.finding.stand_in:
            text += f". Stand-in: {j.finding.stand_in}"
        known = sum(c.effect is not None for c in j.claims)
        claims = f"{known} of {len(j.claims)}"
        if not known:
            none = ("**untested**", "", "no runs yet", "0", claims, "")
            rows.append((j.finding.label, text, *none))
            continue
        claim = _deciding(j)
        effect = claim.effect
        assert effect is not None
        more = cost = ""
        if j.verdict == "undecided":
            more = _more(effect.seeds, j.seeds_needed)
            if j.finding.label in needed and hours is not None:
                cost = f"{needed[j.finding.label].total() * hours:,.0f}"
        rows.append(
            (
                j.finding.label,
                text,
                f"**{j.verdict}**",
                _p_value(j.p_value),
                f"{claim.claim.name}: {_effect(effect)}",
                f"{effect.seeds}{more}",
                claims,
                cost,
            )
        )
    head = (
        "",
        "finding",
        "verdict",
        "p",
        "effect [points] (95 %)",
        "seeds",
        "claims with runs",
        "core-hours to decide",
    )
    return table(head, rows)


def _difference_rows(found: Sequence[Difference], metric: Metric) -> str:
    rows = []
    for each in found:
        open_ = each.p_value > ALPHA
        more = _more(each.effect.seeds, each.seeds_needed) if open_ else ""
        seeds = f"{each.effect.seeds}{more}"
        effect = _effect(each.effect, metric.digits)
        rows.append((each.cell, effect, _p_value(each.p_value), seeds))
    head = f"difference [{metric.difference_unit}] (95 %)"
    return table(("cell", head, "p", "seeds"), rows)


def _effect(effect: Effect, digits: int = 1) -> str:
    """Return an effect with its 95 % interval, if that is known."""
    low, high = effect.interval()
    text = f"{effect.mean:+.{digits}f}"
    if effect.error > 0:
        text += f" ({low:+.{digits}f} to {high:+.{digits}f})"
    return text


def _more(have: int, needed: int | None) -> str:
    """Return how many seeds would decide, after the number that there are."""
    # Fewer than there are only if their differences have no spread.
    return f" of {needed}" if needed is not None and needed > have else ", needs more"


def _p_value(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _cell_rows(manifest: Manifest, values: Mapping[str, Table]) -> str:
    rows = []
    for cell in manifest.cells:
        success = values["success_3s"].get(cell.name)
        if not success:
            continue
        row = [cell.name, str(len(success))]
        for metric in _SHOWN:
            own = list(values[metric.name].get(cell.name, {}).values())
            fewer = f", n = {len(own)}" * (0 < len(own) < len(success))
            row.append(_spread(own, metric.digits) + fewer)
        effect = mean_effect(list(success.values()))
        low, high = effect.interval()
        if effect.error > 0:
            row[2] += f" [{effect.mean:.1f}, {low:.1f} to {high:.1f}]"
        rows.append(row)
    return table(("cell", "seeds", *(f"{m.label} [{m.unit}]" for m in _SHOWN)), rows)


def _spread(values: Sequence[float], digits: int) -> str:
    if not values:
        return "-"
    own = spread(values)
    mean, low, high = (f"{v:.{digits}f}" for v in (own.iqm, own.low, own.high))
    return mean if own.seeds == 1 else f"{mean} ({low} to {high})"


def _seen(folder: StudyFolder) -> list[dict[str, Any]]:
    """Return the cells of the analysis of visibility, none if there is none.

    Raises:
        ValueError: If the file is not such an analysis.
    """
    path = folder.path / "visibility.json"
    if not path.is_file():
        return []
    try:
        rows = read_json(path)["cells"]
        _seen_rows(rows)
        return rows
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged; write it again with: egoskin study plan --dir "
            f"{folder.path} --visibility"
        ) from error


def _seen_rows(seen: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for row in seen:
        share, times = warning_texts(row)
        rows.append((f"{row['coverage']} {row['range']:g} m", share, " / ".join(times)))
    head = ("cell", "hits seen before contact", "warning [ms], 5 / 50 / 95 %")
    return table(head, rows)
