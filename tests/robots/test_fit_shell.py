"""The fit of the shell, on meshes made from the shell itself instead of real data."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from calling import call
from egoskin.robots.builtin import H1_2

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

SCRIPT = Path(__file__).parents[2] / "scripts" / "fit_shell.py"
spec = importlib.util.spec_from_file_location("fit_shell", SCRIPT)
fit_shell = importlib.util.module_from_spec(spec)
sys.modules["fit_shell"] = fit_shell  # dataclasses look their module up
spec.loader.exec_module(fit_shell)


def primitive_mesh(kind: int, size: np.ndarray):
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=4, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[64, 64])
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return trimesh.creation.box(2 * size)


def write_meshes(directory: Path, grow: float = 0.0) -> Path:
    """Write an STL of each link's primitives, grown outwards [m]; return the folder."""
    model = H1_2.model
    for link in H1_2.links:
        # Links without a shape still need a file: a speck inside their neighbours.
        meshes = [trimesh.creation.icosphere(subdivisions=1, radius=1e-3)]
        for geom in np.flatnonzero(model.geom_bodyid == model.body(link).id):
            kind, size = model.geom_type[geom], model.geom_size[geom].copy()
            size[: 3 if kind == mujoco.mjtGeom.mjGEOM_BOX else 1] += grow
            mesh = primitive_mesh(kind, size)
            transform = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
            transform[:3, 3] = model.geom_pos[geom]
            meshes.append(mesh.apply_transform(transform))
        name = "wrist_yaw_link" if link.endswith("wrist_yaw_link") else link
        trimesh.util.concatenate(meshes).export(directory / f"{name}.STL")
    return directory


@pytest.fixture(scope="module")
def own_meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_meshes(tmp_path_factory.mktemp("own"))


def measure(meshes: Path, samples: int = 1500) -> list:
    options = fit_shell.Options(meshes=meshes, samples=samples)
    return list(fit_shell.measure(options))


def test_own_surface_is_at_distance_zero_up_to_point_spacing(own_meshes):
    fits = measure(own_meshes)
    assert [fit.region for fit in fits] == list(fit_shell.REGIONS)
    for fit in fits:
        # 0.4 m^2 of torso over 1500 points: 16 mm apart, nearest at half of that.
        limit = 0.010 if fit.region == "torso" else 0.006
        assert fit.ours_to_mesh.mean() < limit, fit.region
        assert fit.mesh_to_ours.mean() < limit / 2, fit.region


@pytest.mark.slow
def test_distance_on_own_surface_shrinks_with_more_samples(own_meshes):
    coarse, fine = measure(own_meshes, 400), measure(own_meshes, 1600)
    for few, many in zip(coarse, fine, strict=True):
        # Spacing goes with the root of the count: 4 times the points, half of it.
        ratio = many.ours_to_mesh.mean() / few.ours_to_mesh.mean()
        assert ratio == pytest.approx(0.5, abs=0.1), many.region


def test_offset_of_20_mm_is_measured_as_20_mm(tmp_path):
    for fit in measure(write_meshes(tmp_path, grow=0.02)):
        # Edges, ends and spacing add to the offset; seams between shapes reduce it.
        # The grown chest ends above the height that parts torso and head: a loose
        # bound for those two.
        slack = 0.003 if "arm" in fit.region else 0.010
        both = (fit.ours_to_mesh.mean() + fit.mesh_to_ours.mean()) / 2
        assert both == pytest.approx(0.0205, abs=slack), fit.region


def test_sphere_inside_a_box_is_no_outer_shell(tmp_path):
    write_meshes(tmp_path)
    # The torso alone: a cube of 0.3 m, and within it a ball that no view reaches.
    box, ball = (
        trimesh.creation.box((0.3, 0.3, 0.3)),
        trimesh.creation.icosphere(4, 0.1),
    )
    for mesh in (box, ball):
        mesh.apply_translation((0.0, 0.0, 0.25))
    trimesh.util.concatenate([box, ball]).export(tmp_path / "torso_link.STL")
    data = fit_shell.default_data()
    torso = fit_shell.posed_mesh(data, tmp_path, ["torso_link"])
    robot = fit_shell.posed_mesh(data, tmp_path, H1_2.links)
    options = fit_shell.Options(meshes=tmp_path, samples=1000)
    points, outer = fit_shell.mesh_points(torso, robot, (-np.inf, np.inf), options)
    local = points - data.body("torso_link").xpos - (0.0, 0.0, 0.25)
    on_ball = np.linalg.norm(local, axis=1) < 0.101
    # Areas 4 pi 0.1^2 = 0.126 and 6 x 0.3^2 = 0.54: 19 % of the points are the ball's.
    assert 0.15 < on_ball.mean() < 0.23
    assert not outer[on_ball].any()
    assert outer[~on_ball].mean() > 0.7


def test_missing_directory_is_one_line_and_status_2(tmp_path):
    result = call("fit_shell.py", "--meshes", tmp_path / "none")
    assert result.returncode == 2
    assert result.stderr == f"fit_shell: no such mesh directory: {tmp_path / 'none'}\n"


def test_missing_mesh_names_the_file(own_meshes, tmp_path, capsys):
    for file in own_meshes.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "left_elbow_link.STL").unlink()
    assert fit_shell.main(fit_shell.Options(meshes=tmp_path)) == 2
    error = capsys.readouterr().err
    assert str(tmp_path / "left_elbow_link.STL") in error
    assert error.count("\n") == 1


def test_status_tells_a_good_fit_from_a_poor_one(own_meshes, capsys):
    def status(limit_mm: float) -> int:
        options = fit_shell.Options(meshes=own_meshes, samples=300, limit_mm=limit_mm)
        return fit_shell.main(options)

    assert status(40.0) == 0
    assert status(0.1) == 1
    assert "over the 0.1 mm limit" in capsys.readouterr().err
