"""The page without a browser: requests, errors, visitors who come and go."""

from __future__ import annotations

import dataclasses
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import psutil
import pytest
import torch

pytest.importorskip("viser")

from calling import BATCH, SMALL, fail, succeed, wait_for
from egoskin.agents.networks import NetworkConfig
from egoskin.make import EnvConfig
from egoskin.policies.policy import policy_file, save_policy
from egoskin.sensors import Ray, Skin
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.viewer.web import session as session_module
from egoskin.viewer.web.body import mesh_of
from egoskin.viewer.web.page import Page, _short
from egoskin.viewer.web.panel import EPISODES, MEMORY
from egoskin.viewer.web.scene import colour_of
from egoskin.viewer.web.session import Frame
from making import make_agent
from sensing import KINDS, SHAPES
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


@pytest.fixture(scope="module")
def pair() -> Iterator[Page]:
    """Return two robots with different sensors."""
    pair = Page(["field_proximity", "localization"])
    pair.panel.tempo.value = 0
    yield pair
    pair.close()


def serve(page: Page) -> None:
    """Handle all queued requests, as the loop does."""
    while not page._commands.empty():
        page._do(page._commands.get())


def end_episode(page: Page) -> None:
    """End the episode of the first robot."""
    session = page.sessions[0]
    session.frame = dataclasses.replace(session.frame, ending="hit")
    page._end(0)


def drawn_by(page: Page, what: Callable[[], object]) -> list[Frame]:
    """Return the frames of the first robot that are drawn meanwhile."""
    drawn: list[Frame] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page._scenes[0], "draw", lambda frame: drawn.append(frame))
        what()
    return drawn


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


@pytest.mark.parametrize("shape", SHAPES, ids=KINDS)
def test_an_object_is_drawn_as_its_shape(shape):
    mesh = mesh_of(shape)
    extents = torch.from_numpy(np.abs(mesh.vertices).max(0))
    reach = shape.signed_distance(*torch.diag(extents).unbind(0))
    # The surface passes the ends of the mesh, which are vertices, on each axis.
    assert reach.abs().max() < 1e-6
    x, y, z = torch.from_numpy(np.array(mesh.vertices)).unbind(-1)
    assert shape.signed_distance(x, y, z).abs().max() < 0.01


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


@pytest.mark.parametrize(
    ("origin", "way", "place"),
    [
        ((2.0, -3.0, 2.0), (0.0, 0.0, -1.0), (2.0, -3.0)),
        # On the robot: from the visitor's side, in the middle of the task's distances.
        ((8.0, 1.0, 1.0), (-1.0, 0.0, 0.0), (4.96, 0.62)),
    ],
)
def test_a_click_after_an_end_throws_from_the_clicked_side(
    page: Page, origin: tuple, way: tuple, place: tuple
):
    session = page.sessions[0]
    moved = session.frame.qpos.copy()
    moved[:2] = 1.0
    # Turned by 90 degrees.
    moved[3:7] = np.sqrt((0.5, 0, 0, 0.5))
    session.frame = dataclasses.replace(session.frame, qpos=moved, ending="fall")
    page._shown = [session.frame]
    page.click(np.array(origin), np.array(way))
    page.play()
    ball = session.frame.balls[session.frame.active][0, :2]
    np.testing.assert_allclose(ball, place, atol=0.05)


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

    def play_all() -> None:
        while page._replayed:
            page._pictured = 0.0
            page.advance()

    drawn = drawn_by(page, play_all)
    assert [frame.step for frame in drawn] == list(range(1, 41))
    assert page.steps == steps


def test_pause_and_step_hold_and_step_a_replay(page: Page):
    advance(page, 5)
    page.replay()
    page.advance()
    page.pause()
    page.advance()
    assert len(page._replayed) == 4
    assert "Replay" in page._status()[-1]
    assert "Paused" in page._status()[-1]
    page.step_once()
    assert page._shown[0].step == 2
    assert page.sessions[0].frame.step == 5


