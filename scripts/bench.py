"""Measure how fast and how exact the parts of the project are.

python scripts/bench.py loop --json loop.json
python scripts/bench.py sensors
python scripts/bench.py physics
python scripts/bench.py accuracy
python scripts/bench.py gradients --run runs/NAME
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import sys

import tyro

from benchmarks.accuracy import AccuracyBench, accuracy_rows
from benchmarks.gradients import GradientBench, gradient_rows
from benchmarks.loop import LoopConfig, loop
from benchmarks.physics import PhysicsBench, physics_rows
from benchmarks.report import report
from benchmarks.sensors import SensorBench, sensor_rows
from egoskin.cli import check_output, clear_errors


def main(args: list[str]) -> None:
    """Run the command."""
    benches = {
        "loop": LoopConfig,
        "physics": PhysicsBench,
        "sensors": SensorBench,
        "accuracy": AccuracyBench,
        "gradients": GradientBench,
    }
    config = tyro.extras.subcommand_cli_from_dict(benches, args=args)
    check_output(config.json, "--json")
    if isinstance(config, LoopConfig):
        rows = loop(config)
    elif isinstance(config, PhysicsBench):
        rows = physics_rows(config)
    elif isinstance(config, AccuracyBench):
        rows = accuracy_rows(config)
    elif isinstance(config, GradientBench):
        rows = gradient_rows(config)
    else:
        rows = sensor_rows(config)
    report(rows, config.json)


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
