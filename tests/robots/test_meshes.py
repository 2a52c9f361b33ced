"""Primitives in place of collision meshes."""

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calling import succeed
from egoskin.robots.meshes import around_mesh, fit_meshes
from egoskin.robots.own import read_folder
from egoskin.robots.portable import portable
from egoskin.robots.surface import distance_to
from owning import MODEL, write_robot


def fit(mesh, own_axes=None):
    axes = np.eye(3) if own_axes is None else own_axes
    return around_mesh("link", np.array(mesh.vertices), np.array(mesh.faces), axes)


def outside(found, points):
    """Return how far points are outside of all primitives [m]."""
    return np.min([distance_to(p, points) for p in found.primitives], axis=0).max()


SHAPES = {
    "sphere": (trimesh.creation.icosphere(radius=0.1), [0.1, 0, 0]),
    "capsule": (trimesh.creation.capsule(radius=0.05, height=0.3), [0.05, 0.15, 0]),
    "box": (trimesh.creation.box((0.1, 0.2, 0.6)), [0.05, 0.1, 0.3]),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_the_mesh_of_a_primitive_becomes_the_primitive(kind):
    mesh, size = SHAPES[kind]
    # Of which axis the capsule is, must not matter.
    turn = Rotation.from_euler("xyz", (np.pi / 2, 0, np.pi / 2)).as_matrix()
    mesh = mesh.copy()
    mesh.vertices = mesh.vertices @ turn.T + (1, 2, 3)
    (primitive,) = fit(mesh).primitives
    assert primitive.kind == kind
    # The middle of a capsule's mesh is longer by the caps' first rings.
    np.testing.assert_allclose(np.sort(primitive.size), np.sort(size), atol=2e-3)
    np.testing.assert_allclose(primitive.position, (1, 2, 3), atol=1e-3)
    assert outside(fit(mesh), mesh.vertices) < 1e-9


def test_a_turned_mesh_is_fitted_along_its_own_axes():
    mesh, size = SHAPES["box"]
    mesh, turn = mesh.copy(), Rotation.from_euler("xyz", (0.3, 0.5, 0.7)).as_matrix()
    mesh.vertices = mesh.vertices @ turn.T
    found = fit(mesh, turn)
    (primitive,) = found.primitives
    assert primitive.kind == "box"
    np.testing.assert_allclose(primitive.size, size, atol=1e-6)
    np.testing.assert_allclose(primitive.rotation, turn, atol=1e-6)
    assert found.excess == pytest.approx(1, abs=1e-6)


def test_head_and_trunk_are_two_boxes():
    trunk, head = (trimesh.creation.box(size) for size in [(0.2, 0.4, 0.5)] * 2)
    head.vertices = head.vertices * (0.5, 0.3, 0.5) + (0.05, 0, 0.375)
    found = fit(trimesh.util.concatenate([trunk, head]))
    assert [p.kind for p in found.primitives] == ["box", "box"]
    volumes = sorted(8 * p.size.prod() for p in found.primitives)
    # The cut is at one of 11 heights, at most a slab from the neck.
    np.testing.assert_allclose(volumes, [0.1 * 0.12 * 0.25, 0.2 * 0.4 * 0.5], rtol=0.3)
    assert found.excess < 1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_whole_mesh_is_inside(seed):
    rng = np.random.default_rng(seed)
    pieces = []
    for _ in range(rng.integers(1, 4)):
        piece = trimesh.creation.icosphere(subdivisions=1)
        turn = Rotation.random(random_state=rng).as_matrix()
        sizes, middle = rng.uniform(0.02, 0.3, 3), rng.uniform(-0.3, 0.3, 3)
        piece.vertices = piece.vertices * sizes @ turn.T + middle
        pieces.append(piece)
    mesh = trimesh.util.concatenate(pieces)
    turn = Rotation.random(random_state=rng).as_matrix()
    found = fit(mesh, turn)
    # Points on triangles, not only vertices: a cut goes through triangles.
    points = trimesh.sample.sample_surface(mesh, 2000, seed=seed % 2**31)[0]
    assert outside(found, np.concatenate((points, mesh.vertices))) < 1e-9
    assert len(found.primitives) <= 2


def test_a_flat_mesh_has_a_thickness():
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    found = fit(trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]))
    (primitive,) = found.primitives
    assert found.excess == np.inf
    assert primitive.kind == "box"
    assert primitive.size.tolist() == [0.5, 0.5, 5e-4]


CORNERS = [(x, y, z) for x in (0, 0.1) for y in (0, 0.2) for z in (0, 0.6)]


def with_mesh(more=""):
    """Return the walker with a box-shaped collision mesh on its trunk."""
    vertices = " ".join(str(v) for corner in CORNERS for v in corner)
    geom = '<geom type="mesh" mesh="m" mass="1" pos="0 0 0.4" friction="0.7 0.1 0.1"/>'
    return MODEL.replace(
        "<worldbody>",
        f'<asset><mesh name="m" vertex="{vertices}"/></asset><worldbody>',
    ).replace('<body name="left_arm"', f'{geom}{more}<body name="left_arm"')


