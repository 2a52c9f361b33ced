"""Fast kinematics against MuJoCo and pytorch-kinematics; quaternions against MuJoCo."""

from __future__ import annotations

import copy
import math
import pickle
from importlib.util import find_spec

import mujoco
import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.robots.kinematics import (
    LinkKinematics,
    quat_to_matrix,
    rotate,
    rotate_inverse,
)
from egoskin.rounding import pad_rows, sincos

DTYPES = [torch.float32, torch.float64]
# pytorch-kinematics stores the robot's constants in float32 for any joint dtype.
TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def every_link() -> LinkKinematics:
    return LinkKinematics(H1_2.chain, H1_2.links)


def mujoco_poses(joint_pos: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and rotations of all links, the base at the world's origin."""
    model, data = H1_2.model, mujoco.MjData(H1_2.model)
    position, rotation = [], []
    for row in joint_pos.double().numpy():
        data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        data.qpos[7:] = row
        mujoco.mj_kinematics(model, data)
        position.append(data.xpos[1:].copy())
        rotation.append(data.xmat[1:].reshape(-1, 3, 3).copy())
    return np.array(position), np.array(rotation)


@pytest.mark.parametrize("dtype", DTYPES)
def test_link_poses_equal_those_of_mujoco(every_link, random_joint_pos, dtype):
    joint_pos = random_joint_pos(200, 0, dtype)
    position, rotation = every_link.poses_b(joint_pos)
    assert position.dtype == rotation.dtype == dtype
    expected_position, expected_rotation = mujoco_poses(joint_pos)
    np.testing.assert_allclose(position, expected_position, 0, TOLERANCE)
    np.testing.assert_allclose(rotation, expected_rotation, 0, TOLERANCE)


@pytest.mark.parametrize("dtype", DTYPES)
def test_link_poses_equal_those_of_pytorch_kinematics(
    every_link, random_joint_pos, dtype
):
    joint_pos = random_joint_pos(200, 1, dtype)
    position, rotation = every_link.poses_b(joint_pos)
    chain = copy.deepcopy(H1_2.chain).to(dtype=dtype)
    frames = chain.forward_kinematics(joint_pos)
    for i, name in enumerate(H1_2.links):
        matrix = frames[name].get_matrix().expand(200, 4, 4)
        np.testing.assert_allclose(position[:, i], matrix[:, :3, 3], 0, TOLERANCE)
        np.testing.assert_allclose(rotation[:, i], matrix[:, :3, :3], 0, TOLERANCE)


URDF = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/>
<joint name="first" type="continuous"><parent link="base"/><child link="a"/>
  <axis xyz="0 0 1"/></joint>
<joint name="second" type="prismatic"><parent link="base"/><child link="b"/>
  <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"second"', '"first"', "two joints of the chain have the name 'first'"),
        (
            'child link="b"',
            'child link="a"',
            "two links of the chain have the name 'a'",
        ),
        ("0 1 0", "0 0 0", "axis of joint 'second' must not be zero"),
    ],
)
def test_a_chain_that_does_not_say_what_is_meant_is_refused(old, new, expected):
    LinkKinematics(pk.build_chain_from_urdf(URDF), ["a", "b"])
    chain = pk.build_chain_from_urdf(URDF.replace(old, new))
    links = [name for name in ("a", "b") if name in chain.get_link_names()]
    with pytest.raises(ValueError, match=expected):
        LinkKinematics(chain, links)


def test_no_pose_takes_a_link_beyond_its_reach(every_link, random_joint_pos):
    reach = dict(zip(H1_2.links, every_link.reach(), strict=True))
    position, _ = every_link.poses_b(random_joint_pos(200, 2))
    farthest = position.norm(dim=-1).amax(0)
    assert (farthest <= torch.tensor([*reach.values()]) + TOLERANCE).all()
    # Limbs are alike on both sides: a branch does not count for another one.
    for link in H1_2.links:
        assert reach[link.replace("left", "right")] == pytest.approx(reach[link])


def test_a_slide_takes_a_link_anywhere():
    # 0.3 and 0.4 m aside.
    urdf = URDF.replace(
        """link="a"/>
""",
        """link="a"/><origin xyz="0.3 0.4 0"/>
""",
    )
    chain = pk.build_chain_from_urdf(urdf)
    assert LinkKinematics(chain, ["b", "a"]).reach() == [math.inf, pytest.approx(0.5)]


@given(st.lists(st.sampled_from(H1_2.links), min_size=1, max_size=6, unique=True))
def test_pruning_changes_no_bit(every_link, random_joint_pos, links):
    joint_pos = random_joint_pos(32)
    position, rotation = every_link.poses_b(joint_pos)
    some_position, some_rotation = LinkKinematics(H1_2.chain, links).poses_b(joint_pos)
    index = [H1_2.links.index(name) for name in links]
    assert torch.equal(some_position, position[:, index])
    assert torch.equal(some_rotation, rotation[:, index])


@given(st.lists(st.integers(0, 63), min_size=1, max_size=40))
def test_a_padded_subset_is_bit_identical_to_the_whole(every_link, rows):
    generator = torch.Generator().manual_seed(0)
    joint_pos = torch.rand(64, len(H1_2.joints), generator=generator)
    position, rotation = every_link.poses_b(joint_pos)
    subset = every_link.poses_b(joint_pos[pad_rows(torch.tensor(rows))])
    assert torch.equal(subset[0][: len(rows)], position[rows])
    assert torch.equal(subset[1][: len(rows)], rotation[rows])


