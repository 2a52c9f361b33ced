"""Run a study: trainings that differ in a few fields, compared over seeds.

egoskin study plan findings --dir studies/findings    # what it will cost
egoskin study run findings --dir studies/findings     # Ctrl-C; run goes on
egoskin study status studies/findings
egoskin study report studies/findings
egoskin study slurm studies/findings > study.sh
egoskin study adopt studies/findings runs/NAME        # it is one of them

NAME is paper, paper-1000, findings, smoke, or a JSON file with the fields of
egoskin.study.manifest.Study.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from egoskin.bounds import COUNT, POSITIVE, check_bounds
from egoskin.commands.errors import check_packages, parse_subcommand
from egoskin.evaluation.visibility import alike, analyse, warning_texts
from egoskin.parallel import WorkerError, available_cores
from egoskin.progress import can_overwrite, counted, duration
from egoskin.storage.serialization import to_plain, write_json
from egoskin.study.claims import is_claimed, owner
from egoskin.study.cost import WORTH_MEASURING, Speed, cost, measure_all
from egoskin.study.fields import settings
from egoskin.study.folder import RunStatus, StudyFolder
from egoskin.study.manifest import Manifest, PlannedRun, load_study, resolve
from egoskin.study.metrics import BY_NAME, MetricName
from egoskin.study.runner import LocalRunner, Progress, Runner, slurm_script
from egoskin.study.shipped import STUDIES

# Cores of a common server.
_MANY_CORES = 64
# Fields that the analysis of visibility takes from the base, by their first parts.
_OF_THE_BASE = (
    "env.robot",
    "env.skin",
    "env.sensor.field",
    "env.sensor.ray",
    "env.sensor.occlusion",
    "env.task.throws",
)

Name = Annotated[str | None, tyro.conf.Positional]
Folder = Annotated[Path, tyro.conf.Positional]


def requested(name: str | None, folder: Path | None) -> Manifest:
    """Return the manifest that a study and a folder make together; nothing is written.

    Args:
        name: A shipped study or a file; None: the study of the folder.
        folder: A folder, new or with a study; None: none.

    Raises:
        ValueError: If there is no such study or no such folder, or the study would
            change the folder's.
    """
    if folder is None:
        if name is None:
            raise ValueError("a study or the --dir of an existing one is required")
        return find_study(name)
    check_folder(folder, "--dir")
    study = StudyFolder(folder)
    if name is None:
        return study.manifest()
    return study.extended(find_study(name))


def find_study(name: str) -> Manifest:
    """Return the manifest of a shipped study or of a file.

    Raises:
        ValueError: If there is no such study; the text lists the shipped ones.
    """
    if name in STUDIES:
        return resolve(STUDIES[name])
    if not name.endswith(".json"):
        raise ValueError(
            f"no study {name!r} (valid: {', '.join(STUDIES)}, or a .json file)"
        )
    if not Path(name).is_file():
        raise ValueError(f"there is no file {name}")
    return resolve(load_study(Path(name)))


def fastest(manifest: Manifest, runs: Sequence[PlannedRun]) -> tuple[Speed, str] | None:
    """Print measured speeds; return the highest for some runs, and the cell measured.

    A run of each cell is tried, until one can be measured; None if none can.
    """
    first: dict[str, PlannedRun] = {}
    for run in runs:
        first.setdefault(run.cell.name, run)
    for run in first.values():
        try:
            speeds = measure_all(manifest, run, available_cores())
        except (ValueError, OSError, WorkerError) as error:
            print(f"note: {run.name} cannot be measured: {error}", file=sys.stderr)
            continue
        for speed in speeds:
            print(f"  {speed}")
        return max(speeds, key=lambda speed: speed.of(len(runs))), run.cell.name
    return None


def show(text: str, stays: bool) -> None:
    """Print a line; on a terminal the next one replaces it, unless it stays."""
    live = can_overwrite(sys.stdout)
    start, end = ("\r", "\x1b[K" + "\n" * stays) if live else ("", "\n")
    print(f"{start}{text}", end=end, flush=True)


def check_folder(folder: Path, option: str) -> None:
    """Raise ValueError if a folder cannot be made, or a file has its name."""
    parent = folder.absolute().parent
    if not parent.is_dir():
        raise ValueError(f"{option}: there is no folder {parent}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{option}: {folder} is a file, not a folder")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Print the runs and cost of a study; write or extend its manifest."""

    name: Name = None
    """Study: paper, paper-1000, findings, smoke, or a JSON file; None: the folder's."""
    dir: Path | None = None
    """Folder of a new study, or one to add cells and seeds to; None: only print."""
    steps_per_s: Annotated[float | None, POSITIVE] = None
    """Environment steps per second and core; None: measured now, in half a minute for
    each choice of cores per run."""
    visibility: bool = False
    """Also report what each coverage and range sees, without training; stored with the
    study, it becomes part of the report."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)

    def execute(self) -> None:
        """Print the plan, and write the manifest."""
        manifest = requested(self.name, self.dir)
        if self.dir is not None:
            StudyFolder(self.dir).plan(manifest)
        describe(manifest)
        per_s, source, cores = self.steps_per_s, "as given", available_cores()
        if per_s is None:
            measured = fastest(manifest, manifest.runs)
            if measured is None:
                raise ValueError("no run can be measured: use --steps-per-s")
            best, cell = measured
            per_s = best.per_s / cores
            source = f"measured on {cell}; full ray grids take longer"
        total = cost(manifest, per_s)
        print(
            f"{counted(total.runs, 'run')}, {total.frames / 1e6:,.1f} M frames, "
            f"{total.core_s / 3600:,.1f} core-hours ({per_s:,.0f} steps/s per core, "
            f"{source}):\n"
            f"  {duration(total.wall_s(cores))} on the {counted(cores, 'core')} here, "
            f"{duration(total.wall_s(_MANY_CORES))} on {_MANY_CORES}; evaluation adds "
            f"minutes per run\n"
            f"  {total.disk / 1e9:,.2f} GB of disk"
        )
        if self.dir is not None:
            status = StudyFolder(self.dir).status(manifest.runs)
            left = [each for each in status if each.state != "done"]
            if len(left) < len(status):
                frames = sum(each.frames_left for each in left)
                print(
                    f"  {len(status) - len(left)} of these runs are done; left: "
                    f"{counted(len(left), 'run')}, {frames / per_s / 3600:,.1f} "
                    "core-hours"
                )
        if self.visibility:
            seen = what_is_seen(manifest)
            if seen and self.dir is not None:
                write_json(self.dir / "visibility.json", seen, allow_nan=False)
        if self.dir is not None:
            print(f"manifest {StudyFolder(self.dir).manifest_path}")


def describe(manifest: Manifest) -> None:
    """Print the content of a study."""
    print(f"study {manifest.study}: {manifest.purpose}")
    for setting in settings(manifest.not_default()):
        print(f"  not the default: {setting}")
    width = max(len(cell.name) for cell in manifest.cells)
    for cell in manifest.cells:
        text = ", ".join(settings(manifest.overrides(cell)))
        print(f"  {cell.name:<{width}} {text or 'no other changes'}")
    seeds = ", ".join(map(str, manifest.seeds))
    print(
        f"  seeds {seeds}; evaluated on standard {manifest.evaluation.standard}, throw "
        f"set {manifest.evaluation.throw_set} of {manifest.evaluation.episodes}"
    )


def what_is_seen(manifest: Manifest) -> dict[str, Any]:
    """Print and return the visibility of thrown balls by coverage and range."""
    base = manifest.base.env
    if base.task.throws.shape != "sphere":
        print("visibility is analysed for spheres only")
        return {}
    skinned = [c for c in manifest.cells if c.config.env.sensor.uses_skin]
    others = [
        c
        for c in skinned
        if math.isinf(c.config.env.sensor.range)
        or any(name.startswith(_OF_THE_BASE) for name in manifest.overrides(c))
    ]
    sensors = [c.config.env.sensor for c in skinned if c not in others]
    if others:
        print(
            "visibility is not analysed for cells with an infinite range, or another "
            "robot, skin, shape of sensors or throw than the base: "
            f"{', '.join(c.name for c in others)}"
        )
    if not sensors:
        print("no cell is left: there is no visibility to analyse")
        return {}
    analysis = analyse(
        base.robot_config,
        base.skin.build(base.robot_config),
        {s.coverage: s for s in sensors},
        sorted({s.range for s in sensors}),
        base.task.throws,
        timestep=base.task.physics.timestep,
        control_period=1 / base.task.physics.control_hz,
    )
    report = analysis.report()
    print("visibility of the thrown balls that hit a standing robot, without training:")
    for cell, row in zip(analysis.cells, report["cells"], strict=True):
        seen, times = warning_texts(row)
        text = " / ".join(times)
        print(f"  {cell!s:<14} sees {seen:>7}, {text} ms before (5 / 50 / 95 %)")
    for one, other, _ in alike(analysis.cells, report):
        print(f"  {one} and {other} see the same")
    return {"config": to_plain(base), **report}


@dataclass(frozen=True, kw_only=True)
class Run:
    """Run or resume a study; several runners may share its folder."""

    name: Name = None
    """Study to begin or add to; None: the study of the folder's manifest."""
    dir: Path
    """Folder of the study."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="RUN ...")] = ()
    """Names of the runs to execute, or patterns such as 'field-*-seed0'; empty: all
    runs."""
    on: Literal["local", "ray"] = "local"
    """Where to run: this machine, or an existing Ray cluster (extra `ray`)."""
    ray_address: str = "auto"
    """Address of the Ray cluster, ``host:port``; auto: the cluster of this machine."""
    parallel: Annotated[int | None, COUNT] = None
    """Maximum number of parallel runs; None: enough to use all cores."""
    cores_per_run: Annotated[int | None, COUNT] = None
    """Workers and learner threads of each run; None: measured, half a minute for each
    choice (but 1 for a short study, with --parallel, or on Ray). It does not change the
    results."""
    tries: Annotated[int, COUNT] = 3
    """Maximum number of attempts for each run."""
    again: bool = False
    """Whether to retry those of the runs that have used up their attempts."""
    nice: int = 5
    """Niceness of the runs."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        if not 0 <= self.nice < 20:
            raise ValueError(f"nice must be from 0 to 19, got {self.nice}")

    def execute(self) -> None:
        """Execute the runs that are left."""
        manifest, folder = requested(self.name, self.dir), StudyFolder(self.dir)
        runs = manifest.matching(self.only or ("*",))
        kind = self._where()
        folder.plan(manifest)
        if self.again:
            folder.forget_failures(runs)
        status = kind(
            folder,
            runs=runs,
            parallel=self.parallel,
            cores_per_run=self.cores_per_run
            or self._cores_per_run(manifest, folder.status(runs)),
            tries=self.tries,
            nice=self.nice,
            show=show,
        ).run()
        print("\r\x1b[K" * can_overwrite(sys.stdout), end="")
        print_status(folder, manifest, folder.status(manifest.runs))
        if any(each.state == "failed" for each in status):
            again = f"egoskin study run --dir {self.dir} --again"
            print(f"not tried again; to retry: {again}")
        if any(each.state != "done" for each in status):
            raise SystemExit(1)
        print(f"done; now: egoskin study report {self.dir}")

    def _cores_per_run(self, manifest: Manifest, status: list[RunStatus]) -> int:
        """Return the number of cores per run with the highest total throughput."""
        left = [s for s in status if s.state != "done" and s.tries < self.tries]
        frames = sum(each.frames_left for each in left)
        if self.on != "local" or self.parallel or frames < WORTH_MEASURING:
            return 1
        measured = fastest(manifest, [each.run for each in left])
        # The job of a run that cannot start reports why.
        return 1 if measured is None else measured[0].cores_per_run

    def _where(self) -> type[Runner]:
        """Return the runner for the study."""
        if self.on == "local":
            if self.ray_address != Run.ray_address:
                raise ValueError("--ray-address has no effect without --on ray")
            return LocalRunner
        check_packages("--on ray", "ray", "ray")
        # Imported here, because only this option needs Ray.
        from egoskin.study.ray_runner import RayRunner, connect

        connect(self.ray_address)
        return RayRunner


