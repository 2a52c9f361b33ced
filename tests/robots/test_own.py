"""Your own robots: from a folder or a file, stored as data, safe to load."""

from __future__ import annotations

import dataclasses
import json
import pickle
import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import egoskin
from calling import SMALL, call, succeed
from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import PhysicsConfig, Scene
from egoskin.envs.physics.contract import GRAVITY, OBJECT_MASS
from egoskin.envs.physics.model import build_scene
from egoskin.make import EnvConfig
from egoskin.robots.builtin import G1, H1_2
from egoskin.robots.checks import check_trainable
from egoskin.robots.config import RobotConfig
from egoskin.robots.own import find_robot, read_folder, robot_of
from egoskin.robots.portable import portable
from egoskin.storage.formats import read_sealed
from egoskin.storage.serialization import from_plain, to_plain
from egoskin.storage.tensor_file import load_tensors, save_tensors
from owning import MODEL, TOML, write_robot

URDF = """<robot name="stump">
  <link name="hull">
    <inertial><mass value="3"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/hull.stl"/></geometry></visual>
    <collision><geometry><box size=".2 .2 .2"/></geometry></collision>
  </link>
  <link name="foot">
    <inertial><mass value="1"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><cylinder radius=".1" length=".04"/></geometry></collision>
  </link>
  <joint name="ankle" type="revolute">
    <origin xyz="0 0 -.3"/><parent link="hull"/><child link="foot"/><axis xyz="0 1 0"/>
    <limit lower="-.5" upper=".6" effort="30" velocity="5"/>
  </joint>
</robot>"""


@pytest.fixture(scope="module")
def walker(tmp_path_factory) -> RobotConfig:
    """The small robot, as data."""
    return portable(read_folder(write_robot(tmp_path_factory.mktemp("own") / "walker")))


# --- from a folder, from a file ---------------------------------------------------


def test_a_folder_is_a_robot(tmp_path):
    robot = find_robot(str(write_robot(tmp_path / "walker")))
    assert robot.name == "walker"
    assert robot.feet == ("left_foot", "right_foot")
    assert robot.skin_links == ("trunk", "left_arm", "right_arm")
    legs = ("left_leg", "left_foot", "right_leg", "right_foot")
    assert robot.untargeted_links == legs
    assert robot.default_joint_pos.tolist() == [0.1, 0, 0, 0, 0, 0]
    kp, kd = robot.joint_gains(None)
    assert kp.tolist() == [20, 20, 150, 150, 150, 150]
    assert kd.tolist() == [1, 1, 5, 5, 5, 5]
    assert find_robot(str(tmp_path / "walker" / "robot.toml")).links == robot.links
    named = write_robot(tmp_path / "named", f'name = "strider"\n{TOML}')
    assert find_robot(str(named)).name == "strider"


def test_a_variable_of_a_python_file_is_a_robot(tmp_path):
    folder = write_robot(tmp_path / "walker")
    (tmp_path / "mine.py").write_text(
        "from pathlib import Path\n"
        "from egoskin.robots.config import Gain, RobotConfig\n"
        "ROBOT = RobotConfig(name='walker',"
        f" model_path=Path({str(folder)!r}, 'walker.xml'),"
        " base='trunk', skin_links=('trunk',), feet=('left_foot', 'right_foot'),"
        " gains={'one': {'*': Gain(kp=50, kd=2)}})\n"
    )
    robot = portable(find_robot(f"{tmp_path}/mine.py:ROBOT"))
    assert robot.joint_gains("one")[0].tolist() == [50] * 6
    with pytest.raises(ValueError, match="RobotConfig: ROBOT"):
        find_robot(f"{tmp_path}/mine.py:NOBODY")
    with pytest.raises(ValueError, match=r"lacks the name .*mine\.py:ROBOT"):
        find_robot(f"{tmp_path}/mine.py")


@pytest.mark.parametrize(
    ("text", "line", "error"),
    [
        ("x = 1\nimport nothing_of_this_name", 2, "ModuleNotFoundError"),
        ("x = 1\n\ny = = 2", 3, "SyntaxError"),
        ("def f():\n    raise RuntimeError('no')\nf()", 2, "RuntimeError: no"),
        ("import sys\n\nsys.exit(0)", 3, "SystemExit: 0"),
        ("import runpy\nrunpy.run_path(BROKEN)", 2, "SyntaxError"),
    ],
)
def test_errors_in_a_python_file_are_told_with_their_line(text, line, error, tmp_path):
    file, broken = tmp_path / "mine.py", tmp_path / "broken.py"
    broken.write_text("\n" * 9 + "y = = 2")
    file.write_text(text.replace("BROKEN", repr(str(broken))))
    with pytest.raises(ValueError, match=rf"mine\.py:{line}: {error}"):
        find_robot(f"{file}:ROBOT")


