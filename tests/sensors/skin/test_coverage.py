"""Coverage of a sensor: beams compared with values by hand; invalid coverages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egoskin.sensors import Field, Ray
from sensing import along_axes


def test_the_default_view_is_63_degrees_from_corner_to_corner():
    # tan(31.5 deg) = .61280; over sqrt(2) .43332. Along an axis 2 atan(.43332)
    # = 46.86 deg. Zones are 2 * .43332 / 8 = .10833 wide.
    ray = Ray()
    assert ray.num_beams == 64
    assert ray.half_extent == pytest.approx(0.43332, abs=1e-5)
    assert 2 * math.degrees(math.atan(ray.half_extent)) == pytest.approx(
        46.86, abs=0.01
    )
    beams = ray.directions()
    assert beams.shape == (64, 3)
    tangent = beams[:, :2] / beams[:, 2:]
    # The first zone's centre: half a zone from the edge, .43332 - .05416 = .37916.
    assert tangent[0] == pytest.approx([-0.37916, -0.37916], abs=1e-5)
    # Row by row: the next zone is one to the right in x, the next row one up in y.
    assert tangent[1] - tangent[0] == pytest.approx([0.10833, 0], abs=1e-5)
    assert tangent[8] - tangent[0] == pytest.approx([0, 0.10833], abs=1e-5)
    assert tangent[63] == pytest.approx([0.37916, 0.37916], abs=1e-5)
    # The corner beam: atan(sqrt(2) * .37916) = 28.2 deg off the axis.
    corner = math.degrees(math.acos(beams[0, 2]))
    assert corner == pytest.approx(28.2, abs=0.01)


def test_a_view_along_each_axis_is_one_from_corner_to_corner():
    # The data sheet's 45 degrees along each axis: tan(22.5 deg) = sqrt(2) - 1.
    assert along_axes(45) == pytest.approx(60.7, abs=0.05)
    ray = Ray(grid=(2, 2), fov_deg=along_axes(45))
    assert ray.half_extent == pytest.approx(math.sqrt(2) - 1)
    # Centres of two zones: at half of the half extent.
    tangent = ray.directions()[:, :2] / ray.directions()[:, 2:]
    half = (math.sqrt(2) - 1) / 2
    expected = [[-half, -half], [half, -half], [-half, half], [half, half]]
    np.testing.assert_allclose(tangent, expected, atol=1e-12)


def test_rows_lie_along_y_and_columns_along_x():
    # fov 90 along each axis: tangents from -1 to 1; one row, four columns.
    beams = Ray(grid=(1, 4), fov_deg=along_axes(90)).directions()
    np.testing.assert_allclose(beams[:, 0] / beams[:, 2], [-0.75, -0.25, 0.25, 0.75])
    np.testing.assert_allclose(beams[:, 1], 0, atol=1e-15)


@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.floats(0.1, 179),
)
def test_beams_are_unit_symmetric_and_inside_the_view(rows, columns, angle):
    ray = Ray(grid=(rows, columns), fov_deg=angle)
    beams = ray.directions()
    assert beams.shape == (ray.num_beams, 3)
    np.testing.assert_allclose(np.linalg.norm(beams, axis=-1), 1, atol=1e-12)
    tangent = beams[..., :2] / beams[..., 2:]
    assert (np.abs(tangent) < ray.half_extent).all()
    # Rotated by half a turn about the normal, the last beam becomes the first.
    np.testing.assert_allclose(beams[::-1] * [-1, -1, 1], beams, atol=1e-12)
    # No beam deviates more from the normal than half the diagonal.
    assert (beams[..., 2] > math.cos(math.radians(angle / 2)) - 1e-12).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Field(half_angle_deg=0), "half_angle_deg must be positive, got 0"),
        (lambda: Field(half_angle_deg=180.5), "half_angle_deg must be at most 180"),
        (
            lambda: Field(half_angle_deg=math.nan),
            "half_angle_deg must be a finite number, got nan",
        ),
        (lambda: Ray(grid=(0, 8)), r"grid must be two positive integers, got \(0, 8\)"),
        (lambda: Ray(grid=(8,)), "grid must be two positive integers"),
        (lambda: Ray(grid=8), "grid must be two positive integers, got 8"),
        (lambda: Ray(fov_deg=180), "fov_deg must be below 180, got 180"),
        (lambda: Ray(fov_deg=math.nan), "fov_deg must be a finite number"),
        (lambda: Ray(grid=(10**9, 1)), "grid must be at most 1,024, got"),
        (lambda: Ray(measure="distance"), "measure must be one of beam, depth"),
    ],
)
def test_what_is_no_coverage_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
