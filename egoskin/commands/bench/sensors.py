"""Time of the sensor kernels, compared with writing as many bytes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor

from egoskin.bounds import COUNT, check_bounds
from egoskin.commands.bench.report import Row, median_row, show
from egoskin.make import AGENTS, EnvConfig, make_worker_env
from egoskin.parallel import keep_freed_memory
from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, Proximity, RaySensor, Skin
from egoskin.shapes import Sphere

# Interval between recorded states of the rollout [control steps]; balls are in flight.
_STRIDE = 8
# Balls of the close set are within this of a sensor [m].
_CLOSE = 0.5
_RANGE = 2.0


@dataclass(frozen=True, kw_only=True)
class SensorBench:
    """Time of the sensor kernels, on one thread, from joint positions to result.

    Poses and balls come from a rollout of the default task under random actions; in the
    rows "close", every ball is within 0.5 m of a sensor. The ratio is to writing
    into an existing buffer, measured in turn: as many bytes as frames or grid have, for
    the field 24 bytes per sensor, for the minimum of the rays as many as their grid.
    """

    num_envs: Annotated[int, AGENTS] = 4096
    """Agents."""
    snapshots: Annotated[int, COUNT] = 6
    """States of the rollout to measure on, in turn."""
    rounds: Annotated[int, COUNT] = 12
    """How often each row is measured on each state."""
    seed: int = 0
    """Seed of the rollout."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


State = tuple[Tensor, Tensor, Tensor, Tensor]
"""Base pose, joint positions, object poses, active flags."""


def _rollout(config: SensorBench, skin: Skin) -> list[State]:
    """Return states of the default task under random actions."""
    env = make_worker_env(
        EnvConfig(), skin, num_envs=config.num_envs, seed=config.seed, keep_raw=True
    )
    generator = torch.Generator().manual_seed(config.seed)
    states, td = [], env.reset()
    for step in range(_STRIDE * config.snapshots):
        show(f"rollout: step {step + 1}/{_STRIDE * config.snapshots}")
        noise = torch.randn(td["previous_action"].shape, generator=generator)
        td["action"] = 0.5 * noise
        _, td = env.step_and_maybe_reset(td)
        if (step + 1) % _STRIDE == 0:
            keys = ("base_pose", "joint_pos", "object_pose", "object_active")
            states.append(tuple(td[key].clone() for key in keys))
    env.close()
    return states


def _with_two_balls(state: State) -> State:
    """Return the state with two balls: its first, and that of a neighbouring row."""
    base, joints, objects, active = state
    first = objects[:, 0]
    second = first.roll(1, 0)
    second[:, :3] += base[:, :3] - base.roll(1, 0)[:, :3]
    both = torch.stack((active[:, 0], active[:, 0].roll(1)), 1)
    return base, joints, torch.stack((first, second), 1), both


def _close(state: State, sensor: FieldSensor, seed: int) -> State:
    """Return the state with two balls, each within 0.5 m of a sensor on its z-axis."""
    base, joints, objects, active = _with_two_balls(state)
    generator = torch.Generator().manual_seed(seed)
    batch, balls = active.shape
    position, rotation = sensor.poses_b(joints)
    pick = torch.randint(sensor.num_sensors, (batch, balls), generator=generator)
    rows = torch.arange(batch)[:, None]
    gap = _CLOSE * torch.rand(batch, balls, 1, generator=generator) + Sphere().radius
    away_b = position[rows, pick] + gap * rotation[rows, pick, :, 2]
    objects = objects.clone()
    # The rotation of the base is left out, as it turns balls and body alike.
    base = torch.cat((base[:, :3], torch.tensor([1.0, 0, 0, 0]).expand(batch, 4)), -1)
    objects[..., :3] = base[:, None, :3] + away_b
    return base, joints, objects, torch.ones_like(active)


def _one_ball(state: State) -> State:
    base, joints, objects, active = state
    return base, joints, objects[:, :1], active[:, :1]


