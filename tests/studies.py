"""Finished runs of a study with invented results, as input of a report."""

from __future__ import annotations

import json
import math
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import egoskin
from egoskin.runs.run import Run
from egoskin.storage.formats import content_hash, read_sealed, sealed_json
from egoskin.study.folder import StudyFolder, policy_hash
from egoskin.study.manifest import Manifest, PlannedRun
from egoskin.study.stored import Record, to_json

POLICY = Path(egoskin.__file__).parent / "assets/policies/blind.safetensors"
_HASH = policy_hash(POLICY)

# Success at 3 s that a signal would reach with a range of 2 m [%].
_BEST = {"localization": 66, "proximity": 64, "binary": 60}


def expected(run: PlannedRun) -> float:
    """Success [%] of a run if the paper is partly right."""
    sensor = run.config.env.sensor
    if not sensor.uses_skin:
        return 3.0
    success = _BEST[sensor.signal] * (1 - math.exp(-2.2 * sensor.range))
    if sensor.coverage == "ray":
        full = sensor.reduce == "none" and sensor.signal != "localization"
        success *= 0.25 if full else 0.85
    return success


def as_format_1(path: Path) -> None:
    """Convert a manifest or a configuration to format 1."""
    content, _ = read_sealed(path)
    base = content.get("base", content)
    throws = base["env"]["task"]["throws"]
    # In format 1, first_delay and another aim did not exist, and these options did.
    throws.pop("first_delay")
    throws.pop("aim")
    base["compile_kernels"] = True
    base["env"]["sensor"]["numb"] = False
    if "cells" in content:
        content["cells"][0]["overrides"]["compile_kernels"] = False
    sealed = {"format": 1, "egoskin": "0.0.1", **content}
    sealed["sha256"] = content_hash(sealed)
    path.write_text(json.dumps(sealed))


def estimate(mean: float, half: float = 0.01) -> dict[str, float]:
    return {"mean": mean, "low": mean - half, "high": mean + half}


def store(
    folder: StudyFolder, manifest: Manifest, run: PlannedRun, success: float
) -> None:
    """Store a run as finished, with a success [%]."""
    path, end = folder.result_path(run.name), run.end
    (path / "policies").mkdir(parents=True)
    Run(path, run.config).write_config()
    shutil.copy(POLICY, path / "policies" / f"{end:012d}.safetensors")
    record = Record(
        command="python scripts/ppo.py",
        commit="0123456",
        seed=run.seed,
        frames=end,
        wall_s=3600.0,
        machine="Linux",
    )
    (path / "run.json").write_text(to_json(record))
    share = success / 100
    # It rises to 63 % of its end in a fifth of the frames.
    lines = ["frames,time/wall_s,episode/success"]
    for i in range(1, 101):
        lines.append(f"{end * i // 100},{i},{share * (1 - math.exp(-i / 20)):.6g}")
    (path / "metrics.csv").write_text("\n".join(lines) + "\n")
    skinned = run.config.env.sensor.uses_skin
    evaluation = {
        "run": run.name,
        "policy_sha256": _HASH,
        "success": estimate(share),
        "success_5s": estimate(share / 2),
        "survival_time": estimate(1 + 6 * share),
        "ended_by_ball": 0.9 * (1 - share),
        "ended_by_fall": 0.1 * (1 - share),
        "ended_by_self_contact": 0.0,
        "diverged": 0.0,
        "rigid_success": 0.0,
        "avoided": {"first_ball": share, "later_balls": 0.8 * share or None},
        "episodes": manifest.evaluation.episodes,
        "masked": {"success": estimate(0.01)} if skinned else None,
        "standard": manifest.evaluation.standard,
        "trained_on": run.config.env.standard,
        "throw_set": manifest.evaluation.throw_set,
        "frames": end,
    }
    (path / f"evaluation_{end:012d}.json").write_bytes(sealed_json(evaluation))


def store_all(
    folder: StudyFolder,
    manifest: Manifest,
    *,
    spread: float = 4.0,
    keep: Callable[[PlannedRun], bool] = lambda run: True,
) -> None:
    """Store the runs of a study, seeds apart by a standard deviation [points]."""
    draw = random.Random(0)
    for run in manifest.runs:
        success = min(max(draw.gauss(expected(run), spread), 0.0), 100.0)
        if keep(run):
            store(folder, manifest, run, success)
