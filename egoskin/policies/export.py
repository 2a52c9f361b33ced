"""Export a policy as an ONNX file: a graph, and JSON metadata for the robot.

Contract: the graph has one input, ``observation [1, N]``, and one output, ``action
[1, J]``, both float32; it includes the normalisation. The JSON is the metadata entry
named `METADATA`. `egoskin.deploy` reads both without the rest of this package.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from egoskin.agents.normalizers import RunningNorm
from egoskin.policies.policy import Policy
from egoskin.storage.formats import package_version
from egoskin.storage.serialization import to_plain

if TYPE_CHECKING:
    import onnx

METADATA = "egoskin"
"""Name of the metadata entry."""
# Versions of 2020, which onnxruntime 1.6 and TensorRT 8 can read.
_OPSET, _IR_VERSION = 13, 7
# Largest difference from PyTorch, in units of max(1, |action|). |action| is the largest
# over all joints and all observations of a size, because float32 rounding errors are
# relative to the summands, even where their sum is small.
_TOLERANCE = 1e-5
# Sizes of the compared observations, tiny to unrealistic, and the number of each.
_SIZES, _OF_EACH = tuple(10.0**power for power in range(-3, 7)), 100


def observation_parts(policy: Policy) -> list[dict[str, Any]]:
    """Return the parts of the graph input, in order.

    Args:
        policy: The policy.

    Returns:
        ``name``, ``width``, ``unit`` and ``age`` of each part. The age is the number of
        control steps since the observation; it is above 0 only with a history.
    """
    config = policy.env_config
    joints = policy.policy_spec.num_actions
    body = [
        ("base_ang_vel_b", 3, "rad/s"),
        ("joint_deviation", joints, "rad"),
        ("joint_vel", joints, "rad/s"),
        ("gravity_b", 3, "1"),
    ]
    if config.previous_action:
        body.append(("previous_action", joints, "1"))
    blocks = [body]
    if "signal" in config.actor_keys:
        width = policy.policy_spec.sizes["signal"] // config.history
        metric = config.sensor.signal == "localization"
        unit = "m" if metric else "1"
        if config.sensor.coverage == "oracle":
            unit = "m, m/s, 1"
        blocks.append([("signal", width, unit)])
    return [
        {"name": name, "width": width, "unit": unit, "age": age}
        for block in blocks
        for age in reversed(range(config.history))
        for name, width, unit in block
    ]


def needs_tracker(policy: Policy) -> bool:
    """Return whether a policy reads positions of balls, which no skin measures.

    `egoskin.deploy` refuses such a policy.
    """
    sensor = policy.env_config.sensor
    return sensor.coverage == "oracle" or sensor.signal == "localization"


def metadata(policy: Policy, commit: str | None) -> dict[str, Any]:
    """Return the metadata that a robot needs to run a policy, as JSON values.

    All joint values are in the order of ``joints``. Sensor poses are in the frames of
    their links.

    Args:
        policy: The policy.
        commit: Commit of the exporting package, if known.
    """
    config, robot = policy.env_config, policy.env_config.robot_config
    physics = config.task.physics
    kp, kd = robot.joint_gains(physics.gains)
    pipeline = config.pipeline(policy.skin)
    readings = np.zeros(len(pipeline.skin), dtype=int)
    for group in pipeline.groups:
        readings[group.index] = pipeline.num_readings(group)
    return {
        "format": 1,
        "egoskin": package_version("egoskin"),
        "commit": commit,
        "standard": config.standard,
        "frames": policy.policy_spec.frames,
        "robot": robot.name,
        "base": robot.base,
        "control_hz": physics.control_hz,
        "joints": list(robot.joints),
        "default_joint_pos": robot.default_joint_pos.tolist(),
        "joint_range": to_plain(robot.joint_range.tolist()),
        "kp": kp.tolist(),
        "kd": kd.tolist(),
        "torque_limit": robot.torque_limit.tolist(),
        "target_velocity": physics.target_velocity,
        # q* = default_joint_pos + action_scale x action
        "action_scale": (config.task.action_scale * robot.torque_limit / kp).tolist(),
        "history": config.history,
        "previous_action": config.previous_action,
        "observation": observation_parts(policy),
        "sensor": to_plain(config.sensor),
        # Number of signal values of each sensor, in the order of the skin.
        "readings": readings.tolist(),
        "range": [to_plain(value) for value in pipeline.skin.range.tolist()],
        "skin": pipeline.skin.to_dict(),
    }


def to_onnx(policy: Policy, commit: str | None = None) -> onnx.ModelProto:
    """Return a policy as an ONNX model, with its metadata.

    Args:
        policy: The policy.
        commit: Commit of the exporting package, if known.
    """
    import onnx
    from onnx import helper, numpy_helper

    body, sizes = policy.head.body, policy.policy_spec.sizes
    shift, scale, limit = [], [], []
    for key in policy.env_config.actor_keys:
        one = torch.ones(sizes[key])
        if key in policy.norms:
            norm = policy.norms[key]
            assert isinstance(norm, RunningNorm)
            constants = norm.constants(torch.float32)
        else:
            constants = 0.0, 1.0, torch.inf
        for column, value in zip((shift, scale, limit), constants, strict=True):
            column.append(one * value)
    bound = torch.cat(limit)
    constants = {
        "shift": torch.cat(shift),
        "scale": torch.cat(scale),
        "low": -bound,
        "high": bound,
    }
    nodes = [
        helper.make_node("Sub", ["observation", "shift"], ["centred"]),
        helper.make_node("Mul", ["centred", "scale"], ["scaled"]),
        helper.make_node("Max", ["scaled", "low"], ["above_low"]),
        helper.make_node("Min", ["above_low", "high"], ["hidden_0"]),
    ]
    # The first layer is a sum over the keys; here it acts on the concatenation.
    first = [layer for layer in body.inputs if isinstance(layer, nn.Linear)]
    layers = [(torch.cat([layer.weight for layer in first], 1), first[0].bias)]
    layers += [(x.weight, x.bias) for x in body.tail if isinstance(x, nn.Linear)]
    last = len(layers) - 1
    for i, (weight, bias) in enumerate(layers):
        constants |= {f"weight_{i}": weight, f"bias_{i}": bias}
        out = "action" if i == last else f"linear_{i}"
        inputs = [f"hidden_{i}", f"weight_{i}", f"bias_{i}"]
        nodes.append(helper.make_node("Gemm", inputs, [out], transB=1))
        if i < last:
            nodes.append(helper.make_node("Elu", [out], [f"hidden_{i + 1}"]))
    tensor, float32 = helper.make_tensor_value_info, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "policy",
        [tensor("observation", float32, [1, len(bound)])],
        [tensor("action", float32, [1, policy.policy_spec.num_actions])],
        [
            numpy_helper.from_array(value.detach().float().numpy(), name)
            for name, value in constants.items()
        ],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="egoskin",
        producer_version=package_version("egoskin") or "",
    )
    text = json.dumps(metadata(policy, commit), allow_nan=False)
    helper.set_model_props(model, {METADATA: text})
    onnx.checker.check_model(model, full_check=True)
    return model


@torch.no_grad()
def largest_difference(
    content: bytes, policy: Policy, observations: torch.Tensor
) -> float:
    """Return the deviation of onnxruntime from PyTorch, over ``max(1, |action|)``.

    ``|action|`` is the largest over all joints and observations.

    Args:
        content: The ONNX file.
        policy: The exported policy.
        observations: Inputs of the graph, ``[n, N]`` float32, all of one size.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options)
    found = np.concatenate(
        [
            np.asarray(session.run(None, {"observation": row[None]})[0])
            for row in observations.numpy()
        ]
    )
    keys = policy.env_config.actor_keys
    widths = [policy.policy_spec.sizes[key] for key in keys]
    expected = policy(*observations.split(widths, 1)).numpy()
    size = np.abs(expected).max(initial=1.0)
    # Infinite actions differ by NaN.
    with np.errstate(invalid="ignore"):
        return float(np.abs(found - expected).max() / size)


