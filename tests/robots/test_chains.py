"""Chains of any robot: MuJoCo and pytorch-kinematics must agree with each other."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.chains import build_chain
from egoskin.robots.kinematics import LinkKinematics

DTYPES = [torch.float32, torch.float64]
# Rounding of chains that reach a few metres, with room for a dozen products.
TOLERANCE = {torch.float32: 5e-6, torch.float64: 1e-12}
ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


def bodies_below(model: mujoco.MjModel, base: str) -> list[int]:
    """Return the base and all bodies below it, in MuJoCo's order."""
    found = [model.body(base).id]
    for body in range(1, model.nbody):
        if model.body_parentid[body] in found and body not in found:
            found.append(body)
    return found


def joints_below(model: mujoco.MjModel, base: str) -> list[int]:
    below = bodies_below(model, base)[1:]
    return [j for j in range(model.njnt) if model.jnt_bodyid[j] in below]


def mujoco_poses(
    model: mujoco.MjModel, base: str, joint_pos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of the bodies relative to the base, itself at any pose."""
    data, base_id = mujoco.MjData(model), model.body(base).id
    bodies = bodies_below(model, base)
    address = model.jnt_qposadr[joints_below(model, base)]
    rng = np.random.default_rng(0)
    position, rotation = [], []
    for row in joint_pos:
        data.qpos[:] = rng.normal(size=model.nq)
        data.qpos[address] = row
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[base_id].reshape(3, 3).T
        position.append((data.xpos[bodies] - data.xpos[base_id]) @ turn.T)
        rotation.append(turn @ data.xmat[bodies].reshape(-1, 3, 3))
    return np.array(position), np.array(rotation)


def assert_poses_agree(
    chain: pk.Chain,
    links: list[str],
    joint_pos: torch.Tensor,
    expected: tuple[np.ndarray, np.ndarray],
    atol: float,
) -> None:
    """Check that our poses and those of pytorch-kinematics are the expected ones."""
    position, rotation = LinkKinematics(chain, links).poses_b(joint_pos)
    np.testing.assert_allclose(position, expected[0], 0, atol)
    np.testing.assert_allclose(rotation, expected[1], 0, atol)
    frames = chain.forward_kinematics(joint_pos)
    for i, name in enumerate(links):
        matrix = frames[name].get_matrix()
        np.testing.assert_allclose(matrix[:, :3, 3], expected[0][:, i], 0, atol)
        np.testing.assert_allclose(matrix[:, :3, :3], expected[1][:, i], 0, atol)


def check(model: mujoco.MjModel, base: str, dtype: torch.dtype, rows: int = 20) -> None:
    chain = build_chain(model, base, dtype)
    links = [model.body(i).name or f"body{i}" for i in bodies_below(model, base)]
    joints = [model.joint(i).name for i in joints_below(model, base)]
    assert chain.get_link_names() == links
    assert chain.get_joint_parameter_names() == joints
    joint_pos = torch.from_numpy(
        np.random.default_rng(1).uniform(-2, 2, (rows, len(joints)))
    ).to(dtype)
    expected = mujoco_poses(model, base, joint_pos.double().numpy())
    assert_poses_agree(chain, links, joint_pos, expected, TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("file", "base"),
    [
        ("humanoid.xml", "torso"),  # several hinges in a body, off its origin
        ("humanoid.xml", "pelvis"),  # a part of a robot
        ("ant.xml", "torso"),
        ("half_cheetah.xml", "torso"),  # whose own joints are two slides and a hinge
        ("walker2d_v5.xml", "world"),  # its height is a slide with ref 1.25
        ("inverted_double_pendulum.xml", "world"),
        ("pusher_v5.xml", "r_shoulder_pan_link"),  # an arm bolted to the world
    ],
)
def test_chains_of_gymnasium_robots_agree_with_mujoco(file, base, dtype):
    check(mujoco.MjModel.from_xml_path(str(ASSETS / file)), base, dtype)


COORDINATE = st.floats(-1, 1)
VECTOR = st.tuples(*[COORDINATE] * 3)
DIRECTION = VECTOR.filter(lambda v: np.linalg.norm(v) > 0.1)
QUAT = st.tuples(*[COORDINATE] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
JOINT = st.fixed_dictionaries(
    {
        "type": st.sampled_from(
            [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE]
        ),
        "axis": DIRECTION | st.sampled_from([(1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0)]),
        "pos": VECTOR | st.just((0.0, 0.0, 0.0)),
        "ref": st.just(0.0) | st.floats(-1, 1),
    }
)
BODY = st.fixed_dictionaries(
    {
        "parent": st.integers(0, 3),
        "pos": VECTOR,
        "quat": QUAT | st.just((1.0, 0, 0, 0)),
        "joints": st.lists(JOINT, max_size=3),
    }
)


@given(st.lists(BODY, min_size=1, max_size=4), st.sampled_from(DTYPES))
def test_chains_of_any_robot_agree_with_mujoco(bodies, dtype):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    added = [spec.worldbody.add_body(name="base", pos=[1, 2, 3], quat=[1, 1, 0, 0])]
    for i, body in enumerate(bodies):
        parent = added[body["parent"] % len(added)]
        child = parent.add_body(name=f"b{i}", pos=body["pos"], quat=body["quat"])
        child.add_geom(size=[0.1, 0, 0])
        for j, joint in enumerate(body["joints"]):
            # An armature keeps the masses regular where two axes coincide.
            child.add_joint(name=f"j{i}{j}", armature=1, **joint)
        added.append(child)
    check(spec.compile(), "base", dtype, rows=3)


def one_body(joints: str, attributes: str = "name='arm'") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        "<mujoco><compiler angle='radian'/><worldbody><body name='base'>"
        f"<body {attributes}><geom size='.1'/>{joints}</body>"
        "</body></worldbody></mujoco>"
    )


def test_a_door_turns_about_its_hinge():
    # The hinge is at (1, 0, 0); a quarter turn takes the origin to (1, -1, 0).
    model = one_body("<joint name='hinge' axis='0 0 1' pos='1 0 0'/>")
    chain = build_chain(model, "base")
    quarter = torch.tensor([[torch.pi / 2]])
    position, rotation = LinkKinematics(chain, ["arm"]).poses_b(quarter)
    torch.testing.assert_close(
        position[0, 0], torch.tensor([1.0, -1, 0]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        rotation[0, 0] @ torch.tensor([1.0, 0, 0]),
        torch.tensor([0.0, 1, 0]),
        atol=1e-6,
        rtol=0,
    )


def test_a_drawer_slides_from_its_reference():
    # At its reference 0.5 m the drawer is where the model puts it; 0.7 is 0.2 further.
    model = one_body("<joint name='slide' type='slide' axis='0 2 0' ref='.5'/>")
    chain = build_chain(model, "base")
    position, _ = LinkKinematics(chain, ["arm"]).poses_b(torch.tensor([[0.7]]))
    torch.testing.assert_close(position[0, 0], torch.tensor([0.0, 0.2, 0]))


def test_unnamed_bodies_and_joints_get_names():
    chain = build_chain(one_body("<joint/><joint axis='1 0 0'/>", ""), "base")
    assert chain.get_link_names() == ["base", "body2"]
    assert chain.get_joint_parameter_names() == ["joint0", "joint1"]


TWINS = """<mujoco><worldbody><body name="b"><geom size=".05" mass="1"/>
<body name="x" pos="1 0 0"><joint axis="0 0 1"/><geom size=".1"/></body>
<body name="y" pos="0 1 0"><joint name="joint0" axis="0 0 1"/><geom size=".1"/>
  <body name="yy" pos=".5 0 0"><geom size=".1"/>
    <body pos=".1 0 0"><geom size=".1"/></body></body></body>
<body name="body5" pos="0 0 1"><geom size=".1"/></body>
<body name="d" pos="0 0 2"><geom size=".1"/>
  <joint name="j" axis="0 1 0" pos="1 0 0"/><joint axis="1 0 0"/></body>
<body name="d:j" pos="0 0 3"><joint name="joint3" axis="0 1 0"/><geom size=".1"/></body>
</body></worldbody></mujoco>"""


def test_made_names_differ_from_those_that_the_model_gives():
    # The model itself uses the names that its unnamed joints and bodies, and the
    # frames between two joints of a body, would get.
    model = mujoco.MjModel.from_xml_string(TWINS)
    chain = build_chain(model, "b", torch.float64)
    joints, links = chain.get_joint_parameter_names(), chain.get_link_names()
    assert joints == ["joint0_", "joint0", "j", "joint3_", "joint3"]
    assert links == ["b", "x", "y", "yy", "body5_", "body5", "d", "d:j"]
    joint_pos = torch.tensor([[0.3, 1.1, -0.4, 0.8, 0.2]], dtype=torch.float64)
    expected = mujoco_poses(model, "b", joint_pos.numpy())
    assert_poses_agree(chain, links, joint_pos, expected, 1e-12)
    # Expected pose of yy: half a metre from y, turned by 1.1.
    position, _ = LinkKinematics(chain, ["yy"]).poses_b(joint_pos)
    yy = [0.5 * np.cos(1.1), 1 + 0.5 * np.sin(1.1), 0]
    np.testing.assert_allclose(position[0, 0], yy, atol=1e-12)


def test_an_unnamed_base_goes_by_its_made_name():
    model = mujoco.MjModel.from_xml_string(TWINS.replace('name="b"', ""))
    chain = build_chain(model, "body1")
    assert chain.get_link_names()[:2] == ["body1", "x"]
    with pytest.raises(ValueError, match=r"no body 'b'.*; it has 'body1', 'body5'"):
        build_chain(model, "b")


@pytest.mark.skipif(
    (3, 13) <= sys.version_info < (3, 13, 8),
    reason="these Pythons do not check the depth of some calls (CPython gh-132744)",
)
def test_a_row_of_bodies_too_long_to_follow_is_refused():
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for _ in range(1000):
        body = body.add_body()
        body.add_geom(size=[0.1, 0, 0])
    with pytest.raises(ValueError, match="are nested too deeply"):
        build_chain(spec.compile(), "world")


def test_joint_limits_are_those_of_the_model():
    joints = "<joint name='a' range='-1 2'/><joint name='b' axis='1 0 0'/>"
    low, high = build_chain(one_body(joints), "base").get_joint_limits()
    assert low == [-1, -np.inf]
    assert high == [2, np.inf]


@pytest.mark.parametrize("kind", ["ball", "free"])
def test_joints_that_no_chain_has_are_refused_by_name(kind):
    body = f"<body name='x'><geom size='.1'/><joint name='bad' type='{kind}'/></body>"
    # MuJoCo itself allows a free joint only in a child of the world.
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=rf"'bad' of body 'x' is a .*{kind.upper()}"):
        build_chain(model, "world")


def test_an_unknown_base_is_refused_by_name():
    with pytest.raises(ValueError, match=r"'trunk'.*'arm', 'base'"):
        build_chain(one_body(""), "trunk")


# --- chains read from URDF --------------------------------------------------------


def urdf(extra: str = "") -> str:
    def joint(number: int, kind: str, content: str) -> str:
        return (
            f"<joint name='j{number}' type='{kind}'><parent link='l{number - 1}'/>"
            f"<child link='l{number}'/>{content}</joint>"
        )

    links = "".join(
        f"<link name='l{i}'><inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1'"
        " ixy='0' ixz='0' iyz='0'/></inertial></link>"
        for i in range(6)
    )
    limit = "<limit lower='-2' upper='2' effort='1' velocity='1'/>"
    joints = (
        joint(1, "revolute", f"<origin xyz='0 0 .3'/><axis xyz='0 0 1'/>{limit}")
        + joint(2, "continuous", "<origin rpy='.4 -1 2'/><axis xyz='1 2 -2'/>")
        + joint(3, "fixed", "<origin xyz='.1 .2 .3' rpy='0 0 1'/>")
        + joint(4, "prismatic", f"<origin rpy='1 0 0'/><axis xyz='.6 -.8 0'/>{limit}")
        + joint(
            5,
            "revolute",
            "<origin xyz='0 .5 0'/><axis xyz='0 -1 0'/><mimic joint='j1' "
            f"multiplier='-2' offset='.1'/>{limit}",
        )
    )
    return f"<robot name='arm'>{extra}{links}{joints}</robot>"


def test_a_urdf_chain_agrees_with_mujoco_and_takes_a_mimic_as_its_own_joint():
    chain = pk.build_chain_from_urdf(urdf())
    assert chain.get_joint_parameter_names() == ["j1", "j2", "j4", "j5"]
    # Otherwise MuJoCo would merge l0 into the world and l3 into l2.
    static = "<mujoco><compiler fusestatic='false'/></mujoco>"
    model = mujoco.MjModel.from_xml_string(urdf(static))
    joint_pos = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (30, 4)))
    expected = mujoco_poses(model, "l0", joint_pos.numpy())
    # pytorch-kinematics reads URDF in float32.
    chain = chain.to(dtype=torch.float64)
    assert_poses_agree(chain, [f"l{i}" for i in range(6)], joint_pos, expected, 1e-6)


# --- the parts of the evaluation --------------------------------------------------


@pytest.fixture(scope="module")
def humanoid() -> LinkKinematics:
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "humanoid.xml"))
    chain = build_chain(model, "torso")
    return LinkKinematics(chain, chain.get_link_names())


def test_the_wrong_number_of_joints_is_refused(humanoid):
    with pytest.raises(ValueError, match=r"must be \[B, 17\].* got \[5, 24\]"):
        humanoid.link_frames(torch.zeros(5, 24))