@pytest.mark.parametrize(
    ("old", "new", "line", "text"),
    [
        ('base = "trunk"', "base = trunk", 2, "Invalid value"),
        ('base = "trunk"', 'base = "chest"', 2, "chest"),
        ('base = "trunk"', "", 1, "base is missing"),
        ('base = "trunk"', 'bas = "trunk"', 2, "did you mean 'base'"),
        ('"walker.xml"', '"no.xml"', 1, "no file"),
        ('["*_foot"]', '["left_fot"]', 3, "did you mean 'left_foot'"),
        ('["*_foot"]', '"left_foot"', 3, "feet must be a list of links"),
        ('    "*_arm",', '    "*_hand",', 6, "no link '*_hand'"),
        ("left_shoulder = 0.1", "left_shouldr = 0.1", 11, "did you mean"),
        ("left_shoulder = 0.1", "left_shoulder = true", 11, "must be a number"),
        ("left_shoulder = 0.1", "left_shoulder = nan", 11, "must be a number"),
        ('"*_ankle" = {', '"*_anke" = {', 15, "no joint"),
        ("{ kp = 20, kd = 1 }", "{ kp = 20 }", 16, "'*_shoulder' must be"),
        ("{ kp = 20, kd = 1 }", "{ kp = 0, kd = 1 }", 16, "'*_shoulder' must be"),
        ("kp = 20, kd = 1", f"kp = {10**400}, kd = 1", 16, "'*_shoulder' must be"),
        ("kp = 20, kd = 1", "kp = 20, kd = inf", 16, "'*_shoulder' must be"),
        ('"*_shoulder" =', '"*_*" =', 16, "matches '*_hip' and '*_*'"),
        ('"*_shoulder" =', '"left_*er" =', 13, "none of its patterns"),
        ("[gains.stiff]", "[gains]", 14, "table of joints|N m/rad"),
        (
            "{ kp = 20, kd = 1 }",
            '{ kp = 20, kd = 1 }\n[gains.soft]\n"*_hip" = { kp = 2, kd = 1 }',
            17,
            "gains.soft: joint 'left_shoulder' must match one pattern",
        ),
    ],
)
def test_what_is_wrong_is_told_with_its_line(old, new, line, text, tmp_path):
    folder = write_robot(tmp_path / "walker", TOML.replace(old, new))
    with pytest.raises(ValueError, match=r"robot\.toml:\d+: ") as error:
        read_folder(folder)
    assert f"robot.toml:{line}: " in str(error.value)
    parts = text.split("|")
    assert any(part in str(error.value) for part in parts), error.value


def test_what_is_no_robot_is_told(tmp_path):
    with pytest.raises(
        ValueError, match="no robot 'nobody': it must be one of h1_2, g1"
    ):
        find_robot("nobody")
    with pytest.raises(ValueError, match=r"has no robot\.toml"):
        find_robot(str(tmp_path))


# --- as data ----------------------------------------------------------------------


def test_a_robot_as_data_is_the_same_robot(walker, tmp_path):
    before = read_folder(write_robot(tmp_path / "walker"))
    assert (walker.links, walker.joints) == (before.links, before.joints)
    for name in ("body_mass", "body_inertia", "jnt_range", "jnt_actfrcrange"):
        own = getattr(before.model, name)
        np.testing.assert_allclose(getattr(walker.model, name), own, atol=1e-5)
    # The ground, the light and the motor are left out.
    assert (walker.model.nu, walker.model.nlight) == (0, 0)
    assert "ground" not in walker.model_xml
    # 0.05 + 0.62 + 0.02: hip, leg, half a sole.
    assert walker.default_base_height == pytest.approx(0.69)


def test_cylinders_become_capsules_as_long_and_as_wide(walker):
    (leg,) = (shape for shape in walker.primitives if shape.link == "left_leg")
    assert (leg.kind, *leg.size[:2]) == ("capsule", 0.05, pytest.approx(0.23))


def test_a_cylinder_between_two_points_is_where_it_was(tmp_path):
    rod = '<geom type="cylinder" size="0.05" fromto="0.1 0.2 0 0.1 0.6 0.3" mass="1"/>'
    model = MODEL.replace('<body name="left_arm"', f'{rod}<body name="left_arm"')
    before = read_folder(write_robot(tmp_path, model=model))
    after = portable(before)
    own, expected = (
        next(p for p in each.primitives if p.link == "trunk" and p.size[0] == 0.05)
        for each in (after, before)
    )
    assert (own.kind, expected.kind) == ("capsule", "capsule")
    for name in ("size", "position", "rotation"):
        values = (getattr(each, name) for each in (own, expected))
        np.testing.assert_allclose(*values, atol=1e-5)


def test_a_file_that_is_nested_too_deeply_is_refused_with_its_name(tmp_path):
    toml = f"x = {'[' * 10_000}{']' * 10_000}"
    with pytest.raises(ValueError, match=r"robot\.toml: nested too deeply"):
        read_folder(write_robot(tmp_path, toml))


