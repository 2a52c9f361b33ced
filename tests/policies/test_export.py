"""Exported policies compared with PyTorch, and their robot data with MuJoCo."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn

import egoskin
from calling import fail, hide, succeed
from egoskin.agents.networks import NetworkConfig, input_keys
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics.contract import PhysicsConfig, Scene
from egoskin.envs.physics.model import build_scene
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.export import (
    METADATA,
    export_onnx,
    largest_difference,
    observation_parts,
    sample_observations,
    to_onnx,
)
from egoskin.policies.policy import Policy, shipped_policies
from egoskin.sensors.config import SensorConfig, SkinConfig
from making import make_agent, make_policy

FEW = SkinConfig(num_sensors=5)
MADE = {
    "history": EnvConfig(history=4, previous_action=True),
    "grid": EnvConfig(sensor=SensorConfig(coverage="ray")),
    "binary grid": EnvConfig(sensor=SensorConfig(coverage="ray", signal="binary")),
    "closest beams": EnvConfig(sensor=SensorConfig(coverage="ray", reduce="min")),
    "history of a grid": EnvConfig(
        skin=FEW, sensor=SensorConfig(coverage="ray"), history=2
    ),
    "closeness": EnvConfig(sensor=SensorConfig(signal="closeness", range=torch.inf)),
    "oracle": EnvConfig(sensor=SensorConfig(coverage="oracle")),
}


def run(content: bytes, observations: np.ndarray) -> np.ndarray:
    """Actions of an exported policy, ``[n, J]``."""
    session = onnxruntime.InferenceSession(content)
    return np.concatenate(
        [
            session.run(["action"], {"observation": row[None]})[0]
            for row in observations.astype(np.float32)
        ]
    )


def act(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """The policy's own actions, ``[n, J]``."""
    widths = [policy.policy_spec.sizes[key] for key in policy.in_keys]
    parts = torch.from_numpy(observations).float().split(widths, 1)
    return policy(*parts).numpy()


def assert_alike(policy: Policy) -> None:
    content, difference = export_onnx(policy)
    assert difference < 1e-5
    size = sum(policy.policy_spec.sizes[key] for key in policy.in_keys)
    rng = np.random.default_rng(0)
    # Ordinary ones, and every input at once as far out as the normalisation lets it.
    for scale in (0.1, 1.0, 10.0, 1e6):
        given = scale * rng.choice([-1.0, 1.0], (20, size))
        given *= rng.random((20, size)) if scale < 1e6 else 1.0
        if "signal" in policy.in_keys:
            width = policy.policy_spec.sizes["signal"]
            given[:, -width:] = rng.integers(0, 2, (20, width))
        found, expected = run(content, given), act(policy, given)
        size_of = max(1.0, np.abs(expected).max())
        assert (np.abs(found - expected) <= 1e-5 * size_of).all()


@pytest.mark.parametrize("name", shipped_policies())
def test_a_trained_policy_acts_in_onnxruntime_as_in_pytorch(name):
    policy = egoskin.load_policy(name)
    assert_alike(policy)
    # Also on observations of episodes, with balls in range.
    env = make_worker_env(policy.env_config, policy.skin, num_envs=8, seed=1)
    with torch.no_grad():
        rollout = env.rollout(120, policy, break_when_any_done=False)
    rows = rollout.flatten()
    given = torch.cat([rows[key] for key in policy.in_keys], -1).numpy()
    np.testing.assert_allclose(
        run(to_onnx(policy).SerializeToString(), given), rows["action"], 1e-5, 1e-5
    )


@pytest.mark.parametrize("normalize", ["all", "body"])
@pytest.mark.parametrize("kind", MADE)
def test_any_policy_acts_in_onnxruntime_as_in_pytorch(kind, normalize):
    network = NetworkConfig(hidden=(16, 24, 8), normalize=normalize)
    assert_alike(make_policy(MADE[kind], network))


