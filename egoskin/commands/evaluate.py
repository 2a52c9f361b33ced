"""Evaluate a policy on a fixed throw set.

egoskin evaluate runs/NAME
egoskin evaluate localization
egoskin evaluate runs/NAME/policies/000005046272.safetensors --json out.json
egoskin evaluate runs/NAME --behaviour --check-substeps 8
egoskin evaluate runs/NAME --mask
egoskin evaluate runs/NAME --perturbed
egoskin evaluate runs/NAME --skin worn.json
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from egoskin.bounds import COUNT, check_bounds
from egoskin.commands.errors import check_packages
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import Engine, engine_of
from egoskin.evaluation.behaviour import Behaviour, Motion, behave
from egoskin.evaluation.operating_map import check_map, draw_map, operating_map
from egoskin.evaluation.perturbations import Perturbed, perturb
from egoskin.evaluation.throw_set import (
    LATER,
    Estimate,
    Evaluation,
    evaluate,
    standard_task,
)
from egoskin.make import EnvConfig, check_num_workers, device_of
from egoskin.parallel import default_num_workers
from egoskin.policies.policy import Policy, PolicySpec, load_policy
from egoskin.progress import StatusLine, counted
from egoskin.rng import check_seed
from egoskin.sensors import MASK_ALL, Skin
from egoskin.storage.files import check_output, write_figure
from egoskin.storage.serialization import write_json

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Play a throw set with the mean action of a trained policy."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package."""
    throw_set: int = 0
    """Seed of the throw set."""
    episodes: Annotated[int, COUNT] = 1024
    """Throw sequences in the throw set."""
    standard: Literal["2", "1", "paper", "run"] = "2"
    """Version of the standard throw to play, independent of the policy's training;
    run: the throws and terminations of its training, without its randomisation."""
    mask: tuple[str, ...] | None = None
    """Links whose sensors are masked, by name or shell pattern; alone: all sensors. The
    success that remains does not depend on them."""
    skin: Path | None = None
    """Skin file to wear instead of that of the training, with as many readings:
    sensors moved, turned or with other ranges, in the order that the policy knows."""
    num_workers: int | None = None
    """Simulation processes; None: the largest divisor of episodes <= cores."""
    behaviour: bool = False
    """Also report the behaviour: hits by kind of throw, displacement, effort."""
    check_substeps: Annotated[int | None, COUNT] = None
    """Evaluate again with this many physics steps per control step, and report the loss
    of success (8: 480 Hz)."""
    map: Path | None = None
    """Picture to write: success against speed, interval, height and direction of the
    throws, within and beyond those of training (a quarter of the episodes each)."""
    perturbed: bool = False
    """Also evaluate on perturbed robots: other masses, friction, gains and torque
    limits, delayed actions, pushes (a quarter of the episodes each)."""
    engine: Engine = "mujoco"
    """Physics engine: MuJoCo on the CPU; MuJoCo Warp on the device (extra gpu)."""
    device: str = "cpu"
    """Device of engine warp ("cpu", "cuda", "cuda:1")."""
    json: Path | None = None
    """JSON file to write the results to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_seed(self.throw_set, "throw_set")
        check_bounds(self)
        check_num_workers(self.episodes, self.num_workers, "episodes", self.engine)
        check_output(self.json, "--json")
        check_output(self.map, "--map", PICTURE_SUFFIXES)
        if self.map is not None:
            if self.json is not None and self.json.resolve() == self.map.resolve():
                raise ValueError(f"--json and --map are the same file: {self.map}")
            check_packages("--map", "plot", "matplotlib")
        engine_of(self.engine)
        if self.engine == "mujoco" and device_of(self.device).type != "cpu":
            raise ValueError("engine mujoco simulates on the CPU: leave out device")
        if self.engine == "warp" and (self.behaviour or self.map or self.perturbed):
            raise ValueError(
                "behaviour, map and perturbed are only available with engine mujoco"
            )

    @property
    def masked(self) -> tuple[str, ...]:
        """The mask as `egoskin.evaluation.throw_set` takes it."""
        if self.mask is None:
            return ()
        return self.mask or MASK_ALL


def share(value: float | None) -> str:
    """Return a share as text, a dash for None."""
    return "     -" if value is None else f"{100 * value:6.2f} %"


def _later(task: DodgeballConfig) -> float:
    """Return the second age at which success counts [s]."""
    return min(LATER, task.episode_length_s)


def table(result: Evaluation, title: str, task: DodgeballConfig) -> str:
    """Return the results on a task as text."""
    age, end = task.success_age_s, task.episode_length_s
    later = _later(task)

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
        (f"  no contact for {later:g} s", interval(result.success_5s, 100, "%")),
        ("  same throws, robot held rigid", share(result.rigid_success)),
        (f"survival time (at most {end:g} s)", interval(result.survival_time, 1, "s")),
        *((f"ended within {age:g} s by {how}", share(x)) for how, x in ends.items()),
        ("first balls avoided", share(result.avoided.first_ball)),
        ("later balls avoided", share(result.avoided.later_balls)),
    ]
    lines = [f"  {name:<32} {value}" for name, value in rows]
    return "\n".join([title, *lines, "  (95 % intervals in brackets)"])


def _number(value: float | None, form: str) -> str:
    """Return a number as text, a dash for None."""
    return f"{'-':>7}" if value is None else format(value, form)


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m"


def behaviour_table(result: Behaviour) -> str:
    """Return the behaviour of a policy as text."""
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
    if result.waiting is not None:
        waiting = result.waiting
        lines += [
            "",
            "  before the first throw, from 0.5 s on",
            f"    base speed       {_number(waiting.base_speed, '7.3f')} m/s",
            f"    mechanical power {_number(waiting.power, '7.1f')} W",
            f"    fallen           {share(waiting.fallen)}",
        ]
    lines += ["", "  distance from start    mean   90th percentile  base height     of"]
    for way in result.displacement:
        lines.append(
            f"    after {way.age:g} s       {_metres(way.mean):>8} "
            f"{_metres(way.largest_tenth):>16} {_metres(way.height):>12} "
            f"{way.episodes:6}"
        )
    lines += ["", f"  {'':<32}{'policy':>10} {'zero action':>13}"]

    def row(name: str, unit: str, show: Callable[[Motion], float | None]) -> str:
        motions = result.motion, result.motion_zero_action
        own, zero = ("-" if x is None else f"{x:.3g}" for x in map(show, motions))
        return f"  {name:<32}{own:>10} {zero:>13} {unit}"

    return "\n".join(
        [
            *lines,
            row("mechanical power", "W", lambda m: m.power),
            row("joint acceleration, rms", "rad/s^2", lambda m: m.joint_acceleration),
            row("torques at their limit", "%", lambda m: 100 * m.torque_saturation),
            row("feet slide, while on the floor", "cm/s", _slip),
            row("steps without floor contact", "%", lambda m: 100 * m.airborne),
            row("steps with self-contact", "%", lambda m: 100 * m.self_contact),
        ]
    )


def _slip(motion: Motion) -> float | None:
    """Return the sliding speed of the feet [cm/s], None if there is none."""
    return None if motion.foot_slip is None else 100 * motion.foot_slip


def perturbed_table(rows: list[Perturbed], task: DodgeballConfig, episodes: int) -> str:
    """Return success under each perturbation as text; success as in `table`."""
    age, later = task.success_age_s, _later(task)
    lines = [
        f"\n  {counted(episodes, 'episode')} each",
        f"  {'perturbed by':<26} {f'{age:g} s':>8}  {'(95 % interval)':<16} "
        f"{f'{later:g} s':>8}  ended by a fall",
    ]
    for row in rows:
        low, high = (100 * x for x in (row.success.low, row.success.high))
        lines.append(
            f"  {row.name:<26} {share(row.success.mean)}  "
            f"{f'({low:.1f} to {high:.1f})':<16} {share(row.success_5s.mean)}  "
            f"{share(row.ended_by_fall)}"
        )
    return "\n".join(lines)


def with_substeps(config: EnvConfig, substeps: int) -> EnvConfig:
    """Return the configuration with other physics steps per control step."""
    physics = dataclasses.replace(config.task.physics, substeps=substeps)
    task = dataclasses.replace(config.task, physics=physics)
    return dataclasses.replace(config, task=task)


def physics_rate(config: EnvConfig) -> str:
    """Return the physics rate as text."""
    return f"{1 / config.task.physics.timestep:g} Hz"


def title_of(config: EvaluateConfig, spec: PolicySpec, episodes: int) -> str:
    """Return which policy is evaluated on which throws, as text."""
    of_training = config.standard == "run"
    throws = (
        "the throws of its training" if of_training else f"standard {config.standard}"
    )
    text = (
        f"{config.policy}: trained for {spec.frames:,} frames "
        f"on standard {spec.env.standard}; evaluated on {throws}, "
        f"throw set {config.throw_set} of {counted(episodes, 'episode')}"
    )
    if config.skin is not None:
        text += f", skin {config.skin}"
    if config.masked:
        text += f", sensors masked: {', '.join(config.masked)}"
    if config.engine != "mujoco":
        text += f", engine {config.engine}"
    return text


def worn_skin(policy: Policy, path: Path | None) -> Skin:
    """Return the skin to evaluate a policy with: that of its training, or of a file.

    Raises:
        ValueError: If the policy reads no skin, or the file's does not fit the robot or
            has another number of readings.
    """
    if path is None:
        return policy.skin
    config, skin = policy.env_config, Skin.load(path)
    if not config.sensor.uses_skin:
        raise ValueError(f"{path}: the policy reads no skin")
    robot = config.robot_config
    skin.check_robot(robot.name, robot.links, str(path))
    worn, known = (config.pipeline(each).signal_size for each in (skin, policy.skin))
    if worn != known:
        raise ValueError(
            f"{path}: the skin gives {worn} readings, but the policy was trained with "
            f"{known}"
        )
    return skin


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(EvaluateConfig, args=args)
    policy = load_policy(config.policy)
    env_config = standard_task(policy.env_config, config.standard)
    skin = worn_skin(policy, config.skin)
    env_config.pipeline(skin).check_mask(config.masked)
    if config.map is not None:
        check_map(env_config)
    line = StatusLine(f"playing {counted(config.episodes, 'episode')}")
    hz = env_config.task.physics.control_hz

    def on_step(step: int, running: int) -> None:
        line.show(f"{step / hz:.2f} s played, {running} episodes still running")

    def counting(what: str) -> Callable[[int, int], None]:
        return lambda done, total: line.show(f"{what}: {done} of {total}")

    which: dict[str, Any] = {
        "throw_set": config.throw_set,
        "episodes": config.episodes,
        "num_workers": config.num_workers,
        "mask": config.masked,
    }
    engine: dict[str, Any] = {"engine": config.engine, "device": config.device}
    whole: dict[str, Any] = which | {"on_step": on_step}
    subject = policy, env_config, skin
    # For evaluations that are repeated many times.
    episodes, workers = max(config.episodes // 4, 1), config.num_workers
    workers = workers and default_num_workers(episodes, workers)
    quarter = which | {"episodes": episodes, "num_workers": workers}
    behaviour = checked = None
    substeps = config.check_substeps or env_config.task.physics.substeps
    finer = with_substeps(env_config, substeps)
    if config.behaviour:
        result, behaviour = behave(*subject, **whole)
    else:
        result = evaluate(*subject, **whole, **engine)
    if config.check_substeps is not None:
        checked = evaluate(policy, finer, skin, **whole, **engine)
    line.finish()
    spec, of_training = policy.policy_spec, config.standard == "run"
    title = title_of(config, spec, config.episodes) + ", physics at "
    task = env_config.task
    print(table(result, title + physics_rate(env_config), task))
    content = {
        **dataclasses.asdict(result),
        "policy": str(config.policy),
        "standard": spec.env.standard if of_training else config.standard,
        "throws_of_training": of_training,
        "trained_on": spec.env.standard,
        "throw_set": config.throw_set,
        "frames": spec.frames,
        "mask": config.masked,
        "skin": config.skin and str(config.skin),
        "engine": config.engine,
        "trained_by_engine": spec.engine,
    }
    if behaviour is not None:
        print(behaviour_table(behaviour))
        content["behaviour"] = dataclasses.asdict(behaviour)
    if checked is not None:
        print("\n" + table(checked, title + physics_rate(finer), task))
        lost = 100 * (result.success.mean - checked.success.mean)
        print(f"  success lost with the other physics rate: {lost:.2f} points")
        content["check_substeps"] = config.check_substeps
        content["checked"] = dataclasses.asdict(checked)
    if config.perturbed:
        rows = perturb(*subject, **quarter, on_point=counting("perturbed"))
        line.finish()
        print(perturbed_table(rows, task, episodes))
        content["perturbed_episodes"] = episodes
        content["perturbed"] = [dataclasses.asdict(row) for row in rows]
    if config.map is not None:
        lines = operating_map(
            *subject,
            **quarter,
            trained=spec.env.task.throws,
            on_point=counting("map"),
        )
        line.finish()
        figure = draw_map(lines, title_of(config, spec, episodes), task.success_age_s)
        write_figure(config.map, figure, dpi=110)
        content["map_episodes"] = episodes
        content["map"] = [dataclasses.asdict(line) for line in lines]
        print(f"\n{config.map}: success against speed, interval, height and direction")
    if config.json is not None:
        write_json(config.json, content)