def test_paths_of_the_file_are_not_stored(tmp_path):
    model = MODEL.replace("<compiler ", f'<compiler meshdir="{tmp_path}" ')
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    plain = portable(read_folder(write_robot(tmp_path / "walker")))
    assert robot.model_xml == plain.model_xml


def test_materials_stay_without_their_textures(tmp_path):
    assets = (
        '<asset><texture name="t" type="2d" builtin="checker" width="8" height="8"/>'
        '<material name="m" texture="t" rgba="1 0.5 0 1"/></asset><worldbody>'
    )
    model = MODEL.replace("<worldbody>", assets)
    model = model.replace('<geom type="box"', '<geom material="m" type="box"', 1)
    robot = portable(read_folder(write_robot(tmp_path, model=model)))
    assert robot.model.ntex == 0
    assert robot.model.mat("m").rgba.tolist() == [1, 0.5, 0, 1]
    trunk = robot.model.body("trunk")
    assert robot.model.geom_matid[trunk.geomadr[0]] == 0


def test_commands_take_the_robot_of_trainings(tmp_path):
    folder = write_robot(tmp_path / "walker")
    assert find_robot(str(folder)) == portable(read_folder(folder))


def test_margins_are_no_touch(tmp_path):
    model = MODEL.replace("<geom type=", '<geom margin="0.05" gap="0.01" type=')
    robot = portable(read_folder(write_robot(tmp_path, model=model)))
    assert not robot.model.geom_margin.any()
    assert not robot.model.geom_gap.any()


def test_frames_are_kept(tmp_path, walker):
    start, end = '<body name="left_arm"', '<body name="right_arm"'
    i, j = MODEL.index(start), MODEL.index(end)
    framed = f'{MODEL[:i]}<frame pos="0 0 0">{MODEL[i:j]}</frame>{MODEL[j:]}'
    robot = portable(read_folder(write_robot(tmp_path, model=framed)))
    assert robot.links == walker.links
    np.testing.assert_allclose(robot.model.body_pos, walker.model.body_pos)


@pytest.mark.parametrize("name", ["floor", "object_0"])
def test_names_of_the_scene_are_refused(name, tmp_path):
    model = MODEL.replace('<body name="left_arm"', f'<body name="{name}"')
    toml = TOML.replace('"*_arm"', '"right_arm"')
    if name == "floor":
        model = MODEL.replace('<geom type="box"', '<geom name="floor" type="box"', 1)
        toml = TOML
    robot = portable(read_folder(write_robot(tmp_path, toml=toml, model=model)))
    env = DodgeballEnv(robot, DodgeballConfig(), num_envs=1, seed=0)
    with pytest.raises(ValueError, match=f"{name!r} is a name of the scene"):
        env.check_scene()


def test_a_robot_that_cannot_be_trained_is_told_with_all_reasons(tmp_path):
    model = MODEL.replace('"-60 60"', '"-10 50"')
    toml = TOML.replace("left_shoulder = 0.1", "left_shoulder = 2.0")
    robot = portable(read_folder(write_robot(tmp_path, toml=toml, model=model)))
    with pytest.raises(ValueError, match=r"symmetric about 0: .*; the default pose is"):
        check_trainable(robot)


def test_links_and_joints_may_go_without_a_name(tmp_path):
    model = MODEL.replace('<body name="left_arm"', "<body")
    model = model.replace('<joint name="left_shoulder"', "<joint")
    toml = TOML.replace("left_shoulder = 0.1", "joint1 = 0.1")
    toml = toml.replace('"*_arm"', '"*_arm", "body2"')
    toml += "joint1 = { kp = 20, kd = 1 }\n"
    robot = portable(read_folder(write_robot(tmp_path, toml=toml, model=model)))
    assert robot.links[1] == "body2"
    assert robot.joints[0] == "joint1"
    # The scene names them: an actuator for each joint.
    DodgeballEnv(robot, DodgeballConfig(), num_envs=1, seed=0).check_env_specs()


def test_balls_and_floor_meet_a_robot_that_was_not_made_for_them(walker):
    task = DodgeballConfig()
    env = DodgeballEnv(walker, task, num_envs=8, seed=0)
    td = env.reset()
    heights = []
    for _ in range(120):
        td["action"] = torch.zeros(8, 6)
        td = env.step(td)["next"]
        heights.append(td["base_pose"][:, 2])
    assert torch.stack(heights).min() > 0
    assert td["balls_arrived"].sum() + td["hit"].sum() > 0
    both = walker.model.geom_conaffinity & 3
    assert np.all(both == 3)
    assert not np.any(walker.model.geom_contype & 3)
    # Its own shapes collide as before: by MuJoCo's default all of them do.
    assert np.all(walker.model.geom_contype & walker.model.geom_conaffinity)


