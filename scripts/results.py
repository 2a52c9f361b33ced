"""Store runs behind the documented figures, and write the report of all stored.

python scripts/results.py add runs/NAME            # evaluates its last policy
python scripts/results.py add runs/NAME --name field_proximity_2m_seed0
python scripts/results.py repeat results/NAME      # its evaluation, once more
python scripts/results.py write                    # docs/results.md and its pictures
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

try:
    import matplotlib

    matplotlib.use("Agg")  # no display is needed
    from matplotlib import pyplot as plt
    from matplotlib.axes import Axes
    from matplotlib.ticker import PercentFormatter
except ImportError:
    print(
        "error: the pictures need matplotlib: `pip install 'egoskin[plot]'`",
        file=sys.stderr,
    )
    raise SystemExit(2) from None

from egoskin.commands.errors import clear_errors, parse_subcommand
from egoskin.envs.standards import Standard
from egoskin.evaluation.behaviour import behave
from egoskin.evaluation.throw_set import standard_task
from egoskin.make import check_num_workers
from egoskin.policies.policy import Policy, load_policy
from egoskin.progress import counted
from egoskin.report import curve, report, sections
from egoskin.results import (
    StoredRun,
    load_run,
    load_runs,
    record,
    same_but_length,
    thin,
    to_json,
)
from egoskin.rng import check_seed
from egoskin.runs.run import Run
from egoskin.storage.files import check_output
from egoskin.storage.tensor_file import write_file

# Okabe and Ito's colours, told apart by colour-blind readers as well.
_COLOURS = (
    "#000000",
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)
_DASHES = ("-", "--", ":", "-.")


@dataclass(frozen=True, kw_only=True)
class Add:
    """Store a finished or stopped run, or a stored one's longer self."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    name: str | None = None
    """Name to store it by; None: after its sensor and seed."""
    bank_seed: int = 0
    """Seed of the bank of throws."""
    episodes: int = 4096
    """Throw sequences in the bank."""
    num_workers: int | None = None
    """Physics threads; None: the largest divisor of episodes <= cores."""
    results: Path = Path("results")
    """Folder of the stored runs."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which nothing can be stored."""
        check_seed(self.bank_seed, "bank_seed")
        check_num_workers(self.episodes, self.num_workers, "episodes")
        if self.name is not None and Path(self.name).name != self.name:
            raise ValueError(f"name must be the name of a folder, got {self.name!r}")
        if not self.results.is_dir():
            raise ValueError(f"--results: there is no folder {self.results}")

    def execute(self) -> None:
        """Evaluate the last policy the run kept and store what is small."""
        run = Run.open(self.run)
        policies = sorted((self.run / "policies").glob("*.safetensors"))
        if not policies:
            raise ValueError(f"{self.run} has not been trained: nothing to store")
        policy = load_policy(policies[-1])
        frames = policy.policy_spec.frames
        made = record(run, frames)
        label = run.config.env.sensor.label().replace("-", "_")
        folder = self.results / (self.name or f"{label}_seed{run.config.seed}")
        if folder.exists() and not same_but_length(Run.open(folder).config, run.config):
            raise ValueError(
                f"{folder} holds a run of another configuration: choose a --name"
            )
        version = "1" if run.config.env.standard == "1" else "2"
        bank = (self.bank_seed, self.episodes, self.num_workers)
        evaluation = figures(policy, version, *bank)
        (folder / "policies").mkdir(parents=True, exist_ok=True)
        contents = {
            f"policies/{policies[-1].name}": policies[-1].read_bytes(),
            "metrics.csv": thin(run.metrics()).encode(),
            f"evaluation_{frames:012d}.json": _json(evaluation),
            "config.json": (self.run / "config.json").read_bytes(),
            "run.json": to_json(made).encode(),
        }
        for name, content in contents.items():
            write_file(folder / name, content)
        mean = 100 * evaluation["success"]["mean"]
        print(f"{folder}: {frames:,} frames, success {mean:.1f} %; now: write")


