"""Pictures of episodes: what is drawn, what is not, and which states are drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from egoskin.evaluation.throw_set import play_throws, throw_seed
from egoskin.make import EnvConfig, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.robots.config import RobotConfig
from egoskin.robots.portable import portable
from egoskin.sensors import Skin, place_sensors
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere
from egoskin.viewer.film import Frame
from egoskin.viewer.offscreen import (
    CameraConfig,
    Painter,
    RenderingError,
    closest_point,
    painter_of,
)
from egoskin.viewer.recording import (
    Recording,
    ending_of,
    record_longest,
    render_recording,
)
from throwing import TASK

SIZE = (160, 90)


@pytest.fixture(scope="module")
def painter(robot: RobotConfig, skin: Skin) -> Iterator[Painter]:
    try:
        made = Painter(
            robot,
            skin,
            (Sphere(), Sphere()),
            size=(320, 180),
            camera=CameraConfig(distance=3.0),
        )
    except RenderingError as error:
        pytest.skip(str(error))
    with made:
        yield made


@pytest.fixture
def standing(robot: RobotConfig) -> TensorDict:
    """Return the robot in its default pose, facing +x; no ball, nothing detected."""
    return TensorDict(
        base_pose=torch.tensor([0, 0, robot.default_base_height, 1, 0, 0, 0]).float(),
        joint_pos=torch.from_numpy(robot.default_joint_pos).float(),
        object_pose=torch.tensor([0, 0, 1000.0, 1, 0, 0, 0]).repeat(2, 1),
        object_active=torch.zeros(2, dtype=torch.bool),
        balls_avoided=torch.zeros(2),
    )


def place_ball(state: TensorDict, x: float, y: float, z: float) -> TensorDict:
    """Return the same state with the first ball in play at a position [m]."""
    state = state.clone()
    state["object_active"][0] = True
    state["object_pose"][0, :3] = torch.tensor([x, y, z])
    return state


def channels(frame: Frame) -> Iterator[np.ndarray]:
    return iter(np.moveaxis(frame.image.astype(int), -1, 0))


def count_blue(frame: Frame) -> int:
    """Return the number of pixels of field sensors' lines."""
    red, _, blue = channels(frame)
    return int((blue - red > 70).sum())


def count_orange(frame: Frame) -> int:
    """Return the number of pixels of balls."""
    red, _, blue = channels(frame)
    return int((red - blue > 60).sum())


def test_the_robot_stands_in_the_picture(painter: Painter, standing: TensorDict):
    gone = standing.clone()
    gone["base_pose"][2] = -50.0
    here, empty = painter.draw(standing, time=0.0), painter.draw(gone, time=0.0)
    share = (here.image != empty.image).any(-1).mean()
    assert 0.02 < share < 0.5
    assert empty.image.std() > 5


def test_a_ball_is_drawn_only_in_play(painter: Painter, standing: TensorDict):
    inside = place_ball(standing, 0.3, 0.6, 1.2)
    parked = inside.clone()
    parked["object_active"][:] = False
    assert count_orange(painter.draw(inside, time=0.0)) > 50
    assert count_orange(painter.draw(parked, time=0.0)) == 0


def test_a_ball_is_drawn_although_the_robot_hides_shapes_by_default(
    painter: Painter, robot: RobotConfig, standing: TensorDict
):
    text = portable(robot).model_xml or ""
    # The first geom is that of the defaults; MuJoCo draws no group above 2.
    hidden = text.replace("<geom ", '<geom group="4" ', 1)
    assert hidden.index('group="4"') < hidden.index("<worldbody")
    robot = replace(robot, model_path=None, model_xml=hidden)
    with Painter(robot, None, (Sphere(), Sphere()), size=SIZE) as other:
        seen = other.draw(place_ball(standing, 0.3, 0.6, 1.2), time=0.0)
    assert count_orange(seen) > 20


def test_a_line_leads_from_a_sensor_that_detects_to_the_ball(
    painter: Painter, standing: TensorDict
):
    idle = place_ball(standing, 0.5, 0.9, 1.4)
    lit = np.arange(64) < 10
    before, after = painter.draw(idle, time=0.0), painter.draw(idle, lit, time=0.0)
    assert before.num_detecting == 0
    assert after.num_detecting == 10
    assert count_blue(before) == 0
    assert count_blue(after) > 30


