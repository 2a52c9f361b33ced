"""The operating map: throws have the properties of their point; success is right."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from egoskin.envs.throws import ThrowConfig, Thrower
from egoskin.evaluation import operating_map as maps
from egoskin.evaluation.operating_map import check_map, draw_map, operating_map
from egoskin.evaluation.throw_set import play_throws, standard_task, summarize
from egoskin.make import EnvConfig
from egoskin.robots.builtin import H1_2
from egoskin.sensors import MASK_ALL, place_sensors
from egoskin.sensors.config import SensorConfig
from egoskin.storage.files import write_figure
from throwing import TASK

SKIN = place_sensors(H1_2, 8, seed=0)
CONFIG = standard_task(EnvConfig())


def draws(throws: ThrowConfig, n: int = 512):
    thrower = Thrower(throws, H1_2, 1 / 120)
    row = torch.arange(n)
    return thrower, thrower.draw(0, row, row * 0, row * 0)


def test_the_map_varies_what_it_says_alone_and_two_together():
    names = [tuple(what.name for what in line) for line in maps._MAPS]
    speed, tempo = "speed of the ball [m/s]", "time between throws [s]"
    assert [n[0] for n in names[:2]] == [speed, tempo]
    assert names[-1] == (speed, tempo)
    assert [len(n) for n in names] == [1, 1, 1, 1, 2]
    # Within the training range and beyond it, on both sides.
    for varied in maps._MAPS[:2]:
        ((what, values),) = varied.items()
        low, high = getattr(TASK.throws, what.trained)
        inside = [v for v in values if low <= v <= high]
        assert len(inside) >= 3
        assert min(values) < low
        assert max(values) > high


@pytest.mark.parametrize("value", [0.3, 1.5])
def test_a_ball_is_aimed_at_the_height_of_its_place(value):
    thrower, drawn = draws(replace(CONFIG.task.throws, **maps._HEIGHT.fields(value)))
    height, _ = thrower.at_standing_robot(drawn)
    torch.testing.assert_close(height, torch.full_like(height, value))


@pytest.mark.parametrize("value", maps._MAPS[3][maps._DIRECTION])
def test_a_ball_comes_from_the_sector_of_its_place(value):
    _, drawn = draws(replace(CONFIG.task.throws, **maps._DIRECTION.fields(value)))
    off = drawn.azimuth - math.radians(value)
    off = torch.rad2deg(torch.atan2(off.sin(), off.cos()))
    assert -22.501 < off.min() < -21
    assert 21 < off.max() < 22.501


@pytest.mark.parametrize(
    ("changes", "number"),
    [
        # From at most 6 m away and 3 m up, sqrt(45) = 6.71 m, to a metre past the
        # base: 7.71 m, which take 1.93 s at 4 m/s.
        ({}, 2),
        ({"interval": (0.5, 0.5)}, 4),
        # 3.85 s at 2 m/s.
        ({"speed": (2.0, 2.0)}, 4),
        ({"speed": (12.0, 12.0)}, 2),
        ({"speed": (3.0, 3.0), "interval": (0.5, 0.5)}, 6),
        ({"num_balls": 6}, 6),
    ],
)
def test_no_ball_is_thrown_again_before_it_has_passed(changes, number):
    throws = maps._with_enough_balls(replace(CONFIG.task.throws, **changes))
    assert throws.num_balls == number
    assert replace(throws, num_balls=2) == replace(
        CONFIG.task.throws, **{**changes, "num_balls": 2}
    )


def test_slow_balls_in_a_fast_sequence_all_arrive():
    # The robot is rigid and balls fly past: none is lost in flight. With two balls each
    # would be taken away after a second, half of its way.
    throws = ThrowConfig(
        first_delay=(0.0, 0.0),
        aim="box",
        box_half_width=0.05,
        box_height=(2.5, 2.5),
        height=(2.6, 2.6),
        distance=(4.0, 4.0),
        speed=(2.0, 2.0),
        interval=(0.5, 0.5),
    )
    arrived = []
    for own in (throws, maps._with_enough_balls(throws)):
        task = replace(TASK, throws=own, episode_length_s=6.0)
        config = EnvConfig(task=task, sensor=SensorConfig(coverage="none"))
        which = {"throw_set": 0, "episodes": 4, "hold": True}
        played = play_throws(None, config, SKIN, **which)
        assert not played.hit.any()
        arrived.append(played.arrived.sum(1))
    assert (arrived[0] == 0).all()
    # Thrown at 0, 0.5, 1, ... s; each needs 2 s to the base and 0.5 s to a metre past.
    assert (arrived[1] >= 6).all()


def test_an_operating_map_is_the_success_on_each_throw(monkeypatch):
    speed, tempo = {maps._SPEED: (4.0, 9.0)}, {maps._INTERVAL: (1.0, 2.5)}
    monkeypatch.setattr(maps, "_MAPS", (speed, speed | tempo))
    config = replace(CONFIG, task=replace(CONFIG.task, success_s=1.0))
    # What is played may be another task than that of the training.
    trained = replace(config.task.throws, speed=(2.0, 12.0))
    done = []
    lines = operating_map(
        None,
        config,
        SKIN,
        throw_set=5,
        episodes=16,
        mask=MASK_ALL,
        trained=trained,
        on_point=lambda *counts: done.append(counts),
    )
    assert done == [(i, 6) for i in range(1, 7)]
    alone, both = lines
    assert alone.trained == ((2.0, 12.0),)
    assert both.trained == ((2.0, 12.0), (1.0, 2.0))
    assert [p.values for p in alone.points] == [(4.0,), (9.0,)]
    assert [p.values for p in both.points] == [
        (4.0, 1.0),
        (4.0, 2.5),
        (9.0, 1.0),
        (9.0, 2.5),
    ]
    for point in (alone.points[0], both.points[1]):
        throws = replace(config.task.throws, speed=(4.0, 4.0))
        if len(point.values) == 2:
            throws = replace(throws, interval=(2.5, 2.5))
        task = replace(config.task, throws=throws)
        played = play_throws(
            None,
            replace(config, task=task),
            SKIN,
            throw_set=5,
            episodes=16,
        )
        assert point.success == summarize(played, played, task).success
        avoided = float(played.avoided.sum() / played.arrived.sum())
        assert point.avoided == pytest.approx(avoided)
    # A passive robot lasts a second with slow balls, but not with fast ones.
    assert alone.points[0].success.mean > alone.points[1].success.mean


def test_the_mask_reaches_what_is_played(monkeypatch):
    masks = []

    def play(*args, mask, **kwargs):
        masks.append(mask)
        return play_throws(*args, mask=mask, **kwargs)

    monkeypatch.setattr(maps, "play_throws", play)
    monkeypatch.setattr(maps, "_MAPS", ({maps._SPEED: (4.0, 9.0)},))
    options = {"throw_set": 5, "episodes": 4}
    operating_map(None, CONFIG, SKIN, **options, mask=("torso_link",))
    operating_map(None, CONFIG, SKIN, **options)
    assert masks == [("torso_link",)] * 2 + [()] * 2


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_map_is_drawn_with_its_numbers(suffix, tmp_path):
    pytest.importorskip("matplotlib")

    def point(values, mean, avoided):
        success = maps.Estimate(mean=mean, low=mean - 0.05, high=mean + 0.05)
        return maps.Point(values=values, success=success, avoided=avoided)

    lines = [
        maps.Line(
            names=("speed of the ball [m/s]",),
            trained=((4.0, 8.0),),
            points=[point((4.0,), 0.6, 0.9), point((9.0,), 0.2, None)],
        ),
        maps.Line(
            names=("height aimed at [m]",),
            trained=(None,),
            points=[point((0.5,), 0.1, 0.3)],
        ),
        maps.Line(
            names=("speed of the ball [m/s]", "time between throws [s]"),
            trained=((4.0, 8.0), (1.0, 2.0)),
            points=[
                point((4.0, 1.0), 0.37, 0.5),
                point((4.0, 2.0), 0.41, 0.5),
                point((9.0, 1.0), 0.13, 0.5),
                point((9.0, 2.0), 0.29, 0.5),
            ],
        ),
    ]
    path = tmp_path / f"map{suffix}"
    write_figure(path, draw_map(lines, "a policy", 2.0))
    assert path.stat().st_size > 1000
    if suffix == ".svg":
        import matplotlib as mpl

        with mpl.rc_context({"svg.fonttype": "none"}):
            write_figure(path, draw_map(lines, "a policy", 2.0))
        text = path.read_text()
        for shown in (
            "a policy",
            ">37<",
            ">41<",
            ">13<",
            ">29<",
            "trained on",
            "for 2 s",
        ):
            assert shown in text, shown


def test_no_map_is_made_of_an_actor_that_observes_each_ball():
    config = EnvConfig(task=TASK, sensor=SensorConfig(coverage="oracle"))
    message = "may need more balls than the 2 that an oracle observes"
    with pytest.raises(ValueError, match=message):
        check_map(config)
    with pytest.raises(ValueError, match=message):
        operating_map(None, config, SKIN, throw_set=0, episodes=1)
