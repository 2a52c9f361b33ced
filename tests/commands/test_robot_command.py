"""The command `egoskin robot`: checks of a robot before training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calling import call, fail, succeed
from owning import MODEL, TOML, write_robot


def test_a_robot_that_stands_is_told_so_and_drawn(tmp_path):
    picture = tmp_path / "walker.png"
    out = succeed("robot", "check", write_robot(tmp_path / "walker"), "--out", picture)
    # 10 + 2 x (1 + 2 + 0.5) kg; 0.69 + 0.4 m.
    assert out.startswith("walker: 6 joints, 7 links, 17.00 kg\n")
    assert "1.09 m tall, its base 0.69 m up" in out
    assert "skin: 64 sensors on 3 links" in out
    # 0.3 x 60 / 150 rad.
    assert "an action of 1 moves a joint by 0.12 to 0.90 rad" in out
    assert "gains stiff: it stands for 2 s by itself" in out
    assert "wrong" not in out
    image = np.asarray(Image.open(picture))
    assert image.shape == (960, 1280, 3)
    # Sensors are drawn: only they have this colour.
    assert (np.abs(image.astype(int) - [25, 242, 255]).sum(-1) < 120).sum() > 500


def test_a_robot_that_falls_must_learn_to_stand():
    out = succeed("robot", "check", "h1_2")
    assert "without an action it falls after 1.7 s; it must learn to stand" in out


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('actuatorfrcrange="-60 60" ', "", "no torque limit: left_shoulder, right"),
        ("<freejoint/>", "", "must be the free joint of its base 'trunk'"),
        ('range="-1.5 1.5"', 'range="0.2 1.5"', "out of range: left_shoulder, right"),
        ('feet = ["*_foot"]', "feet = []", "no feet: any contact with the floor"),
        ('feet = ["*_foot"]', 'feet = ["*_leg"]', "left_foot, which is not a foot"),
        ("*_arm", "left_arm", None),
        ("left_shoulder = 0.1", '"*_hip" = 1.5', "falls within"),
    ],
)
def test_what_is_wrong_with_a_robot_is_told(old, new, told, tmp_path):
    folder = write_robot(
        tmp_path / "walker", TOML.replace(old, new), MODEL.replace(old, new)
    )
    done = call("robot", "check", folder)
    if told is None:
        assert done.returncode == 0, done.stdout
        return
    assert done.returncode == 2
    assert told in done.stdout
    assert "error: walker cannot be trained" in done.stderr


def test_a_model_alone_cannot_be_trained(tmp_path: Path):
    done = call("robot", "check", write_robot(tmp_path) / "walker.xml")
    assert "walker has no gains" in done.stdout
    assert done.returncode == 2


def test_a_urdf_without_a_single_base_is_told_its_candidates(tmp_path: Path):
    path = tmp_path / "two.urdf"
    path.write_text(
        "<robot name='two'><link name='hull'/><link name='arm'/><link name='loose'/>"
        "<joint name='j' type='fixed'><parent link='hull'/><child link='arm'/></joint>"
        "</robot>"
    )
    told = "two has no single base: attached to the world are hull, loose; give base in"
    assert told in fail("robot", "check", path)


def test_a_joint_without_a_range_and_a_weak_one_are_notes(tmp_path):
    model = MODEL.replace(' range="-1.5 1.5"', "")
    toml = TOML.replace("kp = 20, kd", "kp = 500, kd")
    folder = write_robot(tmp_path / "walker", toml, model)
    out = succeed("robot", "check", folder, "--skin.num-sensors", "5")
    assert "skin: 5 sensors on" in out
    assert "no range: left_shoulder, right_shoulder, left_hip" in out
    assert "by less than 0.1 rad: left_shoulder, right_shoulder;" in out


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("skin_links=()", "no skin_links to place sensors on"),
        ("skin_links=('trunk', 'nose')", "skin_links that are not links: nose"),
        ("untargeted_links=('nose',)", "untargeted_links that are not links: nose"),
        ("feet=('left_foot', 'nose')", "feet that are not links: nose"),
    ],
)
def test_links_that_a_python_file_invents_are_told(change, told, tmp_path):
    folder = write_robot(tmp_path / "walker")
    (tmp_path / "mine.py").write_text(
        "from dataclasses import replace\nfrom pathlib import Path\n"
        "from egoskin.robots.own import read_folder\n"
        f"ROBOT = replace(read_folder(Path({str(folder)!r})), {change})\n"
    )
    done = call("robot", "check", f"{tmp_path}/mine.py:ROBOT")
    assert done.returncode == 2
    assert f"wrong  {told}" in done.stdout


def test_each_set_of_gains_is_tried(tmp_path):
    toml = TOML + '[gains.weak]\n"*" = { kp = 0.1, kd = 0.01 }\n'
    done = call("robot", "check", write_robot(tmp_path / "walker", toml))
    assert "gains stiff: it stands for 2 s by itself" in done.stdout
    # 0.3 x 60 / 0.1 rad.
    assert "gains weak: an action of 1 moves a joint by 180.00 to 180" in done.stdout
    assert (
        "gains weak: it falls " in done.stdout or "gains weak: without" in done.stdout
    )


def test_a_robot_that_touches_itself_is_told_so(tmp_path):
    out = succeed("robot", "check", write_robot(tmp_path / "walker"))
    assert "touches itself" not in out
    # Both arms in one place, inside the trunk, with which they do not collide.
    model = MODEL.replace('"0 0.25 0.3"', '"0 0 0.3"')
    model = model.replace('"0 -0.25 0.3"', '"0 -0.05 0.3"')
    done = call("robot", "check", write_robot(tmp_path / "walker", model=model))
    assert "note   it touches itself in its default pose" in done.stdout


def test_a_robot_whose_simulation_fails_is_told_so(tmp_path):
    # Arms of 10 milligrams, without armature, on very stiff springs.
    model = MODEL.replace('armature="0.02"', 'armature="0"')
    model = model.replace('-0.3" mass="1"', '-0.3" mass="1e-5"')
    toml = TOML.replace("{ kp = 20, kd = 1 }", "{ kp = 1e6, kd = 0 }")
    done = call("robot", "check", write_robot(tmp_path / "walker", toml, model))
    assert "wrong  gains stiff: the simulation fails after 0.0" in done.stdout
    assert "it stands" not in done.stdout.partition("gains stiff")[2]
