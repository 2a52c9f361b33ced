"""Sensors on meshes are placed on the outer shell, not on hidden parts."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from egoskin.robots.builtin import H1_2
from egoskin.robots.config import RobotConfig
from egoskin.robots.surface import distance_to
from egoskin.sensors.skin.mesh_surface import (
    mesh_surface,
    meshes_in_folder,
    meshes_of_mjcf,
    openness,
    triangle_patch,
)
from egoskin.sensors.skin.placement import place_sensors

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

N = 2000


def ball(radius: float, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return mesh.apply_translation(centre)


def box(size, centre=(0.0, 0.0, 0.0)):
    return trimesh.creation.box(size).apply_translation(centre)


def sample(robot, meshes, links=("base",), **options):
    return mesh_surface(robot, links, meshes).sample(N, 0, **options)


@pytest.fixture
def bare_robot(small_robot):
    """A base without a shape, and a link beside it, rotated 90 degrees about z."""
    return small_robot("<body name='b' pos='.3 0 0' euler='0 0 90'/>")


# --- which points are outer -----------------------------------------------------


def test_a_ball_inside_a_ball_is_rejected_by_its_area(bare_robot):
    points = sample(bare_robot, {"base": [ball(0.2), ball(0.1)]})
    np.testing.assert_allclose(np.linalg.norm(points.position, axis=-1), 0.2, atol=2e-3)
    # Areas as .2^2 : .1^2 = 4 : 1.
    assert points.rejected["base"] == pytest.approx(1 / 5, abs=0.03)
    assert points.area["base"] == pytest.approx(4 * np.pi * 0.04, rel=0.05)


def test_a_ball_inside_the_box_of_another_link_is_rejected(bare_robot):
    # The ball's centre is the origin of b, 0.3 m along x of the base.
    meshes = {"base": [box((0.3, 0.2, 0.2), (0.3, 0, 0))], "b": [ball(0.08)]}
    points = sample(bare_robot, meshes, links=("base", "b"))
    assert set(points.link) == {bare_robot.links.index("base")}
    assert points.rejected == {"base": 0.0, "b": 1.0}


def test_what_other_links_cover_is_rejected_in_the_default_pose(bare_robot):
    # b's plate, 0.4 m long along its y, lies along -x of the base: to x = -0.1.
    meshes = {"base": [box((0.4, 0.1, 0.1))], "b": [box((0.2, 0.4, 0.2), (0, 0.2, 0))]}
    points = sample(bare_robot, meshes, links=("base",))
    assert points.position[:, 0].max() < -0.1 + 1e-3
    # Left of the base: an end and half of the sides, less a quarter: 1.3 of 3.6.
    end, side = 0.1 * 0.1, 4 * 0.4 * 0.1
    outer = (end + side / 4) / (2 * end + side)
    assert points.rejected["base"] == pytest.approx(1 - outer, abs=0.03)


@pytest.mark.parametrize("inside_out", [False, True])
def test_normals_point_out_however_faces_are_wound(bare_robot, inside_out):
    mesh = ball(0.2)
    if inside_out:
        mesh.invert()
    points = sample(bare_robot, {"base": [mesh]})
    outward = points.position / np.linalg.norm(points.position, axis=-1, keepdims=True)
    assert (points.normal * outward).sum(-1).min() > 0.99
    assert points.rejected["base"] < 0.01


def test_normals_of_an_open_sheet_point_to_the_wider_view(bare_robot):
    whole = ball(0.2)
    upper = (whole.triangles[..., 2] > -0.1).all(-1)
    dome = trimesh.Trimesh(whole.vertices, whole.faces[upper][:, ::-1])
    points = sample(bare_robot, {"base": [dome]})
    assert (points.normal * points.position).sum(-1).min() > 0


def test_links_without_meshes_keep_their_primitives(small_robot):
    robot = small_robot(
        "<geom size='.2'/><body name='b' pos='1 0 0'><geom size='.05'/></body>"
    )
    # b's mesh replaces its ball; half of it lies in the ball of the base.
    shifted = box((0.2, 0.1, 0.1), (-0.8, 0, 0))
    points = sample(robot, {"b": [shifted]}, links=("base", "b"))
    on_base = points.link == robot.links.index("base")
    assert on_base.any()
    np.testing.assert_allclose(
        np.linalg.norm(points.position[on_base], axis=-1), 0.2, atol=1e-9
    )
    # The base's ball is hidden where the box comes out of it.
    cap = points.position[on_base] > [0.17, -0.05, -0.05]
    assert not (
        cap.all(-1) & (points.position[on_base] < [1, 0.05, 0.05]).all(-1)
    ).any()
    base_frame = points.position[~on_base] + [1, 0, 0]
    assert distance_to(robot.primitives[0], base_frame).min() > -1e-5


def test_stand_off_keeps_out_of_narrow_gaps(bare_robot):
    plates = [box((0.4, 0.4, 0.04)), box((0.4, 0.4, 0.04), (0, 0, 0.2))]
    for stand_off, in_gap in ((0.05, True), (0.18, False)):
        points = sample(bare_robot, {"base": plates}, stand_off=stand_off)
        above = (points.position[:, 2] > 0.019) & (points.normal[:, 2] > 0.9)
        assert (above & (points.position[:, 2] < 0.1)).any() == in_gap


# --- openness, against MuJoCo and by hand ---------------------------------------


def test_openness_of_a_plane_is_one_and_of_a_pit_its_sky():
    plate = box((2.0, 2.0, 0.1))
    tube = trimesh.creation.annulus(r_min=0.1, r_max=0.2, height=0.2)
    # Plate's top and pit's floor at z = 0.05, the pit's rim at 0.1, its radius 0.1:
    # cosine-weighted sky from the floor's centre r^2 / (r^2 + h^2) = 0.8.
    points = np.array([[0.0, 0.0, 0.05], [0.9, 0.9, -0.05]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    scene = trimesh.util.concatenate([plate, tube])
    share = openness(scene, points, normals)
    assert share == pytest.approx([0.8, 1.0], abs=0.05)


def test_openness_agrees_with_rays_of_mujoco():
    shapes = [
        box((0.5, 0.4, 0.1)),
        ball(0.15, (0.1, 0.1, 0.2)),
        ball(0.1, (-0.2, 0, 0)),
    ]
    scene = trimesh.util.concatenate(shapes)
    patch = triangle_patch("base", np.asarray(scene.triangles))
    rng = np.random.default_rng(0)
    points, normals = patch.sample(300, rng)
    spec = mujoco.MjSpec()
    for i, shape in enumerate(shapes):
        mesh = spec.add_mesh(name=str(i))
        mesh.uservert = np.asarray(shape.vertices).ravel()
        mesh.userface = np.asarray(shape.faces).ravel()
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(i))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # Many random cosine-weighted rays: the share is known to 1 / sqrt(1000) x 0.5.
    rays = 1000
    got, geom, far = openness(scene, points, normals), np.empty(rays, np.int32), 0
    for point, normal, share in zip(points, normals, got, strict=True):
        ray = rng.normal(size=(rays, 3))
        ray = normal + ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        mujoco.mj_multiRay(
            model, data, point + 1e-4 * normal, ray.ravel(), None, 1, -1, geom,
            np.empty(rays), None, rays, 100.0,
        )  # fmt: skip
        far += abs(np.mean(geom < 0) - share) > 0.1
    assert far / len(points) < 0.02
    assert 0.1 < np.mean(got < 0.15) < 0.9


def test_triangles_are_sampled_uniformly():
    # A square of two triangles and one triangle of half its area, all facing z.
    square = [[(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 0, 0), (1, 1, 0), (0, 1, 0)]]
    apart = [[(5, 0, 0), (6, 0, 0), (5, 1, 0)]]
    patch = triangle_patch("base", np.array(square + apart, float))
    assert patch.area == pytest.approx(1.5)
    points, normals = patch.sample(20_000, np.random.default_rng(0))
    np.testing.assert_array_equal(normals, np.broadcast_to([0, 0, 1], normals.shape))
    within = points[:, 0] < 2
    # Five standard errors of a share among 20000 points: 0.017.
    assert within.mean() == pytest.approx(2 / 3, abs=0.017)
    for axis in (0, 1):
        share = (points[within][:, axis] < 0.3).mean()
        assert share == pytest.approx(0.3, abs=0.02)
    u, v = points[~within, 0] - 5, points[~within, 1]
    assert (u + v).max() <= 1
    # The corner u, v < 1/2 is a square of half the triangle's area.
    assert ((u < 0.5) & (v < 0.5)).mean() == pytest.approx(1 / 2, abs=0.03)


def test_meshes_in_millimetres_are_told_of_before_a_file_is_written():
    torso = box((300, 200, 500))
    with pytest.raises(
        ValueError, match=r"sensor would be \d+ m from .*meshes of torso_link in me"
    ):
        place_sensors(H1_2, 8, links=["torso_link"], meshes={"torso_link": [torso]})


# --- reading meshes -------------------------------------------------------------


def test_a_folder_gives_the_meshes_named_after_links(tmp_path):
    box((0.1, 0.2, 0.3)).export(tmp_path / "torso_link.STL")
    ball(0.1).export(tmp_path / "left_elbow_link.ply")
    ball(0.1).export(tmp_path / "logo_link.stl")
    (tmp_path / "torso_link.txt").write_text("no mesh")
    meshes = meshes_in_folder(tmp_path, H1_2.links)
    assert set(meshes) == {"torso_link", "left_elbow_link"}
    (torso,) = meshes["torso_link"]
    np.testing.assert_allclose(torso.extents, [0.1, 0.2, 0.3], rtol=1e-6)
    assert torso.metadata["name"] == "torso_link.STL"


def test_meshes_are_read_from_regular_files_alone(tmp_path):
    os.mkfifo(tmp_path / "pelvis.stl")
    with pytest.raises(
        ValueError, match=r"pelvis.stl must be a file, but is a named p"
    ):
        meshes_in_folder(tmp_path, ["pelvis"])
    with pytest.raises(
        ValueError, match=r"pelvis.stl must be a file, but is a named p"
    ):
        meshes_of_mjcf(tmp_path / "pelvis.stl")


def test_damaged_meshes_are_refused_by_name(tmp_path):
    raw = trimesh.creation.box().export(file_type="stl")
    path = tmp_path / "pelvis.stl"
    for content, text in (
        # Depends on trimesh: from 5.2 on, it parses the file as text.
        (raw[:300], "(as a mesh: |contains no triangles)"),
        (b"endsolid a solid b endsolid", "as a mesh: "),
        (b"", "contains no triangles"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"pelvis\.stl {text}"):
            meshes_in_folder(tmp_path, ["pelvis"])


def test_a_folder_without_meshes_or_with_two_of_a_link_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="named after a link, such as pelvis"):
        meshes_in_folder(tmp_path, H1_2.links)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        meshes_in_folder(tmp_path / "nowhere", H1_2.links)
    for name in ("pelvis.stl", "pelvis.obj"):
        ball(0.1).export(tmp_path / name)
    with pytest.raises(ValueError, match=r"two meshes of pelvis: pelvis.obj and pelv"):
        meshes_in_folder(tmp_path, H1_2.links)


@pytest.fixture
def mjcf(tmp_path: Path) -> Path:
    box((1.0, 2.0, 3.0), (0.5, 0.0, 0.0)).export(tmp_path / "brick.stl")
    path = tmp_path / "robot.xml"
    path.write_text(
        "<mujoco><asset><mesh file='brick.stl' scale='.1 .1 .1'/></asset><worldbody>"
        "<body name='base'><freejoint/>"
        "<geom type='mesh' mesh='brick' group='2'/>"
        "<geom type='mesh' mesh='brick' group='3'/>"
        "<geom type='sphere' size='.1'/>"
        "<body name='b'><geom type='mesh' mesh='brick' pos='0 0 1' euler='0 0 90'"
        " group='2'/><geom type='mesh' mesh='brick' pos='0 0 2' group='3'/>"
        "</body></body></worldbody></mujoco>"
    )
    return path


def test_meshes_of_a_model_are_scaled_and_posed(mjcf):
    meshes = meshes_of_mjcf(mjcf)
    # Base: duplicates of a mesh in one place are dropped.
    assert {body: len(found) for body, found in meshes.items()} == {"base": 1, "b": 2}
    bounds = meshes["base"][0].bounds
    np.testing.assert_allclose(bounds, [[0, -0.1, -0.15], [0.1, 0.1, 0.15]], atol=1e-6)
    # A quarter turn about z, then up by 1: x and y change places.
    bounds = meshes["b"][0].bounds
    np.testing.assert_allclose(bounds, [[-0.1, 0, 0.85], [0.1, 0.1, 1.15]], atol=1e-6)
    assert meshes["b"][0].volume == pytest.approx(6e-3, rel=1e-5)
    assert meshes["base"][0].metadata["name"] == "brick.stl"


def test_a_mesh_in_the_same_place_of_two_bodies_is_no_duplicate(mjcf):
    mjcf.write_text(mjcf.read_text().replace("pos='0 0 1' euler='0 0 90'", ""))
    meshes = meshes_of_mjcf(mjcf, group=2)
    assert {body: len(found) for body, found in meshes.items()} == {"base": 1, "b": 1}


def test_a_group_selects_meshes_of_a_model(mjcf):
    assert len(meshes_of_mjcf(mjcf, group=3)["b"]) == 1
    with pytest.raises(ValueError, match="no mesh geoms in group 5"):
        meshes_of_mjcf(mjcf, group=5)


@pytest.mark.parametrize("missing", ["trimesh", "embreex"])
def test_meshes_without_their_libraries_say_what_to_install(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"pip install 'egoskin\[design\]'"):
        mesh_surface(H1_2, ["pelvis"], {"pelvis": [ball(0.1)]})


# --- placing --------------------------------------------------------------------


def test_sensors_are_placed_on_meshes(bare_robot):
    hull, core = ball(0.2), ball(0.1)
    hull.metadata["name"] = "hull.stl"
    core.metadata["name"] = "core.stl"
    skin = place_sensors(
        bare_robot,
        None,
        method="poisson_disk",
        spacing=0.1,
        stand_off=0.01,
        meshes={"base": [hull, core]},
    )
    radius = np.linalg.norm(skin.position, axis=-1)
    np.testing.assert_allclose(radius, 0.21, atol=3e-3)
    # A full cover takes 0.7 of 4 pi .21^2 / .1^2 = 55.
    assert 30 < len(skin) < 45
    assert skin.provenance["meshes"] == {"base": ["hull.stl", "core.stl"]}
    assert skin.provenance["rejected"]["base"] == pytest.approx(0.2, abs=0.03)


def test_a_link_whose_shape_is_no_primitive_takes_a_mesh(small_robot):
    robot = small_robot(
        "<geom size='.2'/>"
        "<body name='b' pos='1 0 0'><geom type='ellipsoid' size='.1 .1 .3'/></body>"
    )
    with pytest.raises(ValueError, match=r"link 'b' .* kind ellipsoid.*meshes=\{'b':"):
        place_sensors(robot, 50)
    tube = trimesh.creation.cylinder(0.1, 0.6)
    with pytest.raises(ValueError, match="link 'b' has a collision shape"):
        place_sensors(robot, 50, meshes={"base": [ball(0.2)]})
    skin = place_sensors(robot, 50, links=["base", "b"], meshes={"b": [tube]})
    on_base = np.array(skin.links) == "base"
    assert 0 < on_base.sum() < 50
    distance = distance_to(robot.primitives_on(["base"])[0], skin.position[on_base])
    np.testing.assert_allclose(distance, 0, atol=2e-6)
    _, distance, _ = tube.nearest.on_surface(skin.position[~on_base])
    np.testing.assert_allclose(distance, 0, atol=2e-6)


def test_links_that_collide_as_meshes_wear_sensors_on_them(mjcf):
    robot = RobotConfig(
        name="bricks", model_path=mjcf, base="base", skin_links=("base", "b")
    )
    with pytest.raises(ValueError, match=r"link 'base' .* of kind mesh"):
        place_sensors(robot, 30)
    meshes = meshes_of_mjcf(mjcf, group=2)
    skin = place_sensors(robot, 30, meshes=meshes)
    assert set(skin.links) == {"base", "b"}
    for link, on_link in meshes.items():
        at = skin.position[np.array(skin.links) == link]
        distance = [mesh.nearest.on_surface(at)[1] for mesh in on_link]
        np.testing.assert_allclose(np.min(distance, axis=0), 0, atol=2e-6)


def test_meshes_of_unknown_or_empty_links_are_refused(bare_robot):
    with pytest.raises(ValueError, match="no link 'arm' for a mesh"):
        mesh_surface(bare_robot, ["base"], {"arm": [ball(0.1)]})
    with pytest.raises(ValueError, match="meshes: empty list for 'base'; remove"):
        mesh_surface(bare_robot, ["base"], {"base": []})
    flat = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False
    )
    with pytest.raises(ValueError, match="meshes of base have no area"):
        mesh_surface(bare_robot, ["base"], {"base": [flat]})