def test_a_replay_that_begins_in_a_pause_ends_in_one(page: Page):
    advance(page, 3)
    page.pause()
    page.replay()
    advance(page, 5)
    assert page.is_paused
    assert (page._shown[0].step, page.sessions[0].frame.step) == (3, 3)


def test_a_replay_is_not_disturbed_by_visitors_and_masks(page: Page):
    advance(page, 3)
    page.replay()
    page.advance()
    drawn = drawn_by(page, page._greet) + drawn_by(page, lambda: page.mask(0, {4}))
    assert [(frame.step, list(frame.masked)) for frame in drawn] == [(1, [])] * 2


def test_after_an_end_a_step_begins_the_next_episode(page: Page):
    advance(page, 3)
    end_episode(page)
    page.step_once()
    frame = page.sessions[0].frame
    assert (frame.step, frame.ending) == (0, None)


def test_an_end_is_shown_for_a_time_that_is_not_counted_in_steps(page: Page):
    advance(page, 3)
    end_episode(page)
    page.play()
    assert page.sessions[0].frame.ending == "hit"
    page._ended_at[0] -= 1.3
    page.play()
    assert page.sessions[0].frame.ending is None


def test_a_throw_after_an_end_is_not_lost(pair: Page):
    pair.reset()
    pair.play()
    end_episode(pair)
    pair.throw_from(0.0)
    pair.play()
    assert all(session.frame.active.any() for session in pair.sessions)
    thrown = [s.task.balls.state["next_throw_step"] for s in pair.sessions]
    assert all(int(step) > 1000 for step in thrown)


def test_a_recording_plays_without_a_server(page: Page):
    page.throw_from(0.0)
    advance(page, 60)
    text = page.recording()
    assert "__VISER_EMBED_DATA__" in text
    assert len(text) < 4e6


@pytest.mark.parametrize(("hz", "pictures"), [(12.0, 10), (60.0, 5), (100.0, 4)])
def test_a_recording_takes_as_long_as_what_was(
    page: Page, monkeypatch, hz: float, pictures: int
):
    advance(page, 10)
    waits = []
    monkeypatch.setattr(Page, "hz", hz)
    monkeypatch.setattr(
        page.server,
        "get_scene_serializer",
        lambda: type(
            "Recorder", (), {"insert_sleep": waits.append, "as_html": lambda: ""}
        ),
    )
    drawn = drawn_by(page, page.recording)
    assert len(waits) == pictures
    assert sum(waits) == pytest.approx(10 / hz, abs=2 / 30)
    # The last but one is the last of the recording, then what was shown before.
    assert drawn[-2].step == 10


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
        assert "a fault of" in page._error_text.content
        assert page._error_text.visible
        steps = page.steps
        page._do(page.advance)
        assert page.steps == steps
    page._do(lambda: page.load(0, "field_proximity"))
    assert not page._error_text.visible
    page._do(page.advance)
    assert page.steps == steps + 1


def test_a_request_that_fails_does_not_stop_play(page: Page):
    for _ in range(2):
        page._do(lambda: page.load(0, "nobody"))
        steps = page.steps
        page._do(page.advance)
        assert page.steps == steps + 1
    assert "no policy nobody" in page.error
    page.reset()
    assert not page.error


def test_a_chosen_policy_is_not_reset_before_it_is_loaded(page: Page):
    choice = page.panel._policies[0]
    visitor = Visitor(page.server.get_port())
    try:
        visitor.choose(choice, "blind")
        wait_for(lambda: choice.value == "blind")
        page._show()
        assert choice.value == "blind"
        page._do(lambda: page.load(0, "nobody"))
        assert choice.value == "field_proximity"
    finally:
        visitor.leave()
        page._commands.queue.clear()


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
    page.sense("range")
    page.panel._signal.value = "binary"
    page.sense("signal")
    sensor = page.sessions[0].config.sensor
    assert (sensor.range, sensor.signal) == (0.5, "binary")
    advance(page, 2)
    page.load(0, "field_proximity")
    assert page.panel._range.value == 2.0


