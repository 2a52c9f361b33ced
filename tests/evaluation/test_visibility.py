"""Visibility: by hand on a ball-shaped robot, by MuJoCo on the H1-2."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import torch

from calling import call, succeed
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.throws import ThrowConfig
from egoskin.evaluation.approaches import (
    THROW_STEP,
    StandingRobot,
    Trace,
    direction_grid,
    direction_paths,
    pipelines,
    surface_paths,
    throw_paths,
    trace,
    unit_vectors,
)
from egoskin.evaluation.visibility import Analysis, Cell, analyse, see_directions
from egoskin.robots.builtin import H1_2
from egoskin.robots.config import read_robot
from egoskin.sensors import Field, Ray, Skin
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere
from throwing import TASK

BALL = Sphere(radius=0.15)
FIELD, RAY = {"field": SensorConfig()}, {"ray": SensorConfig(coverage="ray")}
ONE_BEAM = {"ray": SensorConfig(coverage="ray", ray=Ray(grid=(1, 1)))}
# Radius of the ball-shaped robot [m].
RHO = 0.2


@pytest.fixture
def ball_robot(small_robot):
    """Return a ball 3 m above ground, with a foot of negligible size."""
    return small_robot(f"<geom size='{RHO}'/><geom size='0.01' pos='2 -2 -3'/>")


def sensors(*poses, **options) -> Skin:
    """Return sensors on the ball-shaped robot, from (position, normal) each."""
    position, normal = (np.array(x, dtype=float) for x in zip(*poses, strict=True))
    links = ("base",) * len(position)
    return Skin(robot="small", links=links, position=position, normal=normal, **options)


def traced(body, paths, skin, configs, ranges) -> Trace:
    """Return the trace of the sensors for balls on given paths."""
    made = pipelines(body.config, skin, configs, max(ranges))
    return trace(body, paths, skin, made, ranges, BALL)


AHEAD, BEHIND = (1.0, 0, 0), (-1.0, 0, 0)


# --- the body -------------------------------------------------------------------


def test_distances_to_the_body_are_those_of_mujoco():
    spec = H1_2.spec()
    ball = spec.worldbody.add_body(name="ball", mocap=True)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.15, 0, 0], name="ball")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2], data.qpos[7:] = H1_2.default_base_height, H1_2.default_joint_pos
    geom = model.geom("ball").id
    body = StandingRobot(H1_2)
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (50, 3))
    for point, ours in zip(points, body.distance(points), strict=True):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        theirs = min(
            mujoco.mj_geomDistance(model, data, g, geom, 10.0, np.zeros(6))
            for g in range(model.ngeom)
            if g != geom
        )
        assert ours - 0.15 == pytest.approx(theirs, abs=1e-6)
    # A bound may replace the distance of far objects, never that of near ones.
    bounded = body.distance(points, within=0.3)
    near = body.distance(points) <= 0.3
    assert near.any()
    assert (bounded[near] == body.distance(points)[near]).all()
    assert (bounded[~near] > 0.3).all()
    assert (bounded <= body.distance(points)).all()


def test_a_robot_that_balls_cannot_touch_is_refused(small_robot, tmp_path):
    with pytest.raises(ValueError, match="small has no collision shapes for balls to"):
        StandingRobot(small_robot(""))
    path = tmp_path / "crane.urdf"
    path.write_text(
        '<robot name="crane"><link name="base"><collision><geometry>'
        '<mesh filename="base.stl"/></geometry></collision></link></robot>'
    )
    with pytest.raises(ValueError, match=r"meshes of a URDF are left out\): add sph"):
        StandingRobot(read_robot(path))


def test_throws_fly_and_hit_as_they_do_in_the_simulation():
    config, rows, seed = TASK, 24, 3
    env = DodgeballEnv(H1_2, config, num_envs=rows, seed=seed, hold=True)
    root, step = env.reset(), 0
    hit_at = torch.full((rows,), -1)
    while (hit_at < 0).any():
        step += 1
        root["action"] = torch.zeros(rows, len(H1_2.joints))
        root = env.step(root)["next"]
        if step == 20:
            third = root["object_pose"][:, 0, :3]  # after a third of a second
        # The second throw comes after a second at the earliest; all arrive by then.
        hit_at[(hit_at < 0) & root["hit"][:, 0]] = step
        assert step < 120
    body = StandingRobot(H1_2)
    dt = config.physics.timestep
    paths, _ = throw_paths(body, config.throws, rows, seed, dt)
    # For any heading: height, and distance from the base at the origin.
    index = round(1 / 3 / THROW_STEP)
    way = paths[:, index] + (1 / 3 - index * THROW_STEP) * (
        (paths[:, index + 1] - paths[:, index]) / THROW_STEP
    )
    torch.testing.assert_close(way[:, 2], third[:, 2], atol=1e-3, rtol=0)
    away, theirs = way[:, :2].norm(dim=-1), third[:, :2].norm(dim=-1)
    torch.testing.assert_close(away, theirs, atol=1e-3, rtol=0)
    skin = Skin(
        robot="h1_2",
        links=("torso_link",),
        position=np.zeros((1, 3)),
        normal=np.array([[0, 0, 1.0]]),
    )
    seen = traced(body, paths, skin, FIELD, [1.0])
    assert seen.touches.all()
    late = hit_at / config.physics.control_hz - THROW_STEP * seen.contact
    # The hit is reported at the end of the control step in which it happens.
    assert late.min() > -THROW_STEP
    assert late.max() < 1 / config.physics.control_hz + dt


def test_no_part_of_the_body_is_beyond_its_reach(small_robot):
    # A capsule ends at 0.1 + 0.5 from its middle.
    capsule = StandingRobot(small_robot("<geom type='capsule' size='0.1 0.5'/>"))
    assert capsule.reach == pytest.approx(0.6)
    body = StandingRobot(H1_2)
    # A ball of almost no size ends on the surface.
    points = surface_paths(body, Sphere(radius=1e-6), 0.1, 0)[0][:, -1].numpy()
    assert np.linalg.norm(points - body.origin, axis=-1).max() < body.reach


# --- by hand --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "configs", "max_range", "seconds"),
    [
        # 5 m/s straight at the robot's front: gap at the first detection / speed.
        (((RHO, 0, 0), AHEAD), FIELD, 1.0, 1.0 / 5),
        (((RHO, 0, 0), AHEAD), FIELD, 0.5, 0.5 / 5),
        # On the far side, 0.4 m farther from the ball.
        (((-RHO, 0, 0), BEHIND), FIELD, 1.0, 0.6 / 5),
        (((-RHO, 0, 0), BEHIND), FIELD, 0.3, None),
        # Standing 0.1 m off the surface.
        (((RHO + 0.1, 0, 0), AHEAD), FIELD, 1.0, 1.1 / 5),
        # One beam along the normal.
        (((RHO, 0, 0), AHEAD), ONE_BEAM, 1.0, 1.0 / 5),
        (((RHO, 0, 0), BEHIND), RAY, 1.0, None),
    ],
)
def test_warning_is_the_way_left_over_the_speed(
    ball_robot, pose, configs, max_range, seconds
):
    body = StandingRobot(ball_robot)
    height = (body.origin[2], body.origin[2])
    # Heights of release are given for a robot of 1.78 m.
    release = body.origin[2] * 1.78 / ball_robot.standing_height
    throws = ThrowConfig(
        flight="straight",
        aim="box",
        box_half_width=0.0,
        box_height=height,
        height=(release, release),
        azimuth_deg=(0.0, 0.0),
        speed=(5.0, 5.0),
    )
    paths, _ = throw_paths(body, throws, 3, 0, 1 / 120)
    thrown = traced(body, paths, sensors(pose), configs, [max_range])
    assert thrown.touches.all()
    assert (thrown.seen == (seconds is not None)).all()
    warning = THROW_STEP * (thrown.contact - thrown.first_seen).double()
    expected = torch.full((1, 3), seconds or 0.0, dtype=torch.float64)
    # Both ends are exact to a step.
    torch.testing.assert_close(warning, expected, atol=1.01 * THROW_STEP, rtol=0.0)


@pytest.mark.parametrize("max_range", [0.1, 0.4])
def test_share_of_directions_and_of_surface_is_that_of_the_cap(ball_robot, max_range):
    # A field sensor on a ball of radius rho; the other ball's centre at D from the
    # middle, theta from the sensor: its surface is sqrt(rho^2 + D^2 - 2 rho D cos
    # theta) - r from the sensor. Seen if cos theta >= c; the cap has (1 - c) / 2 of
    # the sphere.
    outward = np.array([1.0, 2, 3]) / math.sqrt(14)
    skin = sensors((RHO * outward, outward))
    analysis = analyse(
        ball_robot, skin, FIELD, [max_range], ThrowConfig(), num_throws=1
    )
    gap = analysis.directions.gap
    last = gap.gather(1, analysis.directions.contact[:, None] - 1).max().item()
    assert 0.001 < last < 0.01

    def share(gap: float) -> float:
        away = RHO + BALL.radius + gap
        seen = RHO**2 + away**2 - (max_range + BALL.radius) ** 2
        return (1 - seen / (2 * RHO * away)) / 2

    (cell,) = analysis.report()["cells"]
    assert cell["directions_seen"] == pytest.approx(share(last), abs=0.01)
    assert cell["directions_seen_by_clearance"].keys() == {
        f"{c:g}" for c in (0.05, 0.1, 0.2) if c < max_range
    }
    if max_range > 0.05:
        by_then = cell["directions_seen_by_clearance"]["0.05"]
        assert share(0.06) - 0.01 < by_then < share(0.05) + 0.01
    # 1000 random points: standard deviation 1.6 %.
    assert cell["surface_blind"] == pytest.approx(1 - share(last), abs=0.05)
    # The centre of the unseen region is opposite.
    cone = cell["widest_blind_cone_deg"]
    azimuth, elevation = np.radians(cone["azimuth"]), np.radians(cone["elevation"])
    assert unit_vectors(azimuth, elevation) @ -outward > math.cos(math.radians(5))
    border = math.degrees(math.acos(1 - 2 * share(last)))
    assert cone["half_angle"] == pytest.approx(180 - border, abs=5)


def test_the_throws_that_are_analysed_are_those_of_the_seed(ball_robot):
    # From the left, about the middle of the robot, 3 m above ground.
    throws = ThrowConfig(
        flight="straight",
        aim="box",
        box_half_width=0.0,
        box_height=(2.9, 3.1),
        azimuth_deg=(80.0, 100.0),
    )
    skin = sensors(((0, RHO, 0), (0, 1, 0)))
    one, other = (
        analyse(ball_robot, skin, FIELD, [0.1], throws, num_throws=40, seed=seed)
        for seed in (3, 4)
    )
    assert not torch.equal(one.contact_height, other.contact_height)
    assert not torch.equal(one.surface.gap, other.surface.gap)
    (cell,) = one.report()["cells"]
    hits = {k: v["hits"] for k, v in cell["warning_by_azimuth"].items()}
    assert hits == {"front": 0, "left": 40, "back": 0, "right": 0}
    # The ball's centre is within both radii of the robot's.
    away = one.contact_height - StandingRobot(ball_robot).origin[2]
    assert away.abs().max() < RHO + BALL.radius
    assert one.surface_link == ("base",) * len(one.surface_link)


def test_a_ball_cannot_come_through_the_floor(small_robot):
    robot = small_robot(f"<geom size='{RHO}'/>")  # stands on the floor
    body = StandingRobot(robot)
    skin = sensors(((0, 0, RHO), (0, 0, 1)))
    paths = direction_paths(body, BALL, 1.0)
    seen = traced(body, paths, skin, FIELD, [1.0])
    # At a gap g the centre is at rho + (rho + r + g) sin(elevation) >= r.
    sine = torch.from_numpy(np.sin(direction_grid()[1])).reshape(-1).float()
    at_contact, far = (RHO + (0.35 + g) * sine - 0.15 for g in (0.0, 1.0))
    assert torch.equal(at_contact > 0, seen.touches)
    assert (seen.runway[~seen.touches] == 0).all()
    assert torch.equal(seen.runway >= 1.0, far >= 0)
    # Under the floor nothing is seen.
    under = paths[..., 2] < 0.15
    assert not seen.num_sensors[0][under].any()


def test_a_skin_that_sees_nothing_has_figures_of_nothing(ball_robot):
    # In the middle of the robot, with a range that ends inside it.
    skin = sensors(((0, 0, 0), (0, 0, 1)), range=np.array([0.1]))
    analysis = analyse(ball_robot, skin, FIELD, [2.0], ThrowConfig(), num_throws=20)
    report = analysis.report()
    (cell,) = report["cells"]
    assert cell["directions_seen"] == 0
    assert cell["surface_blind"] == 1
    assert cell["widest_blind_cone_deg"]["half_angle"] == 180
    assert cell["warning"]["seen"] == 0
    assert cell["warning"]["95%"] == 0
    assert cell["sensors_at_once"] == {"median": None, "one": None}
    json.dumps(report, allow_nan=False)


def test_throws_that_miss_have_no_warning(ball_robot):
    # Above its head.
    over = ThrowConfig(
        flight="straight", aim="box", box_height=(6.0, 6.0), height=(6.0, 6.0)
    )
    skin = sensors(((0, 0, RHO), (0, 0, 1)))
    report = analyse(ball_robot, skin, FIELD, [0.5], over, num_throws=20).report()
    assert (report["throws"], report["hits"]) == (20, 0)
    assert report["cells"][0]["warning"] == {"hits": 0}
    assert report["differing_share"] is None
    json.dumps(report, allow_nan=False)


def test_points_behind_other_parts_are_not_reached(small_robot):
    # Two balls close together: between them there is no room for a third.
    robot = small_robot("<geom size='0.2'/><geom size='0.2' pos='0.5 0 0'/>")
    body = StandingRobot(robot)
    skin = sensors(((0, 0, RHO), (0, 0, 1)))
    paths, _ = surface_paths(body, BALL, 0.5, seed=0)
    analysis = analyse(robot, skin, FIELD, [0.5], ThrowConfig(), num_throws=1)
    reached = analysis.reached
    touch = paths[:, -1].double().numpy()
    free = body.distance(touch) >= 0.15 - 1e-3
    above = touch[:, 2] > 0.15
    inside = reached.numpy()
    assert inside.any()
    assert (~inside).any()
    assert (inside <= (free & above)).all()


def hand_made(num_sensors, contact) -> Trace:
    """Return traces whose gap is the number of steps left divided by 100."""
    num_sensors, contact = torch.tensor(num_sensors), torch.tensor(contact)
    steps = torch.arange(num_sensors.shape[-1])
    gap = (contact[:, None] - steps) / 100
    runway = torch.full((len(contact),), torch.inf)
    return Trace(gap=gap, contact=contact, runway=runway, num_sensors=num_sensors)


def test_first_sight_by_hand():
    seen = hand_made([[[0, 0, 2, 0, 1, 0], [0] * 6]], [5, 4])
    assert seen.first_seen.tolist() == [[2, 4]]
    assert seen.seen.tolist() == [[True, False]]
    torch.testing.assert_close(seen.clearance, torch.tensor([[0.03, 0.0]]))
    missed = hand_made([[[0, 1, 1]]], [3])
    assert not missed.touches.any()


def test_cells_differ_by_more_than_a_control_step_or_not():
    # First sight of two throws, in steps of 2 ms: cell 1 is 16 and 18 ms late.
    seen = torch.zeros(2, 2, 20, dtype=torch.int16)
    seen[0, :, 0:] = 1
    seen[1, 0, 8:] = seen[1, 1, 9:] = 1
    throws = hand_made(seen.tolist(), [15, 15])
    analysis = Analysis(
        cells=(Cell(coverage="a", range=1.0), Cell(coverage="b", range=1.0)),
        directions=throws,
        surface=throws,
        surface_link=("base", "base"),
        throws=throws,
        throw_azimuth=torch.zeros(2),
        contact_height=torch.ones(2),
        control_period=1 / 60,
    )
    assert analysis.differing_share().tolist() == [[0, 0.5], [0.5, 0]]
    torch.testing.assert_close(
        analysis.warning.float(), torch.tensor([[0.03, 0.03], [0.014, 0.012]])
    )


def test_warnings_are_grouped_by_hand():
    # From the front, the left, behind and the right, and a throw that misses; seen by
    # 1, 2, 3 and 2 sensors.
    seen = torch.zeros(1, 5, 20, dtype=torch.int16)
    for throw, (first, count) in enumerate([(5, 1), (7, 2), (9, 3), (11, 2), (0, 5)]):
        seen[0, throw, first:15] = count
    # The third point of the surface cannot be reached along its normal.
    surface = torch.zeros(1, 3, 20, dtype=torch.int16)
    surface[0, 0, 10:] = 1
    everywhere = direction_grid()[0].size
    analysis = Analysis(
        cells=(Cell(coverage="a", range=1.0),),
        directions=hand_made(torch.ones(1, everywhere, 3).tolist(), [2] * everywhere),
        surface=hand_made(surface.tolist(), [19, 19, 3]),
        surface_link=("arm", "leg", "leg"),
        throws=hand_made(seen.tolist(), [15, 15, 15, 15, 20]),
        throw_azimuth=torch.tensor([0.0, 0.5, 1.0, -0.5, 0.0]) * math.pi,
        contact_height=torch.tensor([0.5, 1.3, 1.5, 1.7, 0.1]),
        control_period=1 / 60,
    )
    (cell,) = analysis.report()["cells"]

    def times(group: dict[str, Any]) -> list[float]:
        assert group["seen"] == 1.0
        return [group["hits"], *(1e3 * group[key] for key in ("5%", "median", "95%"))]

    # Steps of 2 ms; levels are interpolated between 8, 12, 16 and 20 ms.
    assert times(cell["warning"]) == pytest.approx([4, 8.6, 14.0, 19.4])
    assert {k: times(v) for k, v in cell["warning_by_azimuth"].items()} == {
        "front": pytest.approx([1, 20, 20, 20]),
        "left": pytest.approx([1, 16, 16, 16]),
        "back": pytest.approx([1, 12, 12, 12]),
        "right": pytest.approx([1, 8, 8, 8]),
    }
    by_height = cell["warning_by_height"]
    assert times(by_height["0-0.8"]) == pytest.approx([1, 20, 20, 20])
    assert by_height["0.8-1.2"] == {"hits": 0}
    assert times(by_height["1.2-1.6"]) == pytest.approx([2, 12.2, 14, 15.8])
    assert times(by_height["1.6-inf"]) == pytest.approx([1, 8, 8, 8])
    # 10 + 8 + 6 + 4 steps with a detection.
    assert cell["sensors_at_once"] == {"median": 2.0, "one": 10 / 28}
    assert cell["surface_blind"] == 0.5
    assert cell["surface_blind_by_link"] == {"arm": 0.0, "leg": 1.0}


# --- invariances on the H1-2 ----------------------------------------------------


@pytest.fixture(scope="module")
def body() -> StandingRobot:
    return StandingRobot(H1_2)


@pytest.fixture(scope="module")
def paths(body) -> torch.Tensor:
    """Return the flights of 24 throws, every fourth step."""
    return throw_paths(body, ThrowConfig(), 24, 0, 1 / 120)[0][:, ::4]


@pytest.fixture(scope="module")
def thrown(body, paths, skin) -> Trace:
    """24 throws seen by 64 sensors: field and ray, 0.3, 1 and 2 m."""
    return traced(body, paths, skin, FIELD | RAY, [0.3, 1.0, 2.0])


def test_a_longer_range_sees_no_less(thrown):
    counts = thrown.num_sensors.unflatten(0, (2, 3))
    assert (counts.diff(dim=1) >= 0).all()
    assert (thrown.first_seen.unflatten(0, (2, 3)).diff(dim=1) <= 0).all()
    assert (counts[:, 2] > counts[:, 1]).any()


def test_a_body_in_the_way_hides_some_of_what_is_seen(body, paths, skin):
    clear, solid = (
        traced(
            *(body, paths[::2], skin),
            {k: replace(c, occlusion=hidden) for k, c in (FIELD | RAY).items()},
            [0.5, 1.0],
        )
        for hidden in (False, True)
    )
    assert (solid.num_sensors <= clear.num_sensors).all()
    assert (solid.num_sensors < clear.num_sensors).any(-1).any(-1).all()
    assert (solid.first_seen >= clear.first_seen).all()


def test_what_a_ray_hits_is_in_the_field(thrown):
    field, ray = thrown.num_sensors.unflatten(0, (2, 3))
    assert (field >= ray).all()
    assert ray.any()


def test_sensors_of_their_own_kind_and_range_keep_them(body, paths, skin):
    # Even sensors are rays of 1 m, odd ones fields of 2 m, whatever is asked.
    even, odd = skin.select(range(0, 64, 2)), skin.select(range(1, 64, 2))
    own = np.where(np.arange(64) % 2, 2.0, 1.0)
    mixed = replace(skin, coverage=(Ray(), Field()) * 32, range=own)
    got = traced(body, paths, mixed, FIELD, [0.3]).num_sensors[0]
    rays = traced(body, paths, even, RAY, [1.0]).num_sensors[0]
    fields = traced(body, paths, odd, FIELD, [2.0]).num_sensors[0]
    assert torch.equal(got, rays + fields)
    # Rays are requested, but there are none.
    own = replace(odd, coverage=(Field(),) * 32)
    alone = traced(body, paths, own, RAY, [2.0]).num_sensors[0]
    assert torch.equal(alone, fields)
    assert rays.any()


def test_what_a_cell_sees_does_not_depend_on_the_others(body, paths, skin):
    # A depth of 0.5 m at the corner of the view is 0.57 m away.
    depth = {"depth": SensorConfig(coverage="ray", ray=Ray(measure="depth"))}
    alone = traced(body, paths, skin, depth, [0.5]).num_sensors[0]
    beside = traced(body, paths, skin, depth, [0.5, 1.0]).num_sensors[0]
    assert torch.equal(alone, beside)
    assert alone.any()


def test_nothing_is_seen_after_the_contact(thrown):
    steps = torch.arange(thrown.gap.shape[1])
    after = steps >= thrown.contact[:, None]
    assert not thrown.num_sensors[:, after].any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ranges": [1.0, -1.0]}, "must be positive and finite"),
        ({"ranges": [math.inf]}, "must be positive and finite"),
        (
            {"ranges": [0.5, 1.0, 0.5]},
            r"ranges must be distinct, got \[0.5, 1.0, 0.5\]",
        ),
        ({"ranges": []}, "at least one coverage and one range"),
        ({"sensors": {}}, "at least one coverage and one range"),
        ({"num_throws": 0}, "num_throws must be at least 1"),
        ({"seed": -1}, r"seed must be in \[0, 2\*\*32\), got -1"),
        (
            {"throws": ThrowConfig(shape="capsule", size=(0.1, 0.2))},
            "visibility is analysed for spheres, got shape=capsule",
        ),
    ],
)
def test_what_cannot_be_analysed_is_refused(skin, changes, message):
    arguments = {"sensors": FIELD, "ranges": [1.0], "throws": ThrowConfig()}
    with pytest.raises(ValueError, match=message):
        analyse(H1_2, skin, **(arguments | changes))


def test_what_a_sensor_of_infinite_range_sees_is_not_defined(skin):
    text = r"sensor 2 of the skin has an infinite range: .* for a finite one"
    ranges = np.full(len(skin), np.nan)
    ranges[2] = math.inf
    own, sensor = replace(skin, range=ranges), SensorConfig(coverage="field", range=1.0)
    with pytest.raises(ValueError, match=text):
        see_directions(H1_2, own, sensor, BALL)
    with pytest.raises(ValueError, match=text):
        analyse(H1_2, own, FIELD, [1.0], ThrowConfig())
    with pytest.raises(ValueError, match="sensor 0 of the skin has an infinite range"):
        see_directions(H1_2, skin, replace(sensor, range=math.inf), BALL)


# --- the command ----------------------------------------------------------------


def test_the_command_writes_a_picture_and_figures(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    small = ("--skin.num-sensors", "8", "--num-throws", "16")
    ranges = ("--ranges", "0.4", "0.2", "--throws.radius", "0.1")
    assert "16 of 16 throws hit" in succeed("visibility", *small, *ranges)
    assert (tmp_path / "visibility.png").read_bytes()[:4] == b"\x89PNG"
    result = json.loads((tmp_path / "visibility.json").read_text())
    cells = [(cell["coverage"], cell["range"]) for cell in result["cells"]]
    assert cells == [("field", 0.2), ("field", 0.4), ("ray", 0.2), ("ray", 0.4)]
    assert result["config"]["throws"]["radius"] == 0.1
    near, far = (cell["warning"]["median"] for cell in result["cells"][:2])
    assert 0 <= near < far < 0.2
    groups = result["cells"][0]["warning_by_azimuth"].values()
    assert sum(group["hits"] for group in groups) == result["hits"] == 16


def test_the_command_has_the_body_in_the_way_if_asked(monkeypatch):
    pytest.importorskip("matplotlib")
    asked = []

    def analyse(robot, skin, sensors, *args, **kwargs):
        asked.append([config.occlusion for config in sensors.values()])
        raise SystemExit

    monkeypatch.setattr("egoskin.commands.visibility.analyse", analyse)
    for option in ((), ("--occlusion",)):
        call("visibility", *option)
    assert asked == [[False, False], [True, True]]


def test_the_options_of_the_command_reach_the_analysis(monkeypatch):
    pytest.importorskip("matplotlib")
    given = {}

    def analyse(robot, skin, sensors, ranges, throws, **options):
        given.update(options, robot=robot.name, number=len(skin), throws=throws)
        given.update(sensors=sensors, ranges=ranges)
        raise SystemExit

    monkeypatch.setattr("egoskin.commands.visibility.analyse", analyse)
    args = ["--robot", "g1", "--skin.num-sensors", "9", "--coverages", "ray"]
    args += ["--ray.grid", "2", "3", "--ranges", "0.4", "0.2"]
    args += ["--throws.radius", "0.1", "--num-throws", "7", "--seed", "5"]
    call("visibility", *args)
    assert (given["robot"], given["number"]) == ("g1", 9)
    ray = Ray(grid=(2, 3))
    assert given["sensors"] == {"ray": SensorConfig(coverage="ray", ray=ray)}
    assert given["ranges"] == [0.2, 0.4]
    assert given["throws"] == ThrowConfig(radius=0.1)
    assert (given["num_throws"], given["seed"]) == (7, 5)


@pytest.mark.parametrize(
    ("own", "without_effect"),
    [
        ({}, []),
        ({"range": np.ones(64)}, ["--ranges"]),
        ({"coverage": (Field(),) * 64}, ["--coverages"]),
    ],
)
def test_the_command_tells_what_the_skin_file_sets(
    own, without_effect, skin: Skin, tmp_path, monkeypatch
):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(
        "egoskin.commands.visibility.analyse", Mock(side_effect=SystemExit)
    )
    replace(skin, **own).save(tmp_path / "skin.json")
    monkeypatch.chdir(tmp_path)
    told = call("visibility", "--skin.path", "skin.json").stderr
    assert re.findall(r"(--\w+) has no effect", told) == without_effect


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--ranges", "-1"], "ranges must be positive"),
        (
            ["--coverages", "ray", "--field.half-angle-deg", "30"],
            "--field has no effect without field",
        ),
        (["--throws.interval", "2", "3"], "--throws.interval has no effect"),
        (["--throws.num-balls", "1"], "--throws.num_balls has no effect"),
        (["--out", "visibility.mp4"], "visibility.mp4 must end in .png or .jpg"),
        (["--json", "none/visibility.json"], "there is no folder none"),
    ],
)
def test_bad_input_to_the_command_is_one_clear_message(
    args, message, tmp_path, monkeypatch
):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    done = call("visibility", *args)
    assert done.returncode == 2
    assert message in done.stderr
    # Reported before the analysis, not after it.
    assert not done.stdout
    assert not list(tmp_path.iterdir())
