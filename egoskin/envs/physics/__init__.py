"""Physics: the engine interface (`contract`) and the engines, one file each."""

from __future__ import annotations

from typing import Literal, get_args

from egoskin.envs.physics.contract import (
    OBJECT_MASS,
    Physics,
    PhysicsConfig,
    PhysicsState,
    Scene,
    StepResult,
    Variation,
)
from egoskin.envs.physics.mujoco import MujocoPhysics

Engine = Literal["mujoco", "warp"]
"""Engines by name: MuJoCo on the CPU; MuJoCo Warp, on a GPU or, slowly, on the CPU."""


def engine_of(name: Engine) -> type[Physics]:
    """Return the class of an engine.

    Raises:
        ValueError: If there is no such engine, or its package is not installed.
    """
    if name not in get_args(Engine):
        raise ValueError(
            f"engine must be one of {', '.join(get_args(Engine))}, got {name!r}"
        )
    if name == "mujoco":
        return MujocoPhysics
    try:
        from egoskin.envs.physics.warp import WarpPhysics
    except ModuleNotFoundError as error:
        raise ValueError(
            f"engine warp needs {error.name}: `pip install 'egoskin[gpu]'` (Python "
            "3.11 or later)"
        ) from error
    return WarpPhysics


__all__ = [
    "OBJECT_MASS",
    "Engine",
    "MujocoPhysics",
    "Physics",
    "PhysicsConfig",
    "PhysicsState",
    "Scene",
    "StepResult",
    "Variation",
    "engine_of",
]
