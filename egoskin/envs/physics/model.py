"""The MuJoCo model of a scene, shared by all MuJoCo-based engines."""

from __future__ import annotations

import mujoco
import numpy as np

from egoskin.envs.physics.contract import GRAVITY, OBJECT_MASS, Scene

# Contact bits of the model files: in a geom's conaffinity, 1 is balls and 2 the floor;
# higher bits are self-collision. Objects and floor have conaffinity 0.
_BALL_BIT, _FLOOR_BIT = 1, 2
# Maximum Newton iterations per physics step; even a fall seldom needs as many.
_SOLVER_ITERATIONS = 10
PARKING = np.array([0.0, 0.0, 1000.0])
"""Position of inactive objects, far above the scene [m]."""
MAX_SPEED = 200.0
"""A row diverges, and is reset, if a robot velocity exceeds this [m/s, rad/s]."""


def build_scene(scene: Scene) -> mujoco.MjModel:
    """Return the compiled model of a robot on a floor with objects to throw.

    Position actuators implement the PD law, evaluated in every substep.

    Args:
        scene: The scene; the robot's MJCF has no floor, actuators or sensors, and its
            options (``<option>``) are ignored.

    Raises:
        ValueError: If the robot's base does not float, a joint is not a hinge, or
            MuJoCo cannot compile the scene.
    """
    robot, config = scene.robot, scene.config
    robot.check_floating_base()
    spec = robot.spec()
    named = [each.name for each in (*spec.bodies, *spec.geoms, *spec.joints)]
    if taken := [x for x in named if x == "floor" or x.startswith("object")]:
        raise ValueError(
            f"{robot.name}: {taken[0]!r} is a name of the scene (floor, object..): "
            "rename it in the robot"
        )
    # A new specification has no settings of the robot's file.
    plain = mujoco.MjSpec()
    spec.option = plain.option
    option = spec.option
    option.gravity = [0, 0, -GRAVITY]
    option.timestep = config.timestep
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Dense: MuJoCo 4.0.0's Newton solver can be wrong with a sparse Jacobian.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations = _SOLVER_ITERATIONS

    # Elements start from the default class they are given; the robot's is not ours.
    spec.worldbody.add_geom(
        default=plain.default,
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=_FLOOR_BIT,
        conaffinity=0,
    )
    # Slide joints instead of a free joint: contact ends the episode, so objects need
    # not rotate, which saves three degrees of freedom each. The common parent lets one
    # contact sensor refer to all objects.
    parent = spec.worldbody.add_body(name="objects")
    axes = ([1, 0, 0], [0, 1, 0], [0, 0, 1])
    for i, shape in enumerate(scene.objects):
        body = parent.add_body(
            name=f"object_{i}", gravcomp=float(scene.weightless_objects)
        )
        for axis, letter in zip(axes, "xyz", strict=True):
            body.add_joint(
                default=plain.default,
                name=f"object_{i}_{letter}",
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=axis,
            )
        shape.add_geom(
            body,
            default=plain.default,
            name=f"object_{i}",
            mass=OBJECT_MASS,
            contype=_BALL_BIT,
            conaffinity=0,
            rgba=[0.9, 0.35, 0.1, 1],
        )

    kp, kd = robot.joint_gains(config.gains)
    for name, p, d, limit in zip(robot.joints, kp, kd, robot.torque_limit, strict=True):
        actuator = spec.add_actuator(
            default=plain.default,
            name=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=name,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        actuator.gainprm[0] = p
        actuator.biasprm[1:3] = -p, -d
    _add_contact_sensors(spec, scene)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot compile the scene: {text}") from error


def _add_contact_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Add contact-count sensors in the order in which an engine's step reads them."""
    body, subtree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    robot, floor = (subtree, scene.robot.base), (mujoco.mjtObj.mjOBJ_GEOM, "floor")
    objects = [(body, f"object_{i}") for i in range(len(scene.objects))]

    def add(obj: tuple, ref: tuple) -> None:
        sensor = spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=obj[0],
            objname=obj[1],
            reftype=ref[0],
            refname=ref[1],
        )
        # intprm: data fields (bit 0: found), reduction (0: none), slots.
        sensor.intprm[:3] = 1, 0, 1

    for thrown in objects:
        add(robot, thrown)
    add(robot, robot)
    add(robot, floor)
    for foot in scene.robot.feet:
        add((body, foot), floor)
    if scene.link_contacts:
        for link in scene.robot.links:
            add((body, link), (subtree, "objects"))
            add((body, link), floor)