def test_of_two_balls_a_line_leads_to_the_nearer_one(
    painter: Painter, standing: TensorDict
):
    alone = place_ball(standing, 0.5, 0.9, 1.4)
    # Out of view, behind the camera.
    both = alone.clone()
    both["object_active"][1] = True
    both["object_pose"][1, :3] = torch.tensor([30.0, 17.0, 1.0])
    lit = np.arange(64) < 10
    one, two = (painter.draw(state, lit, time=0.0) for state in (alone, both))
    # Up to rounding.
    assert np.abs(one.image.astype(int) - two.image).max() < 10
    assert one.gap == two.gap


def test_a_sensor_that_detects_is_lit(painter: Painter, standing: TensorDict):
    # No ball in play: no line; only the sensors change.
    lit = np.ones(64, dtype=bool)
    dim, bright = (
        painter.draw(standing, time=0.0),
        painter.draw(standing, lit, time=0.0),
    )
    changed = (dim.image != bright.image).any(-1)
    assert changed.any()
    assert bright.image[changed].mean() > dim.image[changed].mean() + 20


def test_the_gap_is_from_surface_to_surface(painter: Painter, standing: TensorDict):
    assert painter.draw(standing, time=0.0).gap == np.inf
    # To the side of the arm, which is less than half a metre from the middle.
    near = painter.draw(place_ball(standing, 0.0, 0.9, 1.2), time=0.0).gap
    far = painter.draw(place_ball(standing, 0.0, 1.9, 1.2), time=0.0).gap
    assert 0.2 < near < 0.75
    assert far - near == pytest.approx(1.0, abs=0.02)


@pytest.mark.usefixtures("painter")
def test_the_camera_looks_down_from_where_it_is_placed(standing: TensorDict):
    camera = CameraConfig(distance=3.0, azimuth_deg=-60.0)
    # A ball halfway to the camera, at the height that it looks at.
    state = place_ball(standing, 0.75, -1.3, 1.0)
    with painter_of(EnvConfig(), place_sensors(H1_2, 1), camera=camera) as painter:
        red, _, blue = channels(painter.draw(state, time=0.0))
    rows, columns = np.nonzero(red - blue > 60)
    assert columns.mean() == pytest.approx(480, abs=20)
    # 3 m away and 10 degrees up: 0.52 m above the ball and 1.45 m from it, which is
    # 19.7 degrees down; the middle of the picture is 10 degrees down. 540 pixels show
    # 45 degrees: 270 + 270 tan(9.7) / tan(22.5) = 381.
    assert rows.mean() == pytest.approx(381, abs=20)


def test_camera_and_sensors_turn_with_the_robots_first_heading(
    painter: Painter, standing: TensorDict
):
    turned = standing.clone()
    # By 90 degrees.
    turned["base_pose"][3:] = torch.tensor([0.5, 0.0, 0.0, 0.5]).sqrt()
    lit, changed = np.ones(64, dtype=bool), []
    for state in (standing, turned):
        # The camera is placed anew when the time decreases.
        painter.draw(state, time=1.0)
        dim, bright = painter.draw(state, time=0.0), painter.draw(state, lit, time=0.0)
        changed.append((dim.image != bright.image).any(-1))
    # The pixels of all sensors, whatever is behind them.
    assert changed[0].sum() > 100
    assert (changed[0] != changed[1]).sum() < 0.1 * changed[0].sum()
    painter.draw(standing, time=-1.0)


def test_the_camera_follows_the_base(painter: Painter, standing: TensorDict):
    moved = standing.clone()
    moved["base_pose"][:2] = torch.tensor([30.0, 40.0])
    lost = painter.draw(standing, time=0.0)
    for time in (10.0, 20.0):
        found = painter.draw(moved, time=time)
    # Floor tiles are 1 m: after whole tiles the picture is the same, except for haze.
    difference = np.abs(found.image.astype(int) - lost.image).mean()
    assert difference < 3


