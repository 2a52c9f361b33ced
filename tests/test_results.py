"""Stored runs: cells and seeds, statistics by hand, and a report that is up to date."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egoskin.report import (
    curve,
    interquartile_mean,
    interquartile_range,
    recipe_names,
    report,
    sections,
    table,
)
from egoskin.results import (
    Record,
    cells,
    load_runs,
    record,
    same_but_length,
    thin,
    to_json,
)
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.storage.serialization import to_plain

ROOT = Path(__file__).parents[1]
RECORD = Record(
    command="python scripts/ppo.py",
    commit="0123456",
    seed=0,
    frames=1000,
    wall_s=1800.0,
    machine="Linux",
)


def evaluation(success: float, way: float | None = None) -> dict[str, Any]:
    result: dict[str, Any] = {
        "success": {"mean": success, "low": success - 0.02, "high": success + 0.02},
        "survival_time": {"mean": 2.5, "low": 2.4, "high": 2.6},
        "ended_by_fall": 0.1,
        "rigid_success": 0.004,
        "avoided": {"first_ball": 0.8, "later_balls": None},
        "episodes": 4096,
    }
    if way is not None:
        ages = [
            {"age": 2.0, "mean": 9.0, "episodes": 4000},
            {"age": 3.0, "mean": way, "episodes": 2000},
            {"age": 5.0, "mean": None, "episodes": round(256 * way)},
        ]
        result["behaviour"] = {"displacement": ages}
    return result


def config(seed: int = 0, **env: Any) -> TrainConfig:
    """Configuration of a run; options of the sensor by name."""
    default = TrainConfig()
    sensor = dataclasses.replace(default.env.sensor, **env)
    return dataclasses.replace(
        default, seed=seed, env=dataclasses.replace(default.env, sensor=sensor)
    )


def store(
    folder: Path,
    name: str,
    config: TrainConfig,
    success: float = 0.5,
    curve: str = "216000,0.1\n432000,0.3\n",
    **options: Any,
) -> None:
    path = folder / name
    path.mkdir(parents=True)
    (path / "config.json").write_text(json.dumps(to_plain(config)))
    made = dataclasses.replace(RECORD, seed=config.seed)
    (path / "run.json").write_text(to_json(made))
    (path / "metrics.csv").write_text("frames,episode/success\n" + curve)
    content = evaluation(success, **options)
    (path / "evaluation_000000001000.json").write_text(json.dumps(content))


def test_interquartile_statistics_by_hand():
    assert interquartile_mean([7.0]) == 7.0
    assert interquartile_mean([3.0, 1.0]) == 2.0
    # Of three, the outer count a quarter each: (0.25 * 0 + 3 + 0.25 * 9) / 1.5.
    assert interquartile_mean([9.0, 0.0, 3.0]) == pytest.approx(3.5)
    # Of four, two are left; of ten, the third and the eighth count half.
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    ten = [0.0, 0, 2, 4, 4, 4, 4, 8, 99, 99]
    assert interquartile_mean(ten) == pytest.approx((1 + 16 + 4) / 5)
    assert interquartile_range([0.0, 1, 2, 3, 4]) == (1.0, 3.0)
    assert interquartile_range([5.0]) == (5.0, 5.0)


def test_seeds_of_one_configuration_are_a_cell(tmp_path: Path):
    store(tmp_path, "b", config(1))
    store(tmp_path, "a", dataclasses.replace(config(0), total_frames=7, num_workers=2))
    store(tmp_path, "c", config(0, coverage="none"))
    store(tmp_path, "d", config(0, coverage="oracle"))
    store(tmp_path, "e", config(0, coverage="ray", reduce="min", range=float("inf")))
    slow = dataclasses.replace(config(0), ppo=TrainConfig().ppo)
    slow = dataclasses.replace(slow, ppo=dataclasses.replace(slow.ppo, gamma=0.9))
    store(tmp_path, "f", slow)
    found = {
        key: [r.name for r in runs] for key, runs in cells(load_runs(tmp_path)).items()
    }
    assert list(found.items()) == [
        (("", "oracle"), ["d"]),
        (("", "field proximity, 2 m"), ["a", "b"]),
        (("", "ray proximity, any range, sensor.reduce=min"), ["e"]),
        (("", "blind"), ["c"]),
        (("ppo.gamma=0.9", "field proximity, 2 m"), ["f"]),
    ]
    titles = {t: list(g) for t, g in sections(load_runs(tmp_path)).items()}
    assert titles["Other recipes"] == ["field proximity, 2 m; recipe A"]
    assert recipe_names(load_runs(tmp_path)) == {"ppo.gamma=0.9": "A"}
    assert len(titles["The default recipe"]) == 4


def test_a_table_has_a_line_for_each_seed_and_one_for_all(tmp_path: Path):
    for seed, success in enumerate((0.2, 0.5, 0.35)):
        store(tmp_path, f"run{seed}", config(seed), success, way=1.0 + seed)
    (group,) = sections(load_runs(tmp_path)).values()
    lines = table(group).splitlines()
    assert len(lines) == 2 + 3 + 1
    assert lines[2] == (
        "| field proximity, 2 m | 2, judged on 1 | 0 | 0.0 M | 4,096 "
        "| 20.0 % (18.0 to 22.0) | 6.2 % | 2.50 s | 80.0 % | - | 10.0 % | 1.00 m |"
    )
    # Interquartile mean 0.35 by symmetry; quartiles half way: 0.275 and 0.425.
    assert "3 seeds" in lines[5]
    assert "**35.0 %** (27.5 to 42.5) | 12.5 % |" in lines[5]
    assert lines[5].endswith("| 2.00 m |")


def test_a_curve_goes_as_far_as_all_its_seeds(tmp_path: Path):
    # 216,000 environment steps at 60 Hz are an hour.
    store(tmp_path, "a", config(0), curve="216000,nan\n432000,0.2\n648000,0.4\n")
    store(tmp_path, "b", config(1), curve="216000,0.0\n540000,0.3\n")
    store(tmp_path, "c", config(2), curve="108000,0.9\n540000,0.9\n")
    ((_, runs),) = cells(load_runs(tmp_path)).items()
    seen = curve(runs)
    np.testing.assert_allclose(seen.hours, [2.0])
    # 0.2, 0.2 (two thirds of the way from 0 to 0.3) and 0.9.
    np.testing.assert_allclose(seen.mean, [(0.05 + 0.2 + 0.225) / 1.5])
    np.testing.assert_allclose(seen.low, [0.2])
    np.testing.assert_allclose(seen.high, [0.55])


def test_a_seed_that_has_no_curve_yet_leaves_none(tmp_path: Path):
    store(tmp_path, "a", config(0))
    store(tmp_path, "b", config(1), curve="216000,nan\n")
    (runs,) = cells(load_runs(tmp_path)).values()
    assert len(curve(runs).hours) == len(curve(runs).mean) == 0


def test_thinned_metrics_keep_a_line_for_each_block_and_the_last():
    lines = [f"{n * 65536},{n / 3}" for n in range(1, 11)]
    kept = thin("\n".join(["frames,x", *lines])).splitlines()
    # Blocks of 2**18 = 4 x 65536: lines 1 (in block 0), 4, 8 and the last, 10.
    assert kept[0] == "frames,x"
    assert [int(line.split(",")[0]) // 65536 for line in kept[1:]] == [1, 4, 8, 10]
    assert kept[1].endswith(",0.333333")
    # What is thin stays as it is.
    assert thin("\n".join(kept)).splitlines() == kept
    assert thin("frames,x\n") == "frames,x\n"


def test_a_record_says_what_was_run_but_not_where(tmp_path: Path):
    run = Run(tmp_path, config(4))
    (tmp_path / "metrics.csv").write_text(
        "frames,time/wall_s\n100,1.5\n200,3.5\n300,9.0\n"
    )
    with pytest.raises(ValueError, match=r"no versions\.json"):
        record(run, 200)
    start = {
        "command": ["/some/where/ppo.py", "--run-dir", "/x", "--seed", "4"],
        "python": "3.11.7",
        "machine": "Linux x86_64",
        "cores": 2,
        "packages": {"torch": "2.13", "mujoco": "4.0"},
        "git": {"commit": "0123456789", "changed": True},
    }
    again = {**start, "command": ["ppo.py", "--resume=/x"], "git": None}
    (tmp_path / "versions.json").write_text(json.dumps([start, again]))
    made = record(run, 200)
    assert made.command == "python scripts/ppo.py --seed 4"
    assert made.commit == "0123456+, unknown"
    assert (made.seed, made.frames, made.wall_s) == (4, 200, 3.5)
    assert made.machine == (
        "Linux x86_64, 2 cores, Python 3.11.7, torch 2.13, mujoco 4.0"
    )


def test_a_run_is_its_longer_self_but_no_other_seed():
    longer = dataclasses.replace(config(), total_frames=10**8, num_workers=1)
    assert same_but_length(config(), longer)
    assert not same_but_length(config(), config(1))
    assert not same_but_length(config(), config(range=1.0))


@pytest.mark.parametrize("missing", ["run.json", "metrics.csv", "evaluation"])
def test_a_folder_that_is_not_whole_is_named(missing, tmp_path: Path):
    store(tmp_path, "half", config())
    for path in (tmp_path / "half").glob(f"{missing}*"):
        path.unlink()
    with pytest.raises(ValueError, match=rf"half is not whole: .*{missing}"):
        load_runs(tmp_path)


def test_the_report_is_that_of_the_stored_runs():
    # If this fails: python scripts/results.py write
    text = (ROOT / "docs" / "results.md").read_text()
    runs = load_runs(ROOT / "results")
    pictures = dict(
        zip(sections(runs), re.findall(r"!\[.*\]\((.*)\)", text), strict=True)
    )
    notes = (ROOT / "results" / "notes.md").read_text()
    assert text == report(runs, pictures, notes)
    for picture in pictures.values():
        assert (ROOT / "docs" / picture).is_file()
