"""Names and meshes of a compiled MuJoCo model."""

from __future__ import annotations

import mujoco
import numpy as np

from egoskin.hints import did_you_mean

_BODY, _JOINT = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_JOINT


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body; a generated one if it is unnamed in the model.

    A generated name is ``body2``, or ``body2_`` if another body has that name.
    """
    return model.body(body).name or unique_name(model, _BODY, f"body{body}")


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name of a joint; a generated one if it is unnamed in the model.

    A generated name is ``joint3``, or ``joint3_`` if another joint has that name.
    """
    return model.joint(joint).name or unique_name(model, _JOINT, f"joint{joint}")


def unique_name(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> str:
    """Return a name, with underscores appended until it is unique."""
    while mujoco.mj_name2id(model, kind, name) >= 0:
        name += "_"
    return name


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of the body with a name, which may be a generated one.

    Raises:
        ValueError: If no body has the name.
    """
    names = [body_name(model, body) for body in range(model.nbody)]
    if name not in names:
        known = ", ".join(map(repr, sorted(names)))
        hint = did_you_mean(name, names)
        raise ValueError(f"the model has no body {name!r}{hint}; it has {known}")
    return names.index(name)


def geom_mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh of a geom that is one, as MuJoCo stores it.

    Returns:
        (vertices in the frame of the geom [m], ``[V, 3]``; their indices by face,
        ``[F, 3]``).
    """
    mesh = model.geom_dataid[geom]
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return (
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
        model.mesh_face[face : face + model.mesh_facenum[mesh]],
    )
