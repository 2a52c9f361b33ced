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

from egoskin.commands.bench.accuracy import AccuracyBench, accuracy_rows
from egoskin.commands.bench.engine import EngineBench, engine_rows
from egoskin.commands.bench.gradients import GradientBench, gradient_rows
from egoskin.commands.bench.gymnasium import GymnasiumBench, gymnasium_rows
from egoskin.commands.bench.loop import LoopConfig, loop
from egoskin.commands.bench.physics import PhysicsBench, physics_rows
from egoskin.commands.bench.report import report
from egoskin.commands.bench.sensors import SensorBench, sensor_rows
from egoskin.commands.errors import parse_subcommand
from egoskin.storage.files import check_output


def main(args: list[str]) -> None:
    """Run the command."""
    benches = {
        "loop": LoopConfig,
        "physics": PhysicsBench,
        "engine": EngineBench,
        "sensors": SensorBench,
        "accuracy": AccuracyBench,
        "gradients": GradientBench,
        "gymnasium": GymnasiumBench,
    }
    config = parse_subcommand(benches, args)
    check_output(config.json, "--json")
    if isinstance(config, LoopConfig):
        rows = loop(config)
    elif isinstance(config, PhysicsBench):
        rows = physics_rows(config)
    elif isinstance(config, EngineBench):
        rows = engine_rows(config)
    elif isinstance(config, AccuracyBench):
        rows = accuracy_rows(config)
    elif isinstance(config, GradientBench):
        rows = gradient_rows(config)
    elif isinstance(config, GymnasiumBench):
        rows = gymnasium_rows(config)
    else:
        rows = sensor_rows(config)
    report(rows, config.json)
