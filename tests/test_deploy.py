"""Policies without PyTorch: same targets as the environment, and watchdogs."""

from __future__ import annotations

import inspect
import json
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import onnx
import pytest
import torch
from tensordict import TensorDict

import egoskin
from calling import SCRIPTS
from egoskin.deploy import Controller
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import PhysicsConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.evaluation.throw_set import standard_task, throw_seed
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.export import export_onnx, metadata
from egoskin.policies.policy import Policy
from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, Ray, place_sensors
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.sensors.pipeline import READINGS
from making import make_policy

# A slow ball that comes near.
TASK = DodgeballConfig(
    throws=ThrowConfig(
        first_delay=(0.0, 0.0), height=(1.0, 1.2), distance=(1.5, 1.6), speed=(2.0, 2.1)
    )
)
KINDS = {
    "proximity": EnvConfig(task=TASK),
    "closeness": EnvConfig(task=TASK, sensor=SensorConfig(signal="closeness", range=5)),
    "no limit": EnvConfig(task=TASK, sensor=SensorConfig(range=torch.inf)),
    "binary": EnvConfig(task=TASK, sensor=SensorConfig(signal="binary", range=4)),
    "history": EnvConfig(task=TASK, history=3, previous_action=True),
    "grid": EnvConfig(task=TASK, sensor=SensorConfig(coverage="ray")),
    "closest beams": EnvConfig(
        task=TASK,
        sensor=SensorConfig(coverage="ray", reduce="min", signal="binary", range=5),
    ),
    "blind": EnvConfig(task=TASK, sensor=SensorConfig(coverage="none")),
}


def deploy(policy: Policy, folder: Path, **kwargs: Any) -> Controller:
    path = folder / "policy.onnx"
    path.write_bytes(export_onnx(policy)[0])
    return Controller(path, **kwargs)