def test_shapes_that_only_look_are_dropped_and_their_masses_stay(tmp_path):
    (tmp_path / "tetra.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    text = MODEL.replace(
        "<worldbody>",
        '<asset><mesh name="t" file="tetra.obj" scale=".3 .3 .3"/></asset><worldbody>',
    ).replace(
        '<body name="left_arm"',
        '<geom type="mesh" mesh="t" contype="0" conaffinity="0" mass="4"/>'
        '<body name="left_arm"',
    )
    folder = write_robot(tmp_path, model=text)
    before, after = read_folder(folder), portable(read_folder(folder))
    trunk = before.model.body("trunk").id
    assert before.model.body_mass[trunk] == pytest.approx(14)
    for name in ("body_mass", "body_inertia", "body_ipos"):
        own = getattr(before.model, name)[1:]
        np.testing.assert_allclose(getattr(after.model, name)[1:], own, atol=1e-5)
    assert "mesh" not in (after.model_xml or "mesh")
    touching = text.replace(
        "<asset>", '<asset><hfield name="h" nrow="2" ncol="2" size=".2 .2 .1 .1"/>'
    ).replace(
        'type="mesh" mesh="t" contype="0" conaffinity="0"', 'type="hfield" hfield="h"'
    )
    refused = r"link .trunk. has a collision shape.* of kind hfield"
    with pytest.raises(ValueError, match=refused):
        portable(read_folder(write_robot(tmp_path, model=touching)))


def test_settings_of_what_is_left_out_are_left_out(tmp_path):
    before = portable(read_folder(write_robot(tmp_path / "before")))
    # As in most published files.
    settings = (
        '<size memory="10M" nuserdata="2"/><statistic meansize="0.1" extent="2"/>'
        '<visual><global azimuth="120"/><headlight ambient="0.1 0.1 0.1"/></visual>'
    )
    defaults = (
        '<mesh scale="0.001 0.001 0.001"/><light diffuse="1 0 0"/><camera fovy="60"/>'
        '<equality solref="0.01 1"/><tendon width="0.01"/><motor gear="2"/>'
        '<geom rgba="1 0 0 1"/><site size="0.01"/><material specular="0.1"/>'
        '<pair condim="1"/><default class="own"><position kp="50" ctrllimited="true" '
        'ctrlrange="-1 1"/><joint damping="4"/></default>'
    )
    model = MODEL.replace("<worldbody>", f"{settings}<worldbody>")
    model = model.replace("<default>", f"<default>{defaults}")
    model = model.replace('"left_ankle" axis', '"left_ankle" class="own" axis')
    robot = portable(read_folder(write_robot(tmp_path / "after", model=model)))
    assert (robot.links, robot.joints) == (before.links, before.joints)
    # What applies to the robot is kept.
    np.testing.assert_array_equal(robot.torque_limit, before.torque_limit)
    assert robot.model.joint("left_ankle").damping == 4
    assert robot.model.geom_rgba[-1].tolist() == [1, 0, 0, 1]
    for tag in ("size ", "statistic", "visual", "motor", "general", "tendon", "camera"):
        assert f"<{tag}" not in (robot.model_xml or "<")
    # A robot without any of them is stored as MuJoCo writes it, as it always was.
    text = mujoco.MjSpec.from_string(before.model_xml or "").to_xml()
    assert before.model_xml == text


@pytest.mark.parametrize(
    ("tag", "elements"),
    [
        ("equality", '<weld body1="left_arm" body2="right_arm"/>'),
        *(
            (
                "tendon",
                f'<fixed {what}><joint joint="left_hip" coef="1"/></fixed>',
            )
            for what in (
                'stiffness="1"',
                'damping="1"',
                'frictionloss="1"',
                'armature="1"',
                'limited="true" range="-1 1"',
            )
        ),
    ],
)
def test_elements_that_move_a_robot_are_not_left_out(tag, elements, tmp_path):
    model = MODEL.replace("<actuator>", f"<{tag}>{elements}</{tag}><actuator>")
    robot = read_folder(write_robot(tmp_path, model=model))
    with pytest.raises(ValueError, match=rf"{tag}.* are not supported"):
        portable(robot)


def test_tendons_without_effect_are_left_out(tmp_path):
    tendon = '<fixed name="t"><joint joint="left_hip" coef="1"/></fixed>'
    model = MODEL.replace(
        '<actuator><motor joint="left_hip"/>',
        f'<tendon>{tendon}</tendon><actuator><motor tendon="t"/>',
    )
    robot = portable(read_folder(write_robot(tmp_path, model=model)))
    assert robot.model.ntendon == 0
    # And so the robot is that of the file without it.
    assert robot.model_xml == portable(read_folder(write_robot(tmp_path))).model_xml


