"""Check that a robot can be trained, from its model alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from egoskin.robots.config import RobotConfig


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    kind: Literal["ok", "note", "wrong"]
    """Fine; worth knowing; or an error that prevents training."""
    text: str
    """Description of the result, and what to do."""


def check_model(robot: RobotConfig) -> Iterator[Finding]:
    """Check base, joints, gains, limits, default pose, feet and shapes of a robot."""
    yield from _joints(robot)
    yield from _feet(robot)


def check_trainable(robot: RobotConfig) -> None:
    """Raise ValueError if a robot cannot be trained, with all reasons."""
    wrong = [each.text for each in check_model(robot) if each.kind == "wrong"]
    if wrong:
        raise ValueError(f"robot {robot.name} cannot be trained: {'; '.join(wrong)}")


def _joints(robot: RobotConfig) -> Iterator[Finding]:
    """Check base, joints, gains and limits."""
    try:
        robot.check_floating_base()
        yield Finding("ok", f"the base {robot.base} floats, all joints are hinges")
    except ValueError as error:
        yield Finding("wrong", str(error))
    try:
        for gains in robot.gains or [None]:
            robot.joint_gains(gains)
        yield Finding("ok", f"gains: {', '.join(robot.gains)} (the first is used)")
    except ValueError as error:
        yield Finding("wrong", str(error))
    without = names_of(robot, robot.torque_limit <= 0)
    if without:
        yield Finding(
            "wrong",
            f"no torque limit: {without}; set actuatorfrcrange of the joint (URDF: "
            "effort of its limit)",
        )
    ids = [robot.model.joint(name).id for name in robot.joints]
    lowest = robot.model.jnt_actfrcrange[ids, 0]
    if uneven := names_of(robot, lowest != -robot.torque_limit):
        yield Finding("wrong", f"actuatorfrcrange is not symmetric about 0: {uneven}")
    low, high = robot.joint_range
    if without := names_of(robot, np.isinf(low)):
        yield Finding(
            "note", f"no range: {without}; only their collision shapes limit them"
        )
    pose = robot.default_joint_pos
    outside = names_of(robot, (pose < low) | (pose > high))
    if outside:
        yield Finding("wrong", f"the default pose is out of range: {outside}")


def names_of(robot: RobotConfig, which: np.ndarray) -> str:
    """Return the names of the joints that a mask selects, ``[J]`` bool."""
    return ", ".join(np.array(robot.joints)[which])


def _feet(robot: RobotConfig) -> Iterator[Finding]:
    """Check the feet and the links that touch the ground."""
    if not robot.feet:
        yield Finding("wrong", "no feet: any contact with the floor counts as a fall")
    if missing := sorted({*robot.feet} - {*robot.links}):
        yield Finding("wrong", f"feet that are not links: {', '.join(missing)}")
    try:
        if not robot.primitives:
            yield Finding("wrong", "no collision shapes")
            return
        base, tall = robot.default_base_height, robot.standing_height
    except ValueError as error:
        yield Finding("wrong", str(error))
        return
    lowest = robot.lowest_link
    kind = "ok" if lowest in robot.feet else "wrong"
    yield Finding(
        kind,
        f"it stands on {lowest}{'' if kind == 'ok' else ', which is not a foot'}: "
        f"{tall:.2f} m tall, its base {base:.2f} m up",
    )