def check_target(controller: Controller, td: TensorDict, **given: Any) -> None:
    """Check that a controller's target is that of our environment in the same step."""
    target = controller.step(
        base_quat=td["base_pose"][3:].numpy(),
        base_ang_vel_b=td["base_ang_vel_b"].numpy(),
        joint_pos=td["joint_pos"].numpy(),
        joint_vel=td["joint_vel"].numpy(),
        **given,
    )
    assert controller.stopped is None
    scale = np.array(controller.metadata["action_scale"])
    default = np.array(controller.metadata["default_joint_pos"])
    # q* = q_default + scale x action
    expected = default + scale * td["action"].numpy()
    np.testing.assert_allclose(target, expected, 1e-4, 1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_from_raw_states_and_distances_come_our_environments_targets(kind, tmp_path):
    policy = make_policy(KINDS[kind])
    # Unlimited, for the comparison.
    free = {"margin": np.inf, "max_change": np.inf}
    controller = deploy(policy, tmp_path, **free)
    env = make_worker_env(
        policy.env_config, policy.skin, num_envs=1, seed=1, keep_raw=True
    )
    with torch.no_grad():
        # The robot falls, so all orientations occur.
        rollout = env.rollout(40, policy)[0]
    for td in rollout.unbind(0):
        reading = {}
        if kind != "blind":
            reading = {"distance": td["distance"].numpy(), "skin_age": 0.01}
        check_target(controller, td, body_age=0.01, **reading)
    if kind != "blind":
        assert rollout["distance"].isfinite().any()


def test_sensors_of_two_kinds_are_in_the_order_of_the_skin(tmp_path):
    # Alternating, each with a range of its own.
    kinds = (Ray(grid=(2, 3), fov_deg=150.0), Field()) * 6
    skin = replace(
        place_sensors(H1_2, 12, seed=0),
        coverage=kinds,
        range=np.linspace(1.0, 5.0, 12),
    )
    skin.save(tmp_path / "skin.json")
    config = EnvConfig(task=TASK, skin=SkinConfig(path=tmp_path / "skin.json"))
    policy = make_policy(config)
    free = {"margin": np.inf, "max_change": np.inf}
    controller = deploy(policy, tmp_path, **free)
    env = make_worker_env(config, policy.skin, num_envs=1, seed=1, keep_raw=True)
    with torch.no_grad():
        rollout = env.rollout(30, policy)[0]
    rays, fields = rollout["distance_0"], rollout["distance_1"]
    assert rays.isfinite().any()
    assert fields.isfinite().any()
    distances = torch.cat((rays.flatten(2), fields[..., None]), -1).flatten(1)
    for td, distance in zip(rollout.unbind(0), distances.numpy(), strict=True):
        check_target(controller, td, body_age=0.0, distance=distance)


def test_every_signal_of_distances_is_compared():
    assert {config.sensor.signal for config in KINDS.values()} == {*READINGS}


@pytest.fixture(scope="module")
def controller(tmp_path_factory) -> Controller:
    return deploy(
        egoskin.load_policy("field_proximity"), tmp_path_factory.mktemp("policy")
    )


@pytest.fixture
def state(controller) -> dict[str, Any]:
    """A robot in its default pose, with nothing in range."""
    controller.reset()
    return {
        "base_quat": np.array([1.0, 0, 0, 0]),
        "base_ang_vel_b": np.zeros(3),
        "joint_pos": np.array(controller.metadata["default_joint_pos"]),
        "joint_vel": np.zeros(21),
        "body_age": 0.0,
        "distance": np.full(64, np.inf),
        "skin_age": 0.0,
    }


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"body_age": 0.2}, "the state of the body is 0.2 s old"),
        ({"body_age": np.nan}, "the state of the body is nan s old"),
        ({"body_age": -0.2}, "the state of the body is -0.2 s old"),
        ({"skin_age": 1.5}, "the distances of the skin are 1.5 s old"),
        ({"skin_age": -1e9}, "the distances of the skin are -1e+09 s old"),
        ({"joint_vel": np.full(21, np.nan)}, "the state of the body is not finite"),
        ({"base_quat": np.full(4, np.inf)}, "the state of the body is not finite"),
        ({"base_quat": np.zeros(4)}, "base_quat is not a unit quaternion"),
        ({"base_quat": np.eye(4)[0] * 1.1}, "base_quat is not a unit quaternion"),
        ({"distance": None}, "100% of the skin is missing"),
        ({"distance": np.full(64, np.nan)}, "100% of the skin is missing"),
        ({"distance": np.full(64, -1.0)}, "100% of the skin is missing"),
        ({"distance": np.repeat([np.nan, 1], [7, 57])}, "11% of the skin is missing"),
    ],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_a_watchdog_stops_it_for_good(controller, state, change, why):
    last = controller.step(**state)
    target = controller.step(**{**state, **change})
    assert controller.stopped == why
    np.testing.assert_array_equal(target, last)
    # A sensor that recovers does not end the stop.
    moved = {**state, "distance": np.full(64, 0.3)}
    np.testing.assert_array_equal(controller.step(**moved), last)
    assert controller.stopped == why
    controller.reset()
    assert (controller.step(**moved) != last).any()
    assert controller.stopped is None


def test_after_a_reset_nothing_is_left_of_the_episode_before(tmp_path):
    policy = make_policy(KINDS["history"])
    controller = deploy(policy, tmp_path, margin=np.inf, max_change=np.inf)
    rng = np.random.default_rng(0)
    velocities, distances = rng.normal(size=(3, 21)), rng.uniform(0, 3, (3, 64))

    def play() -> list[np.ndarray]:
        state = {"base_quat": [1, 0, 0, 0], "base_ang_vel_b": np.zeros(3)}
        state |= {"joint_pos": np.zeros(21), "body_age": 0}
        return [
            controller.step(**state, joint_vel=velocity, distance=distance)
            for velocity, distance in zip(velocities, distances, strict=True)
        ]

    first, later = play(), play()
    assert (first[0] != later[0]).any()
    controller.reset()
    np.testing.assert_array_equal(play(), first)