@pytest.mark.parametrize(
    ("actuators", "expected"),
    [
        ('<motor joint="left_hip" gear="50" ctrlrange="-2 2"/>', [-100, 100]),
        ('<motor joint="left_hip" gear="-50" ctrlrange="-2 1"/>', [-50, 100]),
        (
            '<motor joint="left_hip" gear="50" ctrlrange="-2 2" forcerange="-1 1"/>',
            [-50, 50],
        ),
        ('<position joint="left_hip" kp="90" forcerange="-70 70"/>', [-70, 70]),
        ('<general joint="left_hip" gainprm="30" ctrlrange="-1 1"/>', [-30, 30]),
        (
            '<motor joint="left_hip" ctrlrange="-4 4"/>'
            '<motor joint="left_hip" ctrlrange="-3 3"/>',
            [-7, 7],
        ),
        # No limit, or one of positions.
        ('<motor joint="left_hip"/>', [0, 0]),
        ('<position joint="left_hip" kp="90" ctrlrange="-1 1"/>', [0, 0]),
        (
            '<motor joint="left_hip" ctrlrange="-4 4"/><motor joint="left_hip"/>',
            [0, 0],
        ),
    ],
)
def test_a_joint_without_a_torque_limit_has_that_of_its_actuators(
    actuators, expected, tmp_path
):
    def torques(model, joint):
        robot = portable(read_folder(write_robot(tmp_path, model=model)))
        return robot.model.jnt_actfrcrange[robot.model.joint(joint).id].tolist()

    before, after = MODEL.split('<motor joint="left_hip"/>')
    model = before + actuators + after
    # Of the joint itself: its range counts.
    assert torques(model, "left_hip") == [-60, 60]
    model = model.replace('actuatorfrcrange="-60 60" ', "")
    assert torques(model, "left_hip") == expected
    assert torques(model, "left_ankle") == [0, 0]


def test_the_base_of_a_urdf_floats(tmp_path):
    (tmp_path / "stump.urdf").write_text(URDF)
    (tmp_path / "robot.toml").write_text(
        'model = "stump.urdf"\nbase = "hull"\nfeet = ["foot"]\nskin_links = ["hull"]\n'
        "[gains.a]\nankle = { kp = 40, kd = 2 }\n"
    )
    robot = portable(read_folder(tmp_path))
    robot.check_floating_base()
    assert robot.torque_limit.tolist() == [30]
    assert robot.joint_range.T.tolist() == [[-0.5, 0.6]]
    # A flat cylinder becomes a box: a sole, not a ball.
    assert [s.kind for s in robot.primitives] == ["box", "box"]


def test_a_robot_as_data_comes_back_as_it_was(walker):
    config = EnvConfig(robot=walker)
    content = json.loads(json.dumps(to_plain(config)))
    again = from_plain(EnvConfig, content, "it")
    assert again == config
    assert hash(again.robot) == hash(walker)
    _ = walker.model
    assert pickle.loads(pickle.dumps(walker)) == walker
    assert "model" not in vars(pickle.loads(pickle.dumps(walker)))


def test_names_of_the_package_stay_names():
    assert to_plain(EnvConfig())["robot"] == "h1_2"
    assert EnvConfig().robot_config is H1_2
    assert robot_of("g1") is G1


def test_a_robot_has_one_model():
    with pytest.raises(ValueError, match="exactly one of model_path and model_xml"):
        RobotConfig(name="r", base="b", skin_links=())
    with pytest.raises(ValueError, match="exactly one of model_path and model_xml"):
        dataclasses.replace(H1_2, model_xml="<mujoco/>")


# --- in a policy ------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run of one rollout with a robot whose folder is gone."""
    root = tmp_path_factory.mktemp("trained")
    folder = write_robot(root / "walker")
    succeed(
        *("train", *SMALL, "--robot", folder, "--skin.num-sensors", "8"),
        *("--total-frames", "512", "--run-dir", root / "run"),
    )
    shutil.rmtree(folder)
    return root / "run"


def test_a_trained_policy_is_loaded_where_its_robot_is_not(trained, walker, tmp_path):
    (file,) = (p for p in (trained / "policies").iterdir() if "512" in p.name)
    alone = tmp_path / "policy.safetensors"
    shutil.copy(file, alone)
    for path in (trained, alone):
        policy = egoskin.load_policy(path)
        assert policy.env_config.robot == walker
        env = egoskin.make_worker_env(
            policy.env_config, policy.skin, num_envs=2, seed=0
        )
        assert env.rollout(3, policy)["action"].shape == (2, 3, 6)
    # No path of this machine is in the file.
    assert str(trained.parent) not in json.dumps(load_tensors(alone)[1])


def test_a_run_with_a_robot_of_ones_own_is_repeated_and_resumed(trained, tmp_path):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    succeed("train", "--resume", run, "--total-frames", "1024", "--num-workers", "1")
    again = tmp_path / "again"
    config = trained / "config.json"
    succeed("train", "--config", config, "--run-dir", again)
    robots = [read_sealed(r / "config.json")[0]["env"]["robot"] for r in (run, again)]
    assert robots[0] == robots[1]