@dataclass(frozen=True, kw_only=True)
class Status:
    """Print the progress of a study, from its folder alone."""

    dir: Folder
    """Folder of the study."""

    def execute(self) -> None:
        """Print a table by cell and seed."""
        folder = StudyFolder(self.dir)
        manifest = folder.manifest()
        print_status(folder, manifest, folder.status(manifest.runs))


def print_status(
    folder: StudyFolder, manifest: Manifest, status: list[RunStatus]
) -> None:
    """Print the progress of each run, by cell and seed, where it runs, its failures."""
    entries = {(each.run.cell.name, each.run.seed): entry(each) for each in status}
    width = max(len(cell.name) for cell in manifest.cells)
    wide = max(map(len, entries.values())) + 2
    seeds = "".join(f"{f'seed {seed}':<{wide}}" for seed in manifest.seeds)
    print(f"{'':{width}}  {seeds.rstrip()}")
    for cell in manifest.cells:
        row = "".join(f"{entries[cell.name, seed]:<{wide}}" for seed in manifest.seeds)
        print(f"{cell.name:{width}}  {row.rstrip()}")
    for each in status:
        if each.state == "running":
            print(f"{each.run.name}: running {where(folder, each.run.name)}")
        if each.failure is not None:
            print(
                f"{each.run.name}: failed {counted(each.failure.tries, 'time')}, "
                f"last: {each.failure.error}"
            )
    print(Progress.of(status))


