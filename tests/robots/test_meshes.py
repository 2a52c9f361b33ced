"""Primitives in place of collision meshes."""

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calling import succeed
from egoskin.robots.meshes import around_mesh
from egoskin.robots.own import read_folder
from egoskin.robots.portable import make_portable, portable
from egoskin.robots.surface import distance_to, sample_surface
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
    np.testing.assert_allclose(primitive.size, size, atol=3e-5)
    np.testing.assert_allclose(primitive.rotation, turn, atol=1e-6)
    assert found.excess == pytest.approx(1, abs=1e-3)


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
    np.testing.assert_allclose(primitive.size, [0.5, 0.5, 5e-4], atol=3e-5)


BOX = trimesh.creation.box(bounds=[(0, 0, 0), (0.1, 0.2, 0.6)])


def with_mesh(mesh=BOX, inertia="convex"):
    """Return the walker with a collision mesh on its trunk."""
    vertices, faces = (
        " ".join(map(str, np.array(each).ravel()))
        for each in (mesh.vertices, mesh.faces)
    )
    asset = f'<mesh name="m" inertia="{inertia}" vertex="{vertices}" face="{faces}"/>'
    geom = '<geom type="mesh" mesh="m" mass="1" pos="0 0 0.4" friction="0.7 0.1 0.1"/>'
    return MODEL.replace("<worldbody>", f"<asset>{asset}</asset><worldbody>").replace(
        '<body name="left_arm"', f'{geom}<body name="left_arm"'
    )


def test_a_collision_mesh_of_an_mjcf_becomes_a_primitive(tmp_path):
    # A rock of the scene is not the robot's.
    rock = '<worldbody><geom type="mesh" mesh="m" pos="2 0 0"/>'
    model = with_mesh().replace("<worldbody>", rock)
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    made = make_portable(before)
    assert [fit.link for fit in made.fits] == ["trunk"]
    robot = made.robot
    np.testing.assert_allclose(robot.model.body_mass, before.model.body_mass, 1e-5)
    np.testing.assert_allclose(
        robot.model.body_inertia, before.model.body_inertia, 1e-5
    )
    (shape,) = [p for p in robot.primitives if abs(p.size[2] - 0.3) < 1e-4]
    assert (shape.link, shape.kind) == ("trunk", "box")
    np.testing.assert_allclose(shape.size, (0.05, 0.1, 0.3), atol=3e-5)
    np.testing.assert_allclose(shape.position, (0.05, 0.1, 0.7), atol=1e-5)
    geom = np.flatnonzero(np.abs(robot.model.geom_size[:, 2] - 0.3) < 1e-4).item()
    assert robot.model.geom_friction[geom].tolist() == [0.7, 0.1, 0.1]
    # Balls and floor meet it.
    assert robot.model.geom_conaffinity[geom] & 3 == 3


@pytest.mark.parametrize(
    ("size", "kinds"),
    [
        ((0.1, 0.1, 0.1), ["sphere"]),
        ((0.05, 0.05, 0.3), ["capsule"]),
        ((0.02, 0.2, 0.3), ["box"]),
    ],
)
def test_an_ellipsoid_becomes_a_primitive_around_it(size, kinds, tmp_path):
    geom = (
        '<geom type="ellipsoid" mass="1" pos="0.1 0 0.4" euler="0 30 0" '
        f'size="{size[0]} {size[1]} {size[2]}"/>'
    )
    model = MODEL.replace('<body name="left_arm"', f'{geom}<body name="left_arm"')
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    made = make_portable(before)
    np.testing.assert_allclose(made.robot.model.body_mass, before.model.body_mass, 1e-5)
    (fit,) = made.fits
    assert fit.link == "trunk"
    assert [each.kind for each in fit.primitives] == kinds
    own = before.model.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    rotation = Rotation.from_quat(before.model.geom_quat[own][0], scalar_first=True)
    sphere = trimesh.creation.icosphere(subdivisions=4).vertices
    points = rotation.apply(sphere * size) + before.model.geom_pos[own]
    # It touches a polyhedron that is 1 % larger.
    assert -0.012 * max(size) < outside(fit, points) <= 0
    # A box around an ellipsoid has 1.91 times its volume.
    assert 1 < fit.excess < 1.95