@given(st.lists(st.integers(0, 999), min_size=1, max_size=70))
def test_padding_keeps_the_rows_and_repeats_the_first(rows):
    padded = pad_rows(torch.tensor(rows))
    assert padded[: len(rows)].tolist() == rows
    assert (padded[len(rows) :] == rows[0]).all()
    assert len(padded) - len(rows) < 32


@pytest.mark.parametrize("dtype", DTYPES)
def test_elementary_functions_of_padded_rows_do_not_depend_on_the_batch(dtype):
    # atan2 is the function of this project whose scalar tail rounds differently.
    generator = torch.Generator().manual_seed(0)
    x, y = torch.randn(2, 1024, generator=generator, dtype=dtype)
    whole = torch.atan2(y, x)
    for n in range(1, 100):
        rows = torch.arange(n) * 7
        padded = pad_rows(rows)
        assert torch.equal(torch.atan2(y[padded], x[padded])[:n], whole[rows])


def test_unknown_link_is_refused_by_name():
    with pytest.raises(ValueError, match=r"'torso' is not in the chain.*torso_link"):
        LinkKinematics(H1_2.chain, ["pelvis", "torso"])


def test_chain_takes_a_hinge_about_an_oblique_axis(small_robot):
    robot = small_robot(
        "<geom size='.1'/><body name='arm' pos='0 0 1'><joint axis='1 2 -2'/>"
        "<geom size='.1'/></body>"
    )
    angle = 0.7
    _, rotation = LinkKinematics(robot.chain, ["arm"]).poses_b(torch.tensor([[angle]]))
    expected = np.zeros(9)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.array([1, 2, -2]) / 3, angle)
    mujoco.mju_quat2Mat(expected, quat)
    np.testing.assert_allclose(rotation[0, 0], expected.reshape(3, 3), 0, 1e-6)


COMPONENT = st.floats(-1, 1, width=32)


@given(
    st.tuples(*[COMPONENT] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.tuples(*[COMPONENT] * 3),
)
def test_rotations_equal_those_of_mujoco(quat, vector):
    quat = np.array(quat, float) / np.linalg.norm(quat)
    vector = np.array(vector, float)
    inverse, turned, back = np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_rotVecQuat(turned, vector, quat)
    mujoco.mju_negQuat(inverse, quat)
    mujoco.mju_rotVecQuat(back, vector, inverse)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)

    q, v = torch.from_numpy(quat), torch.from_numpy(vector)
    np.testing.assert_allclose(rotate(q, v), turned, 0, 1e-12)
    np.testing.assert_allclose(rotate_inverse(q, v), back, 0, 1e-12)
    np.testing.assert_allclose(quat_to_matrix(q), matrix.reshape(3, 3), 0, 1e-12)


def test_a_quarter_turn_about_z_takes_x_to_y():
    # cos 45 deg, sin 45 deg about z
    quat = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5])
    x, y = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    torch.testing.assert_close(rotate(quat, x), y)
    torch.testing.assert_close(rotate_inverse(quat, y), x)


def test_quaternions_take_any_leading_dimensions():
    generator = torch.Generator().manual_seed(0)
    quat = torch.randn(3, 4, 5, 4, generator=generator)
    quat = quat / quat.norm(dim=-1, keepdim=True)
    vector = torch.randn(3, 4, 5, 3, generator=generator)
    product = (quat_to_matrix(quat) @ vector[..., None])[..., 0]
    torch.testing.assert_close(rotate(quat, vector), product)
    torch.testing.assert_close(rotate_inverse(quat, product), vector)


@pytest.mark.parametrize(
    ("dtype", "atol"), [(torch.float32, 1e-7), (torch.float64, 4e-16)]
)
@given(st.lists(st.floats(-100, 100, width=32), min_size=1, max_size=40))
def test_sines_and_cosines_are_right_to_the_last_bits(dtype, atol, angles):
    x = torch.tensor(angles, dtype=dtype)
    exact = np.array(angles)
    sin, cos = sincos(x)
    assert sin.dtype == cos.dtype == dtype
    np.testing.assert_allclose(sin, np.sin(exact), 0, atol)
    np.testing.assert_allclose(cos, np.cos(exact), 0, atol)


def test_sines_of_nan_are_nan():
    for value in sincos(torch.tensor([math.nan, 0.0])):
        assert value.isnan().tolist() == [True, False]


@pytest.mark.slow
@pytest.mark.warp
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="needs mujoco-warp")
@pytest.mark.parametrize("slides", [False, True])
def test_the_kernel_of_a_gpu_gives_the_same_bits(monkeypatch, random_joint_pos, slides):
    kinematics = LinkKinematics(H1_2.chain, H1_2.links)
    joint_pos = 5 * random_joint_pos(300)
    if slides:
        chain = pk.build_chain_from_urdf(URDF)
        kinematics = LinkKinematics(chain, ["a", "b"])
        joint_pos = joint_pos[:, : kinematics.num_joints]
    expected = [kinematics.link_frames(x) for x in (joint_pos, joint_pos[:0])]
    monkeypatch.setattr("egoskin.robots.kinematics.uses_warp", lambda *inputs: True)
    # A copy makes its own kernel.
    copied = pickle.loads(pickle.dumps(kinematics))
    for fast in (kinematics, copied):
        for x, frames in zip((joint_pos, joint_pos[:0]), expected, strict=True):
            assert all(map(torch.equal, fast.link_frames(x), frames))
            strided = x.t().contiguous().t()
            assert all(map(torch.equal, fast.link_frames(strided), frames))
        assert fast._warp
    # Derivatives, and float64, are PyTorch's.
    assert kinematics.link_frames(joint_pos.double())[1].dtype == torch.float64
    kinematics.link_frames(joint_pos.requires_grad_())[1].sum().backward()
    assert joint_pos.grad is not None