def where(folder: StudyFolder, name: str) -> str:
    """Return the host and process that work on a run, in a few words."""
    if not is_claimed(folder.claims, name):
        # A job that was killed leaves its name.
        return "outside the study"
    return f"on {owner(folder.claims, name) or 'an unknown host'}"


def entry(status: RunStatus) -> str:
    """Return the progress of a run in a few words."""
    share = status.frames / status.run.end
    match status.state:
        case "done":
            return f"done {status.success:.1%}"
        case "running":
            return f"{share:.0%}, {duration(status.left_s)} left"
        case "failed":
            return f"FAILED at {share:.0%}"
        case "stopped":
            return f"stopped at {share:.0%}"
        case _:
            return "-"


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write report.md, index.html, runs.csv and the figures of a study."""

    dir: Folder
    """Folder of the study."""
    out: Path | None = None
    """Folder to write to; None: report/ in the study's folder."""
    metric: MetricName = "success_3s"
    """Column of runs.csv to compare with the first cell's, in a study of your own."""

    def execute(self) -> None:
        """Write the report."""
        check_packages("a report", "study", "matplotlib", "markdown")
        # Imported here, because only the report needs these packages.
        from egoskin.study.report import write_report

        folder = StudyFolder(self.dir)
        folder.manifest()  # a wrong folder is named before --out
        out = self.out or self.dir / "report"
        check_folder(out, "--out")
        write_report(folder, out, BY_NAME[self.metric])
        print(f"{out / 'report.md'}, {out / 'index.html'}, {out / 'runs.csv'}")