HOSTILE = {
    "an include": '<include file="FILE"/>',
    "a mesh": '<asset><mesh name="m" file="FILE"/></asset>',
    "a texture": '<asset><texture name="t" type="2d" file="FILE"/></asset>',
    "another model": '<asset><model name="m" file="FILE"/></asset>',
    "a plugin": '<extension><plugin plugin="mujoco.pid"/></extension>',
    "a size": '<size memory="1000G"/>',
    "a crowd": '<worldbody><replicate count="1000000"><body/></replicate></worldbody>',
}


@pytest.mark.parametrize("what", [*HOSTILE, "a path", "a script", "an entity", "deep"])
def test_a_hostile_policy_reads_no_file_and_runs_nothing(what, trained, tmp_path):
    # A valid model: it would load if it were read.
    secret = tmp_path / "secret.xml"
    secret.write_text(MODEL)
    script = tmp_path / "evil.py"
    script.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nROBOT = None\n")
    tensors, header = load_tensors(trained / "checkpoint.safetensors")
    robot = header["policy"]["env"]["robot"]
    if what in HOSTILE:
        evil = HOSTILE[what].replace("FILE", str(secret))
        robot["model_xml"] = re.sub("(<mujoco.*?>)", rf"\1{evil}", robot["model_xml"])
    elif what == "a path":
        robot |= {"model_xml": None, "model_path": str(secret)}
    elif what == "a script":
        header["policy"]["env"]["robot"] = f"{script}:ROBOT"
    elif what == "an entity":
        entity = f'<!DOCTYPE m [<!ENTITY e SYSTEM "file://{secret}">]>'
        robot["model_xml"] = entity + robot["model_xml"]
    else:
        nested = "<body>" * 300 + "</body>" * 300
        robot["model_xml"] = f"<mujoco><worldbody>{nested}</worldbody></mujoco>"
    file = tmp_path / "policy.safetensors"
    save_tensors(file, tensors, {"policy": header["policy"]})
    opened = []
    watch_opens(opened, tmp_path)
    with pytest.raises(ValueError, match=r"its model|refers to a file|no robot"):
        egoskin.load_policy(file)
    assert [name for name in opened if name != str(file)] == []
    assert not (tmp_path / "ran").exists()


def watch_opens(names: list[str], folder: Path) -> None:
    """Record what Python opens in a folder from now on."""
    import sys

    def note(event: str, args: tuple) -> None:
        if event == "open" and str(args[0]).startswith(str(folder)):
            names.append(str(args[0]))

    sys.addaudithook(note)


def test_mistakes_of_the_command_line_are_told(tmp_path):
    toml = TOML.replace('["*_foot"]', '["left_fot"]')
    told = call("train", "--robot", write_robot(tmp_path / "walker", toml))
    assert told.returncode == 2
    assert "did you mean 'left_foot'" in " ".join(told.stderr.split())
    bare = tmp_path / "bare.xml"
    bare.write_text(MODEL)
    told = call("train", "--robot", bare)
    assert "has no gains" in " ".join(told.stderr.split())


def test_the_portable_g1_keeps_what_it_collides_with():
    one = portable(G1)
    for name in ("geom_contype", "geom_conaffinity", "exclude_signature"):
        own = getattr(G1.model, name)
        np.testing.assert_array_equal(getattr(one.model, name), own)
    assert mujoco.mj_getTotalmass(one.model) == pytest.approx(33.34, abs=0.01)


def test_a_base_below_another_body_is_refused(tmp_path):
    above = '<link name="footprint"/><joint name="up" type="fixed">'
    above += '<parent link="footprint"/><child link="hull"/></joint></robot>'
    (tmp_path / "stump.urdf").write_text(URDF.replace("</robot>", above))
    (tmp_path / "robot.toml").write_text(
        'model = "stump.urdf"\nbase = "hull"\nfeet = ["foot"]\nskin_links = ["hull"]\n'
        "[gains.a]\nankle = { kp = 40, kd = 2 }\n"
    )
    with pytest.raises(ValueError, match=r"base 'hull' is fixed to 'footprint'"):
        portable(read_folder(tmp_path))


def test_geoms_that_only_pairs_let_collide_meet_balls_and_floor(tmp_path):
    # Nothing but a pair lets the feet and the floor collide.
    feet = MODEL.replace('size="0.15 0.06 0.02"', 'contype="0" conaffinity="0" {}')
    for side in ("left", "right"):
        feet = feet.replace("{}", f'name="{side}_sole" size="0.15 0.06 0.02"', 1)
    text = feet.replace(
        "<worldbody>",
        '<contact><pair geom1="floor" geom2="left_sole"/>'
        '<pair geom1="left_sole" geom2="right_sole"/></contact>'
        '<worldbody><geom name="floor" type="plane" size="1 1 1"/>',
    )
    robot = portable(read_folder(write_robot(tmp_path, model=text)))
    model = robot.model
    assert model.npair == 1
    for side in ("left", "right"):
        assert model.geom(f"{side}_sole").conaffinity.item()
    assert len(robot.primitives) == len(
        portable(read_folder(write_robot(tmp_path / "as it was"))).primitives
    )


