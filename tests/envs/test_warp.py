"""MuJoCo Warp against MuJoCo, on Warp's CPU device: `make test-warp`.

Tolerances are some times what was measured, and far below what a policy could feel; the
measured figures are in docs/gpu.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from calling import call, succeed
from egoskin.agents.ppo import PPO, PPOConfig
from egoskin.agents.rollout import collect
from egoskin.commands.verify import run_hash
from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import (
    Physics,
    PhysicsConfig,
    PhysicsState,
    Scene,
    Variation,
    engine_of,
)
from egoskin.envs.randomization import Randomization, RandomizationConfig
from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.evaluation.throw_set import play_throws, standard_task
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.policy import PolicySpec, load_policy
from egoskin.robots.builtin import H1_2
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.runs.trainer import METRIC_KEYS
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Box, Capsule, Ellipsoid, Shape, Sphere
from sensing import use_warp_kernels
from throwing import TASK

pytestmark = [pytest.mark.slow, pytest.mark.warp]
if find_spec("mujoco_warp") is None:
    pytest.skip("mujoco-warp is not installed (extra gpu)", allow_module_level=True)
wp = pytest.importorskip("warp")

DEFAULT = torch.from_numpy(H1_2.default_joint_pos).float()
J = len(DEFAULT)
BALL = Sphere(radius=0.15)


def scene(ball: Shape = BALL, **options: Any) -> Scene:
    """Return a scene with the robot and two balls."""
    options = {"config": PhysicsConfig(), **options}
    return Scene(robot=H1_2, objects=(ball,) * 2, **options)


def engines(num_envs: int, **options: Any) -> list[Physics]:
    """Return MuJoCo and Warp with the same scene."""
    return [engine_of(name)(scene(**options), num_envs) for name in ("mujoco", "warp")]


def put(physics: Physics, n: int, height: float = 0.0, noise: float = 0.0) -> None:
    """Put all robots at rest."""
    draw = torch.Generator().manual_seed(0)
    pose = torch.tensor([0, 0, H1_2.default_base_height + height, 1.0, 0, 0, 0])
    joints = DEFAULT + noise * (2 * torch.rand(n, J, generator=draw) - 1)
    physics.reset(torch.arange(n), pose.expand(n, 7), joints)


def stepping(step: int) -> torch.Tensor:
    """Return the targets of a robot that steps on the spot, ``[J]``."""
    swing, target = math.sin(2 * math.pi * 1.2 * step / 60), DEFAULT.clone()
    for i, name in enumerate(H1_2.joints):
        lift = max(swing if name.startswith("left") else -swing, 0.0)
        for joint, share in (("hip_pitch", -1.0), ("knee", 2.0), ("ankle_pitch", -1.0)):
            if joint in name:
                target[i] += 0.2 * share * lift
    return target


def largest_gaps(one: PhysicsState, other: PhysicsState) -> dict[str, float]:
    return {
        f.name: float((getattr(one, f.name) - getattr(other, f.name)).abs().max())
        for f in fields(PhysicsState)
    }


def check(gaps: dict[str, float], **limits: float) -> None:
    """Print the gaps and compare them with their limits."""
    print({name: f"{gap:.1e}" for name, gap in gaps.items()})
    assert not {name: gaps[name] for name, x in limits.items() if gaps[name] > x}


# --- parity -------------------------------------------------------------------------


def test_in_free_fall_all_is_as_with_mujoco():
    n, draw = 8, torch.Generator().manual_seed(1)
    both = engines(n)
    targets = DEFAULT + 0.1 * torch.randn(20, n, J, generator=draw)
    spin = torch.randn(n, 3, generator=draw)
    for physics in both:
        put(physics, n, height=1.0, noise=0.05)
        physics.push(torch.arange(n), spin)
        for ball in range(2):
            place = torch.tensor([2.0 + ball, 1.0, 2.0]).expand(n, 3)
            physics.throw(torch.arange(n), torch.full((n,), ball), place, spin)
    for target in targets:
        results = [p.step(target, torch.ones(n, 2, dtype=torch.bool)) for p in both]
        for result in results:
            for name in ("object_hit", "fallen", "self_contact", "diverged"):
                assert not getattr(result, name).any()
    gap = (results[0].power - results[1].power).abs() / results[0].power
    assert gap.max() < 1e-3
    check(
        largest_gaps(both[0].read(), both[1].read()),
        base_pose=1e-5,
        base_lin_vel_w=1e-4,
        base_ang_vel_b=1e-3,
        joint_pos=1e-4,
        joint_vel=1e-2,
        object_pose=1e-5,
        object_lin_vel_w=1e-4,
    )


@pytest.mark.parametrize("motion", ["standing", "stepping"])
def test_for_fifty_steps_a_robot_stands_and_steps_as_with_mujoco(motion):
    n = 8
    both = engines(n)
    for physics in both:
        put(physics, n, noise=0.05)
    active = torch.zeros(n, 2, dtype=torch.bool)
    fallen = []
    for step in range(50):
        target = stepping(step) if motion == "stepping" else DEFAULT
        results = [p.step(target.expand(n, J), active) for p in both]
        fallen.append(results[0].fallen)
        assert torch.equal(results[0].fallen, results[1].fallen)
    assert not torch.stack(fallen).any()
    check(
        largest_gaps(both[0].read(), both[1].read()),
        base_pose=1e-4,
        base_lin_vel_w=1e-3,
        joint_pos=1e-4,
        joint_vel=1e-2,
    )


@pytest.mark.parametrize(
    "ball",
    [
        lambda r: Sphere(radius=r),
        lambda r: Box(half_extents=(r, r - 0.05, r + 0.05)),
        lambda r: Capsule(radius=r - 0.05, half_length=0.1),
        lambda r: Ellipsoid(semi_axes=(r, r - 0.05, r + 0.05)),
    ],
    ids=["sphere", "box", "capsule", "ellipsoid"],
)
def test_what_hits_or_misses_by_two_centimetres_does_so_here_as_well(
    ball: Callable[[float], Shape],
):
    # Unambiguous: hits with 2 cm smaller objects, and misses with 2 cm larger ones.
    n, steps = 96, 50
    config = EnvConfig().task
    thrower = Thrower(config.throws, H1_2, config.physics.timestep)
    rows = torch.arange(n)
    zero = torch.zeros_like(rows)
    verdicts = {}
    for name, radius in (
        ("mujoco", 0.13),
        ("mujoco", 0.15),
        ("mujoco", 0.17),
        ("warp", 0.15),
    ):
        physics = engine_of(name)(
            scene(ball(radius), hold=True, weightless_objects=True, link_contacts=True),
            n,
        )
        put(physics, n)
        state = physics.read()
        draw = thrower.draw(5, rows, zero, zero)
        release = thrower.release(
            draw, state.base_pose, state.base_lin_vel_w, state.joint_pos
        )
        # From nearby, and beside the point aimed at by up to 60 cm.
        aside = 0.6 * (draw.target[:, :1] - 0.5) * torch.tensor([[0.0, 0.0, 1.0]])
        aside = aside + 1.2 * (
            draw.target[:, 1:] - 0.5
        ) * torch.nn.functional.normalize(
            torch.linalg.cross(release.velocity, torch.tensor([[0.0, 0, 1]])), dim=-1
        )
        place = release.position + aside + 0.35 * release.velocity
        physics.throw(rows, zero, place, release.velocity)
        active = torch.tensor([[True, False]]).expand(n, 2)
        hit = torch.zeros(n, dtype=torch.bool)
        links = torch.zeros(n, len(H1_2.links), dtype=torch.bool)
        for _ in range(steps):
            result = physics.step(DEFAULT.expand(n, J), active)
            hit |= result.object_hit[:, 0]
            assert result.link_contact is not None
            links |= result.link_contact
        verdicts[name, radius] = hit, links
    hits, misses = verdicts["mujoco", 0.13][0], ~verdicts["mujoco", 0.17][0]
    hit, links = verdicts["warp", 0.15]
    same = hit == verdicts["mujoco", 0.15][0]
    print(f"{int(hits.sum())} hit, {int(misses.sum())} miss, of {n}; same {same.sum()}")
    assert min(hits.sum(), misses.sum()) > n // 5
    assert hit[hits].all()
    assert not hit[misses].any()
    by_link = (links == verdicts["mujoco", 0.15][1]).all(1)
    print(f"the same links were touched in {int(by_link.sum())}")
    assert by_link.float().mean() > 0.95


def test_robots_that_differ_do_so_as_with_mujoco():
    n, draw = 4, torch.Generator().manual_seed(2)

    def factors(*shape: int) -> torch.Tensor:
        return 0.6 + 0.8 * torch.rand(shape, generator=draw)

    variation = Variation(
        link_mass=factors(n, len(H1_2.links)),
        friction=factors(n),
        gains=factors(n, J),
        torque_limit=0.3 * factors(n, J),
    )
    both = engines(n)
    for physics in both:
        put(physics, n, noise=0.05)
        physics.vary(torch.arange(n), variation)
        # A reset keeps the variation.
        put(physics, n, noise=0.05)
    active = torch.zeros(n, 2, dtype=torch.bool)
    for step in range(20):
        results = [p.step(stepping(10 + step).expand(n, J), active) for p in both]
    saturation = [result.torque_saturation for result in results]
    assert saturation[0].max() > 0
    torch.testing.assert_close(*saturation, rtol=0, atol=0.03)
    gaps = largest_gaps(both[0].read(), both[1].read())
    check(gaps, base_pose=1e-4, joint_pos=1e-3)
    # The robot without variation moves differently.
    plain = engine_of("mujoco")(scene(), n)
    put(plain, n, noise=0.05)
    for step in range(20):
        plain.step(stepping(10 + step).expand(n, J), active)
    assert largest_gaps(plain.read(), both[0].read())["joint_pos"] > 5e-2


def test_what_masses_determine_is_computed_only_if_they_vary(monkeypatch):
    n, launches = 2, []
    launch = wp.launch

    def count(kernel, *args, **kwargs):
        launches.append(kernel)
        return launch(kernel, *args, **kwargs)

    physics = engine_of("warp")(scene(), n)
    monkeypatch.setattr(wp, "launch", count)
    rows = torch.arange(n)
    for config, least, most in (
        (RandomizationConfig(friction=(0.5, 0.9)), 0, 0),
        (RandomizationConfig(link_mass=(1.1, 1.2)), 100, 2000),
    ):
        sizes = (len(H1_2.links), J, 60.0)
        random = Randomization(config, n, *sizes, torch.device("cpu"))
        variation = random.variation(0, rows, torch.zeros_like(rows))
        for _ in range(2):
            launches.clear()
            physics.vary(rows, variation)
        print(f"launches of {variation.varies_mass=}: {len(launches)}")
        assert least <= len(launches) <= most


def test_a_policy_dodges_as_well_as_with_mujoco():
    throws, policy = 256, load_policy("field_proximity")
    config = standard_task(policy.env_config)
    # Success is measured after three seconds.
    task = replace(config.task, episode_length_s=config.task.success_s)
    config = replace(config, task=task)
    failed = []
    for engine in ("mujoco", "warp"):
        played = play_throws(
            policy,
            config,
            policy.skin,
            throw_set=0,
            episodes=throws,
            # Simulates in this process.
            watch=lambda *step: None,
            engine=engine,
        )
        failed.append(played.hit | played.fallen | played.diverged)
        ends = {
            name: int(getattr(played, name).sum())
            for name in ("hit", "fallen", "diverged")
        }
        print(f"{engine}: {throws - int(failed[-1].sum())} of {throws} dodged, {ends}")
    print(f"the same of both in {int((failed[0] == failed[1]).sum())}")
    success = [1 - float(x.float().mean()) for x in failed]
    assert abs(success[0] - success[1]) <= 0.03


# --- the contract -------------------------------------------------------------------


def flail(physics: Physics, n: int, steps: int, seed: int = 3) -> list:
    draw = torch.Generator().manual_seed(seed)
    targets = DEFAULT + 0.5 * torch.randn(steps, 8, J, generator=draw)
    active = torch.ones(n, 2, dtype=torch.bool)
    return [physics.step(target[:n], active) for target in targets]


@pytest.mark.parametrize("target_velocity", ["zero", "finite_difference"])
def test_a_loaded_state_continues_bit_for_bit_in_any_number_of_rows(target_velocity):
    config = PhysicsConfig(target_velocity=target_velocity)
    whole, other = (engine_of("warp")(scene(config=config), 8) for _ in range(2))
    for physics in (whole, other):
        put(physics, 8)
    flail(whole, 8, 20)
    # Another history, of which nothing may remain.
    flail(other, 8, 3, seed=4)
    saved = whole.state()
    other.load_state(saved)
    few = engine_of("warp")(scene(config=config), 3)
    few.load_state(saved[:3])
    after = flail(whole, 8, 10)
    for physics, n in ((other, 8), (few, 3)):
        for result, expected in zip(flail(physics, n, 10), after, strict=True):
            assert torch.equal(result.power, expected.power[:n])
        assert torch.equal(physics.state(), whole.state()[:n])


def test_a_diverged_row_is_told_and_finite_harms_no_other_and_starts_anew():
    broken, sound = (engine_of("warp")(scene(), 4) for _ in range(2))
    for physics in (broken, sound):
        put(physics, 4)
        flail(physics, 4, 5)
    state = broken.state()
    state[1, 40] = math.nan
    state[2, 41] = 1e30
    broken.load_state(state)
    result, expected = (flail(physics, 4, 1)[0] for physics in (broken, sound))
    assert result.diverged.tolist() == [False, True, True, False]
    assert all(
        getattr(broken.read(), f.name).isfinite().all() for f in fields(PhysicsState)
    )
    kept = torch.tensor([0, 3])
    assert torch.equal(broken.state()[kept], sound.state()[kept])
    assert torch.equal(result.power[kept], expected.power[kept])
    for physics in (broken, sound):
        put(physics, 4)
    assert torch.equal(flail(broken, 4, 5)[-1].power, flail(sound, 4, 5)[-1].power)
    assert torch.equal(broken.state(), sound.state())


def test_contacts_that_do_not_fit_are_told_with_the_cure(monkeypatch):
    monkeypatch.setenv("EGOSKIN_WARP_CONTACTS", "2")
    physics = engine_of("warp")(scene(), 2)
    put(physics, 2)
    assert flail(physics, 2, 1)[0].diverged.all()
    note = physics.note()
    assert note is not None
    assert "2 contacts" in note
    assert "increase EGOSKIN_WARP_CONTACTS" in note
    assert physics.note() is None
    monkeypatch.setenv("EGOSKIN_WARP_CONTACTS", "many")
    with pytest.raises(ValueError, match="EGOSKIN_WARP_CONTACTS must be a positive"):
        engine_of("warp")(scene(), 2)


def test_what_it_cannot_simulate_is_refused_by_name():
    many = Scene(robot=H1_2, objects=(Sphere(),) * 20, config=PhysicsConfig())
    with pytest.raises(ValueError, match="MuJoCo Warp cannot load the scene: Dense"):
        engine_of("warp")(many, 1)


# --- training -----------------------------------------------------------------------


def test_a_training_is_repeated_and_gone_on_with_bit_for_bit(tmp_path: Path):
    options = ["--engine", "warp", "--num-envs", "8", "--sensor.coverage", "ray"]
    for name, frames in (("whole", 512), ("again", 512), ("half", 256)):
        succeed(
            "train", *options, "--run-dir", tmp_path / name, "--total-frames", frames
        )
    succeed("train", "--resume", tmp_path / "half", "--total-frames", 512)
    runs = [Run.open(tmp_path / name) for name in ("whole", "again", "half")]
    assert len({run_hash(run) for run in runs}) == 1
    policy = load_policy(tmp_path / "whole")
    assert policy.policy_spec.engine == runs[0].config.engine == "warp"
    assert runs[0].starts()[0]["packages"]["mujoco-warp"] is not None
    done = call("train", "--resume", tmp_path / "half", "--engine", "mujoco")
    assert done.returncode == 2
    assert "changed: engine" in done.stderr
    # It also runs on the other engine.
    done = call("evaluate", tmp_path / "whole", "--episodes", "2")
    assert done.returncode == 0


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_trains_and_its_policy_plays_on_both_engines(tmp_path: Path):
    folder, on_gpu = tmp_path / "run", ("--engine", "warp", "--device", "cuda")
    size = ("--num-envs", 64, "--ppo.num-mini-batches", 2)
    succeed("train", *on_gpu, *size, "--run-dir", folder, "--total-frames", 2048)
    succeed("train", "--resume", folder, "--total-frames", 4096)
    random = RandomizationConfig(link_mass=(0.9, 1.1))
    config = EnvConfig(task=replace(TASK, randomization=random))
    env = make_worker_env(config, num_envs=4, seed=0, engine="warp", device="cuda")
    env.reset()
    env.rollout(3)
    # The second step and the second variation of masses were captured.
    graphs = env.base_env.physics._graphs
    assert len(graphs) == 2
    assert None not in graphs.values()
    for engine in (on_gpu, ()):
        succeed("evaluate", folder, "--episodes", 8, *engine)


def test_an_environment_gives_what_its_specs_say():
    config = EnvConfig(sensor=SensorConfig(coverage="ray", reduce="min"))
    env = make_worker_env(config, num_envs=4, seed=0, keep_raw=True, engine="warp")
    assert isinstance(env.base_env, DodgeballEnv)
    # The same draws: throws and starts.
    other = DodgeballEnv(H1_2, DodgeballConfig(), num_envs=4, seed=0)
    starts = [e.reset()["first_throw_step"] for e in (env, other)]
    assert torch.equal(*starts)
    assert starts[0].unique().numel() > 1
    env.check_env_specs()


class Reads(TorchDispatchMode):
    """Counts operations, and those that make a device wait: reads and row indices."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers = self.indices = self.operations = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        # A view is no work for the device.
        aliases = [r.alias_info for r in func._schema.returns]
        self.operations += not any(a is not None and not a.is_write for a in aliases)
        self.numbers += name == "_local_scalar_dense"
        masks = args[1] if name in ("index", "index_put_") else ()
        masked = any(x is not None and x.dtype == torch.bool for x in masks)
        self.indices += masked or name in ("nonzero", "_unique2", "bincount")
        return func(*args, **(kwargs or {}))