def test_a_dragged_slider_is_applied_once_with_its_last_value(page: Page, monkeypatch):
    session, scene, slider = page.sessions[0], page._scenes[0], page.panel._range
    built, build = [], session_module.make_worker_env

    def build_slowly(config, *args, **kwargs):
        built.append(config.sensor.range)
        # Meanwhile it is dragged on.
        slider._impl.value = 0.7
        return build(config, *args, **kwargs)

    visitor = Visitor(page.server.get_port())
    monkeypatch.setattr(session_module, "make_worker_env", build_slowly)
    try:
        for value in (1.8, 1.5, 1.0):
            visitor.choose(slider, value)
        wait_for(lambda: slider.value == 1.0 and page._commands.qsize() == 4)
        serve(page)
    finally:
        visitor.leave()
        monkeypatch.undo()
    assert built == [1.0, 0.7]
    assert session.config.sensor.range == slider.value == 0.7
    # The meshes are not sent again.
    assert page._scenes[0] is scene
    page.load(0, "field_proximity")


def test_numbers_typed_beyond_a_sliders_limits_are_clamped(page: Page, monkeypatch):
    session, panel = page.sessions[0], page.panel
    # What the box sends while "0.5" is typed.
    for slider in (panel.speed, panel.height, panel.slowdown):
        monkeypatch.setattr(slider._impl, "value", 0)
    page._show()
    page.throw_from(0.0)
    page.play()
    start = page.sessions[0].frame.balls[0]
    page.play()
    speed = np.linalg.norm(session.frame.balls[0] - start) * page.hz
    assert (speed, start[2]) == pytest.approx((1.0, 0.3), abs=1e-3)
    # At most once a second.
    panel.tempo.value = 600
    throws = session.task.balls.state["throw"]
    before = int(throws)
    for _ in range(57):
        page.play()
    assert int(throws) == before


def test_a_range_is_ignored_while_it_is_typed(page: Page):
    slider, before = page.panel._range, page.sessions[0].config.sensor
    for typed in (0.0, 50.0):
        slider.value = typed
        page._do(lambda: page.sense("range"))
        assert not page.error
        assert slider.value == typed
        assert page.sessions[0].config.sensor == before
    slider.value = 0.5
    page._do(lambda: page.sense("range"))
    assert page.sessions[0].config.sensor.range == 0.5
    page.load(0, "field_proximity")


def test_a_setting_changes_both_robots_or_none(pair: Page):
    one, other = pair.sessions
    before = [session.config.sensor for session in pair.sessions]
    pair.panel._signal.value = "binary"
    pair._do(lambda: pair.sense("signal"))
    assert "localization cannot read these sensors" in pair.error
    assert [session.config.sensor for session in pair.sessions] == before
    assert pair.panel._signal.value == "proximity"
    pair.panel._range.value = 1.0
    pair.sense("range")
    assert (one.config.sensor, other.config.sensor) == tuple(
        dataclasses.replace(sensor, range=1.0) for sensor in before
    )
    assert not pair.error


def test_a_range_that_the_slider_cannot_show_is_kept(page: Page):
    session = page.sessions[0]
    sensor = session.readable(range=np.inf)
    assert sensor is not None
    session.configure(sensor)
    page.panel._signal.value = "closeness"
    page.sense("signal")
    assert session.config.sensor == dataclasses.replace(sensor, signal="closeness")
    page.load(0, "field_proximity")


def test_what_the_skin_file_sets_cannot_be_changed(page: Page, skin: Skin, tmp_path):
    grid = Ray(grid=(2, 2))
    beams = dataclasses.replace(
        skin, coverage=(grid,) * len(skin), range=np.full(len(skin), 0.8)
    )
    beams.save(tmp_path / "skin.json")
    config = EnvConfig(
        skin=SkinConfig(path=tmp_path / "skin.json"), sensor=SensorConfig(reduce="min")
    )
    file = tmp_path / "beams.safetensors"
    save_policy(file, *make_agent(config, NetworkConfig(hidden=(8,))))
    page.load(0, str(file))
    page.play()
    assert not page.panel._kind.visible
    assert not page.panel._range.visible
    assert not page.panel._signal.disabled
    page.load(0, "field_proximity")
    assert page.panel._kind.visible
    assert page.panel._range.visible