def test_a_joint_without_a_range_has_an_infinite_one(walker):
    assert np.isinf(walker.joint_range).all(0).tolist() == [
        not limited for limited in walker.model.jnt_limited[1:]
    ]
    json.dumps(to_plain(walker.joint_range.tolist()), allow_nan=False)


def test_a_robot_without_collision_shapes_has_a_height():
    xml = "<mujoco><worldbody><body name='a'><freejoint/><inertial mass='1' pos='0 0 0'"
    xml += " diaginertia='1 1 1'/><body name='b' pos='0 0 -.5'><joint/><inertial"
    xml += (
        " mass='1' pos='0 0 0' diaginertia='1 1 1'/></body></body></worldbody></mujoco>"
    )
    robot = RobotConfig(name="bare", model_xml=xml, base="a", skin_links=())
    assert robot.default_base_height == robot.standing_height == 0.5
    assert robot.lowest_link == "b"


# --- in the scene -----------------------------------------------------------------


def scene_of(robot: RobotConfig) -> mujoco.MjModel:
    """The scene of a robot and two balls."""
    balls = DodgeballConfig().throws.balls
    return build_scene(Scene(robot=robot, objects=balls, config=PhysicsConfig()))


def test_the_defaults_of_a_robot_apply_to_the_robot_alone(tmp_path):
    joint = 'range="-1.5 1.5" damping="3" frictionloss="2" armature="0.02"'
    shared = (
        '<geom friction="0.1 0.2 0.3" condim="6" margin="0.5" solref="0.1 2"/>'
        '<general ctrllimited="true" ctrlrange="-0.01 0.01" gear="7"/>'
    )
    model = MODEL.replace('range="-1.5 1.5" armature="0.02"', joint)
    model = model.replace("<default>", f"<default>{shared}")
    # As in a file that holds the robot alone.
    model = model.replace('<actuator><motor joint="left_hip"/></actuator>', "")
    scene = scene_of(read_folder(write_robot(tmp_path / "walker", model=model)))
    balls = np.flatnonzero(scene.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
    assert len(balls) == 6
    assert not scene.jnt_limited[balls].any()
    assert not scene.jnt_actfrclimited[balls].any()
    dofs = scene.jnt_dofadr[balls]
    for value in (scene.dof_damping, scene.dof_frictionloss, scene.dof_armature):
        assert not value[dofs].any()
    plain = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    ).geom(0)
    for name in ("floor", "object_0"):
        for value in ("friction", "condim", "margin", "solref"):
            own = getattr(scene.geom(name), value)
            np.testing.assert_array_equal(own, getattr(plain, value), value)
    assert not scene.actuator_ctrllimited.any()
    assert np.all(scene.actuator_gear[:, 0] == 1)
    # The robot keeps them.
    assert scene.joint("left_hip").damping == 3
    assert scene.geom_condim[scene.body("trunk").geomadr[0]] == 6


def test_the_options_of_a_robots_file_are_not_those_of_the_scene(tmp_path):
    option = (
        '<option solver="PGS" gravity="0 0 -3.7" density="900" wind="5 0 0" '
        'impratio="10" actuatorgroupdisable="0" timestep="0.1">'
        '<flag contact="disable" actuation="disable" energy="enable"/></option>'
    )
    model = MODEL.replace("<worldbody>", f"{option}<worldbody>")
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    assert "PGS" in (robot.model_xml or "")
    own, expected = scene_of(robot).opt, scene_of(H1_2).opt
    names = [n for n in dir(own) if n[0] != "_" and not callable(getattr(own, n))]
    for name in names:
        values = getattr(own, name), getattr(expected, name)
        np.testing.assert_array_equal(*values, name)
    # The built-in robots have no options of their own.
    assert expected.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert expected.gravity.tolist() == [0, 0, -GRAVITY]
    assert expected.disableflags == expected.enableflags == 0


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize(
    "setting",
    [
        'settotalmass="50"',
        'inertiafromgeom="true"',
        'inertiagrouprange="2 3"',
        'boundmass="12"',
        'boundinertia="0.3"',
    ],
)
def test_settings_that_change_masses_act_on_the_robot_alone(setting, tmp_path):
    heavy = '<inertial pos="0 0 0.1" mass="30" fullinertia="1 1 1 0.1 0 0"/>'
    model = MODEL.replace("<geom ", '<geom group="2" ')
    model = model.replace("<freejoint/>", f"<freejoint/>{heavy}")
    model = re.sub("<compiler ", f"<compiler {setting} ", model)
    assert heavy in model
    assert setting in model
    plain = mujoco.MjModel.from_xml_string(model)
    robot = read_folder(write_robot(tmp_path / "walker", model=model))
    for kept in (robot, portable(robot)):
        scene = scene_of(kept)
        for link in robot.links:
            own, expected = scene.body(link), plain.body(link)
            for value in ("mass", "ipos", "inertia"):
                # An MJCF has six digits.
                pair = getattr(own, value), getattr(expected, value)
                np.testing.assert_allclose(*pair, rtol=1e-5)
        ball = scene.body("object_0")
        assert ball.mass == OBJECT_MASS
        radius = scene.geom("object_0").size[0]
        np.testing.assert_allclose(ball.inertia, 0.4 * OBJECT_MASS * radius**2)