@dataclass(frozen=True, kw_only=True)
class Slurm:
    """Print a Slurm job array whose elements share the work on a study."""

    dir: Folder
    """Folder of the study, shared by all nodes."""
    cores: Annotated[int, COUNT] = 16
    """Cores of each element, and number of parallel runs."""
    elements: Annotated[int | None, COUNT] = None
    """Elements of the array; None: enough for one core per run."""
    hours: Annotated[float, POSITIVE] = 24.0
    """Time limit of each element [h]."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)

    def execute(self) -> None:
        """Print the script."""
        folder = StudyFolder(self.dir)
        manifest = folder.manifest()
        # Slurm writes its logs there but does not create the folder.
        (self.dir / "logs").mkdir(exist_ok=True)
        elements = self.elements or -(-len(manifest.runs) // self.cores)
        path = self.dir.absolute()
        text = slurm_script(
            manifest, path, cores=self.cores, elements=elements, hours=self.hours
        )
        print(text, end="")


@dataclass(frozen=True, kw_only=True)
class Adopt:
    """Add existing runs to a study, by links to their folders."""

    dir: Folder
    """Folder of the study."""
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders; each is matched to a run of the study by its configuration."""

    def execute(self) -> None:
        """Link to the runs."""
        if not self.runs:
            raise ValueError("name the run folders to adopt")
        folder = StudyFolder(self.dir)
        manifest = folder.manifest()
        for source in self.runs:
            print(f"{source} adopted as {folder.adopt(manifest, source).name}")


def main(args: list[str]) -> None:
    """Run the command."""
    kinds = {k.__name__.lower(): k for k in (Plan, Run, Status, Report, Slurm, Adopt)}
    parse_subcommand(kinds, args, __doc__).execute()