@dataclass(frozen=True, kw_only=True)
class Repeat:
    """Evaluate stored policies again, each on its bank, and store what comes out."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of stored runs."""
    num_workers: int | None = None
    """Physics threads; None: the largest divisor of the bank's size <= cores."""

    def __post_init__(self) -> None:
        """Raise ValueError if there is nothing to evaluate."""
        if not self.runs:
            raise ValueError("name the stored runs to evaluate again")

    def execute(self) -> None:
        """Evaluate the policies one after another, and say what the success was."""
        # All are read before the first is played: a bad one costs no time.
        stored = []
        for folder in self.runs:
            run = load_run(folder)
            frames = f"{run.record.frames:012d}"
            policy = load_policy(folder / "policies" / f"{frames}.safetensors")
            file = folder / f"evaluation_{frames}.json"
            stored.append((file, run, policy))
        for file, run, policy in stored:
            old = run.evaluation
            bank = (old["bank_seed"], old["episodes"], self.num_workers)
            new = figures(policy, run.judged_on, *bank)
            write_file(file, _json(new))
            now, before = (100 * x["success"]["mean"] for x in (new, old))
            print(f"{file.parent}: success {now:.1f} %, was {before:.1f} %", flush=True)


@dataclass(frozen=True, kw_only=True)
class Write:
    """Write the report and its learning curves from all stored runs."""

    results: Path = Path("results")
    """Folder of the stored runs."""
    out: Path = Path("docs/results.md")
    """Report to write; its pictures go beside it."""

    def __post_init__(self) -> None:
        """Raise ValueError if the report cannot be written."""
        check_output(self.out, "--out")

    def execute(self) -> None:
        """Write the files."""
        runs = load_runs(self.results)
        pictures = {}
        for title, group in sections(runs).items():
            name = title.lower().replace(" ", "-").removeprefix("the-")
            pictures[title] = f"{self.out.stem}-{name}.png"
            draw(group, self.out.parent / pictures[title])
        notes = self.results / "notes.md"
        hand = notes.read_text() if notes.is_file() else ""
        write_file(self.out, report(runs, pictures, hand).encode())
        number = counted(len(runs), "run")
        print(f"{self.out}: {number}, pictures {', '.join(pictures.values())}")


def figures(
    policy: Policy,
    version: Standard,
    bank_seed: int,
    episodes: int,
    num_workers: int | None,
) -> dict[str, Any]:
    """Return how a policy fares on a bank of standard throws, as it is stored."""
    result, behaviour = behave(
        policy,
        standard_task(policy.env_config, version),
        policy.skin,
        bank_seed=bank_seed,
        episodes=episodes,
        num_workers=num_workers,
    )
    return {
        **dataclasses.asdict(result),
        "standard": version,
        "bank_seed": bank_seed,
        "behaviour": dataclasses.asdict(behaviour),
    }


def _json(content: object) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()


def draw(cells: dict[str, list[StoredRun]], out: Path) -> None:
    """Write a picture of the learning curves of cells, in the paper's form."""
    figure, axes = plt.subplots(figsize=(7.2, 5.0), layout="constrained")
    for i, (name, runs) in enumerate(cells.items()):
        _draw_cell(axes, name, runs, i)
    hz = next(iter(cells.values()))[0].config.env.task.physics.control_hz
    per_hour = hz * 3600 / 1e6
    above = axes.secondary_xaxis(
        "top",
        functions=(
            lambda hours: np.asarray(hours) * per_hour,
            lambda millions: np.asarray(millions) / per_hour,
        ),
    )
    above.set_xlabel("environment steps [million]")
    axes.set_xlabel("simulated time [h]")
    axes.set_ylabel("success at 3 s, while exploring")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines["right"].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    figure.savefig(out, dpi=160, metadata={"Software": None})
    plt.close(figure)


def _draw_cell(axes: Axes, name: str, runs: list[StoredRun], number: int) -> None:
    """Draw the mean and the range of one cell."""
    seen = curve(runs)
    colour = _COLOURS[number % len(_COLOURS)]
    dash = _DASHES[number // len(_COLOURS) % len(_DASHES)]
    label = f"{name} ({counted(len(runs), 'seed')})"
    axes.plot(
        seen.hours, seen.mean, color=colour, linestyle=dash, linewidth=1.6, label=label
    )
    if len(runs) > 1:
        axes.fill_between(
            seen.hours, seen.low, seen.high, color=colour, alpha=0.18, linewidth=0
        )


def main(args: list[str]) -> None:
    """Run the command."""
    commands = {"add": Add, "repeat": Repeat, "write": Write}
    parse_subcommand(commands, args).execute()


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
