"""Evaluate a policy on a fixed bank of throws.

python scripts/evaluate.py runs/NAME
python scripts/evaluate.py localization
python scripts/evaluate.py runs/NAME/policies/000005046272.safetensors --json out.json
python scripts/evaluate.py runs/NAME --behaviour --check-substeps 8
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from egoskin.behaviour import Behaviour, Motion, behave
from egoskin.cli import check_counts, check_output, clear_errors, counted
from egoskin.draws import check_seed
from egoskin.evaluation import Estimate, Evaluation, evaluate, standard_task
from egoskin.make import EnvConfig, check_num_workers
from egoskin.policies import load_policy
from egoskin.report import metres


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Play a bank of throws with the mean action of a trained policy."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package."""
    bank_seed: int = 0
    """Seed of the bank of throws."""
    episodes: int = 1024
    """Throw sequences in the bank."""
    throw: Literal["standard", "run"] = "standard"
    """The standard throw and ends of an episode whatever the run trained on, or the
    run's own."""
    num_workers: int | None = None
    """Processes that simulate; None: the largest divisor of episodes <= cores."""
    behaviour: bool = False
    """Also say what the policy does: hits by kind of throw, displacement, effort."""
    check_substeps: int | None = None
    """Play the bank once more with this many physics steps in each control step, and
    say what is lost (8: 480 Hz)."""
    numb: bool = False
    """Play the bank once more with sensors that are told of no ball, and say what is
    lost: the rest is done blindly."""
    json: Path | None = None
    """File to write the figures to."""

    def __post_init__(self) -> None:
        """Raise ValueError for values with which nothing can be played."""
        check_seed(self.bank_seed, "bank_seed")
        check_counts(self, "check_substeps")
        check_num_workers(self.episodes, self.num_workers, "episodes")
        check_output(self.json, "--json")


def share(value: float | None) -> str:
    """Return a share as text, a dash for None."""
    return "     -" if value is None else f"{100 * value:6.2f} %"


def table(result: Evaluation, title: str, age: float) -> str:
    """Return the figures as text, with the age of success [s]."""

    def interval(value: Estimate, scale: float, unit: str) -> str:
        mean, low, high = (scale * v for v in (value.mean, value.low, value.high))
        return f"{mean:6.2f} {unit}  ({low:.2f} to {high:.2f})"

    ends = {
        "a ball": result.ended_by_ball,
        "a fall": result.ended_by_fall,
        "self-contact": result.ended_by_self_contact,
        "divergence": result.diverged,
    }
    rows = [
        (f"success (no contact for {age:g} s)", interval(result.success, 100, "%")),
        ("  same bank, robot held rigid", share(result.rigid_success)),
        ("survival time (at most 10 s)", interval(result.survival_time, 1, "s")),
        *((f"ended within {age:g} s by {how}", share(x)) for how, x in ends.items()),
        ("first balls avoided", share(result.avoided.first_ball)),
        ("later balls avoided", share(result.avoided.later_balls)),
    ]
    lines = [f"  {name:<32} {value}" for name, value in rows]
    return "\n".join([title, *lines, "  (95 % intervals in brackets)"])


def behaviour_table(result: Behaviour) -> str:
    """Return what the policy does as text."""
    lines = []
    for kind, groups in result.throws.items():
        lines += ["", f"  {kind:<20} {'success':>8}   of  first hits  later hits   of"]
        for group in groups:
            success = None if group.success is None else group.success.mean
            lines.append(
                f"    {group.name:<18} {share(success)} {group.episodes:4}    "
                f"{share(group.first_hits)}    {share(group.later_hits)} "
                f"{group.later_balls:4}"
            )
    lines += ["", "  way from the start     mean   a tenth exceeds  base height     of"]
    for way in result.displacement:
        lines.append(
            f"    after {way.age:g} s       {metres(way.mean):>8} "
            f"{metres(way.largest_tenth):>16} {metres(way.height):>12} {way.episodes:6}"
        )
    lines += ["", f"  {'':<32}{'policy':>10} {'zero action':>13}"]

    def row(name: str, unit: str, show: Callable[[Motion], float]) -> str:
        own, zero = show(result.motion), show(result.motion_zero_action)
        return f"  {name:<32}{own:10.3g} {zero:13.3g} {unit}"

    return "\n".join(
        [
            *lines,
            row("mechanical power", "W", lambda m: m.power),
            row("joint acceleration, rms", "rad/s^2", lambda m: m.joint_acceleration),
            row("torques at their limit", "%", lambda m: 100 * m.torque_saturation),
            row("feet slide, while on the floor", "cm/s", lambda m: 100 * m.foot_slip),
            row("steps without floor contact", "%", lambda m: 100 * m.airborne),
            row("steps with self-contact", "%", lambda m: 100 * m.self_contact),
        ]
    )


def with_substeps(config: EnvConfig, substeps: int) -> EnvConfig:
    """Return the configuration with another number of physics steps."""
    physics = dataclasses.replace(config.task.physics, substeps=substeps)
    task = dataclasses.replace(config.task, physics=physics)
    return dataclasses.replace(config, task=task)


def physics_rate(config: EnvConfig) -> str:
    """Return the physics rate as text."""
    return f"{1 / config.task.physics.timestep:g} Hz"


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(EvaluateConfig, args=args)
    policy = load_policy(config.policy)
    env_config = policy.env_config
    if config.throw == "standard":
        env_config = standard_task(env_config)

    def show(step: int, running: int) -> None:
        if sys.stderr.isatty():
            text = f"\r{step / env_config.task.physics.control_hz:5.2f} s, "
            print(f"{text}{running} still running \x1b[K", end="", file=sys.stderr)

    bank: dict[str, Any] = {
        "bank_seed": config.bank_seed,
        "episodes": config.episodes,
        "num_workers": config.num_workers,
        "on_step": show,
    }
    behaviour = None
    if config.behaviour:
        result, behaviour = behave(policy, env_config, policy.skin, **bank)
    else:
        result = evaluate(policy, env_config, policy.skin, **bank)
    # Under each one's name: what is changed, and how the success lost by it is called.
    changes: dict[str, tuple[EnvConfig, str]] = {}
    if config.check_substeps is not None:
        changed = with_substeps(env_config, config.check_substeps)
        changes["checked"] = changed, "by the other physics rate"
    if config.numb:
        sensor = dataclasses.replace(env_config.sensor, numb=True)
        changed = dataclasses.replace(env_config, sensor=sensor)
        changes["numb"] = changed, "without what the sensors tell"
    again = {
        name: evaluate(policy, changed, policy.skin, **bank)
        for name, (changed, _) in changes.items()
    }
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    title = (
        f"{config.policy}: {policy.policy_spec.frames:,} frames; bank "
        f"{config.bank_seed} of {counted(config.episodes, 'episode')}, "
        f"{config.throw} throw, physics at "
    )
    age = env_config.task.success_s
    print(table(result, title + physics_rate(env_config), age))
    content = dataclasses.asdict(result)
    if behaviour is not None:
        print(behaviour_table(behaviour))
        content["behaviour"] = dataclasses.asdict(behaviour)
    if config.check_substeps is not None:
        content["check_substeps"] = config.check_substeps
    for name, (changed, how) in changes.items():
        rate = physics_rate(changed) + ", sensors numb" * changed.sensor.numb
        print("\n" + table(again[name], title + rate, age))
        lost = 100 * (result.success.mean - again[name].success.mean)
        print(f"  success lost {how}: {lost:.2f} points")
        content[name] = dataclasses.asdict(again[name])
    if config.json is not None:
        config.json.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
