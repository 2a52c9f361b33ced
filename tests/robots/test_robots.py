"""Any robot can carry sensors; the task needs one with a floating base."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import PhysicsConfig, Scene
from egoskin.envs.physics.model import build_scene
from egoskin.robots.builtin import H1_2
from egoskin.robots.config import Gain, Primitive, RobotConfig, read_robot
from egoskin.robots.kinematics import LinkKinematics
from egoskin.robots.surface import default_frames, distance_to
from egoskin.sensors import FieldSensor, Skin, place_sensors
from egoskin.shapes import Sphere

HUMANOID = RobotConfig(
    name="humanoid",
    model_path=Path(gymnasium.__file__).parent / "envs/mujoco/assets/humanoid.xml",
    base="torso",
    skin_links=("torso", "pelvis", "right_shin", "left_lower_arm"),
)

# A stand, a lift without a name (the body after it) and a hand with two hinges; a hull
# to look at; a floor.
ARM = """
<mujoco><worldbody>
  <geom name='floor' type='plane' size='1 1 .1'/>
  {before}
  <body name='stand' pos='.2 0 .1' euler='0 0 30'><geom type='box' size='.1 .1 .1'/>
    <body pos='0 0 .2'>
      <joint name='lift' type='slide' axis='0 0 1' range='0 .5'
             actuatorfrcrange='-80 80'/>
      <geom type='capsule' size='.05 .1'/>
      <geom type='ellipsoid' size='.2 .2 .2' contype='0' conaffinity='0'/>
      <body name='hand' pos='.1 0 .15'>
        <joint axis='0 1 0' pos='.01 0 0' range='-90 90' actuatorfrcrange='-5 5'/>
        <joint name='roll' axis='1 0 0' range='-45 45' actuatorfrcrange='-3 3'/>
        <geom size='.06'/>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""
TABLE = (
    "<body name='table' pos='2 0 1'><joint name='wobble' axis='1 0 0'/>"
    "<geom type='cylinder' size='.3 .1'/></body>"
)


@pytest.fixture
def make_arm(tmp_path: Path) -> Callable[..., RobotConfig]:
    """Return a function of (base, MJCF before the arm) that makes a fixed arm."""

    def make(base: str, before: str = "") -> RobotConfig:
        path = tmp_path / "arm.xml"
        path.write_text(ARM.format(before=before))
        return RobotConfig(
            name="arm",
            model_path=path,
            base=base,
            skin_links=("stand", "hand"),
            default_pose={"lift": 0.3, "roll": 0.5},
        )

    return make


@pytest.fixture(params=["humanoid", "arm on the world", "arm on its stand"])
def any_robot(request, make_arm) -> RobotConfig:
    if request.param == "humanoid":
        return HUMANOID
    return make_arm("world") if "world" in request.param else make_arm("stand", TABLE)


def posed(robot: RobotConfig, joint_pos: np.ndarray):
    """Return MuJoCo's data at these joint positions, and its base."""
    data = mujoco.MjData(robot.model)
    # A free joint or the table's hinge comes first.
    data.qpos[robot.model.nq - len(joint_pos) :] = joint_pos
    mujoco.mj_kinematics(robot.model, data)
    return data, data.body(robot.base)


# --- what belongs to the robot --------------------------------------------------


def test_joints_are_those_of_the_chain(any_robot):
    names = any_robot.chain.get_joint_parameter_names()
    assert any_robot.joints == tuple(names)
    assert H1_2.joints == tuple(H1_2.chain.get_joint_parameter_names())


@pytest.mark.parametrize(("base", "before"), [("world", ""), ("stand", TABLE)])
def test_what_does_not_hang_on_the_base_is_not_the_robots(make_arm, base, before):
    arm = make_arm(base, before)
    # Numbered as in the model, where the table comes first.
    number = 2 if base == "world" else 3
    assert arm.links == ("stand", f"body{number}", "hand")
    assert arm.joints == ("lift", f"joint{number - 1}", "roll")
    kinds = [(shape.link, shape.kind) for shape in arm.primitives]
    expected = ["box", "capsule", "sphere"]
    assert kinds == list(zip(arm.links, expected, strict=True))
    np.testing.assert_array_equal(arm.default_joint_pos, [0.3, 0, 0.5])
    np.testing.assert_array_equal(arm.torque_limit, [80, 5, 3])
    # [m], then [rad].
    half, quarter = np.pi / 2, np.pi / 4
    np.testing.assert_allclose(
        arm.joint_range, [[0, -half, -quarter], [0.5, half, quarter]]
    )


