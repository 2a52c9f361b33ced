"""Fixtures shared by several test files: the robot, random states, small robots."""

from __future__ import annotations

from egoskin.viewer import draw_without_display

# Before mujoco is first imported.
draw_without_display()

# isort: split

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings
from tensordict import TensorDict

from calling import BATCH, SCHEDULES, SMALL, succeed
from egoskin.robots.builtin import H1_2
from egoskin.robots.config import RobotConfig
from egoskin.sensors import Skin, place_sensors
from egoskin.sensors.kernels import compilation

# The same examples in every run: a test fails with the change that broke it.
settings.register_profile(
    "egoskin", deadline=None, derandomize=True, max_examples=50, database=None
)
settings.load_profile("egoskin")

# A shell that starts the tests in the background ignores it, and children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Compiling takes longer than all the rest and changes no result: only its own tests
# compile.
os.environ[compilation.SETTING] = "0"


@pytest.fixture(autouse=True)
def same_numbers_in_any_order() -> None:
    """Torch's global generator: without this, its numbers depend on earlier tests."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def robot() -> RobotConfig:
    return H1_2


@pytest.fixture(scope="session")
def skin(robot: RobotConfig) -> Skin:
    """64 sensors on the upper body."""
    return place_sensors(robot, 64, seed=0)


@pytest.fixture(scope="session")
def random_joint_pos(robot: RobotConfig) -> Callable[..., torch.Tensor]:
    """Function of (n, seed, dtype): joint positions uniform over their ranges."""

    def draw(n: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        low, high = robot.model.jnt_range[1:].T
        values = np.random.default_rng(seed).uniform(low, high, (n, len(low)))
        return torch.from_numpy(values).to(dtype)

    return draw


@pytest.fixture(scope="session")
def random_state(
    robot: RobotConfig, random_joint_pos: Callable[..., torch.Tensor]
) -> Callable[..., TensorDict]:
    """Function of (n, seed, dtype, objects): raw states like the environment's.

    The base is within 2 m, at a random orientation; objects within about 2 m of it.
    """

    def draw(
        n: int, seed: int = 0, dtype: torch.dtype = torch.float32, objects: int = 2
    ) -> TensorDict:
        rng = np.random.default_rng(seed)

        def normal(*shape: int) -> torch.Tensor:
            return torch.from_numpy(rng.normal(size=(n, *shape))).to(dtype)

        position = torch.from_numpy(rng.uniform(-2, 2, (n, 3))).to(dtype)
        quat = torch.nn.functional.normalize(normal(4), dim=-1)
        object_pos = position[:, None] + 0.8 * normal(objects, 3)
        upright = object_pos.new_tensor([1.0, 0, 0, 0]).expand(n, objects, 4)
        return TensorDict(
            {
                "base_pose": torch.cat((position, quat), -1),
                "base_lin_vel_w": normal(3),
                "base_ang_vel_b": normal(3),
                "joint_pos": random_joint_pos(n, seed, dtype),
                "joint_vel": normal(len(robot.joints)),
                "object_pose": torch.cat((object_pos, upright), -1),
                "object_lin_vel_w": normal(objects, 3),
                "object_active": torch.from_numpy(rng.random((n, objects)) < 0.8),
                "displacement_w": position[:, :2].clone(),
                "previous_action": normal(len(robot.joints)),
            },
            batch_size=[n],
        )

    return draw


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of four rollouts; tests that change it must copy it."""
    folder = tmp_path_factory.mktemp("runs") / "trained"
    size = ("--total-frames", 4 * BATCH)
    succeed("train", *SMALL, *SCHEDULES, *size, "--run-dir", folder)
    return folder


@pytest.fixture
def small_robot(tmp_path: Path) -> Callable[..., RobotConfig]:
    """Function of (the MJCF inside the base body): a robot with that base alone."""

    def build(content: str) -> RobotConfig:
        path = tmp_path / "small.xml"
        path.write_text(
            "<mujoco><worldbody><body name='base'><freejoint/>"
            f"<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>{content}"
            "</body></worldbody></mujoco>"
        )
        return RobotConfig(
            name="small",
            model_path=path,
            base="base",
            skin_links=("base",),
        )

    return build