def test_an_action_that_is_not_finite_stops_it_for_good(controller, state, monkeypatch):
    last = controller.step(**state)
    # Exporting refuses policies that give such actions.
    broken = SimpleNamespace(run=lambda *args: [np.full((1, 21), np.nan)])
    with monkeypatch.context() as patch:
        patch.setattr(controller, "_session", broken)
        np.testing.assert_array_equal(controller.step(**state), last)
    assert controller.stopped == "the policy's action is not finite"
    moved = {**state, "distance": np.full(64, 0.3)}
    np.testing.assert_array_equal(controller.step(**moved), last)


def test_a_stop_from_the_first_step_on_leaves_the_robot_as_it_is(controller, state):
    state["joint_pos"] = state["joint_pos"] + 0.1
    controller.stop("the operator let go of the button")
    np.testing.assert_allclose(controller.step(**state), state["joint_pos"])
    assert controller.stopped == "the operator let go of the button"


def test_targets_may_be_changed_by_whoever_receives_them(controller, state):
    target = controller.step(**state)
    kept = target.copy()
    target += 99.0
    controller.stop("the operator let go of the button")
    np.testing.assert_array_equal(controller.step(**state), kept)


@pytest.mark.parametrize("position", [100.0, -100.0, np.inf])
def test_a_wrong_encoder_at_the_start_gives_no_target_beyond_the_limits(
    controller, state, position
):
    state["joint_pos"] = state["joint_pos"].copy()
    state["joint_pos"][0] = position
    target = controller.step(**state)
    data = controller.metadata
    beyond = np.array(data["torque_limit"]) / np.array(data["kp"])
    low, high = np.array(data["joint_range"])
    assert (low - beyond <= target).all()
    assert (target <= high + beyond).all()


def test_an_age_is_allowed_to_be_a_little_negative(controller, state):
    controller.step(**{**state, "body_age": -0.05, "skin_age": -0.05})
    assert controller.stopped is None


def test_dead_beams_of_live_sensors_count_as_missing(tmp_path):
    controller = deploy(make_policy(KINDS["closest beams"]), tmp_path)
    state = {"joint_pos": np.zeros(21), "joint_vel": np.zeros(21), "body_age": 0}
    state |= {"base_quat": [1, 0, 0, 0], "base_ang_vel_b": np.zeros(3)}
    distance = np.full((64, 64), np.inf)
    distance[:, 59:] = np.nan
    controller.step(**state, distance=distance)
    assert controller.stopped is None
    distance[:, 1:] = -1.0
    controller.step(**state, distance=distance)
    assert controller.stopped == "98% of the skin is missing"


@pytest.mark.parametrize("missing", [np.nan, -1.0])
def test_a_sensor_that_is_missing_reads_as_one_of_nothing(controller, state, missing):
    expected = controller.step(**state)
    controller.reset()
    distance = state["distance"].copy()
    distance[[3, 60]] = missing
    target = controller.step(**{**state, "distance": distance})
    assert controller.stopped is None
    np.testing.assert_array_equal(target, expected)


@pytest.mark.parametrize(
    ("name", "value", "shapes"),
    [
        ("base_quat", np.ones(3), r"\[4\]"),
        ("base_ang_vel_b", np.zeros((1, 3)), r"\[3\]"),
        ("joint_pos", 0.0, r"\[21\]"),
        ("joint_vel", np.zeros(20), r"\[21\]"),
        ("distance", np.ones(63), r"\[64\] or \[64, 1\]"),
        ("distance", np.ones((1, 64)), r"\[64\] or \[64, 1\]"),
    ],
    ids=str,
)
def test_an_input_of_a_wrong_shape_is_refused_by_name(
    controller, state, name, value, shapes
):
    text = f"^{name} must have the shape {shapes}, got "
    with pytest.raises(ValueError, match=text + re.escape(str([*np.shape(value)]))):
        controller.step(**{**state, name: value})