def test_the_default_pose_is_that_of_mujoco(any_robot):
    data, base = posed(any_robot, any_robot.default_joint_pos)
    turn = base.xmat.reshape(3, 3).T
    position, rotation = default_frames(any_robot)
    # Other bodies come first.
    links = slice(-len(any_robot.links), None)
    expected = (data.xpos[links] - base.xpos) @ turn.T
    np.testing.assert_allclose(position, expected, 0, 5e-6)
    expected = turn @ data.xmat[links].reshape(-1, 3, 3)
    np.testing.assert_allclose(rotation, expected, 0, 5e-6)


def test_height_of_the_humanoid_above_its_soles():
    # Down the legs .26 + .165 + .04 + .403 + .45 - .1, and the radius of a foot.
    assert HUMANOID.default_base_height == pytest.approx(1.218 + 0.075, abs=2e-3)


def test_a_pose_that_lifts_the_leg_lowers_the_base(small_robot):
    robot = small_robot(
        "<geom size='.1'/><body name='leg'><joint axis='0 1 0'/>"
        "<geom size='.05' pos='0 0 -.5'/></body>"
    )
    assert robot.default_base_height == pytest.approx(0.55)
    # A quarter turn: it rests on its own ball.
    assert robot.base_height(np.array([np.pi / 2])) == pytest.approx(0.1)
    assert robot.default_base_height == pytest.approx(0.55)


def test_shapes_that_touch_only_in_a_pair_are_collision_shapes(tmp_path):
    path = tmp_path / "pair.xml"
    path.write_text(
        "<mujoco><default><geom contype='0' conaffinity='0'/></default><worldbody>"
        "<geom name='floor' type='plane' size='1 1 1'/>"
        "<body name='base'><freejoint/><geom name='foot' size='.1'/>"
        "<geom name='hull' size='.2'/></body></worldbody>"
        "<contact><pair geom1='floor' geom2='foot'/></contact></mujoco>"
    )
    robot = RobotConfig(name="r", model_path=path, base="base", skin_links=("base",))
    (shape,) = robot.primitives
    assert shape.size[0] == 0.1


def test_a_cylinder_is_the_capsule_inside_it_or_if_flat_a_box(small_robot):
    robot = small_robot(
        "<geom type='cylinder' size='.1 .3'/>"
        "<body name='b'><geom type='cylinder' size='.2 .05' pos='0 0 -.5'/></body>"
    )
    long, flat = robot.primitives
    assert (long.kind, *long.size[:2]) == ("capsule", 0.1, pytest.approx(0.2))
    assert (flat.kind, *flat.size) == ("box", 0.2, 0.2, 0.05)
    assert robot.standing_height == pytest.approx(0.3 + 0.55)
    assert len(place_sensors(robot, 20)) == 20


def test_the_height_of_a_robot_is_also_that_of_its_meshes(tmp_path):
    path = tmp_path / "mesh.xml"
    # A corner of a cube with edges of 0.1 m, standing on its tip.
    path.write_text(
        "<mujoco><asset><mesh name='m' vertex='0 0 0  .1 0 0  0 .1 0  0 0 .1'/>"
        "</asset><worldbody><body name='base' pos='0 0 1'><freejoint/>"
        "<geom type='mesh' mesh='m' euler='45 -35.26439 0' pos='0 0 -.2'/>"
        "<geom size='.1'/></body></worldbody></mujoco>"
    )
    robot = read_robot(path)
    assert robot.default_base_height == pytest.approx(0.2)
    assert robot.standing_height == pytest.approx(0.3)


def test_gains_are_positive_numbers():
    for kp, kd in ((-60, 2), (0, 2), (60, -1), ("60", 2), (60, float("nan"))):
        with pytest.raises(ValueError, match="a gain must have numbers kp > 0"):
            Gain(kp=kp, kd=kd)