def sample_observations(policy: Policy, n: int, size: float) -> torch.Tensor:
    """Return random observations of a given size, ``[n, N]``.

    Signals without unit stay in [0, 1]; more than half of them are 0 or 1.

    Args:
        policy: The policy.
        n: Number of observations.
        size: Standard deviation of all other parts, in their units.
    """
    generator = torch.Generator().manual_seed(0)
    parts = []
    for part in observation_parts(policy):
        x = torch.randn(n, part["width"], generator=generator)
        shares = part["name"] == "signal" and part["unit"] == "1"
        parts.append((x + 0.5).clamp(0, 1) if shares else size * x)
    return torch.cat(parts, 1)


def export_onnx(policy: Policy, commit: str | None = None) -> tuple[bytes, float]:
    """Return a policy as an ONNX file, and its deviation from PyTorch.

    Args:
        policy: The policy.
        commit: Commit of the exporting package, if known.

    Raises:
        ValueError: If the deviation exceeds ``1e-5 max(1, |action|)``.
    """
    content = to_onnx(policy, commit).SerializeToString()
    differences = [
        largest_difference(content, policy, sample_observations(policy, _OF_EACH, size))
        for size in _SIZES
    ]
    # NaN fails, too; Python's max would lose it.
    difference = float(np.max(differences))
    if not difference <= _TOLERANCE:
        raise ValueError(
            f"the exported policy differs from PyTorch by {difference:.1e} x "
            f"max(1, |action|), more than {_TOLERANCE:g}: its weights are too large "
            "for float32"
        )
    return content, difference