def test_two_parts_of_a_mesh_collide_alike(tmp_path):
    # A trunk and a narrow head.
    head = trimesh.creation.box(bounds=[(0, 0, 0.6), (0.02, 0.03, 0.9)])
    model = with_mesh(trimesh.util.concatenate([BOX, head]), "shell")
    own = 'condim="6" priority="1" group="1" solmix="2" rgba="1 0 0 1" friction="0.7'
    model = model.replace('friction="0.7', own)
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    own = [
        g for g in range(robot.model.ngeom) if robot.model.geom_friction[g, 0] == 0.7
    ]
    assert len(own) == 2
    names = ("contype", "conaffinity", "condim", "priority", "group", "rgba")
    for name in (*names, "friction", "solmix", "solref", "bodyid"):
        values = getattr(robot.model, f"geom_{name}")[own]
        np.testing.assert_array_equal(values[0], values[1])


def test_a_mesh_in_a_frame_is_where_the_file_puts_it(tmp_path):
    model = with_mesh()
    start, end = model.index('<geom type="mesh"'), model.index('<body name="left_arm"')
    mesh = model[start:end]
    posed = (
        f'<frame pos="0.3 0 0" euler="0 0 0.5">{mesh}{mesh.replace("mesh", "box", 1)}'
    )
    model = model[:start] + posed + "</frame>" + model[end:]
    before = read_folder(write_robot(tmp_path / "walker", model=model))
    after = portable(before)
    tall = [np.abs(r.model.geom_size[:, 2] - 0.3) < 1e-3 for r in (before, after)]
    # One that is around the mesh, and one that MuJoCo fits to it.
    (box,) = before.model.geom_pos[tall[0]][-1:]
    found = after.model.geom_pos[tall[1]]
    assert len(found) == 2
    np.testing.assert_allclose(found, [box, box], atol=1e-4)


def test_a_robot_whose_meshes_are_shown_in_place_of_its_shapes_is_seen(tmp_path):
    model = with_mesh().replace('<geom type="mesh"', '<geom group="3" type="mesh"')
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    assert robot.model.geom_group.max() == 0


def test_what_looks_at_a_deleted_body_is_deleted_first(tmp_path):
    scene = '<body name="post"/><camera name="c" mode="targetbody" target="post"/>'
    model = with_mesh().replace("<worldbody>", f"<worldbody>{scene}")
    robot = portable(read_folder(write_robot(tmp_path / "walker", model=model)))
    assert robot.model.ncam == 0
    assert "post" not in (robot.model_xml or "post")


def test_no_sensor_is_between_the_parts_of_a_mesh(tmp_path):
    rng = np.random.default_rng(0)
    cut = 0
    for _ in range(6):
        pieces = []
        # Above 1 m, the six digits of an MJCF are steps of 10 micrometres.
        for height, width in ((1, 0.3), (1.25, 0.1)):
            piece = trimesh.creation.box((width, width, 0.25))
            piece.vertices = piece.vertices + (0, 0, height) + rng.normal(size=3) / 100
            pieces.append(piece)
        model = with_mesh(trimesh.util.concatenate(pieces))
        made = make_portable(read_folder(write_robot(tmp_path / "walker", model=model)))
        (fit,) = made.fits
        cut += len(fit.primitives) == 2
        points = sample_surface(made.robot, ["trunk"], 2000, 0).position
        depth = [-distance_to(part, points) for part in fit.primitives]
        # On the surface of both is between them.
        assert (np.max(np.abs(depth), axis=0) < 1e-4).sum() <= 3
    assert cut


def test_a_mesh_that_collides_by_pairs_alone_is_one_primitive(tmp_path):
    plate, rod = (trimesh.creation.box(s) for s in ((0.3, 0.3, 0.2), (0.05, 0.05, 0.8)))
    model = with_mesh(trimesh.util.concatenate([plate, rod]))
    pairs = '<contact><pair geom1="hull" geom2="hand"/></contact><actuator>'
    alone = model.replace("<actuator>", pairs).replace(
        '<geom type="mesh"', '<geom name="hull" contype="0" conaffinity="0" type="mesh"'
    )
    hand = '<body name="right_arm" pos="0 -0.25 0.3">'
    alone = alone.replace(
        hand, f'{hand}<geom name="hand" size="0.01" contype="0" conaffinity="0"/>'
    )
    for text, number in ((model, 2), (alone, 1)):
        folder = write_robot(tmp_path / "walker", model=text)
        (fit,) = make_portable(read_folder(folder)).fits
        assert len(fit.primitives) == number


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
    # Without an effect here: the scene has options of its own.
    off = model.replace(
        "<worldbody>", '<option><flag contact="disable"/></option><worldbody>', 1
    )
    (folder / "walker.xml").write_text(off)
    assert portable(read_folder(folder)).spec().excludes
    pairs = {tuple(sorted((e.bodyname1, e.bodyname2))) for e in robot.spec().excludes}
    assert ("head", "trunk") in pairs
    data = mujoco.MjData(robot.model)
    mujoco.mj_forward(robot.model, data)
    assert data.ncon == 0