@pytest.mark.parametrize("kind", ["ellipsoid"])
def test_other_collision_shapes_are_refused_with_the_remedy(small_robot, kind):
    robot = small_robot(
        "<geom size='.1'/><body name='b'>"
        f"<geom name='odd' type='{kind}' size='.1 .1 .1'/></body>"
    )
    text = rf"link 'b' .* geom 'odd', of kind {kind}; .* meshes=\{{'b': \[...\]\}}"
    with pytest.raises(ValueError, match=text):
        place_sensors(robot, 5)
    with pytest.raises(ValueError, match=text):
        _ = robot.default_base_height
    assert [shape.link for shape in robot.primitives_on(["base"])] == ["base"]
    assert [shape.link for shape in robot.known_primitives] == ["base"]


def test_names_may_look_like_patterns(small_robot):
    robot = small_robot(
        "<geom size='.1'/><body name='arm[1]' pos='1 0 0'><joint name='j*'/>"
        "<geom size='.1'/><body name='arm?' pos='1 0 0'><joint name='j[2]'/>"
        "<geom size='.1'/></body></body>"
    )
    np.testing.assert_array_equal(robot.default_joint_pos, [0, 0])
    links = ("base", "arm[1]", "arm?")
    assert set(place_sensors(robot, 30, links=links).links) == set(links)


# --- robots from files ----------------------------------------------------------

URDF = """<?xml version="1.0"?><!-- <mujoco> -->
<robot name="crane"><link name="foot"/>
<joint name="mount" type="fixed"><parent link="foot"/><child link="mast"/>
  <origin xyz="0 0 1"/></joint>
<link name="mast"><visual><geometry><mesh filename="package://a/v.dae"/></geometry>
  </visual><collision><geometry><mesh filename="package://a/c.stl"/></geometry>
  </collision></link>
<joint name="turn" type="revolute"><parent link="mast"/><child link="boom"/>
  <origin xyz="0 0 2"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<link name="boom"><collision><origin xyz="0 1 0"/><geometry><box size=".2 2 .2"/>
  </geometry></collision></link>
<joint name="grip" type="fixed"><parent link="boom"/><child link="hook"/>
  <origin xyz="0 2 0"/></joint><link name="hook"/></robot>"""


def test_a_urdf_is_a_robot_with_all_its_links(tmp_path):
    (tmp_path / "some.urdf").write_text(URDF)
    robot = read_robot(tmp_path / "some.urdf")
    assert robot.name == "crane"
    assert robot.links == robot.skin_links == ("foot", "mast", "boom", "hook")
    assert robot.joints == ("turn",)
    (shape,) = robot.primitives
    assert shape.link == "boom"
    np.testing.assert_allclose(shape.size, [0.1, 1, 0.1])
    # A joint without <axis> turns about x: a quarter turn lifts the hook.
    quarter = torch.tensor([[torch.pi / 2]])
    position, _ = LinkKinematics(robot.chain, ["hook"]).poses_b(quarter)
    np.testing.assert_allclose(position[0, 0], [0, 0, 5], atol=1e-6)
    assert len(place_sensors(robot, 5, links=["boom"])) == 5
    with pytest.raises(ValueError, match=r"meshes of a URDF are left out; .*--mesh"):
        place_sensors(robot, 5, links=["hook"])


