"""The page without a browser: requests, errors, visitors who come and go."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import psutil
import pytest

pytest.importorskip("viser")

from calling import BATCH, SMALL, fail, succeed, wait_for
from egoskin.viewer.web.page import Page
from egoskin.viewer.web.panel import MEMORY
from visiting import Visitor


@pytest.fixture(scope="module")
def shared() -> Iterator[Page]:
    page = Page(["field_proximity"])
    yield page
    page.close()


@pytest.fixture
def page(shared: Page) -> Page:
    """Return the shared page, as if just opened, without automatic balls."""
    shared.panel.tempo.value = 0
    shared.is_paused = False
    shared.mask_all(False)
    shared.reset()
    return shared


def advance(page: Page, steps: int) -> None:
    for _ in range(steps):
        page.advance()


def test_a_throw_changes_what_the_sensors_show(page: Page):
    advance(page, 30)
    colours = [mesh.batched_colors.copy() for _, mesh in page._scenes[0]._sensors]
    page.throw_from(0.0)
    for _ in range(60):
        page.play()
        if page.sessions[0].frame.reading.max() > 0.3:
            break
    page._draw(page._memory[-1])
    shown = [mesh.batched_colors for _, mesh in page._scenes[0]._sensors]
    assert any((a != b).any() for a, b in zip(colours, shown, strict=True))
    assert page._scenes[0]._balls[0].visible
    assert page._scenes[0]._lines.visible


def test_balls_are_thrown_by_themselves_as_often_as_the_panel_says(page: Page):
    page.panel.tempo.value = 60
    flights = 0
    for _ in range(150):
        page.play()
        flights = int(page.sessions[0].task.balls.state["throw"])
    assert flights == 2


def test_a_click_on_a_sensor_masks_it_and_another_brings_it_back(page: Page):
    session = page.sessions[0]
    skin = session.skin
    assert skin is not None
    session.body.place(session.frame.qpos)
    point = session.body.sensor_points(skin)[5]
    normal = session.body.sensor_normals(skin)[5]
    for expected in ({5}, set()):
        page.click(point + 2 * normal, -normal)
        assert session.masked == expected
    assert not session.task.balls.state["active"].any()


def test_a_click_on_the_floor_throws_from_there(page: Page):
    page.click(np.array([2.0, -3.0, 2.0]), np.array([0.0, 0.0, -1.0]))
    page.play()
    np.testing.assert_allclose(page.sessions[0].frame.balls[0, :2], [2, -3], atol=0.02)


def test_a_click_on_the_robot_throws_at_it(page: Page):
    # At the chest, between sensors or not: the click hits the body here.
    page.sessions[0].mask(set())
    page.click(np.array([4.0, 0.0, 0.55]), np.array([-1.0, 0.0, 0.0]))
    page.click(np.array([4.0, 0.05, 0.7]), np.array([-1.0, 0.0, 0.0]))
    page.click(np.array([4.0, 0.1, 0.6]), np.array([-1.0, 0.0, 0.0]))
    page.play()
    frame = page.sessions[0].frame
    assert frame.active.any()
    ball = frame.balls[frame.active][0]
    # From where the visitor looks.
    assert abs(np.arctan2(ball[1], ball[0])) < 0.1


def test_pause_step_and_reset(page: Page):
    advance(page, 3)
    page.pause()
    advance(page, 3)
    assert page.sessions[0].frame.step == 3
    page.step_once()
    assert page.sessions[0].frame.step == 4
    page.pause()
    advance(page, 1)
    assert page.sessions[0].frame.step == 5
    page.reset()
    assert page.sessions[0].frame.step == 0


def test_a_replay_shows_what_was_and_computes_nothing(page: Page):
    page.throw_from(90.0)
    advance(page, 40)
    steps = page.steps
    page.replay()
    drawn = []
    page._scenes[0].draw, original = (
        lambda frame, masked: drawn.append(frame.step),
        page._scenes[0].draw,
    )
    try:
        while page._replayed:
            page._pictured = 0.0
            page.advance()
    finally:
        page._scenes[0].draw = original
    assert drawn == list(range(1, 41))
    assert page.steps == steps


def test_a_recording_plays_without_a_server(page: Page):
    page.throw_from(0.0)
    advance(page, 60)
    text = page.recording()
    assert "__VISER_EMBED_DATA__" in text
    assert len(text) < 4e6


def test_balls_avoided_are_counted(page: Page):
    page.mask_all(True)
    for _ in range(400):
        if page.sessions[0].frame.step % 40 == 0:
            page.throw_from(0.0)
        page.play()
        if page._survival[0]:
            break
    avoided, came = page._avoided[0], page._came[0]
    assert came >= 1
    assert avoided < came
    assert f"**{avoided}** of {came}" in page._status()[2]
    page.reset()
    assert "**0** of 0" in page._status()[2]


def test_a_policy_that_fails_shows_its_error_and_the_page_lives_on(
    page: Page, monkeypatch
):
    def fall_ill(td):
        raise RuntimeError("a fault of <its> own")

    with monkeypatch.context() as patch:
        patch.setattr(page.sessions[0], "policy", fall_ill)
        page._do(page.advance)
        assert "a fault of" in page.panel._error.content
        assert page.panel._error.visible
        steps = page.steps
        page._do(page.advance)
        assert page.steps == steps
    page._do(lambda: page.load(0, "field_proximity"))
    assert not page.panel._error.visible
    page._do(page.advance)
    assert page.steps == steps + 1


def test_another_policy_is_loaded_and_a_wrong_name_is_told(page: Page):
    page._do(lambda: page.load(0, "blind"))
    assert page.sessions[0].source == "blind"
    assert not page._scenes[0]._sensors
    advance(page, 2)
    page._do(lambda: page.load(0, "nobody"))
    assert "no policy nobody" in page.error
    assert page.sessions[0].source == "blind"
    page._do(lambda: page.load(0, "field_proximity"))
    assert not page.error
    assert page._scenes[0]._sensors


def test_sensors_are_exchanged_as_the_panel_says(page: Page):
    page.panel._range.value = 0.5
    page.panel._signal.value = "binary"
    page.sense()
    sensor = page.sessions[0].config.sensor
    assert (sensor.range, sensor.signal) == (0.5, "binary")
    advance(page, 2)
    page.load(0, "field_proximity")
    assert page.panel._range.value == 2.0


def test_a_newer_policy_of_a_run_is_taken_up(trained, tmp_path):
    import os
    import shutil

    run = tmp_path / "run"
    shutil.copytree(trained, run)
    page = Page([str(run)])
    try:
        advance(page, 5)
        old = page.sessions[0].policy
        page._follow()
        assert page.sessions[0].policy is old
        checkpoint = run / "checkpoint.safetensors"
        os.utime(checkpoint, ns=(0, checkpoint.stat().st_mtime_ns + 10**9))
        page._follow()
        assert page.sessions[0].policy is not old
        # In the middle of the episode.
        assert page.sessions[0].frame.step == 5
        assert "loaded at" in page._notes[0]
    finally:
        page.close()


def test_two_robots_meet_the_same_throws():
    page = Page(["field_proximity", "blind"])
    try:
        page.panel.tempo.value = 0
        page.throw_from(None)
        page.play()
        one, other = (session.frame for session in page.sessions)
        # Until they move differently the two robots are the same.
        np.testing.assert_allclose(one.balls[0], other.balls[0], atol=0.02)
        page._draw([one, other])
        assert len(page._status()) >= 4
    finally:
        page.close()


def test_robots_side_by_side_have_one_control_rate(tmp_path):
    slow = tmp_path / "slow"
    rate = ("--task.physics.control-hz", "50")
    succeed("train", *SMALL, *rate, "--run-dir", slow, "--total-frames", BATCH)
    with pytest.raises(
        ValueError, match="blind acts at 60 Hz and the other robot at 50 Hz"
    ):
        Page([str(slow), "blind"])
    page = Page(["blind"])
    try:
        page.load(0, str(slow))
        assert page.hz == 50
        assert page._memory.maxlen == MEMORY * 50
    finally:
        page.close()


def test_it_computes_while_somebody_watches_and_not_otherwise():
    page = Page(["blind"])
    threading.Thread(target=page.run, daemon=True).start()
    try:
        time.sleep(0.3)
        assert page.steps == 0
        port = page.server.get_port()
        first = Visitor(port)
        wait_for(lambda: page.steps > 5)
        second = Visitor(port)
        wait_for(lambda: second.received > 50)
        threads = psutil.Process().num_threads()
        second.leave()
        before = page.steps
        wait_for(lambda: page.steps > before + 5)
        for _ in range(3):
            other = Visitor(port)
            wait_for(lambda: other.received > 50)  # noqa: B023
            other.vanish()
        wait_for(lambda: len(page.server.get_clients()) == 1)
        assert page.error == ""
        assert psutil.Process().num_threads() <= threads + 2
        first.leave()
        wait_for(lambda: not page.server.get_clients())
        time.sleep(0.2)
        before = page.steps
        time.sleep(0.3)
        assert page.steps == before
    finally:
        page.close()


def test_a_port_that_is_taken_is_an_error(page: Page):
    assert "is already in use" in fail("view", "--port", page.server.get_port())


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["nobody"], "no policy nobody"),
        (["blind", "blind", "blind"], "at most two"),
        (["--port", "-1"], "port"),
    ],
)
def test_bad_input_is_an_error(args: list, text: str):
    assert text in fail("view", *args)


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (800, 900), (400, 800)])
def test_all_robots_are_seen_beside_the_panel(page: Page, width: int, height: int):
    camera = page.server.initial_camera
    page._look(camera, (width, height))
    forward = np.array(camera.look_at) - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    # The head and both sides of the robot, which stands at the origin.
    for point in ((0, 0, 1.8), (0, 0, 0), (0, -0.4, 1.0), (0, 0.4, 1.0)):
        way = np.array(point) - camera.position
        scale = height / 2 / np.tan(camera.fov / 2) / (way @ forward)
        x, y = width / 2 + scale * (way @ right), height / 2 - scale * (way @ up)
        assert 0 < y < height
        # On a narrow screen the panel is collapsed.
        assert 0 < x < (width - 340 if width > 600 else width)
