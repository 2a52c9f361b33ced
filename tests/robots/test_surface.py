"""Points lie on the outer surface, uniformly by area, with outward normals."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egoskin.robots.builtin import H1_2
from egoskin.robots.config import Primitive
from egoskin.robots.surface import (
    area,
    distance_to,
    points_b,
    primitive_surface,
    sample_surface,
)


def by_link(points) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return (link, positions, normals) of each link that has points."""
    return [
        (
            H1_2.links[i],
            points.position[points.link == i],
            points.normal[points.link == i],
        )
        for i in np.unique(points.link)
    ]


@pytest.fixture(scope="module")
def points():
    return sample_surface(H1_2, H1_2.links, 3000, seed=0)


@pytest.fixture(scope="module")
def default_frames() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rotation and position of each link in the default pose, by MuJoCo."""
    model, data = H1_2.model, mujoco.MjData(H1_2.model)
    data.qpos[7:] = H1_2.default_joint_pos
    mujoco.mj_kinematics(model, data)
    return {
        name: (data.body(name).xmat.reshape(3, 3), data.body(name).xpos)
        for name in H1_2.links
    }


SIZES = st.tuples(*[st.floats(0.05, 0.3)] * 3)
PLACES = st.tuples(*[st.floats(-0.6, 0.6)] * 3)


@given(st.sampled_from(["sphere", "capsule", "box"]), SIZES, PLACES, st.integers(0, 99))
def test_distance_equals_that_of_mujoco(kind, size, place, seed):
    pos = np.random.default_rng(seed).normal(scale=0.1, size=3)
    tiny = 1e-6
    spec = mujoco.MjSpec()
    body = spec.worldbody
    body.add_geom(
        name="shape",
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=size,
        pos=pos,
        quat=[1, 0.3, -0.2, 0.5],
    )
    body.add_geom(name="point", size=[tiny, 0, 0], pos=place)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    expected = tiny + mujoco.mj_geomDistance(model, data, 0, 1, 10, np.zeros(6))
    rotation = data.geom("shape").xmat.reshape(3, 3)
    shape = Primitive(
        link="base", kind=kind, size=np.array(size), position=pos, rotation=rotation
    )
    got = distance_to(shape, np.array([place]))[0]
    if expected > 0:
        assert got == pytest.approx(expected, abs=2e-6)
    else:
        # Inside, MuJoCo's depth is that of a contact: only the sign is comparable.
        assert got <= 1e-9


def test_samples_lie_on_a_shape_of_their_link(points):
    for link, position, _ in by_link(points):
        own = [distance_to(s, position) for s in H1_2.primitives if s.link == link]
        assert np.abs(own).min(0).max() < 1e-9


def test_samples_lie_inside_no_shape_of_the_default_pose(points, default_frames):
    for link, position, _ in by_link(points):
        turn, shift = default_frames[link]
        world = position @ turn.T + shift
        for shape in H1_2.primitives:
            turn, shift = default_frames[shape.link]
            # The chain's offsets are float32: a micrometre of additional error.
            assert distance_to(shape, (world - shift) @ turn).min() > -3e-6


def test_normals_are_unit_and_point_outwards(points):
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=-1), 1, atol=1e-9)
    step = 1e-6
    for link, position, normal in by_link(points):
        shapes = [s for s in H1_2.primitives if s.link == link]
        distance = np.array([distance_to(s, position) for s in shapes])
        own = np.abs(distance).argmin(0)
        for i, shape in enumerate(shapes):
            at, along = position[own == i], normal[own == i]
            # The normal is the gradient of the distance, by central differences.
            gradient = np.stack(
                [
                    distance_to(shape, at + step * axis)
                    - distance_to(shape, at - step * axis)
                    for axis in np.eye(3)
                ],
                -1,
            ) / (2 * step)
            # There is none on the edge of a box: skip points within the step.
            smooth = np.abs(np.linalg.norm(gradient, axis=-1) - 1) < 1e-3
            assert smooth.mean() > 0.99
            np.testing.assert_allclose(gradient[smooth], along[smooth], atol=1e-3)


N = 20_000


def share_error(share: float) -> float:
    """Return five standard errors of a share among N points."""
    return 5 * (share * (1 - share) / N) ** 0.5


@pytest.mark.parametrize(
    ("size", "surface"),
    [
        ("type='sphere' size='.5'", np.pi),  # 4 pi .5^2
        # caps 4 pi .1^2 = .04 pi, side 2 pi .1 x .6 = .12 pi
        ("type='capsule' size='.1 .3'", 0.16 * np.pi),
        # twice .2 x .4 + .4 x .6 + .2 x .6 = .44
        ("type='box' size='.1 .2 .3'", 0.88),
    ],
)
def test_area_of_a_primitive(small_robot, size, surface):
    (shape,) = small_robot(f"<geom {size}/>").primitives
    assert area(shape) == pytest.approx(surface)


def test_sphere_is_sampled_uniformly(small_robot):
    robot = small_robot("<geom size='.5' pos='1 2 3'/>")
    points = sample_surface(robot, ["base"], N, seed=0)
    np.testing.assert_allclose(points.position, [1, 2, 3] + 0.5 * points.normal)
    # Archimedes: each coordinate of the normal is uniform in [-1, 1].
    for coordinate in points.normal.T:
        for share in (0.1, 0.5, 0.8):
            found = (coordinate < 2 * share - 1).mean()
            assert found == pytest.approx(share, abs=share_error(share))


def test_capsule_is_sampled_uniformly(small_robot):
    robot = small_robot("<geom type='capsule' size='.1' fromto='0 0 0  .6 0 0'/>")
    points = sample_surface(robot, ["base"], N, seed=1)
    along = points.position[:, 0]
    # The caps hold .04 of .16 pi of the area: 1/8 at each end.
    for cap in (along < 0, along > 0.6):
        assert cap.mean() == pytest.approx(1 / 8, abs=share_error(1 / 8))
    # The side is uniform along the axis, and its normals turn evenly around it.
    side = (along >= 0) & (along <= 0.6)
    assert (along[side] < 0.15).mean() == pytest.approx(1 / 4, abs=share_error(1 / 4))
    np.testing.assert_allclose(points.normal[side, 0], 0, atol=1e-9)
    quadrant = (points.normal[side, 1:] > 0).all(-1)
    assert quadrant.mean() == pytest.approx(1 / 4, abs=share_error(1 / 4))
    # The height of a cap's points over its rim is uniform in [0, r], as on any sphere.
    assert (along[~side] > 0.65).sum() / (along > 0.6).sum() == pytest.approx(
        1 / 2, abs=4 * share_error(1 / 2)
    )


def test_box_is_sampled_uniformly(small_robot):
    robot = small_robot("<geom type='box' size='.1 .2 .3'/>")
    points = sample_surface(robot, ["base"], N, seed=2)
    # Pairs of faces across x, y, z have areas in proportion .06 : .03 : .02.
    for axis, share in enumerate((6 / 11, 3 / 11, 2 / 11)):
        for sign in (-1, 1):
            on_face = points.normal[:, axis] == sign
            found = on_face.mean()
            assert found == pytest.approx(share / 2, abs=share_error(share / 2))
            on = points.position[on_face]
            np.testing.assert_allclose(on[:, axis], sign * (axis + 1) / 10)
            quarter = (np.delete(on, axis, 1) > 0).all(-1).mean()
            assert quarter == pytest.approx(1 / 4, abs=4 * share_error(1 / 4))


def test_what_another_shape_covers_gets_no_points(small_robot):
    robot = small_robot(
        "<geom size='1'/><body name='b' pos='1 0 0'><geom size='.5'/></body>"
    )
    points = sample_surface(robot, ["base", "b"], N, seed=3)
    # The spheres meet in the plane x = (1 + 1 - .25)/2 = .875. Hidden caps: height
    # .125 of radius 1 (area .25 pi) and .375 of radius .5 (.375 pi); there remain
    # 3.75 pi and .625 pi: the small one keeps 1/7 of the whole.
    small = points.link == robot.links.index("b")
    assert small.mean() == pytest.approx(1 / 7, abs=share_error(1 / 7))
    assert points.position[~small, 0].max() <= 0.875 + 1e-5
    assert (points.position[small, 0] + 1).min() >= 0.875 - 1e-5


@pytest.mark.parametrize("stand_off", [0.0, 0.01])
def test_where_shapes_touch_flush_there_is_no_outer_surface(small_robot, stand_off):
    robot = small_robot(
        "<geom type='box' size='.1 .1 .1'/>"
        "<body name='b' pos='0 0 .2'><geom type='box' size='.1 .1 .1'/>"
        "<geom type='box' size='.05 .05 .05' pos='.15 0 0'/></body>"
    )
    surface = primitive_surface(robot, robot.links)
    points = surface.sample(N, 4, stand_off=stand_off)
    at = points_b(surface.frames, points.link, points.position)
    x, y, z = at.T
    above = (np.abs(z - 0.1) < 1e-6) & (np.abs([x, y]).max(0) < 0.099)
    beside = (np.abs(x - 0.1) < 1e-6) & (np.abs([y, z - 0.2]).max(0) < 0.049)
    assert not (above | beside).any()
    # Hidden: two of twelve faces of .04 m^2, one of six of .01 and the place of it.
    visible = 10 * 0.04 - 0.01 + 5 * 0.01
    assert sum(points.area.values()) == pytest.approx(visible, rel=0.03)


def test_only_the_links_asked_for_get_points():
    points = sample_surface(H1_2, ["left_elbow_link", "torso_link"], 500, seed=0)
    names = {H1_2.links[i] for i in points.link}
    assert names == {"left_elbow_link", "torso_link"}


def test_the_seed_decides_the_points():
    first, again, other = (
        sample_surface(H1_2, ["torso_link"], 100, seed) for seed in (5, 5, 6)
    )
    for name in ("link", "position", "normal"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.isclose(first.position, other.position).all(-1).any()


def test_impossible_requests_are_refused(small_robot):
    with pytest.raises(ValueError, match="must be positive, got 0"):
        sample_surface(H1_2, ["torso_link"], 0, seed=0)
    with pytest.raises(
        ValueError, match=r"no link 'torso', did you mean 'torso_link'\? \(links: "
    ):
        sample_surface(H1_2, ["pelvis", "torso"], 10, seed=0)
    with pytest.raises(ValueError, match="have no collision shape"):
        sample_surface(H1_2, ["left_wrist_yaw_link"], 10, seed=0)
    hidden = small_robot("<geom size='1'/><body name='in'><geom size='.5'/></body>")
    with pytest.raises(ValueError, match="in lie inside other shapes"):
        sample_surface(hidden, ["in"], 10, seed=0)