def test_an_mjcf_is_a_robot_whatever_stands_in_its_world(tmp_path):
    path = tmp_path / "two.xml"
    body = "<body name='{}'><freejoint/><geom size='.1'/><body><geom size='.1'/></body>"
    for names, base, links in (
        (["a"], "a", ("a", "body2")),
        (["a", "b"], "world", ("a", "body2", "b", "body4")),
        ([""], "body1", ("body1", "body2")),
    ):
        world = "".join(body.format(name) + "</body>" for name in names)
        path.write_text(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
        robot = read_robot(str(path))
        assert (robot.name, robot.base, robot.links) == ("two", base, links)
    assert read_robot(H1_2.model_path).links == H1_2.links


def test_a_robot_may_be_one_body_of_a_scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/>"
        "<body name='ball' mocap='true'><geom size='.1'/></body>"
        "<body name='bot'><freejoint/><geom size='.1'/><body name='arm'><joint/>"
        "<geom size='.1'/></body></body></worldbody></mujoco>"
    )
    with pytest.raises(
        ValueError, match=r"free joint as the base \(base in robot.toml, or "
    ):
        _ = read_robot(path).chain
    robot = read_robot(path, base="bot")
    assert (robot.base, robot.links, robot.skin_links) == ("bot", *[("bot", "arm")] * 2)
    assert robot.floats
    assert {p.link for p in robot.primitives} == {"bot", "arm"}
    skin = place_sensors(read_robot(path, base="bot", skin_links=["arm"]), 5)
    assert {*skin.links} == {"arm"}
    assert read_robot(path, base="bot", skin_links=["a*"]).skin_links == ("arm",)
    for options, message in (
        ({"base": "bat"}, "the model has no body 'bat', did you mean 'bot'"),
        (
            {"base": "bot", "skin_links": ["ball"]},
            r"below base 'bot': no link 'ball'",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            read_robot(path, **options)


def test_the_base_is_where_the_file_puts_it(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        "<mujoco><worldbody><body name='stand' pos='0.3 -0.2 0.5' euler='0 0 90'>"
        "<geom size='.1'/><body name='b' pos='1 0 0'><joint name='j'/>"
        "<geom size='.1'/></body></body></worldbody></mujoco>"
    )
    robot, half = read_robot(path), np.sqrt(0.5)
    expected = [0.3, -0.2, 0.5, half, 0, 0, half]
    np.testing.assert_allclose(robot.base_pose, expected, atol=1e-12)
    # A ball beyond the arm, which points along the world's y axis.
    skin = Skin(
        robot="arm", links=("b",), position=np.zeros((1, 3)), normal=np.eye(3)[:1]
    )
    sensor = FieldSensor(skin, robot.chain, Sphere(radius=0.1), 2.0)
    ball = torch.tensor([[[0.3, 1.3, 0.5, 1.0, 0, 0, 0]]], dtype=torch.float64)
    base = torch.from_numpy(robot.base_pose)[None]
    inputs = base, torch.zeros(1, 1).double(), ball, torch.ones(1, 1) > 0
    assert float(sensor.compute(*inputs)[0]) == pytest.approx(0.4, abs=1e-6)


def test_shapes_of_a_body_may_be_given_as_lists():
    shape = Primitive(
        link="a", kind="box", size=[1, 2, 3], position=[0, 0, 0], rotation=np.eye(3)
    )
    assert (shape.size.tolist(), shape.position.shape) == ([1.0, 2.0, 3.0], (3,))


@pytest.mark.parametrize(
    ("joint", "base", "joints"),
    [
        ("", "a", ("elbow",)),
        ("<freejoint/>", "a", ("elbow",)),
        ("<joint name='waist' axis='0 0 1'/>", "world", ("waist", "elbow")),
        ("<joint name='rail' type='slide'/>", "world", ("rail", "elbow")),
    ],
)
def test_the_joints_of_the_first_body_are_the_robots(tmp_path, joint, base, joints):
    path = tmp_path / "arm.xml"
    path.write_text(
        f"<mujoco><worldbody><body name='a'>{joint}<geom size='.1'/>"
        "<body name='b'><joint name='elbow'/><geom size='.1'/></body></body>"
        "</worldbody></mujoco>"
    )
    robot = read_robot(path)
    assert (robot.base, robot.joints, robot.skin_links) == (base, joints, ("a", "b"))


def test_the_path_of_a_model_may_be_text(make_arm):
    arm = make_arm("stand")
    same = replace(arm, model_path=str(arm.model_path))
    assert same == arm
    assert same.links == arm.links


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        (
            "r.xml",
            "<mujoco><bod/></mujoco>",
            "MuJoCo cannot load .*r.xml as a robot: ",
        ),
        ("r.urdf", "", "cannot load .*r.urdf as a robot"),
        ("r.csv", "Index,X", r"must be an MJCF \(.xml\) or a URDF"),
        (
            "r.xml",
            '<mujoco><asset><mesh name="m" file="m.stl"/></asset></mujoco>',
            "cannot load .*r.xml as a robot: .*m.stl",
        ),
    ],
)
def test_a_file_that_is_no_robot_is_refused_in_one_line(
    tmp_path, name, content, expected
):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=expected) as error:
        read_robot(tmp_path / name)
    assert "\n" not in str(error.value)


def test_a_robot_in_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "r.xml")
    with pytest.raises(ValueError, match="named pipe"):
        read_robot(tmp_path / "r.xml")
    with pytest.raises(FileNotFoundError):
        read_robot(tmp_path / "none.xml")


# --- sensors on it --------------------------------------------------------------