def test_a_mask_in_a_pause_is_shown_and_the_past_stays(page: Page):
    page.throw_from(0.0)
    for _ in range(60):
        page.play()
        if page.sessions[0].frame.reading.max() > 0.3:
            break
    page.pause()
    sensor = int(page.sessions[0].frame.reading.argmax())
    (drawn,) = drawn_by(page, lambda: page.mask(0, {sensor}))
    assert drawn.reading[sensor] == 0
    assert np.isnan(drawn.line[sensor]).all()
    assert list(drawn.masked) == [sensor]
    (recorded,) = page._memory[-1]
    assert recorded.reading[sensor] > 0.3
    assert not recorded.masked


def test_a_click_meets_what_is_shown(page: Page):
    session = page.sessions[0]
    skin = session.skin
    assert skin is not None
    raised = session.frame.qpos + np.eye(len(session.frame.qpos))[2]
    page._shown = [dataclasses.replace(session.frame, qpos=raised)]
    session.body.place(raised)
    point = session.body.sensor_points(skin)[5]
    normal = session.body.sensor_normals(skin)[5]
    page.click(point + 2 * normal, -normal)
    assert session.masked == {5}


def test_a_click_masks_no_sensor_that_is_hidden(page: Page):
    session = page.sessions[0]
    skin = session.skin
    assert skin is not None
    generator = np.random.default_rng(0)
    masked = 0
    for _ in range(300):
        angle = generator.uniform(-np.pi, np.pi)
        origin = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2])
        way = generator.normal((0, 0, 1.3), (0.15, 0.25, 0.2)) - origin
        page.mask_all(False)
        page.click(origin, way)
        session.body.place(page._shown[0].qpos)
        for sensor in session.masked:
            away = np.linalg.norm(session.body.sensor_points(skin)[sensor] - origin)
            hit = session.body.hit(origin, way / np.linalg.norm(way))
            assert away < hit + 0.05
            masked += 1
    assert masked > 20


def test_a_click_meets_the_nearer_robot(pair: Page):
    pair.reset()
    session = pair.sessions[1]
    skin = session.skin
    assert skin is not None
    session.body.place(session.frame.qpos)
    # The sensor that is farthest to its left, where the other robot is not.
    left = int(session.body.sensor_points(skin)[:, 1].argmax())
    point = session.body.sensor_points(skin)[left] + pair._scenes[1].place
    pair.click(point + np.array([0, 2, 0]), np.array([0.0, -1.0, 0.0]))
    assert [len(session.masked) for session in pair.sessions] == [0, 1]
    assert pair.panel._masked.content.startswith("**0 of 64 and 1 of 64** sensors")
    pair.mask_all(False)


def test_little_is_sent_while_little_changes(page: Page):
    advance(page, 3)
    page.pause()
    page._show()
    buffer = page.server._websock_server._broadcast_buffer
    frame = page.sessions[0].frame
    qpos = frame.qpos + 1e-6
    before = buffer.message_counter
    page._draw([dataclasses.replace(frame, qpos=qpos)])
    page._show()
    # The word above the robot moves with it.
    assert buffer.message_counter - before <= 2


def test_the_best_episode_is_kept_longer_than_the_others(page: Page):
    session = page.sessions[0]
    for survived in (50.0, *[1.0] * 300):
        session.frame = dataclasses.replace(session.frame, survived=survived)
        page._end(0)
    assert len(page._survival[0]) == EPISODES
    assert "| 50.0 s |" in page._status()[2]


def test_a_name_keeps_its_dots():
    assert _short("runs/v1.2") == "v1.2"
    assert _short("files/v1.2.safetensors") == "v1.2"
    assert _short("runs/v1.2/checkpoint.safetensors") == "v1.2"
    assert _short("runs/v1.2/policies/000000065536.safetensors") == "v1.2 65536"


