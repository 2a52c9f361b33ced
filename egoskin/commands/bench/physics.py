"""Cost of modelling choices of the robot in raw physics."""

from __future__ import annotations

import time
from dataclasses import dataclass
from operator import truediv
from pathlib import Path
from typing import Annotated

import mujoco
import torch

from egoskin.bounds import COUNT, check_bounds
from egoskin.commands.bench.report import Row, median_row, show
from egoskin.envs.physics import PhysicsConfig, Scene
from egoskin.envs.physics.model import build_scene
from egoskin.envs.physics.mujoco import MujocoPhysics
from egoskin.envs.throws import ThrowConfig
from egoskin.make import AGENTS, EnvConfig


@dataclass(frozen=True, kw_only=True)
class PhysicsBench:
    """Cost of modelling choices, as environment steps/s of raw physics.

    One thread, CPU time. "stand" holds the default pose, "flail" draws new targets
    (standard deviation 0.4 rad) in every control step and falls.
    """

    num_envs: Annotated[int, AGENTS] = 256
    """Simulations."""
    steps: Annotated[int, COUNT] = 30
    """Control steps in each measurement."""
    rounds: Annotated[int, COUNT] = 15
    """How often each variant is measured, in turn."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


def physics_rows(config: PhysicsBench) -> list[Row]:
    """Return the rows of the physics benchmark; ratios are to the shipped model."""
    robot = EnvConfig().robot_config
    joints = slice(6, 6 + len(robot.joints))

    def build(name: str) -> MujocoPhysics:
        scene = Scene(
            robot=robot,
            objects=ThrowConfig().balls,
            config=PhysicsConfig(substeps=4 if name == "240_hz" else 2),
            weightless_objects=not ThrowConfig().gravity,
            link_contacts=name == "link_contacts",
        )
        model = build_scene(scene)
        if name == "no_self_collision":
            # Keep only the bits of balls and floor.
            model.geom_contype[:] &= 3
            model.geom_conaffinity[:] &= 3
        if name == "frictionloss":
            model.dof_frictionloss[joints] = 0.2
        if name == "damping":
            model.dof_damping[joints] = 1.0
        if name == "no_contact_sensors":
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        return MujocoPhysics(scene, config.num_envs, model=model)

    names = ("shipped", "no_self_collision", "frictionloss", "damping")
    names += ("240_hz", "link_contacts", "no_contact_sensors")
    variants = {name: build(name) for name in names}
    default = torch.from_numpy(robot.default_joint_pos).float()
    default = default.expand(config.num_envs, -1)
    pose = torch.zeros(config.num_envs, 7)
    pose[:, 2], pose[:, 3] = robot.default_base_height, 1.0
    speeds: dict[str, list[float]] = {}
    for i in range(config.rounds):
        for motion, noise in (("stand", 0.0), ("flail", 0.4)):
            for name, physics in variants.items():
                show(f"round {i + 1}/{config.rounds}: {motion} {name}")
                generator = torch.Generator().manual_seed(i)
                physics.reset(torch.arange(config.num_envs), pose, default)
                begin = time.process_time()
                for _ in range(config.steps):
                    shift = torch.randn(default.shape, generator=generator)
                    physics.set_target(default + noise * shift)
                    physics.step_raw()
                spent = time.process_time() - begin
                speed = config.steps * config.num_envs / spent
                speeds.setdefault(f"{motion}_{name}", []).append(speed)
    show("")
    return [
        median_row(
            name,
            each,
            map(truediv, each, speeds[f"{name.split('_')[0]}_shipped"]),
            "environment steps/s of one core",
        )
        for name, each in speeds.items()
    ]