def test_a_collision_mesh_of_an_mjcf_becomes_a_primitive(tmp_path):
    # A rock of the scene is not the robot's.
    rock = '<worldbody><geom type="mesh" mesh="m" pos="2 0 0"/>'
    model = with_mesh().replace("<worldbody>", rock)
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    fits, _ = fit_meshes(before.spec())
    assert [fit.link for fit in fits] == ["trunk"]
    robot = portable(before)
    np.testing.assert_allclose(robot.model.body_mass, before.model.body_mass, 1e-5)
    np.testing.assert_allclose(
        robot.model.body_inertia, before.model.body_inertia, 1e-5
    )
    (shape,) = [p for p in robot.primitives if abs(p.size[2] - 0.3) < 1e-4]
    assert (shape.link, shape.kind) == ("trunk", "box")
    np.testing.assert_allclose(shape.size, (0.05, 0.1, 0.3), atol=1e-5)
    np.testing.assert_allclose(shape.position, (0.05, 0.1, 0.7), atol=1e-5)
    geom = np.flatnonzero(np.abs(robot.model.geom_size[:, 2] - 0.3) < 1e-4).item()
    assert robot.model.geom_friction[geom].tolist() == [0.7, 0.1, 0.1]
    # Balls and floor meet it.
    assert robot.model.geom_conaffinity[geom] & 3 == 3


def test_two_parts_of_a_mesh_collide_alike(tmp_path):
    # A trunk and a narrow head.
    head = [(x, y, z) for x in (0, 0.02) for y in (0, 0.03) for z in (0.6, 0.9)]
    vertices = " ".join(str(v) for corner in CORNERS + head for v in corner)
    mesh = trimesh.util.concatenate(
        [trimesh.convex.convex_hull(np.array(points)) for points in (CORNERS, head)]
    )
    vertices, faces = (
        " ".join(map(str, np.array(each).ravel()))
        for each in (mesh.vertices, mesh.faces)
    )
    model = with_mesh()
    start, _, rest = model.partition("<asset>")
    model = (
        f'{start}<asset><mesh name="m" inertia="shell" vertex="{vertices}" '
        f'face="{faces}"/>{rest[rest.index("</asset>") :]}'
    )
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    own = [
        g for g in range(robot.model.ngeom) if robot.model.geom_friction[g, 0] == 0.7
    ]
    assert len(own) == 2
    for name in ("contype", "conaffinity", "friction", "solref", "bodyid"):
        values = getattr(robot.model, f"geom_{name}")[own]
        np.testing.assert_array_equal(values[0], values[1])


def test_links_that_overlap_because_of_their_meshes_do_not_collide(tmp_path):
    # The trunk's mesh reaches into an arm of its arm.
    model = with_mesh().replace(
        '<body name="right_arm"',
        '<body name="neck" pos="0 0 0.5"><joint name="neck" axis="0 0 1"/>'
        '<geom size="0.02" mass="1"/><body name="head" pos="0 0.1 0.2">'
        '<joint name="nod" axis="0 1 0"/><geom size="0.05" mass="1"/></body></body>'
        '<body name="right_arm"',
    )
    toml = (
        'model = "walker.xml"\nbase = "trunk"\nfeet = ["*_foot"]\n'
        'skin_links = ["trunk"]\n[gains.a]\n"*" = { kp = 20, kd = 1 }\n'
    )
    folder = write_robot(tmp_path / "walker", model=model)
    (folder / "robot.toml").write_text(toml)
    robot = portable(read_folder(folder))
    pairs = {tuple(sorted((e.bodyname1, e.bodyname2))) for e in robot.spec().excludes}
    assert ("head", "trunk") in pairs
    data = mujoco.MjData(robot.model)
    mujoco.mj_forward(robot.model, data)
    assert data.ncon == 0


URDF = """
<robot name="stump">
  <link name="hull">
    <inertial><mass value="3"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://stump/look.dae"/></geometry></visual>
    <collision><origin xyz="0 0 0.2" rpy="0 0 0"/>
      <geometry>
        <mesh filename="package://stump/meshes/hull.stl" scale="0.001 0.001 0.001"/>
      </geometry></collision>
  </link>
  <link name="foot">
    <inertial><mass value="1"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.3 0.2 0.04"/></geometry></collision>
    <collision><geometry><mesh filename="package://stump/meshes/lost.dae"/></geometry></collision>
  </link>
  <joint name="ankle" type="revolute">
    <parent link="hull"/><child link="foot"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="0.6" effort="30" velocity="1"/>
  </joint>
</robot>
"""
TOML = (
    'model = "stump.urdf"\nbase = "hull"\nfeet = ["foot"]\nskin_links = ["hull"]\n'
    "[gains.a]\nankle = { kp = 40, kd = 2 }\n"
)


@pytest.mark.parametrize("folder", ["meshes", "../meshes", "../../stump/meshes"])
def test_a_collision_mesh_of_a_urdf_is_found(folder, tmp_path):
    home = tmp_path / "stump" / "urdf"
    (home / folder).mkdir(parents=True)
    (home / "stump.urdf").write_text(URDF)
    (home / "robot.toml").write_text(TOML)
    trimesh.creation.box((100, 200, 300)).export(home / folder / "hull.stl")
    robot = portable(read_folder(home))
    hull, foot = robot.primitives
    assert (hull.link, hull.kind, foot.link) == ("hull", "box", "foot")
    np.testing.assert_allclose(hull.size, (0.05, 0.1, 0.15), atol=1e-6)
    np.testing.assert_allclose(hull.position, (0, 0, 0.2), atol=1e-6)
    assert robot.model.body_mass.sum() == pytest.approx(4)
    out = succeed("robot", "check", home)
    assert "1.0 to 1.0 times the volume of their convex hulls: hull (box)" in out
    assert "foot: collision meshes that are not found, or neither STL nor OBJ" in out