def test_a_newer_policy_of_a_run_is_taken_up(trained, tmp_path):
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


def put_checkpoint(run: Path, name: str, age: int) -> None:
    """Write a policy of the package as the checkpoint of a run."""
    run.mkdir(exist_ok=True)
    checkpoint = run / "checkpoint.safetensors"
    shutil.copy(policy_file(name), checkpoint)
    os.utime(checkpoint, ns=(0, age * 10**9))


def test_a_run_that_changes_in_any_way_is_followed(page: Page, tmp_path, monkeypatch):
    run, session = tmp_path / "run", page.sessions[0]
    put_checkpoint(run, "field_proximity", 1)
    load = type(session).load

    def load_slowly(*args) -> None:
        load(*args)
        put_checkpoint(run, "field_proximity", 2)

    with monkeypatch.context() as patch:
        patch.setattr(type(session), "load", load_slowly)
        page.load(0, str(run))
    page.play()
    old = session.policy
    page._follow()
    assert session.policy is not old
    assert session.frame.step == 1
    # Another training in the same folder has other sensors.
    put_checkpoint(run, "blind", 3)
    page._follow()
    assert session.skin is None
    page.play()
    # A folder that is being cleared is no error.
    (run / "checkpoint.safetensors").unlink()
    page._follow()
    assert "it has no checkpoint" in page._notes[0]
    page.load(0, "field_proximity")


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
    assert "already in use" in fail("view", "--port", page.server.get_port())


def test_a_port_without_rights_is_another_error(monkeypatch):
    def refuse(*args):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    assert "port 80 of 127.0.0.1: Permission denied" in fail("view", "--port", 80)


def test_a_page_closes_although_a_visitor_does_not_answer(monkeypatch):
    page = Page(["blind"])
    stop = page.server.stop
    monkeypatch.setattr(page.server, "stop", lambda: time.sleep(30))
    before = time.monotonic()
    page.close()
    assert time.monotonic() - before < 5
    stop()


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


@pytest.mark.parametrize("density", [1, 2, 3])
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1000, 800), (800, 900)])
def test_two_robots_are_seen_beside_the_panel_on_a_dense_screen(
    pair: Page, width: int, height: int, density: int
):
    camera = pair.server.initial_camera
    pair._look(camera, (width * density, height * density))
    forward = np.array(camera.look_at) - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    for side in (-1.7, 1.7):
        way = np.array([0, side, 1.0]) - camera.position
        scale = height / 2 / np.tan(camera.fov / 2) / (way @ forward)
        assert 0 < width / 2 + scale * (way @ right) < width - 340


# --- what is drawn, and what the buttons do -----------------------------------------


def heading_of(qpos: np.ndarray) -> float:
    """Return the heading of an upright robot [rad]."""
    return 2 * float(np.arctan2(qpos[6], qpos[3]))


@pytest.mark.parametrize(
    ("side", "bearing"),
    [("Front", 0), ("Left", 90), ("Behind", 180), ("Right", -90)],
)
def test_a_side_of_the_panel_is_that_side_of_the_robot(
    page: Page, side: str, bearing: float
):
    (buttons,) = (
        handle
        for handle in page.server.gui._gui_input_handle_from_uuid.values()
        if handle._impl.props.label == "From"
    )
    visitor = Visitor(page.server.get_port())
    try:
        visitor.choose(buttons, side)
        wait_for(lambda: page.sessions[0].first_throw is not None or serve(page))
    finally:
        visitor.leave()
        page._commands.queue.clear()
    page.play()
    frame = page.sessions[0].frame
    x, y = frame.balls[0, :2] - frame.qpos[:2]
    off = np.arctan2(y, x) - heading_of(frame.qpos) - np.radians(bearing)
    assert np.cos(off) > 0.99


@pytest.mark.parametrize(("away", "distance"), [(0.7, 1.5), (5.0, 5.0), (30.0, 8.0)])
def test_a_ball_from_the_floor_is_neither_too_near_nor_too_far(
    page: Page, away: float, distance: float
):
    page.click(np.array([-away, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]))
    page.play()
    frame = page.sessions[0].frame
    start = np.linalg.norm(frame.balls[0, :2] - frame.qpos[:2])
    # In a step it comes some centimetres nearer.
    assert start == pytest.approx(distance, abs=0.15)