def test_the_closest_point_lies_on_the_surface():
    ball, pose = Sphere(radius=0.15), np.array([1.0, 0, 0, 1, 0, 0, 0])
    points = np.array([[0.0, 0, 0], [1, 2, 0], [1.05, 0, 0]])
    # 1 - 0.15; 0 + 0.15; a point inside maps to itself.
    expected = [[0.85, 0, 0], [1, 0.15, 0], [1.05, 0, 0]]
    assert closest_point(ball, pose, points) == pytest.approx(np.array(expected))


def render(
    config: EnvConfig, skin: Skin, *, hold: bool = False, **options: object
) -> list[Frame]:
    recording = record_longest(config, skin, None, hold=hold)
    with painter_of(config, skin, size=SIZE) as painter:
        return render_recording(painter, config, skin, recording, **options)


@pytest.mark.usefixtures("painter")
@pytest.mark.parametrize(("sensor_range", "shows"), [(100.0, True), (1e-3, False)])
def test_an_episode_shows_lines_only_in_range(
    skin: Skin, sensor_range: float, shows: bool
):
    config = EnvConfig(task=TASK, sensor=SensorConfig(range=sensor_range))
    frames = render(config, skin, max_seconds=0.2)
    # 0.2 s at 30 pictures a second, and the start.
    assert [f.time for f in frames] == pytest.approx([i / 30 for i in range(7)])
    assert all(f.image.shape == (90, 160, 3) for f in frames)
    assert all((f.num_detecting == 64) == shows for f in frames)
    assert all((count_blue(f) > 0) == shows for f in frames)
    assert [f.ending for f in frames] == [None] * 6 + ["cut"]


def test_pictures_tell_how_many_balls_were_avoided(
    painter: Painter, standing: TensorDict, skin: Skin
):
    standing["distance"] = torch.full((64,), torch.inf)
    later = standing.clone()
    later["balls_avoided"] = torch.tensor([2.0, 1.0])
    states = [standing, later]
    recording = Recording(row=0, states=[*states], ending=None)
    frames = render_recording(painter, EnvConfig(), skin, recording, fps=60)
    assert [frame.num_avoided for frame in frames] == [0, 3]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ((), None),
        (("truncated",), "time limit"),
        (("self_contact",), None),
        (("terminated", "self_contact"), "self-contact"),
        (("terminated", "self_contact", "fallen"), "fall"),
        (("terminated", "hit", "fallen"), "hit + fall"),
    ],
)
def test_the_end_of_an_episode_is_named(flags, expected):
    keys = ("truncated", "terminated", "hit", "fallen", "diverged", "self_contact")
    state = TensorDict({key: torch.tensor([key in flags]) for key in keys})
    assert ending_of(state) == expected


@pytest.mark.usefixtures("painter")
def test_a_rigid_robot_is_hit_and_the_last_frame_says_so(skin: Skin):
    frames = render(EnvConfig(task=TASK), skin, hold=True, fps=5)
    assert frames[-1].ending == "hit"
    assert frames[-1].gap < 0.05
    assert all(f.ending is None for f in frames[:-1])


@pytest.mark.usefixtures("painter")
def test_a_whole_episode_lasts_until_long_after_the_first_throw(skin: Skin):
    # Balls to a point 50 m up, the first after 0.3 s; the limit is 0.2 s later.
    high = {"aim": "box", "box_height": (50.0, 50.0), "first_delay": (0.3, 0.3)}
    throws = replace(TASK.throws, **high)
    task = replace(TASK, throws=throws, episode_length_s=0.2)
    frames = render(EnvConfig(task=task), skin, hold=True, fps=10)
    assert frames[-1].ending == "time limit"
    assert frames[-1].time == pytest.approx(0.5)


@pytest.mark.usefixtures("painter")
@pytest.mark.parametrize("coverage", ["none", "oracle"])
def test_without_a_skin_there_are_no_sensors_to_draw(coverage, skin: Skin):
    config = EnvConfig(task=TASK, sensor=SensorConfig(coverage=coverage))
    frame = render(config, skin, max_seconds=0.02)[0]
    assert (frame.num_sensors, frame.num_detecting) == (0, 0)