def test_grids_of_beams_must_not_be_transposed(tmp_path):
    # 64 sensors of 64 beams would not show it.
    skin = SkinConfig(num_sensors=10)
    controller = deploy(make_policy(replace(KINDS["grid"], skin=skin)), tmp_path)
    assert controller.metadata["readings"] == [64] * 10
    state = {"joint_pos": np.zeros(21), "joint_vel": np.zeros(21), "body_age": 0}
    state |= {"base_quat": [1, 0, 0, 0], "base_ang_vel_b": np.zeros(3)}
    controller.step(**state, distance=np.ones((10, 64)))
    with pytest.raises(
        ValueError, match=r"^distance must have the shape .*\[64, 10\]$"
    ):
        controller.step(**state, distance=np.ones((64, 10)))


def test_of_grids_of_beams_the_closest_count_where_a_policy_reads_those(tmp_path):
    controller = deploy(make_policy(KINDS["closest beams"]), tmp_path)
    distance = np.random.default_rng(0).uniform(0, 50, (64, 64))
    targets = []
    for given in (distance, distance.min(1)):
        controller.reset()
        state = {"joint_pos": np.zeros(21), "joint_vel": np.zeros(21)}
        state |= {"base_quat": [0.6, 0, 0.8, 0], "base_ang_vel_b": np.ones(3)}
        targets.append(controller.step(**state, body_age=0, distance=given))
    np.testing.assert_array_equal(*targets)


@pytest.mark.parametrize("kind", ["no limit", "closest beams"])
@pytest.mark.filterwarnings("error")
def test_no_kind_of_policy_takes_a_negative_distance_for_contact(kind, tmp_path):
    controller = deploy(make_policy(KINDS[kind]), tmp_path)
    state = {"joint_pos": np.zeros(21), "joint_vel": np.zeros(21), "body_age": 0}
    state |= {"base_quat": [1, 0, 0, 0], "base_ang_vel_b": np.zeros(3)}
    shape = (64, 64) if kind == "closest beams" else (64,)
    missing, near = np.full(shape, np.inf), np.full(shape, 0.5)
    targets = []
    for first in (np.inf, -1.0):
        # A sensor, and one beam of another.
        missing[0], near.reshape(64, -1)[-1, 0] = first, first
        for distance in (missing, near):
            controller.reset()
            targets.append(controller.step(**state, distance=distance))
    np.testing.assert_array_equal(targets[:2], targets[2:])


def test_targets_stay_within_limits_of_place_and_change(tmp_path):
    policy = make_policy(EnvConfig())
    # A policy with extreme actions.
    for weight in policy.head.body.tail[-1].parameters():
        weight.data *= 1e3
    controller = deploy(policy, tmp_path, margin=0.5, max_change=0.2)
    data = {k: np.array(controller.metadata[k]) for k in ("torque_limit", "kp")}
    # The error of position that asks for the full torque.
    unit = data["torque_limit"] / data["kp"]
    low, high = np.array(controller.metadata["joint_range"])
    rng = np.random.default_rng(0)
    last = np.array(controller.metadata["default_joint_pos"])
    reached = np.zeros(21, dtype=bool)
    for _ in range(200):
        target = controller.step(
            base_quat=np.array([1.0, 0, 0, 0]),
            base_ang_vel_b=rng.normal(size=3),
            joint_pos=last,
            joint_vel=rng.normal(size=21),
            body_age=0.0,
            distance=rng.uniform(0, 2, 64),
        )
        assert (np.abs(target - last) <= 0.2 * unit + 1e-9).all()
        assert (target >= low - 0.5 * unit - 1e-9).all()
        assert (target <= high + 0.5 * unit + 1e-9).all()
        reached |= np.isclose(np.abs(target - last), 0.2 * unit)
        last = target
    assert reached.all()