def test_a_stronger_reading_is_redder_and_none_is_dark():
    none, weak, strong = colour_of(np.array([0.0, 0.1, 1.0])).astype(int)
    assert none.max() < 60
    assert weak[2] - weak[0] > 200
    assert strong[0] - strong[2] > 100


def test_every_sensor_is_drawn_at_its_place_in_its_own_colour(page: Page):
    page.throw_from(0.0)
    while page.sessions[0].frame.reading.max() < 0.3:
        page.play()
    masked = int(page.sessions[0].frame.reading.argmin())
    page.mask(0, {masked})
    session, scene = page.sessions[0], page._scenes[0]
    frame, skin = session.frame, session.skin
    assert skin is not None
    session.body.place(frame.qpos)
    places, seen = session.body.sensor_points(skin), []
    for which, mesh in scene._sensors:
        # Of the link that it is drawn on.
        link = scene._links[int(mesh.name.split("/link_")[1].split("/")[0])]
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.asarray(link.wxyz, float))
        drawn = mesh.batched_positions @ turn.reshape(3, 3).T + link.position
        np.testing.assert_allclose(drawn, places[which], atol=1e-3)
        expected = colour_of(frame.reading[which])
        expected[which == masked] = (214, 216, 221)
        np.testing.assert_array_equal(mesh.batched_colors, expected)
        seen += which.tolist()
    assert sorted(seen) == list(range(len(skin)))
    colours = np.concatenate([mesh.batched_colors for _, mesh in scene._sensors])
    assert len(np.unique(colours, axis=0)) > 2


def test_lines_of_fields_are_blue_and_of_rays_yellow(page: Page):
    session = page.sessions[0]

    def line_colours() -> np.ndarray:
        page.throw_from(0.0)
        for _ in range(90):
            page.play()
            if np.isfinite(session.frame.line).any():
                break
        page._draw(page._shown)
        assert page._scenes[0]._lines.visible
        return page._scenes[0]._lines.colors.reshape(-1, 3).astype(int)

    red, _, blue = line_colours().T
    assert (blue > red).all()
    page.panel._kind.value = "ray, closest beam"
    page.sense("kind")
    sensor = session.config.sensor
    assert (sensor.coverage, sensor.reduce) == ("ray", "min")
    red, _, blue = line_colours().T
    assert (red > blue).all()
    page.load(0, "field_proximity")


def test_the_newest_readings_are_at_the_right_of_the_map(page: Page):
    # Two sensors in three of five steps.
    readings = np.array([[0.1, 0.0], [0.0, 0.0], [0.0, 1.0]])
    page.panel.show_map([readings], 5)
    # Each reading has 2 x 2 pixels.
    image = page.panel._map.image[::2, ::2]
    shown = (image != colour_of(np.zeros(1))).any(-1)
    expected = [[False, False, True, False, False], [False] * 4 + [True]]
    np.testing.assert_array_equal(shown, expected)


def test_plots_end_now_and_tell_the_strongest_reading_and_the_value(
    page: Page, monkeypatch
):
    page.play()
    frame, readings = page.sessions[0].frame, np.zeros((3, 64))
    readings[0, 5], readings[2, :2] = 0.5, (0.25, 0.75)
    page._memory.clear()
    for i, reading in enumerate(readings):
        page._memory.append([dataclasses.replace(frame, reading=reading, value=10 - i)])
    # Policies of the package have no critic.
    monkeypatch.setattr(page.sessions[0], "critic", "some critic")
    page._show()
    seconds, strongest = page.panel._nearest.data
    np.testing.assert_allclose(seconds, np.array([-2, -1, 0]) / 60)
    np.testing.assert_allclose(strongest, [0.5, 0.0, 0.75])
    np.testing.assert_allclose(page.panel._value.data, (seconds, [10, 9, 8]))