def test_links_that_overlap_in_the_default_pose_alone_do_not_collide(tmp_path):
    # Half a turn of the neck takes the head from beside the trunk's mesh into it.
    model = with_mesh().replace(
        '<body name="right_arm"',
        '<body name="neck" pos="0.05 0 0.7"><joint name="neck" axis="0 0 1" '
        'range="-4 4"/><geom size="0.01" mass="1"/>'
        '<body name="head" pos="0 -0.15 0"><joint name="nod" axis="0 1 0"/>'
        '<geom size="0.02" mass="1"/></body></body><body name="right_arm"',
    )
    for pose, excluded in (("0", False), ("3.14159", True)):
        toml = (
            'model = "walker.xml"\nbase = "trunk"\nfeet = ["*_foot"]\n'
            'skin_links = ["trunk"]\n'
            f"[default_pose]\nneck = {pose}\n"
            '[gains.a]\n"*" = { kp = 20, kd = 1 }\n'
        )
        robot = portable(read_folder(write_robot(tmp_path, toml, model)))
        pairs = [{e.bodyname1, e.bodyname2} for e in robot.spec().excludes]
        assert ({"head", "trunk"} in pairs) == excluded


URDF = """
<robot name="stump">
  <link name="hull">
    <inertial><mass value="3"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://stump/look.dae"/></geometry></visual>
    <collision><origin xyz="0 0 0.2" rpy="0 0 1.570796"/>
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


# Unitree's files keep visual geoms.
KEPT = '<mujoco><compiler discardvisual="false"/></mujoco>'


@pytest.mark.parametrize("visuals", ["", KEPT])
@pytest.mark.parametrize("folder", ["meshes", "../meshes", "../../stump/meshes"])
def test_a_collision_mesh_of_a_urdf_is_found(folder, visuals, tmp_path):
    home = tmp_path / "stump" / "urdf"
    (home / folder).mkdir(parents=True)
    urdf = URDF.replace("stump/look.dae", "stump/meshes/look.stl")
    # A second thing in the file's world is not the robot.
    table = """<link name="world"/><link name="table"><collision><geometry>
      <mesh filename="meshes/hull.stl"/></geometry></collision></link>
      <joint name="a" type="fixed"><parent link="world"/><child link="table"/></joint>
      <joint name="b" type="floating"><parent link="world"/><child link="hull"/></joint>
    """
    urdf = urdf.replace("<link", f"{visuals}{table}<link", 1)
    (home / "stump.urdf").write_text(urdf)
    (home / "robot.toml").write_text(TOML)
    trimesh.creation.box((100, 200, 300)).export(home / folder / "hull.stl")
    trimesh.creation.box((1, 1, 1)).export(home / folder / "look.stl")
    robot = portable(read_folder(home))
    hull, foot = robot.primitives
    assert (hull.link, hull.kind, foot.link) == ("hull", "box", "foot")
    # A quarter turn about z: x and y change places.
    np.testing.assert_allclose(hull.size, (0.1, 0.05, 0.15), atol=3e-5)
    np.testing.assert_allclose(hull.position, (0, 0, 0.2), atol=1e-6)
    assert robot.model.body_mass.sum() == pytest.approx(4)
    out = succeed("robot", "check", home)
    assert "1.0 to 1.0 times the volume of their convex hulls: hull (box)" in out
    assert "  note   foot: collision meshes that are not found, or neither" in out


def test_a_mesh_of_a_urdf_is_found_in_its_folder_of_meshes(tmp_path):
    folder = '<mujoco><compiler meshdir="shapes"/></mujoco><link'
    (tmp_path / "stump.urdf").write_text(URDF.replace("<link", folder, 1))
    (tmp_path / "robot.toml").write_text(TOML)
    (tmp_path / "shapes").mkdir()
    trimesh.creation.box((100, 200, 300)).export(tmp_path / "shapes" / "hull.stl")
    made = make_portable(read_folder(tmp_path))
    assert [fit.link for fit in made.fits] == ["hull"]
    assert made.lost == ["foot"]