@pytest.mark.parametrize("name", ["localization", "oracle"])
def test_what_needs_a_tracker_is_refused_in_one_line(name, tmp_path):
    if name == "oracle":
        policy = make_policy(EnvConfig(sensor=SensorConfig(coverage="oracle")))
    else:
        policy = egoskin.load_policy(name)
    with pytest.raises(ValueError, match=r"reads positions of balls, which needs a tr"):
        deploy(policy, tmp_path)


@pytest.mark.parametrize("new", [{"format": 2}, {"sensor": {"signal": "echo"}}])
def test_a_newer_file_is_refused(new, tmp_path):
    model = onnx.load_from_string(export_onnx(egoskin.load_policy("blind"))[0])
    (entry,) = model.metadata_props
    data = json.loads(entry.value)
    for key, value in new.items():
        data[key] = data[key] | value if key == "sensor" else value
    entry.value = json.dumps(data)
    onnx.save(model, tmp_path / "new.onnx")
    with pytest.raises(ValueError, match=r"new\.onnx was written by a newer egoskin"):
        Controller(tmp_path / "new.onnx")


def test_a_file_of_others_is_refused(tmp_path):
    model = onnx.load_from_string(export_onnx(egoskin.load_policy("blind"))[0])
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(ValueError, match=r"other\.onnx was not written by `egoskin"):
        Controller(tmp_path / "other.onnx")


@pytest.mark.parametrize("content", [b"", b"hello"])
def test_what_is_no_onnx_file_is_refused_by_name(content, tmp_path):
    (tmp_path / "bad.onnx").write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.onnx is not an ONNX file: "):
        Controller(tmp_path / "bad.onnx")
    with pytest.raises(FileNotFoundError, match=r"none\.onnx"):
        Controller(tmp_path / "none.onnx")


@pytest.mark.parametrize(
    ("limit", "value", "most"),
    [
        ("max_age", -1, "inf"),
        ("max_age", np.nan, "inf"),
        ("margin", -5, "inf"),
        ("max_change", -1, "inf"),
        ("max_missing", 2, "1"),
    ],
)
def test_limits_that_make_no_sense_are_refused(limit, value, most):
    with pytest.raises(ValueError, match=rf"^{limit} must be in \[0, {most}\], got "):
        Controller("policy.onnx", **{limit: value})


def test_the_limits_are_those_of_the_documentation():
    text = (SCRIPTS.parent / "docs" / "deploy.md").read_text()
    (age,) = re.findall(r"than `max_age` \(([\d.]+) s\)", text)
    limits = re.findall(r"`(\w+)` x torque limit / kp \(default ([\d.]+)\)", text)
    told = {"max_age": age, **dict(limits)}
    assert list(told) == ["max_age", "margin", "max_change"]
    parameters = inspect.signature(Controller).parameters
    assert all(parameters[name].default == float(x) for name, x in told.items())


