"""Build pytorch-kinematics chains from compiled MuJoCo models.

`pytorch_kinematics.build_chain_from_mjcf` fails with MuJoCo 4 (its table of joint types
is keyed by an enum that no longer equals an integer) and keeps the root's offset.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np
import pytorch_kinematics as pk
import torch
from pytorch_kinematics import frame as pk_frame

from egoskin.robots.model import body_id, body_name, joint_name, unique_name

JOINT_TYPES = {
    mujoco.mjtJoint.mjJNT_HINGE: "revolute",
    mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
}
"""Joint types of pytorch-kinematics by MuJoCo joint type."""


def _body_frames(
    model: mujoco.MjModel, body_id: int, dtype: torch.dtype
) -> list[pk_frame.Frame]:
    """Return the frames that lead from a body's parent to the body, in series.

    MuJoCo rotates a hinge about the axis through its ``pos`` p: T(p) R(q - ref) T(-p).
    A pytorch-kinematics frame has a fixed offset before its joint and none after, so
    T(-p) goes into the next frame, and one more frame follows the last such joint.
    """
    body = model.body(body_id)
    name = body_name(model, body_id)
    # All frames of a body have its name as link, so that the chain's links are bodies.
    frames: list[pk_frame.Frame] = []
    position, quat = body.pos.copy(), body.quat.copy()

    def append(frame_name: str, joint: pk_frame.Joint) -> None:
        offset = pk.Transform3d(pos=position.tolist(), rot=quat.tolist(), dtype=dtype)
        link = pk_frame.Link(name, offset=offset)
        frames.append(pk_frame.Frame(frame_name, link=link, joint=joint))

    for joint_id in range(body.jntadr[0], body.jntadr[0] + body.jntnum[0]):
        joint = model.joint(joint_id)
        own_name = joint_name(model, joint_id)
        kind = mujoco.mjtJoint(int(joint.type[0]))
        if kind not in JOINT_TYPES:
            raise ValueError(
                f"joint {own_name!r} of body {name!r} is a {kind.name}: only hinges "
                "and slides are supported below the base; replace a ball joint by "
                "three hinges, and choose a body with a free joint as the base "
                "(base in robot.toml, or read_robot(path, base=...))"
            )
        # R(q - ref) = R(-ref) R(q), and likewise for a slide.
        reference = float(model.qpos0[joint.qposadr[0]])
        turn = np.array([1.0, 0.0, 0.0, 0.0])
        if kind == mujoco.mjtJoint.mjJNT_HINGE:
            before, after = joint.pos, -joint.pos
            mujoco.mju_axisAngle2Quat(turn, joint.axis, -reference)
        else:
            before, after = -reference * joint.axis, np.zeros(3)
        mujoco.mju_mulPose(position, quat, position.copy(), quat.copy(), before, turn)
        append(
            # Frame names must be unique and differ from all body names.
            unique_name(model, mujoco.mjtObj.mjOBJ_BODY, f"{name}:{own_name}"),
            pk_frame.Joint(
                own_name,
                axis=torch.tensor(joint.axis),
                joint_type=JOINT_TYPES[kind],
                limits=tuple(joint.range) if model.jnt_limited[joint_id] else None,
                dtype=dtype,
            ),
        )
        position, quat = after, np.array([1.0, 0.0, 0.0, 0.0])
    if frames and not position.any():
        frames[-1].name = name
    else:
        append(name, pk_frame.Joint(f"{name}_fixed", dtype=dtype))
    return frames


def build_chain(
    model: mujoco.MjModel, base: str, dtype: torch.dtype = torch.float32
) -> pk.Chain:
    """Return the pytorch-kinematics chain of a MuJoCo model from a body downwards.

    Args:
        model: Compiled model; a body may have any number of hinges and slides.
        base: Root of the chain: the body with the free joint or, for a fixed-base
            robot, a body welded to the world or ``"world"`` itself. Its own pose and
            joints are not part of the chain.
        dtype: Type of the chain's constants. With float32 poses are accurate to about
            4e-7 m, also those computed in float64.

    Returns:
        A chain whose joints are those below the base and whose links are the base and
        the bodies below it, in the order and with the names of the model (if unnamed:
        `joint_name`, `body_name`). A body with several joints, or with a joint that is
        not at the body's origin, has additional frames, ``body:joint``.

    Raises:
        ValueError: If the model has no body of the base's name, a joint below the base
            is neither hinge nor slide, or too many bodies are nested in each other.
    """
    joint = pk_frame.Joint(f"{base}_fixed", dtype=dtype)
    root = pk_frame.Frame(base, link=pk_frame.Link(base), joint=joint)
    ends = {body_id(model, base): root}
    # Bodies come after their parents.
    for body in range(1, model.nbody):
        end = ends.get(int(model.body_parentid[body]))
        if end is None or body in ends:
            continue
        for frame in _body_frames(model, body, dtype):
            end.add_child(frame)
            end = frame
        ends[body] = end
    try:
        return pk.Chain(root, dtype=dtype)
    except RecursionError:
        raise ValueError(
            f"bodies below {base!r} are nested too deeply: pytorch-kinematics supports "
            f"about {sys.getrecursionlimit() - 100} levels"
        ) from None
