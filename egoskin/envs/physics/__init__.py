"""Physics: what an engine must do (`contract`), and the engines, a file each."""

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

DEFAULT_ENGINE: type[Physics] = MujocoPhysics
"""What simulates unless another engine is asked for."""

__all__ = [
    "DEFAULT_ENGINE",
    "OBJECT_MASS",
    "Physics",
    "PhysicsConfig",
    "PhysicsState",
    "Scene",
    "StepResult",
    "Variation",
]
