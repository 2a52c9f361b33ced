"""The H1-2's model file: values copied from Unitree's description, shapes, contacts."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from egoskin.robots.builtin import H1_2

MODEL = Path(__file__).parents[2] / "egoskin" / "assets" / "h1_2.xml"

LEG = ("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
JOINTS = [
    *(f"left_{joint}_joint" for joint in LEG),
    *(f"right_{joint}_joint" for joint in LEG),
    "torso_joint",
    *(f"left_{joint}_joint" for joint in ARM),
    *(f"right_{joint}_joint" for joint in ARM),
]
DEFAULT_POSE = {
    "hip_pitch": -0.16,
    "knee": 0.36,
    "ankle_pitch": -0.2,
    "shoulder_pitch": 0.4,
    "elbow": 0.3,
}
# Links inside their neighbours' shapes, by design.
BARE = {
    f"{side}_{link}"
    for side in ("left", "right")
    for link in ("ankle_pitch_link", "wrist_pitch_link", "wrist_yaw_link")
}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(MODEL))


def default_pose(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for joint, angle in DEFAULT_POSE.items():
        for side in ("left", "right"):
            data.joint(f"{side}_{joint}_joint").qpos[:] = angle
    return data


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    names = [model.geom(g).name for g in range(model.ngeom)]
    return [(names[a], names[b]) for a, b in data.contact.geom]


def test_total_mass_is_that_of_unitrees_description(model):
    assert model.body_mass.sum() == pytest.approx(66.98, abs=0.01)


def test_joints_are_a_free_one_and_21_hinges_in_unitrees_order(model):
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names == ["floating_base_joint", *JOINTS]
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert np.all(model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE)


@pytest.mark.parametrize(
    ("joint", "axis", "limits", "torque", "armature"),
    [
        ("left_hip_yaw_joint", "z", (-0.43, 0.43), 200, 0.025),
        ("right_hip_pitch_joint", "y", (-3.14, 2.5), 200, 0.025),
        ("left_hip_roll_joint", "x", (-0.43, 3.14), 200, 0.025),
        ("right_hip_roll_joint", "x", (-3.14, 0.43), 200, 0.025),
        ("left_knee_joint", "y", (-0.12, 2.19), 300, 0.040),
        ("left_ankle_pitch_joint", "y", (-0.897334, 0.523598), 60, 0.005),
        ("right_ankle_roll_joint", "x", (-0.261799, 0.261799), 40, 0.005),
        ("torso_joint", "z", (-2.35, 2.35), 200, 0.025),
        ("left_shoulder_pitch_joint", "y", (-3.14, 1.57), 40, 0.005),
        ("right_shoulder_roll_joint", "x", (-3.4, 0.38), 40, 0.005),
        ("left_shoulder_yaw_joint", "z", (-2.66, 3.01), 18, 0.002),
        ("right_elbow_joint", "y", (-0.95, 3.18), 18, 0.002),
    ],
)
def test_joint_has_unitrees_figures(model, joint, axis, limits, torque, armature):
    j = model.joint(joint)
    np.testing.assert_array_equal(j.axis, np.eye(3)["xyz".index(axis)])
    np.testing.assert_array_equal(j.range, limits)
    assert model.jnt_limited[j.id]
    np.testing.assert_array_equal(model.jnt_actfrcrange[j.id], (-torque, torque))
    assert model.jnt_actfrclimited[j.id]
    assert model.dof_armature[j.dofadr[0]] == armature


def test_rotor_gains_follow_from_the_armature(model):
    """kp = I w^2, kd = 2 zeta I w at 10 Hz and damping ratio 2, to one decimal."""
    kp, kd = H1_2.joint_gains("rotor_inertia")
    inertia, w = model.dof_armature[6:], 2 * np.pi * 10
    np.testing.assert_allclose(kp, inertia * w**2, rtol=5e-3)
    np.testing.assert_allclose(kd, 4 * inertia * w, rtol=0, atol=0.05)
    assert H1_2.joint_gains(None)[0].tolist() == kp.tolist()


@pytest.mark.parametrize(
    ("joint", "kp", "kd", "position"),
    [
        ("left_hip_yaw_joint", 200, 2.5, 0.0),
        ("right_hip_pitch_joint", 200, 2.5, -0.16),
        ("left_knee_joint", 300, 4, 0.36),
        ("right_ankle_pitch_joint", 40, 2, -0.2),
        ("left_ankle_roll_joint", 40, 2, 0.0),
        ("torso_joint", 300, 3, 0.0),
        ("right_shoulder_pitch_joint", 120, 2, 0.4),
        ("left_shoulder_yaw_joint", 120, 2, 0.0),
        ("right_elbow_joint", 80, 1, 0.3),
    ],
)
def test_real_gains_and_the_stance_are_unitrees(joint, kp, kd, position):
    index = H1_2.joints.index(joint)
    assert [gain[index] for gain in H1_2.joint_gains("real")] == [kp, kd]
    assert H1_2.default_joint_pos[index] == position


def test_joints_have_neither_damping_nor_friction_loss(model):
    assert not model.dof_damping.any()
    assert not model.dof_frictionloss.any()


def test_file_holds_the_robot_alone(model):
    assert (model.nu, model.nsensor, model.nkey, model.nmesh) == (0, 0, 0, 0)
    assert model.site("imu").pos == pytest.approx([-0.04452, -0.01891, 0.27756])
    assert np.all(model.geom_bodyid > 0)


def test_shapes_are_few_spheres_capsules_and_boxes_named_after_their_link(model):
    kinds = (
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_BOX,
    )
    assert np.isin(model.geom_type, kinds).all()
    assert model.ngeom <= 30
    for g in range(model.ngeom):
        body = model.body(model.geom_bodyid[g]).name
        assert model.geom(g).name.startswith(f"{body}_")


def test_every_link_has_a_shape_but_those_inside_their_neighbours(model):
    links = {model.body(b).name for b in range(1, model.nbody)}
    with_shape = {model.body(b).name for b in model.geom_bodyid}
    assert links - with_shape == BARE


def test_balls_and_floor_meet_every_shape(model):
    assert np.all(model.geom_conaffinity & 3 == 3)
    # The robot's own shapes have neither bit in contype: the world alone has both.
    assert not np.any(model.geom_contype & 3)


def test_self_collision_is_arm_torso_arm_arm_and_leg_leg(model):
    def part(geom: int) -> str:
        body = model.body(model.geom_bodyid[geom]).name
        if body in ("pelvis", "torso_link"):
            return body
        limb = (
            "arm" if any(k in body for k in ("shoulder", "elbow", "wrist")) else "leg"
        )
        return f"{body.split('_')[0]} {limb}"

    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    met = {
        frozenset((part(a), part(b)))
        for a in range(model.ngeom)
        for b in range(a)
        if contype[a] & conaffinity[b] or contype[b] & conaffinity[a]
    }
    assert met == {
        frozenset(("left arm", "torso_link")),
        frozenset(("right arm", "torso_link")),
        frozenset(("left arm", "right arm")),
        frozenset(("left leg", "right leg")),
    }


def test_masking_the_bits_with_3_turns_self_collision_off(model):
    spec = mujoco.MjSpec.from_file(str(MODEL))
    for geom in spec.geoms:
        geom.contype &= 3
        geom.conaffinity &= 3
    masked = spec.compile()
    crossed = {"left_hip_roll_joint": -0.43, "right_hip_roll_joint": 0.43}
    for candidate, expected in ((model, True), (masked, False)):
        data = default_pose(candidate)
        for joint, angle in crossed.items():
            data.joint(joint).qpos[:] = angle
        assert bool(touching(candidate, data)) is expected


def test_nothing_touches_in_the_default_pose(model):
    assert touching(model, default_pose(model)) == []


def test_nothing_touches_with_joint_noise_of_a_tenth(model):
    rng = np.random.default_rng(0)
    for _ in range(200):
        data = default_pose(model)
        data.qpos[7:] += rng.uniform(-0.1, 0.1, model.nq - 7)
        assert touching(model, data) == []


@pytest.mark.parametrize(
    ("pose", "first", "second"),
    [
        # Both hands in front of the chest, upper arms turned in: found by search.
        (
            {
                "shoulder_pitch": -0.95,
                "shoulder_roll": -0.3,
                "shoulder_yaw": 0.44,
                "elbow": 0.94,
            },
            "left_wrist_roll_link",
            "right_wrist_roll_link",
        ),
        ({"hip_roll": -0.3}, "left_", "right_"),
    ],
)
def test_limbs_that_cross_touch(model, pose, first, second):
    data = default_pose(model)
    for joint, angle in pose.items():
        # Roll and yaw are mirrored, pitch and elbow are not.
        mirror = -1 if joint.endswith(("roll", "yaw")) else 1
        data.joint(f"left_{joint}_joint").qpos[:] = angle
        data.joint(f"right_{joint}_joint").qpos[:] = mirror * angle
    pairs = [sorted(pair) for pair in touching(model, data)]
    assert any(a.startswith(first) and b.startswith(second) for a, b in pairs), pairs


def test_soles_are_level_and_just_above_the_floor_on_straight_legs(model):
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for side in ("left", "right"):
        foot = model.geom(f"{side}_ankle_roll_link_foot").id
        sole = data.geom_xpos[foot, 2] - model.geom_size[foot, 2]
        # 1.03 - 0.1632 - 0.4 - 0.4 - 0.02 - 0.045, the mesh's lowest point.
        assert sole == pytest.approx(0.0018, abs=1e-9)
        assert data.geom_xmat[foot, 8] == pytest.approx(1.0)


def mirrored(name: str) -> str:
    swap = {"left": "right", "right": "left"}
    return "_".join(swap.get(word, word) for word in name.split("_"))


def test_shapes_and_masses_mirror_left_to_right(model):
    data = default_pose(model)
    mujoco.mj_kinematics(model, data)
    flip = np.array([1.0, -1.0, 1.0])
    for g in range(model.ngeom):
        other = model.geom(mirrored(model.geom(g).name)).id
        np.testing.assert_array_equal(model.geom_size[g], model.geom_size[other])
        position = data.geom_xpos[other] * flip
        np.testing.assert_allclose(data.geom_xpos[g], position, atol=1e-6)
        a, b = (data.geom_xmat[i].reshape(3, 3) for i in (g, other))
        # A capsule has only its axis (z), without a sign; a box all three.
        axes = [2] if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE else [0, 1, 2]
        for axis in axes:
            cosine = abs(a[:, axis] @ (b[:, axis] * flip))
            assert cosine == pytest.approx(1.0, abs=1e-6)
    for b in range(1, model.nbody):
        other = model.body(mirrored(model.body(b).name)).id
        assert model.body_mass[b] == model.body_mass[other]
        np.testing.assert_array_equal(model.body_inertia[b], model.body_inertia[other])