@pytest.mark.parametrize("fixed", ["trunk", "left_arm"])
def test_links_on_fixed_joints_stay_and_weigh_once(fixed, tmp_path):
    imu = (
        '<body name="imu" pos="0 0 0.1">'
        '<inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>'
        '<body name="lens" pos="0 0 0.1"><geom size="0.01" mass="2"/></body></body>'
    )
    model = MODEL.replace("<compiler ", '<compiler fusestatic="true" ')
    before, after = model.split(f'<body name="{fixed}"')
    model = f'{before}<body name="{fixed}"{after.replace("<geom", f"{imu}<geom", 1)}'
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    for robot in (before, portable(before)):
        assert {"imu", "lens"} <= {*robot.links}
        # 10 + 2 x (1 + 2 + 0.5) kg, and what is fixed.
        assert robot.model.body_mass.sum() == pytest.approx(17 + 3 + 2)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "box"])
@pytest.mark.parametrize("touches", [True, False])
def test_a_primitive_fitted_to_a_mesh_is_a_primitive(kind, touches, tmp_path):
    # A box whose centre is not the origin, as every mesh of a file, turned.
    corners = [(x, y, z) for x in (0, 0.1) for y in (0, 0.2) for z in (0, 0.6)]
    vertices = " ".join(str(v) for corner in corners for v in corner)
    bits = f'contype="{int(touches)}" conaffinity="{int(touches)}"'
    fitted = f'<geom name="fitted" type="{kind}" mesh="m" mass="1" {bits} '
    fitted += 'pos="0 0 0.4" euler="0.3 0.2 0.1"/>'
    model = MODEL.replace(
        "<worldbody>",
        f'<asset><mesh name="m" vertex="{vertices}"/></asset><worldbody>',
    ).replace('<body name="left_arm"', f'{fitted}<body name="left_arm"')
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    robot = portable(before)
    own, expected = (r.model.geom("fitted") for r in (robot, before))
    for name in ("pos", "quat"):
        np.testing.assert_allclose(getattr(own, name), getattr(expected, name), 1e-5)
    np.testing.assert_allclose(robot.model.body_mass, before.model.body_mass, 1e-5)
    np.testing.assert_allclose(
        robot.model.body_inertia, before.model.body_inertia, 1e-5
    )
    if touches:
        for mine, theirs in zip(robot.primitives, before.primitives, strict=True):
            assert (mine.link, mine.kind) == (theirs.link, theirs.kind)
            np.testing.assert_allclose(mine.size, theirs.size, 1e-5)


FLAT = {
    "thin box": '<geom type="box" size="{a} {b} 5e-5" mass="1"/>',
    "planar": '<inertial pos="0 0 0" mass="1" diaginertia="{a} {b} {c}"/>',
    "tilt": '<inertial pos="0 0 0" euler="1 2 3" mass="1" diaginertia="{a} {b} {c}"/>',
    "full": '<inertial pos="0 0 0" mass="1" fullinertia="{a} {b} {c} {d} 0 0"/>',
}


@pytest.mark.parametrize("kind", FLAT)
def test_flat_links_are_kept(kind, tmp_path):
    for seed in range(20):
        a, b = np.random.default_rng(seed).uniform(0.01, 0.2, 2)
        # In the plane, an inertia about its normal is the sum of the other two.
        sizes = {"a": a, "b": b, "c": (a + b) * (1 - 1e-12), "d": 0.3 * min(a, b)}
        flat = f'<body name="plate">{FLAT[kind].format(**sizes)}</body>'
        model = MODEL.replace('<body name="left_arm"', f'{flat}<body name="left_arm"')
        before = read_folder(write_robot(tmp_path / "walker", model=model))
        after = portable(before)
        own, expected = (r.model.body("plate") for r in (after, before))
        np.testing.assert_allclose(own.inertia, expected.inertia, 2e-5)
        assert own.mass == pytest.approx(expected.mass)
        others = np.arange(before.model.nbody) != expected.id
        values = (r.model.body_inertia[others] for r in (after, before))
        np.testing.assert_allclose(*values, 1e-5)
