"""Check a robot before training.

egoskin robot check my_robot
egoskin robot check my_robot.py:ROBOT --out robot.png
egoskin robot check g1
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from egoskin.commands.errors import parse_subcommand
from egoskin.commands.skin import bare_links, views
from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import PhysicsConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.progress import counted
from egoskin.robots.builtin import ROBOTS
from egoskin.robots.checks import Finding, check_model, names_of
from egoskin.robots.config import RobotConfig
from egoskin.robots.own import raw_robot
from egoskin.robots.portable import Portable, make_portable
from egoskin.sensors.config import SkinConfig
from egoskin.sensors.skin.fit import fit_notes
from egoskin.storage.files import check_output
from egoskin.viewer.film import save_picture

# Duration of the standing test with zero action [s].
_STAND_S = 2.0
# A joint that an action of 1 moves by less than this is hardly usable [rad].
_SMALL_REACH = 0.1


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check a robot for problems in training, and draw it with its skin."""

    robot: Annotated[str, tyro.conf.Positional]
    """Its folder (with robot.toml), my_robot.py:ROBOT, an MJCF or URDF, or a name."""
    skin: SkinConfig = field(default_factory=SkinConfig)
    """Placement of the sensors."""
    out: Path | None = None
    """Picture to write, .png: the robot from the front and from behind."""

    def run(self) -> None:
        """Print the results of the checks; write the picture.

        Raises:
            ValueError: If the robot cannot be trained.
        """
        check_output(self.out, "--out", (".png",))
        robot = original = raw_robot(self.robot)
        meshes: list[Finding] = []
        if ROBOTS.get(robot.name) is not robot:
            made = make_portable(robot)
            robot, meshes = made.robot, list(_meshes(made))
        mass = float(robot.model.body_mass.sum())
        print(
            f"{robot.name}: {counted(len(robot.joints), 'joint')}, "
            f"{counted(len(robot.links), 'link')}, {mass:.2f} kg"
        )
        wrong = 0
        for finding in (*meshes, *findings(robot, self.skin, original)):
            print(f"  {finding.kind:<5}  {finding.text}", flush=True)
            wrong += finding.kind == "wrong"
        if self.out is not None:
            save_picture(self.out, views(robot, self.skin.build(robot)))
            print(f"{self.out}: the robot with its skin")
        if wrong:
            raise ValueError(
                f"{robot.name} cannot be trained: fix the {counted(wrong, 'error')} "
                "above"
            )


def _meshes(made: Portable) -> Iterator[Finding]:
    """Tell what became of collision meshes and ellipsoids."""
    if fits := made.fits:
        excess = [fit.excess for fit in fits]
        shapes = ", ".join(
            f"{fit.link} ({', '.join(each.kind for each in fit.primitives)})"
            for fit in fits
        )
        yield Finding(
            "note",
            "collision meshes and ellipsoids become primitives around them, of "
            f"{min(excess):.1f} to {max(excess):.1f} times the volume of their convex "
            f"hulls: {shapes}",
        )
    if made.lost:
        yield Finding(
            "note",
            f"{', '.join(made.lost)}: collision meshes that are not found, or neither "
            "binary STL nor OBJ with a volume, are left out; balls pass through, so "
            "add primitives",
        )


def findings(
    robot: RobotConfig, skin: SkinConfig, original: RobotConfig
) -> Iterator[Finding]:
    """Check a robot, from its model to how it stands.

    Args:
        robot: The robot.
        skin: Placement of its sensors.
        original: The robot with its visual shapes.
    """
    static = [*check_model(robot), *_skin(robot, skin, original)]
    yield from static
    if any(finding.kind == "wrong" for finding in static):
        yield Finding("note", "whether it stands is tested once this is fixed")
        return
    yield from _actuation(robot)
    yield from _standing(robot)


def _skin(
    robot: RobotConfig, skin: SkinConfig, original: RobotConfig
) -> Iterator[Finding]:
    """Check the links that carry sensors, at which the throws are aimed."""
    if not robot.skin_links:
        yield Finding("wrong", "no skin_links to place sensors on and to aim balls at")
        return
    for name in ("skin_links", "untargeted_links"):
        if missing := sorted({*getattr(robot, name)} - {*robot.links}):
            yield Finding("wrong", f"{name} that are not links: {', '.join(missing)}")
            return
    try:
        made = skin.build(robot)
    except ValueError as error:
        yield Finding("wrong", str(error))
        return
    on = counted(len(set(made.links)), "link")
    yield Finding("ok", f"skin: {counted(len(made), 'sensor')} on {on}")
    for text in bare_links(robot, robot.skin_links, original):
        yield Finding("note", f"skin: {text}, and balls pass through")
    for text in fit_notes(made, robot):
        yield Finding("note", f"skin: {text}")


def _actuation(robot: RobotConfig) -> Iterator[Finding]:
    """Check how far an action moves the joints."""
    scale = DodgeballConfig().action_scale
    for name in robot.gains:
        kp, _ = robot.joint_gains(name)
        reach = scale * robot.torque_limit / kp
        yield Finding(
            "ok",
            f"gains {name}: an action of 1 moves a joint by {reach.min():.2f} to "
            f"{reach.max():.2f} rad (half of them by {np.median(reach):.2f} or more)",
        )
        if small := names_of(robot, reach < _SMALL_REACH):
            yield Finding(
                "note",
                f"... by less than {_SMALL_REACH:g} rad: {small}; too stiff for their "
                "torque limit, a policy can hardly move them",
            )


def _standing(robot: RobotConfig) -> Iterator[Finding]:
    """Check whether it stands with zero action, for each set of gains."""
    for name in robot.gains:
        task = DodgeballConfig(
            physics=PhysicsConfig(gains=name),
            # No ball is thrown during the test.
            throws=ThrowConfig(first_delay=(10 * _STAND_S, 10 * _STAND_S)),
            start_joint_noise=0.0,
        )
        env = DodgeballEnv(robot, task, num_envs=1)
        td, hz = env.reset(), task.physics.control_hz
        fell, touched = math.inf, False
        for step in range(1, round(_STAND_S * hz) + 1):
            td["action"] = torch.zeros(env.action_spec.shape)
            td = env.step(td)["next"]
            if td["diverged"].item():
                yield Finding(
                    "wrong",
                    f"gains {name}: the simulation fails after {step / hz:.2f} s; "
                    "masses, armature or gains are out of proportion",
                )
                break
            if step == 1:
                touched = bool(td["self_contact"].item())
            if td["fallen"].item():
                fell = step / hz
                break
        else:
            yield Finding("ok", f"gains {name}: it stands for {_STAND_S:g} s by itself")
        if touched:
            yield Finding("note", "it touches itself in its default pose")
        if fell < 0.5:
            yield Finding(
                "wrong",
                f"gains {name}: it falls within {fell:.2f} s, before it can learn: "
                "check the default pose and the feet",
            )
        elif math.isfinite(fell):
            yield Finding(
                "note",
                f"gains {name}: without an action it falls after {fell:.1f} s; it must "
                "learn to stand (as the H1-2, after 1.7 s)",
            )


def main(args: list[str]) -> None:
    """Run the command."""
    parse_subcommand({"check": Check}, args, description=__doc__).run()