def test_a_sparse_first_layer_is_exported_dense():
    # What the agent computes from a dozen of 4,096 beams, in training.
    config = MADE["grid"]
    agent, spec = make_agent(config, NetworkConfig())
    content, _ = export_onnx(Policy(agent, spec))
    shared: dict[str, Any] = {"num_envs": 8, "seed": 0}
    dense, sparse = (
        make_worker_env(config, spec.skin, sparse=sparse, **shared)
        for sparse in (False, True)
    )
    zero = torch.zeros(8, spec.num_actions)
    one, other = (
        env.rollout(90, lambda td: td.set("action", zero), break_when_any_done=False)
        for env in (dense, sparse)
    )
    seen = (one["signal"] < 1).any(-1)
    assert seen.any()
    one, other = one[seen], other[seen]
    with torch.no_grad():
        inputs = agent.encode(agent.sense(other))
        keys = input_keys(agent.actor_keys)
        mean, _ = agent.head(*(inputs[key] for key in keys))
    given = torch.cat((one["observation"], one["signal"]), -1).numpy()
    np.testing.assert_allclose(run(content, given), mean, 1e-5, 1e-5)


def test_an_export_that_is_not_exact_is_refused(monkeypatch):
    policy = egoskin.load_policy("blind")
    content = to_onnx(policy).SerializeToString()
    observations = sample_observations(policy, 10, 1.0)
    assert largest_difference(content, policy, observations) < 1e-5
    policy.head.body.tail[-1].bias.data.add_(1e-3)
    assert largest_difference(content, policy, observations) > 1e-5
    monkeypatch.setattr("egoskin.policies.export.largest_difference", lambda *_: 2e-5)
    with pytest.raises(ValueError, match=r"differs from PyTorch by 2\.0e-05"):
        export_onnx(policy)


def test_a_policy_that_is_exact_only_for_small_observations_is_refused():
    # The signal, in metres, is not limited by a normalisation.
    config = EnvConfig(sensor=SensorConfig(signal="localization"))
    policy = make_policy(config, NetworkConfig(hidden=(16, 16), normalize="body"))
    *_, of_signal = (x for x in policy.head.body.inputs if isinstance(x, nn.Linear))
    of_signal.weight.data.mul_(1e33)
    content = to_onnx(policy).SerializeToString()
    small = sample_observations(policy, 10, 1e-3)
    assert largest_difference(content, policy, small) < 1e-5
    with pytest.raises(ValueError, match="its weights are too large for float32"):
        export_onnx(policy)


def test_an_old_runtime_on_a_robot_reads_the_file():
    model = to_onnx(egoskin.load_policy("field_binary"))
    # https://onnxruntime.ai/docs/reference/compatibility.html: from version 1.6 on.
    assert [x.version for x in model.opset_import] == [13]
    assert model.ir_version == 7
    (given,), (action,) = model.graph.input, model.graph.output
    for value, shape in ((given, [1, 112]), (action, [1, 21])):
        dims = value.type.tensor_type.shape.dim
        assert [d.dim_value for d in dims] == shape
        assert value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT


def told(policy: Policy, **kwargs: Any) -> dict[str, Any]:
    """The metadata as a robot reads them."""
    session = onnxruntime.InferenceSession(export_onnx(policy, **kwargs)[0])
    return json.loads(session.get_modelmeta().custom_metadata_map[METADATA])