def test_it_needs_numpy_and_onnxruntime_alone():
    # As if nothing else that the package depends on were installed.
    missing = ("torch", "tensordict", "torchrl", "mujoco", "gymnasium", "tyro")
    code = f"""
import sys
sys.modules |= dict.fromkeys({missing!r})
import egoskin.deploy
print(sorted(name for name in sys.modules if name.startswith("egoskin")))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == "['egoskin', 'egoskin.deploy']\n"


def test_it_is_short_enough_to_be_read_before_it_moves_a_robot():
    assert len(Path(inspect.getfile(Controller)).read_text().splitlines()) <= 190


# --- the example ------------------------------------------------------------------


DRAWN = ("azimuth", "distance", "height", "speed", "interval", "aim_link", "aim_point")


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["run", "nope"], r"No such file .*nope.policy\.onnx"),
        (["prepare", "nope", "--out", "made"], "nope"),
        (["prepare", "localization", "--out", "made"], "needs a tracker"),
    ],
    ids=str,
)
def test_the_example_tells_what_it_refuses_in_one_line(
    args, text, tmp_path, monkeypatch
):
    main = runpy.run_path(str(SCRIPTS / "deploy_mujoco.py"))["main"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["deploy_mujoco.py", *args])
    with pytest.raises(SystemExit, match=rf"^error: .*{text}.*$"):
        main()
    assert not (tmp_path / "made").exists()


CONE = SensorConfig(field=Field(half_angle_deg=90.0))
PD = PhysicsConfig(target_velocity="finite_difference")


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (EnvConfig(sensor=SensorConfig(occlusion=True)), "see all around"),
        (EnvConfig(sensor=SensorConfig(coverage="ray")), "see all around"),
        (EnvConfig(sensor=CONE), "see all around"),
        (EnvConfig(sensor=SensorConfig(corruption="acoustic")), "real sensors"),
        (EnvConfig(task=DodgeballConfig(physics=PD)), "velocity targets"),
    ],
)
def test_the_example_refuses_what_its_driver_does_not_do(config, text):
    check = runpy.run_path(str(SCRIPTS / "deploy_mujoco.py"))["check_supported"]
    for fine in (EnvConfig(), KINDS["blind"]):
        check(metadata(make_policy(fine), None))
    with pytest.raises(ValueError, match=text):
        check(metadata(make_policy(config), None))


@pytest.mark.slow
def test_the_examples_robot_moves_and_feels_as_our_environments(tmp_path):
    example = SimpleNamespace(**runpy.run_path(str(SCRIPTS / "deploy_mujoco.py")))
    example.prepare("field_proximity", tmp_path, 4, 0)
    policy = egoskin.load_policy("field_proximity")
    config = standard_task(policy.env_config, "2")
    env = make_worker_env(
        config, policy.skin, num_envs=4, seed=throw_seed(config, 0), keep_raw=True
    )
    with torch.no_grad():
        rollout = env.rollout(35, policy, break_when_any_done=False)
    controller = Controller(tmp_path / "policy.onnx")
    model = mujoco.MjModel.from_binary_path(str(tmp_path / "scene.mjb"))
    robot = example.Robot(model, controller.metadata)
    throws = dict(np.load(tmp_path / "throws.npz"))
    for row in range(4):
        controller.reset()
        robot.reset(throws["base_pose"][row], throws["joint_pos"][row])
        robot.throw(0, {key: throws[key][row, 0] for key in DRAWN})
        for td in rollout[row].unbind(0):
            body, distance = robot.body(), robot.distance()
            # Up to rounding, which contacts with the floor enlarge.
            for name in ("joint_pos", "base_ang_vel_b"):
                np.testing.assert_allclose(body[name], td[name], 0, 0.02)
            expected = td["distance"].numpy()
            near = np.minimum(distance, expected) < 1.99
            np.testing.assert_allclose(distance[near], expected[near], 0, 0.02)
            assert robot.step(controller.step(**body, body_age=0.0, distance=distance))
    assert rollout["distance"].isfinite().any()


@pytest.mark.slow
def test_the_example_succeeds_without_pytorch_as_often_as_with_it(tmp_path):
    script = [sys.executable, str(SCRIPTS / "deploy_mujoco.py")]
    for args in (["prepare", "field_proximity", "--out", "made"], ["run", "made"]):
        done = subprocess.run(
            [*script, *args], cwd=tmp_path, capture_output=True, text=True, check=True
        )
    without, number, with_it = re.fullmatch(
        r"without PyTorch: success in ([\d.]+)% of (\d+) episodes "
        r"\(with it: ([\d.]+)% of 512\)\n",
        done.stdout,
    ).groups()
    assert number == "512"
    assert abs(float(without) - float(with_it)) <= 2