def test_recordings_are_of_the_rows_of_the_throw_set(skin: Skin):
    config = EnvConfig(task=TASK)
    recordings = [
        record_longest(config, skin, None, throw_set=3, first=row, hold=True)
        for row in (5, 6)
    ]
    assert [r.row for r in recordings] == [5, 6]
    which = {"throw_set": 3, "episodes": 8, "hold": True}
    steps = play_throws(None, config, skin, **which).steps
    # The start, and a state after each step up to the end.
    assert [len(r.states) - 1 for r in recordings] == steps[5:7].tolist()
    env = make_worker_env(
        config,
        skin,
        num_envs=8,
        seed=throw_seed(config, 3),
        hold=True,
        keep_raw=True,
    )
    td = env.reset()
    for step in range(30):
        for recording in recordings:
            state = recording.states[step]
            for key in ("object_pose", "base_pose", "joint_pos", "distance"):
                assert torch.equal(state[key], td[key][recording.row]), key
        td["action"] = torch.zeros(8, 21)
        td = env.step(td)["next"]


@pytest.mark.parametrize("coverage", ["field", "none"])
def test_the_longest_episode_is_recorded_in_little_memory(coverage, skin: Skin):
    config = EnvConfig(task=TASK, sensor=SensorConfig(coverage=coverage))
    which = {"throw_set": 3, "hold": True}
    every = [
        record_longest(config, skin, None, **which, first=row) for row in range(2, 10)
    ]
    longest = max(every, key=lambda recording: len(recording.states))
    alone = record_longest(config, skin, None, **which, first=2, episodes=8)
    assert (alone.row, alone.ending) == (longest.row, longest.ending)
    for state, expected in zip(alone.states, longest.states, strict=True):
        assert all(torch.equal(state[key], expected[key]) for key in state.keys())
    # Without most other episodes and keys.
    (state, *_) = alone.states
    rows = state["base_pose"].untyped_storage().nbytes() // (7 * 4)
    assert rows <= 2
    assert "observation" not in state.keys()


def test_of_equally_long_episodes_the_first_is_recorded(skin: Skin, monkeypatch):
    state = TensorDict({"hit": torch.zeros(6, 1, dtype=torch.bool)}, [6])
    keys = ("base_pose", "joint_pos", "object_pose", "object_active", "distance")
    flags = ("balls_avoided", "truncated", "fallen", "diverged", "terminated")
    for key in (*keys, *flags):
        state[key] = torch.zeros(6, 1)
    state["base_pose"] = torch.arange(6)[:, None]

    def play(*args, watch, **kwargs) -> None:
        for running in ([1, 1, 1, 1, 1, 1], [1, 0, 1, 0, 1, 1], [0, 0, 1, 0, 0, 1]):
            watch(state, state, torch.tensor(running, dtype=torch.bool))

    monkeypatch.setattr("egoskin.viewer.recording.play_throws", play)
    alone = record_longest(EnvConfig(), skin, None, episodes=6)
    assert alone.row == 2
    assert [int(state["base_pose"]) for state in alone.states] == [2] * 4


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"fps": 61.0}, "fps must be in"),
        ({"max_seconds": 0.0}, "the film must last at least one control step"),
    ],
)
def test_numbers_out_of_range_are_refused(
    painter: Painter, skin: Skin, options: dict, text: str
):
    nothing = Recording(row=0, states=[], ending=None)
    with pytest.raises(ValueError, match=text):
        render_recording(painter, EnvConfig(), skin, nothing, **options)


@pytest.mark.parametrize("size", [(161, 90), (160, 8)])
def test_a_size_that_is_no_film_is_refused(skin: Skin, size: tuple[int, int]):
    with pytest.raises(ValueError, match="two even numbers of at least 16"):
        painter_of(EnvConfig(), skin, size=size)


@pytest.mark.parametrize(
    "options",
    [{"distance": 0.0}, {"azimuth_deg": math.nan}, {"elevation_deg": math.inf}],
)
def test_a_camera_that_is_nowhere_is_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        CameraConfig(**options)