@pytest.mark.parametrize("method", ["area_uniform", "poisson_disk"])
def test_sensors_lie_on_the_surface_of_any_robot(any_robot, method):
    skin = place_sensors(any_robot, 60, method=method)
    assert set(skin.links) == set(any_robot.skin_links)
    for link, position in zip(skin.links, skin.position, strict=True):
        own = [
            distance_to(shape, position[None])[0]
            for shape in any_robot.primitives_on([link])
        ]
        # Positions are rounded to six decimals.
        assert min(own) == pytest.approx(0, abs=2e-6)


def test_sensors_on_any_robot_measure_what_mujoco_says(any_robot):
    skin, radius = place_sensors(any_robot, 40), 0.1
    rng = np.random.default_rng(0)
    joint_pos = rng.uniform(-0.5, 0.5, len(any_robot.joints))
    data, base = posed(any_robot, joint_pos)
    ball = np.array([0.4, 0.2, 1.0])
    at = [
        data.body(link).xmat.reshape(3, 3) @ position + data.body(link).xpos
        for link, position in zip(skin.links, skin.position, strict=True)
    ]
    expected = np.linalg.norm(at - ball, axis=-1) - radius
    states = TensorDict(
        {
            "base_pose": torch.tensor([*base.xpos, *base.xquat]),
            "joint_pos": torch.tensor(joint_pos),
            "object_pose": torch.tensor([[*ball, 1.0, 0, 0, 0]]),
            "object_active": torch.ones(1, dtype=torch.bool),
        }
    )
    sensor = FieldSensor(skin, any_robot.chain, [Sphere(radius=radius)], max_range=5.0)
    distance = sensor(states)["distance"]
    np.testing.assert_allclose(distance, np.maximum(expected, 0), 0, 1e-5)
    assert (expected > 0.1).mean() > 0.5


# --- the task -------------------------------------------------------------------


def refused(robot: RobotConfig, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        DodgeballEnv(robot, DodgeballConfig(), num_envs=1)
    with pytest.raises(ValueError, match=text):
        build_scene(
            Scene(robot=robot, objects=(Sphere(radius=0.1),), config=PhysicsConfig())
        )


def test_the_task_wants_a_floating_base_that_is_the_chains(make_arm, tmp_path):
    text = "the first joint must be the free joint of its base"
    for base in ("world", "stand"):
        refused(make_arm(base), f"arm: {text} '{base}'")
    path = HUMANOID.model_path
    refused(
        RobotConfig(name="h", model_path=path, base="pelvis", skin_links=()),
        f"h: {text} 'pelvis'",
    )
    still = tmp_path / "still.xml"
    still.write_text("<mujoco><worldbody><body name='b'/></worldbody></mujoco>")
    refused(RobotConfig(name="s", model_path=still, base="b", skin_links=()), text)


@pytest.mark.parametrize("euler", ["0 30 0", "180 0 0", "5 0 90"])
def test_the_task_wants_an_upright_base(tmp_path, euler):
    text = (
        "<mujoco><worldbody><body name='b' EULER><freejoint/><geom size='.1'/><body "
        "name='c'><joint/><geom size='.1'/></body></body></worldbody></mujoco>"
    )
    path = tmp_path / "tilted.xml"
    path.write_text(text.replace("EULER", f"euler='{euler}'"))
    fields = {"name": "t", "model_path": path, "base": "b", "skin_links": ()}
    refused(RobotConfig(**fields), "t: its base 'b' must be upright in the file")
    # A turn about z is a heading: episodes draw their own.
    path.write_text(text.replace("EULER", "euler='0 0 120'"))
    RobotConfig(**fields).check_floating_base()


@pytest.mark.parametrize("inside", [True, False])
def test_the_task_wants_hinges_below_the_base_alone(tmp_path, inside):
    joint = "slide" if inside else "hinge"
    other = f"<body name='b'><joint type='{joint}'/><geom size='.1'/></body>"
    path = tmp_path / "odd.xml"
    path.write_text(
        "<mujoco><worldbody><body name='base'><freejoint/><geom size='.1'/>"
        f"{other if inside else ''}</body>{'' if inside else other}"
        "</worldbody></mujoco>"
    )
    robot = RobotConfig(name="odd", model_path=path, base="base", skin_links=())
    refused(robot, "odd: all joints but the first must be hinges below its base")
