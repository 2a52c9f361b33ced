"""Measure the speed and accuracy of parts of the project.

egoskin bench loop --json loop.json
egoskin bench sensors
egoskin bench physics
egoskin bench engine --device cuda
egoskin bench accuracy
egoskin bench gradients --run runs/NAME
egoskin bench gymnasium
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from egoskin.commands.bench.accuracy import AccuracyBench, accuracy_rows
from egoskin.commands.bench.engine import EngineBench, engine_rows
from egoskin.commands.bench.gradients import GradientBench, gradient_rows
from egoskin.commands.bench.gymnasium import GymnasiumBench, gymnasium_rows
from egoskin.commands.bench.loop import LoopConfig, loop
from egoskin.commands.bench.physics import PhysicsBench, physics_rows
from egoskin.commands.bench.report import Row, report
from egoskin.commands.bench.sensors import SensorBench, sensor_rows
from egoskin.commands.errors import parse_subcommand
from egoskin.storage.files import check_output

# Options of each benchmark, and the function that measures.
_BENCHES: dict[str, tuple[type, Callable[[Any], list[Row]]]] = {
    "loop": (LoopConfig, loop),
    "physics": (PhysicsBench, physics_rows),
    "engine": (EngineBench, engine_rows),
    "sensors": (SensorBench, sensor_rows),
    "accuracy": (AccuracyBench, accuracy_rows),
    "gradients": (GradientBench, gradient_rows),
    "gymnasium": (GymnasiumBench, gymnasium_rows),
}


def main(args: list[str]) -> None:
    """Run the command."""
    config = parse_subcommand({k: kind for k, (kind, _) in _BENCHES.items()}, args)
    check_output(config.json, "--json")
    measure = dict(_BENCHES.values())[type(config)]
    report(measure(config), config.json)