def test_the_metadata_say_what_the_simulated_robot_is():
    policy = egoskin.load_policy("field_proximity")
    data = told(policy, commit="abc123")
    physics = policy.env_config.task.physics
    robot = policy.env_config.robot_config
    model = build_scene(Scene(robot=robot, objects=(), config=physics))
    # Actuators carry the PD law: force = kp (q* - q) - kd qdot, cut off.
    actuators = [model.actuator(name) for name in data["joints"]]
    assert [a.id for a in actuators] == list(range(model.nu))
    kp, kd = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    np.testing.assert_allclose(data["kp"], kp)
    np.testing.assert_allclose(data["kd"], kd)
    np.testing.assert_allclose(data["torque_limit"], model.actuator_forcerange[:, 1])
    np.testing.assert_allclose(data["joint_range"], model.jnt_range[1:].T)
    np.testing.assert_allclose(data["default_joint_pos"], robot.default_joint_pos)
    # q* moves by 0.3 x the error that asks for the full torque.
    limit = model.actuator_forcerange[:, 1]
    np.testing.assert_allclose(data["action_scale"], 0.3 * limit / kp)
    assert (data["control_hz"], data["target_velocity"]) == (60, "zero")
    assert data["base"] == model.body(model.jnt_bodyid[0]).name
    assert (data["standard"], data["commit"]) == ("2", "abc123")
    assert data["frames"] == policy.policy_spec.frames > 1e6
    assert data["egoskin"] is not None
    assert data["sensor"]["signal"] == "proximity"
    sensors = data["skin"]["sensors"]
    assert [s["link"] for s in sensors] == list(policy.skin.links)
    np.testing.assert_allclose(
        [s["position"] for s in sensors], policy.skin.position, atol=1e-6
    )
    np.testing.assert_allclose(
        [s["normal"] for s in sensors], policy.skin.normal, atol=1e-6
    )
    assert data["range"] == [2.0] * 64
    assert data["readings"] == [1] * 64


def test_the_metadata_are_those_of_the_policys_own_task():
    physics = PhysicsConfig(
        gains="real", control_hz=50, target_velocity="finite_difference"
    )
    task = DodgeballConfig(physics=physics, success_s=2.0)
    data = told(make_policy(EnvConfig(task=task, skin=FEW)))
    # Unitree's figures for the knees.
    knee = data["joints"].index("left_knee_joint")
    assert (data["kp"][knee], data["kd"][knee]) == (300, 4)
    assert data["action_scale"][knee] == 0.3 * data["torque_limit"][knee] / 300
    assert (data["control_hz"], data["target_velocity"]) == (50, "finite_difference")
    assert (data["standard"], data["frames"]) == ("custom", 0)


@pytest.mark.parametrize("kind", MADE)
def test_the_parts_of_the_observation_are_as_wide_as_the_whole(kind):
    policy = make_policy(MADE[kind])
    parts = observation_parts(policy)
    sizes = [policy.policy_spec.sizes[key] for key in policy.in_keys]
    assert sum(part["width"] for part in parts) == sum(sizes)
    ages = [part["age"] for part in parts if part["name"] == "gravity_b"]
    assert ages == list(reversed(range(policy.env_config.history)))


def test_an_infinite_range_is_told_as_text():
    assert told(make_policy(MADE["closeness"]))["range"] == ["inf"] * 64


def test_the_command_writes_the_file_and_lists_its_input(tmp_path):
    out = tmp_path / "policy.onnx"
    said = succeed("export", "localization", "--to", "onnx", "--out", out)
    assert f"{out}: observation [1, 51] -> action" in said
    assert "joint_vel           21 rad/s" in said
    assert "equal to PyTorch within" in said
    assert "egoskin.deploy refuses it: it reads positions of balls" in said
    assert run(out.read_bytes(), np.zeros((1, 51))).shape == (1, 21)


def test_what_a_skin_measures_is_exported_without_that_note(tmp_path):
    said = succeed("export", "field_proximity", "--out", tmp_path / "policy.onnx")
    assert "refuses" not in said


def test_without_onnx_the_command_names_the_extra(tmp_path, monkeypatch):
    hide("onnx", monkeypatch)
    error = fail("export", "blind", "--out", tmp_path / "policy.onnx")
    assert "export needs onnx: `pip install 'egoskin[export]'`" in error
    assert not list(tmp_path.iterdir())