def _reference(sensor: FieldSensor, skin: Skin) -> Callable[[Tensor], Any]:
    """Return a function that computes the same frames by pytorch-kinematics."""
    chain = H1_2.chain.to(dtype=torch.float32)
    links = list(dict.fromkeys(skin.links))
    offsets = torch.eye(4).repeat(len(skin), 1, 1)
    offsets[:, :3, :3] = torch.from_numpy(skin.rotation())
    offsets[:, :3, 3] = torch.from_numpy(skin.position)
    index = chain.get_frame_indices(*links)

    def frames(joint_pos: Tensor) -> Any:
        found = chain.forward_kinematics(joint_pos, frame_indices=index)
        poses = torch.stack([found[name].get_matrix() for name in skin.links], 1)
        return poses @ offsets

    return frames


def sensor_rows(config: SensorBench) -> list[Row]:
    """Return the rows of the sensor benchmark."""
    keep_freed_memory()  # as a training does
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _measure(config)
    finally:
        torch.set_num_threads(threads)


def _measure(config: SensorBench) -> list[Row]:
    skin = EnvConfig().skin.build(H1_2)
    states = _rollout(config, skin)
    ball, n = Sphere(), config.num_envs
    args = (skin, H1_2.chain)
    plain = FieldSensor(*args, [ball], _RANGE)
    one = [_one_ball(s) for s in states]
    two = [_with_two_balls(s) for s in states]
    close = [_close(s, plain, config.seed) for s in states]
    one_close = [_one_ball(s) for s in close]
    grid = torch.empty(n, len(skin), 64)
    poses = torch.empty(n, len(skin), 3), torch.empty(n, len(skin), 3, 3)
    frames_bytes, field_bytes = n * len(skin) * 48, n * len(skin) * 24
    grid_bytes = grid.numel() * 4
    # By row: bytes to write, states, and the function that is timed.
    jobs: dict[str, tuple[int, list[State], Callable[..., Any]]] = {}
    proximity = Proximity(_RANGE)

    for suffix, fast in (("", True), ("_eager", False)):
        field = FieldSensor(*args, [ball], _RANGE, compile=fast)
        ray = RaySensor(*args, [ball], _RANGE, compile=fast)
        ray_two = RaySensor(*args, [ball, ball], _RANGE, compile=fast)
        ray_min = RaySensor(*args, [ball], _RANGE, reduce="min", compile=fast)

        def frames(state: State, sensor: FieldSensor = field) -> Any:
            return sensor.poses_b(state[1], out=poses)

        def signal(state: State, sensor: FieldSensor = field) -> Any:
            return proximity.compute(sensor.compute(*state)[0])

        def fill(state: State, sensor: RaySensor = ray) -> Any:
            return sensor.compute(*state, out=grid)

        def fill_two(state: State, sensor: RaySensor = ray_two) -> Any:
            return sensor.compute(*state, out=grid)

        def minimum(state: State, sensor: RaySensor = ray_min) -> Any:
            return sensor.compute(*state)

        jobs[f"sensor_frames{suffix}"] = (frames_bytes, one, frames)
        jobs[f"field{suffix}"] = (field_bytes, one, signal)
        for where, single, double in (("", one, two), ("_close", one_close, close)):
            jobs[f"ray_grid{where}{suffix}"] = (grid_bytes, single, fill)
            jobs[f"ray_grid_two_balls{where}{suffix}"] = (grid_bytes, double, fill_two)
            jobs[f"ray_min{where}{suffix}"] = (grid_bytes, single, minimum)
    frames_by_pk = _reference(plain, skin)
    jobs["sensor_frames_pytorch_kinematics"] = (
        frames_bytes,
        one,
        lambda state: frames_by_pk(state[1]),
    )
    return [_row(name, *job, config.rounds) for name, job in jobs.items()]


def _row(
    name: str,
    size: int,
    states: list[State],
    run: Callable[[State], Any],
    rounds: int,
) -> Row:
    """Time a job, alternating with writing as many bytes."""
    show(name)
    buffer = torch.empty(size // 4)
    for state in states:
        run(state)
    times, ratios = [], []
    for _ in range(rounds):
        for state in states:
            begin = time.perf_counter()
            buffer.fill_(1.0)
            middle = time.perf_counter()
            run(state)
            end = time.perf_counter()
            times.append(1e3 * (end - middle))
            ratios.append((end - middle) / (middle - begin))
    show("")
    return median_row(name, times, ratios, "ms")