def as_on_a_gpu(monkeypatch) -> None:
    """Let the loop take the paths of a GPU."""
    use_warp_kernels(monkeypatch)
    monkeypatch.setattr("egoskin.transform._on_gpu", lambda tensordict: True)


def refuse(self: torch.Tensor, *args: object) -> None:
    raise AssertionError("a tensor is read by the host")


def test_a_rollout_reads_nothing_but_a_few_numbers_for_each_step(monkeypatch):
    config, counts, operations = EnvConfig(task=TASK), [], []
    skin = config.skin.build(config.robot_config)
    for n, fast in ((4, True), (16, True), (16, False)):
        env = make_worker_env(config, skin, num_envs=n, seed=0, engine="warp")
        network = TrainConfig().ppo.network
        spec = PolicySpec.of(config, skin, network, env, {})
        agent = spec.build_agent()
        ppo = PPO(agent, PPOConfig())
        root = env.reset()
        with monkeypatch.context() as patch, Reads() as collecting:
            if fast:
                as_on_a_gpu(patch)
            for name in ("numpy", "tolist", "cpu"):
                patch.setattr(torch.Tensor, name, refuse)
            rollout, _, _ = collect(env, agent, root, 16, METRIC_KEYS)
        # As on a GPU; and threads of a pool would not be counted.
        ppo.shares = 1
        monkeypatch.setattr(ppo, "_pool", SimpleNamespace(map=map))
        with Reads() as learning:
            ppo.update(rollout)
        counts.append((collecting.numbers, collecting.indices, learning.numbers))
        operations.append(collecting.operations / 16)
        print(f"{n} robots: numbers, index lists, numbers of an update: {counts[-1]}")
        print(f"operations in a step: {operations[-1]:.0f}, sensors' kernels: {fast}")
    # However many robots there are.
    for numbers, indices, learned in counts[:2]:
        assert numbers <= 16 * 4
        assert indices <= 16 * 5
        assert 3 * 20 < learned <= 4 * 20 + 20
    assert operations[1] < operations[2] - 150


