"""Kinematic chains, for pytorch-kinematics, of compiled MuJoCo models.

`pytorch_kinematics.build_chain_from_mjcf` fails with MuJoCo 4 (its table of joint types
is keyed by an enum that no longer equals an integer) and keeps the root's offset.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytorch_kinematics as pk
import torch
from pytorch_kinematics import frame as pk_frame

JOINT_TYPES = {
    mujoco.mjtJoint.mjJNT_HINGE: "revolute",
    mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
}
"""Joints that pytorch-kinematics has, by MuJoCo's type."""


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body, ``body2`` if the model gives it none."""
    return model.body(body).name or f"body{body}"


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name of a joint, ``joint3`` if the model gives it none."""
    return model.joint(joint).name or f"joint{joint}"


def _body_frames(
    model: mujoco.MjModel, body_id: int, dtype: torch.dtype
) -> list[pk_frame.Frame]:
    """Return the frames that lead from a body's parent to the body, in series.

    MuJoCo turns a hinge about the axis through its ``pos`` p: T(p) R(q - ref) T(-p).
    A frame of pytorch-kinematics has a fixed offset before its joint and none after, so
    T(-p) goes to the next frame, and there is one more frame after the last such joint.
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
                f"joint {own_name!r} of body {name!r} is a {kind.name}: below the "
                "base there may only be hinges and slides; write a ball joint as three "
                "hinges, and choose a body with a free joint as the base"
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
            f"{name}:{own_name}",
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
        model: Compiled model with any number of hinges and slides in a body.
        base: Root of the chain: the body with the free joint or, of a robot that stands
            fixed, one that is welded to the world, or ``"world"`` itself. Its own pose
            and joints are not part of the chain.
        dtype: Precision of the chain's constants.

    Returns:
        A chain whose joints and links are the joints below the base and the bodies from
        it on, in the order and with the names of the model (unnamed ones: ``joint3``,
        ``body2``). A body with several joints, or one that does not turn about the
        body's origin, has further frames, ``body:joint``.

    Raises:
        KeyError: If the model has no body of the base's name.
        ValueError: If a joint below the base is neither hinge nor slide.
    """

    def attach(parent: pk_frame.Frame, parent_id: int) -> None:
        """Append all that hangs on a body to its frame."""
        for body_id in range(1, model.nbody):
            if model.body_parentid[body_id] == parent_id:
                frame = parent
                for next_frame in _body_frames(model, body_id, dtype):
                    frame.add_child(next_frame)
                    frame = next_frame
                attach(frame, body_id)

    joint = pk_frame.Joint(f"{base}_fixed", dtype=dtype)
    root = pk_frame.Frame(base, link=pk_frame.Link(base), joint=joint)
    attach(root, model.body(base).id)
    return pk.Chain(root, dtype=dtype)
