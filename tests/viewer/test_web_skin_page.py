"""The page of a robot without a policy: joints, and the directions its skin sees."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("viser")

from calling import fail
from egoskin.robots.builtin import H1_2
from egoskin.robots.config import read_robot
from egoskin.viewer.web import skin_page
from egoskin.viewer.web.body import Body
from egoskin.viewer.web.skin_page import SkinPage, colour_directions, group_joints
from visiting import Visitor


@pytest.fixture(scope="module")
def page(skin) -> Iterator[SkinPage]:
    page = SkinPage(H1_2, skin)
    yield page
    page.close()


def test_a_joint_moves_the_links_below_it_alone(page: SkinPage):
    elbow = H1_2.joints.index("left_elbow_joint")

    def places() -> dict[str, np.ndarray]:
        data = page.body.data
        names = ("left_wrist_roll_link", "right_wrist_roll_link", "torso_link")
        return {name: data.body(name).xpos.copy() for name in names}

    page.reset()
    before = places()
    page.move(elbow, 1.5)
    after = places()
    moved = [name for name in before if not np.allclose(before[name], after[name])]
    assert moved == ["left_wrist_roll_link"]
    page.reset()
    np.testing.assert_allclose(places()["left_wrist_roll_link"], before[moved[0]])


def test_a_joint_stays_within_its_limits_while_a_position_is_typed(page: SkinPage):
    slider = page._sliders[0]
    visitor = Visitor(page.server.get_port())
    try:
        visitor.choose(slider, 99.0)
        page._do(page._commands.get(timeout=20))
    finally:
        visitor.leave()
    assert page.joint_pos[0] == slider.max
    page.reset()


def test_a_range_is_within_its_limits_while_it_is_typed(page: SkinPage, monkeypatch):
    given = []
    monkeypatch.setattr(
        skin_page, "see_directions", lambda *args, **_: given.append(args)
    )
    monkeypatch.setattr(page, "show", lambda *_: page._end(""))
    page._range.value = 0.0
    look(page)
    page._range.value = 0.5
    assert [sensor.range for _, _, sensor, _ in given] == [0.1]


def test_directions_are_shown_and_their_share_is_told(page: SkinPage):
    clearance = np.full((36, 72), np.nan)
    # Half of all directions are above the base, and half of these are seen.
    clearance[18:, :36], clearance[18:, 36:] = 0.0, 0.5
    page.show(clearance, 1.0)
    assert page._result.content.startswith("**50.0%**")


def look(page: SkinPage) -> None:
    """Compute the directions seen, and handle what the computation asks for."""
    page.look()
    while page._computing is not None:
        page._do(page._commands.get(timeout=120))


def test_a_map_is_of_the_pose_that_is_shown(page: SkinPage, monkeypatch):
    nodes = page.server.scene._handle_from_node_name
    map_of = np.full((36, 72), 0.5)
    monkeypatch.setattr(skin_page, "see_directions", lambda *_, **__: map_of)
    page.reset()
    look(page)
    assert "/directions" in nodes
    page.move(0, 0.1)
    assert "/directions" not in nodes
    assert page._result.content.startswith("Each point")
    # A pose that changes during the computation.
    page.look()
    page.move(0, 0.2)
    page._do(page._commands.get(timeout=60))
    assert "/directions" not in nodes
    assert not page._button.disabled


def test_a_computation_that_fails_shows_its_error(page: SkinPage, monkeypatch):
    def fall_ill(*args, **kwargs):
        raise RuntimeError("out of <memory>")

    with monkeypatch.context() as patch:
        patch.setattr(skin_page, "see_directions", fall_ill)
        look(page)
    assert "out of &lt;memory&gt;" in page._error_text.content
    assert not page._button.disabled
    # A request that fails does not end the page.
    ask = [lambda: 1 / 0, lambda: page.move(0, 0.3), threading.Event().wait]
    for request in ask:
        page._commands.put(request)
    threading.Thread(target=page.run, daemon=True).start()
    end = time.monotonic() + 20
    while page.joint_pos[0] != 0.3:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_ranges_of_the_skin_file_take_precedence(skin, monkeypatch):
    page = SkinPage(H1_2, dataclasses.replace(skin, range=np.full(len(skin), 0.4)))
    shown = []
    monkeypatch.setattr(page, "show", lambda *args: shown.append(args))
    monkeypatch.setattr(skin_page, "see_directions", lambda *_, **__: None)
    try:
        page._range.value = 3.0
        page.look()
        page._do(page._commands.get(timeout=60))
    finally:
        page.close()
    assert shown == [(None, 0.4)]


def test_the_robot_stands_on_the_floor_in_every_pose(page: SkinPage):
    knees = [i for i, name in enumerate(H1_2.joints) if "knee" in name]
    height = page.body.data.xpos[1, 2]
    for knee in knees:
        page.move(knee, 1.5)
    pose = dict(zip(H1_2.joints, page.joint_pos.tolist(), strict=True))
    posed = dataclasses.replace(H1_2, default_pose=pose)
    assert page.body.data.xpos[1, 2] == pytest.approx(posed.default_base_height)
    assert page.body.data.xpos[1, 2] < height - 0.05
    page.reset()


def test_never_seen_is_red_and_seen_is_not():
    never, late, early = colour_directions(np.array([0.0, 0.1, 1.0])).tolist()
    assert never == [200, 30, 40]
    assert late[2] > late[1]
    assert early[1] > early[2]


def test_joints_are_grouped_each_once():
    groups = group_joints(H1_2.joints)
    assert sorted(i for group in groups.values() for i in group) == list(range(21))
    assert all(len(group) <= 12 for group in groups.values())
    assert list(group_joints([f"j{i}" for i in range(20)])) == ["joints 1", "joints 2"]


def test_a_robot_of_ones_own_that_stands_fixed_is_shown(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        "<mujoco model='arm'><worldbody><body name='shoulder' pos='0 0 1'>"
        "<geom type='cylinder' size='0.1 0.2' rgba='1 0 0 1'/><body name='upper'>"
        "<joint name='lift' axis='0 1 0'/>"
        "<geom type='ellipsoid' size='0.1 0.1 0.3' pos='0 0 0.3'/>"
        "</body></body></worldbody></mujoco>"
    )
    page = SkinPage(read_robot(path), None)
    try:
        top = page.body.bounds()[1, 2]
        page.move(0, math.pi)
        assert page.body.bounds()[1, 2] < top
        red = [p for p in page.body.parts() if p.rgba == (1, 0, 0, 1)]
        np.testing.assert_allclose(np.ptp(red[0].vertices[:, 2]), 0.4)
    finally:
        page.close()


def test_the_share_of_directions_is_that_of_their_solid_angle(page: SkinPage):
    # Seen from more than 30 degrees above the horizon: (1 - sin 30) / 2 of the sphere,
    # but a third of the map's cells.
    clearance = np.zeros((36, 72))
    clearance[24:] = 0.5
    page.show(clearance, 1.0)
    assert page._result.content.startswith("**25.0%**")
    cloud = page.server.scene._handle_from_node_name["/directions"]
    centre = page.body.standing(page.joint_pos)[:3]
    outward = cloud.points - centre
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    is_red = (cloud.colors == (200, 30, 40)).all(1)
    np.testing.assert_array_equal(is_red, outward[:, 2] < 0.5)


@pytest.mark.parametrize("kind", ["field", "ray"])
def test_the_chosen_kind_of_sensors_is_looked_with(
    page: SkinPage, kind: str, monkeypatch
):
    given = []
    monkeypatch.setattr(
        skin_page, "see_directions", lambda *args, **_: given.append(args)
    )
    monkeypatch.setattr(page, "show", lambda *_: page._end(""))
    page.move(2, 0.2)
    page._kind.value = kind
    look(page)
    page._kind.value = "field"
    ((robot, _, sensor, _),) = given
    assert sensor.coverage == kind
    # In the pose that is shown.
    np.testing.assert_allclose(robot.default_joint_pos, page.joint_pos)
    page.reset()


def test_shapes_are_drawn_turned_moved_and_in_their_materials_colour(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        "<mujoco model='arm'><asset><material name='blue' rgba='0 0 1 1'/></asset>"
        "<worldbody><body name='shoulder' pos='0 0 1'>"
        "<geom type='box' size='0.1 0.2 0.3' pos='1 0 0' euler='0 0 90'/>"
        "<geom size='0.1' material='blue'/><body name='upper'>"
        "<joint name='lift' axis='0 1 0'/><geom size='0.1'/>"
        "</body></body></worldbody></mujoco>"
    )
    grey, blue, upper = Body(read_robot(path)).parts()
    assert grey.body == blue.body == upper.body - 1
    assert blue.rgba == (0, 0, 1, 1)
    low, high = grey.vertices.min(0), grey.vertices.max(0)
    # In the frame of the link; a quarter turn exchanges two of the box's sides.
    np.testing.assert_allclose(low, (0.8, -0.1, -0.3), atol=1e-6)
    np.testing.assert_allclose(high, (1.2, 0.1, 0.3), atol=1e-6)


def test_a_robot_whose_shapes_are_all_left_out_is_shown(tmp_path):
    path = tmp_path / "arm.urdf"
    mesh = "<collision><geometry><mesh filename='no.stl'/></geometry></collision>"
    path.write_text(
        f"<robot name='arm'><link name='base'>{mesh}</link><link name='upper'>{mesh}"
        "</link><joint name='lift' type='revolute'><parent link='base'/>"
        "<child link='upper'/><origin xyz='0 0 0.4'/><axis xyz='0 1 0'/>"
        "<limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>"
    )
    page = SkinPage(read_robot(path), None)
    try:
        low, high = page.body.bounds()
        assert 0.4 < high[2] - low[2] < 0.6
    finally:
        page.close()


def test_a_model_without_bodies_is_refused(tmp_path):
    path = tmp_path / "empty.xml"
    path.write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(ValueError, match="the model of empty has no bodies to show"):
        SkinPage(read_robot(path), None)


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["--robot", "nobody"], "no robot 'nobody': it must be one of h1_2"),
        (["--skin", "nothing.json"], "nothing.json"),
        (["blind", "--robot", "h1_2"], "leave out --skin and --robot"),
    ],
)
def test_bad_input_is_an_error(args: list, text: str):
    assert text in fail("view", *args)
