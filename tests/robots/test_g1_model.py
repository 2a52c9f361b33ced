"""The G1's model: values copied from Unitree's description, shapes, contacts, skin."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.robots.builtin import G1, H1_2
from egoskin.sensors import place_sensors

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)
JOINTS = (
    *(f"left_{joint}_joint" for joint in LEG),
    *(f"right_{joint}_joint" for joint in LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"left_{joint}_joint" for joint in ARM),
    *(f"right_{joint}_joint" for joint in ARM),
)


def in_default_pose() -> mujoco.MjData:
    data = mujoco.MjData(G1.model)
    data.qpos[7:] = G1.default_joint_pos
    mujoco.mj_forward(G1.model, data)
    return data


def test_joints_and_mass_are_those_of_unitrees_description():
    assert G1.joints == JOINTS
    G1.check_floating_base()
    assert G1.model.body_mass.sum() == pytest.approx(33.34, abs=0.01)


@pytest.mark.parametrize(
    ("joint", "axis", "limits", "torque", "armature"),
    [
        ("left_hip_pitch_joint", "y", (-2.5307, 2.8798), 88, 0.01017752),
        ("right_hip_roll_joint", "x", (-2.9671, 0.5236), 139, 0.025101925),
        ("left_hip_yaw_joint", "z", (-2.7576, 2.7576), 88, 0.01017752),
        ("left_knee_joint", "y", (-0.087267, 2.8798), 139, 0.025101925),
        ("right_ankle_pitch_joint", "y", (-0.87267, 0.5236), 50, 0.00721945),
        ("waist_yaw_joint", "z", (-2.618, 2.618), 88, 0.01017752),
        ("waist_pitch_joint", "y", (-0.52, 0.52), 50, 0.00721945),
        ("left_shoulder_roll_joint", "x", (-1.5882, 2.2515), 25, 0.003609725),
        ("right_elbow_joint", "y", (-1.0472, 2.0944), 25, 0.003609725),
        ("left_wrist_pitch_joint", "y", (-1.61443, 1.61443), 5, 0.00425),
    ],
)
def test_a_joint_has_unitrees_figures(joint, axis, limits, torque, armature):
    model = G1.model
    j = model.joint(joint)
    np.testing.assert_array_equal(j.axis, np.eye(3)["xyz".index(axis)])
    np.testing.assert_array_equal(j.range, limits)
    np.testing.assert_array_equal(model.jnt_actfrcrange[j.id], (-torque, torque))
    assert model.dof_armature[j.dofadr[0]] == armature


def test_rotor_gains_follow_from_the_armature():
    """kp = I w^2, kd = 2 zeta I w at 10 Hz and damping ratio 2, to three digits."""
    kp, kd = G1.joint_gains("rotor_inertia")
    inertia, w = G1.model.dof_armature[6:], 2 * np.pi * 10
    np.testing.assert_allclose(kp, inertia * w**2, rtol=5e-3)
    np.testing.assert_allclose(kd, 4 * inertia * w, rtol=5e-3)
    assert G1.joint_gains(None)[0].tolist() == kp.tolist()


def test_it_is_as_tall_as_published_with_straight_legs():
    model, data = G1.model, mujoco.MjData(G1.model)
    mujoco.mj_kinematics(model, data)
    head = model.geom("torso_link_head").id
    foot = model.geom("left_ankle_roll_link_foot").id
    # The head is upright and the sole level in this pose.
    top = data.geom_xpos[head, 2] + model.geom_size[head, :2].sum()
    sole = data.geom_xpos[foot, 2] - model.geom_size[foot, 2]
    assert top - sole == pytest.approx(1.32, abs=0.02)
    assert G1.standing_height == 1.30
    assert H1_2.standing_height == 1.78


def test_nothing_touches_in_the_default_pose_and_the_mass_is_above_the_soles():
    data = in_default_pose()
    assert data.ncon == 0
    foot = G1.model.geom("left_ankle_roll_link_foot").id
    half = G1.model.geom_size[foot, 0]
    assert abs(data.subtree_com[1, 0] - data.geom_xpos[foot, 0]) < 0.5 * half
    assert data.geom_xmat[foot, 8] == pytest.approx(1.0, abs=1e-6)


def test_balls_and_floor_meet_every_shape():
    assert np.all(G1.model.geom_conaffinity & 3 == 3)
    assert not np.any(G1.model.geom_contype & 3)


def test_a_skin_of_48_sensors_sits_on_torso_and_arms():
    skin = place_sensors(G1, 48, 0, method="poisson_disk")
    assert len(skin) == 48
    assert set(skin.links) <= set(G1.skin_links)
    gaps = [
        np.linalg.norm(a - b)
        for i, a in enumerate(skin.position)
        for j, b in enumerate(skin.position[:i])
        if skin.links[i] == skin.links[j]
    ]
    assert min(gaps) > 0.03


def test_balls_are_released_at_heights_that_follow_from_the_robots():
    rows = torch.arange(64)
    zero = torch.zeros_like(rows)
    draws = [
        Thrower(ThrowConfig(), robot, 1 / 120).draw(0, rows, zero, zero)
        for robot in (G1, H1_2)
    ]
    torch.testing.assert_close(draws[0].height, draws[1].height * (1.30 / 1.78))
    assert torch.equal(draws[0].speed, draws[1].speed)
    assert 2 <= draws[1].height.min() < draws[1].height.max() <= 3