def test_throws_and_resets_wait_as_often_for_any_number_of_robots(monkeypatch):
    frame = 1 / 60
    throws = {
        "neither": ThrowConfig(first_delay=(2.0, 2.0)),
        "throws": ThrowConfig(first_delay=(0.0, 0.0), interval=(frame, frame)),
        "resets": ThrowConfig(first_delay=(2 * frame, 6 * frame)),
    }
    most: dict[tuple[str, int, bool], list[int]] = {}
    as_on_a_gpu(monkeypatch)
    for name, n in (("neither", 16), ("throws", 16), ("resets", 4), ("resets", 16)):
        ends = {"episode_length_s": frame} if name == "resets" else {}
        config = EnvConfig(task=replace(TASK, throws=throws[name], **ends))
        env = make_worker_env(config, num_envs=n, seed=0, engine="warp")
        root = env.reset()
        # The points to aim at are found once.
        _ = env.base_env.thrower._aim_points
        for _ in range(12 if ends else 3):
            root["action"] = env.action_spec.zero()
            with Reads() as reads:
                step, root = env.step_and_maybe_reset(root)
            kind = name, n, bool(step["next", "done"].any())
            found = reads.numbers, reads.indices, reads.operations
            most[kind] = [*map(max, found, most.get(kind, found))]
    for (name, n, reset), (numbers, indices, operations) in most.items():
        print(
            f"{name}, {n} robots, reset {reset}: numbers {numbers}, index lists "
            f"{indices}, operations {operations}"
        )
    numbers, indices, operations = most["neither", 16, False]
    thrown, ended = most["throws", 16, False], most["resets", 16, True]
    assert most["resets", 4, True][:2] == ended[:2]
    # One list of robots is empty without throws.
    assert thrown[:2] == [numbers, indices]
    assert thrown[2] < operations + 160
    assert ended[0] <= numbers + 4
    assert ended[1] <= indices + 2
    # Other robots are thrown at meanwhile.
    assert ended[2] < thrown[2] + 200


def test_bench_engine_gives_its_rows(tmp_path: Path):
    file = tmp_path / "rows.json"
    args = ("--worlds", "4", "--rounds", "1", "--json", file)
    succeed("bench", "engine", *args)
    rows = {row["name"]: row["value"] for row in json.loads(file.read_text())["rows"]}
    layers = ("physics", "sensors_field", "train_field", "sensors_ray", "train_ray")
    names = [*layers, "memory_field", "memory_ray"]
    assert list(rows) == [f"{name}_4" for name in names]
    assert min(rows.values()) > 0
