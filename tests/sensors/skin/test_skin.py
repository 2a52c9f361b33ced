"""The skin, its sensor frames and its file."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, Ray, Skin
from egoskin.sensors.config import SkinConfig
from egoskin.sensors.skin.gentact import save_gentact


def make_skin(normal, **changes) -> Skin:
    normal = np.atleast_2d(np.asarray(normal, float))
    fields = {
        "robot": "h1_2",
        "links": ("torso_link",) * len(normal),
        "position": np.zeros_like(normal),
        "normal": normal,
    }
    return Skin(**{**fields, **changes})


UNIT = (
    arrays(float, 3, elements=st.floats(-1, 1))
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)


# --- frames ---------------------------------------------------------------------


@given(UNIT)
def test_sensor_frames_are_right_handed_with_z_along_the_normal(normal):
    (frame,) = make_skin(normal).rotation()
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)
    np.testing.assert_allclose(frame[:, 2], normal, atol=1e-15)
    # x = normalise(z_link x n): horizontal in the link frame, unless n is parallel.
    if np.hypot(*normal[:2]) > 1e-3:
        across = np.array([-normal[1], normal[0], 0]) / np.hypot(*normal[:2])
        np.testing.assert_allclose(frame[:, 0], across, atol=1e-6)


@pytest.mark.parametrize(
    ("normal", "x", "y"),
    [
        ([1, 0, 0], [0, 1, 0], [0, 0, 1]),  # z x x = y, then y = z_sensor x x_sensor
        ([0, 1, 0], [-1, 0, 0], [0, 0, 1]),
        ([0, 0, 1], [1, 0, 0], [0, 1, 0]),  # parallel: x_link
        ([0, 0, -1], [1, 0, 0], [0, -1, 0]),
    ],
)
def test_sensor_frames_by_hand(normal, x, y):
    (frame,) = make_skin(normal).rotation()
    np.testing.assert_allclose(frame, np.array([x, y, normal]).T, atol=1e-12)


@given(UNIT, st.floats(0.9991, 1.0009))
def test_frames_are_orthonormal_whatever_digits_the_normals_have(normal, length):
    (frame,) = make_skin(length * normal).rotation()
    (exact,) = make_skin(normal).rotation()
    np.testing.assert_allclose(frame, exact, atol=1e-9)


@given(st.floats(-1e-5, 1e-5), st.floats(-1e-5, 1e-5))
def test_frames_stay_orthonormal_where_the_convention_switches(a, b):
    normal = np.array([a, b, 1.0])
    (frame,) = make_skin(normal / np.linalg.norm(normal)).rotation()
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)


def test_a_misplaced_skin_is_off_by_the_deviations_given():
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((4000, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    skin = make_skin(normal, roll_deg=rng.uniform(-180, 180, 4000))
    moved = skin.misplaced(0.002, 3.0, seed=1)
    assert (moved.position - skin.position).std() == pytest.approx(0.002, rel=0.03)
    turn = moved.rotation() @ skin.rotation().transpose(0, 2, 1)
    # Rotation vector from the antisymmetric part: sin(angle) k.
    vector = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1) - np.stack(
        [turn[:, 1, 2], turn[:, 2, 0], turn[:, 0, 1]], -1
    )
    np.testing.assert_allclose(np.degrees(vector / 2).std(0), [3.0] * 3, rtol=0.05)
    again = skin.misplaced(0.002, 3.0, seed=1)
    np.testing.assert_array_equal(again.normal, moved.normal)
    assert moved.provenance["misplaced"]["seed"] == 1
    other = skin.misplaced(0.002, 3.0, seed=2)
    assert not np.isclose(other.position, moved.position).all(-1).any()
    assert not np.isclose(other.normal, moved.normal).all(-1).any()


def test_a_skin_misplaced_by_nothing_has_its_own_frames():
    skin = make_skin([[1, 0, 0], [0.6, 0, 0.8], [0, 0, 1]], roll_deg=[0, 30, -100])
    still = skin.misplaced(0.0, 0.0, seed=0)
    np.testing.assert_allclose(still.rotation(), skin.rotation(), atol=1e-12)
    for wrong in (-0.1, np.inf, np.nan):
        with pytest.raises(ValueError, match="angle_std_deg must be finite"):
            skin.misplaced(0.0, wrong, seed=0)


# --- file -----------------------------------------------------------------------


def test_an_infinite_range_numpys_integers_and_a_path_are_saved_as_json(tmp_path):
    grid = (np.int64(2), np.int64(3))
    skin = make_skin(
        [[1, 0, 0]],
        range=[np.inf],
        coverage=(Ray(grid=grid),),
        provenance={"of": tmp_path},
    )
    path = tmp_path / "skin.json"
    skin.save(path)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    json.loads(path.read_text(), parse_constant=refuse)
    loaded = Skin.load(path)
    assert loaded.range.tolist() == [np.inf]
    assert loaded.coverage == skin.coverage
    assert loaded.provenance == {"of": str(tmp_path)}
    assert save_gentact(skin, tmp_path / "skin.csv") == ("coverage", "range")


def test_types_keep_their_names_and_new_ones_are_numbered():
    content = skin_content(SENSOR | {"type": "type_2"}, SENSOR | {"type": "palm"})
    content["types"] = {"palm": {"coverage": "ray"}, "type_2": {"coverage": "field"}}
    skin = Skin.from_dict(content)
    skin = replace(skin, coverage=(*skin.coverage[:1], Field(half_angle_deg=30)))
    types = skin.to_dict()["types"]
    assert {name: type_["coverage"] for name, type_ in types.items()} == {
        "type_2": "field",
        "type_1": "field",
        "palm": "ray",
    }
    assert Skin.from_dict(skin.to_dict()).coverage == skin.coverage
    assert [s["type"] for s in skin.to_dict()["sensors"]] == ["type_2", "type_1"]


def test_a_saved_skin_is_the_same_skin(skin, tmp_path):
    skin.save(tmp_path / "skin.json")
    loaded = Skin.load(tmp_path / "skin.json")
    assert loaded.links == skin.links
    assert loaded.robot == skin.robot
    assert loaded.provenance == skin.provenance
    np.testing.assert_array_equal(loaded.position, skin.position)
    np.testing.assert_array_equal(loaded.normal, skin.normal)


def test_ranges_rolls_and_radii_are_saved(tmp_path):
    values = {
        "range": [0.5, np.nan, 2],
        "roll_deg": [-100, 0, 30.5],
        "radius": [np.nan, 0.004, 0.02],
    }
    skin = make_skin([[1, 0, 0]] * 3, **values)
    skin.save(tmp_path / "skin.json")
    loaded = Skin.load(tmp_path / "skin.json")
    for name, value in values.items():
        np.testing.assert_array_equal(getattr(loaded, name), value)


def test_the_file_is_json_with_one_sensor_on_each_line(skin, tmp_path):
    path = tmp_path / "skin.json"
    skin.save(path)
    text = path.read_text()
    assert json.loads(text)["conventions"]["position"].startswith("metres")
    lines = [line for line in text.splitlines() if '"link"' in line]
    assert len(lines) == len(skin)
    assert json.loads(lines[3].strip().rstrip(","))["link"] == skin.links[3]
    assert max(map(len, text.splitlines())) < 160


def test_saving_a_loaded_skin_changes_no_byte(skin, tmp_path):
    skin.save(tmp_path / "a.json")
    Skin.load(tmp_path / "a.json").save(tmp_path / "b.json")
    assert (tmp_path / "a.json").read_text() == (tmp_path / "b.json").read_text()


SENSOR = {"link": "torso_link", "position": [0, 0, 0], "normal": [0, 0, 1]}


def without(content: dict, name: str) -> dict:
    return {key: value for key, value in content.items() if key != name}


def skin_content(*sensors: object) -> dict:
    return {"format": "egoskin-skin-1", "robot": "h1_2", "sensors": list(sensors)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{ no json", "Expecting"),
        ("[1, 2]", r"not a skin: .* got \[1, 2\]"),
        ({"robot": "h1_2"}, "not a skin: 'format' must be 'egoskin-skin-1', got None"),
        (without(skin_content(SENSOR), "robot"), "needs the field 'robot'"),
        (without(skin_content(SENSOR), "sensors"), "needs the field 'sensors'"),
        (skin_content(), "at least one sensor"),
        (
            {**skin_content(SENSOR), "type": {}},
            "a skin: unknown field 'type', did you mean 'types'",
        ),
        (
            skin_content(SENSOR, {**SENSOR, "range": -1}, SENSOR),
            "range of sensor 1 must be positive, got -1",
        ),
        (
            skin_content(SENSOR, without(SENSOR, "normal")),
            "sensor 1 lacks the field 'normal'",
        ),
        (
            skin_content(SENSOR, {**SENSOR, "position": [0, 1]}),
            r"sensor 1: 'position' must be three numbers, got \[0, 1\]",
        ),
        (
            skin_content({**SENSOR, "position": [0, 1, "a"]}),
            "sensor 0: 'position' must be three numbers",
        ),
        (
            skin_content(SENSOR, {**SENSOR, "normal": [0, 0, 2]}),
            "normal of sensor 1 has length 2.0000, not 1",
        ),
        (
            skin_content(SENSOR, {**SENSOR, "position": [3, 120, -40]}),
            "sensor 1 lies 127 m from the origin of its link: .* in metres",
        ),
        (
            skin_content({**SENSOR, "position": [0, 0, float("nan")]}),
            r"sensor 0: 'position' must be three numbers, got \[0, 0, nan\]",
        ),
        (skin_content({**SENSOR, "normal": [0, 10**400, 0]}), "'normal' must be three"),
        (skin_content({**SENSOR, "range": 10**400}), "'range' must be a number"),
        (skin_content({**SENSOR, "radius": float("nan")}), "'radius' must be a number"),
        (skin_content({**SENSOR, "radius": "inf"}), "'radius' must be a number"),
        (
            skin_content({**SENSOR, "roll_deg": [9]}),
            r"'roll_deg' must be a number, got",
        ),
        ("1" * 5000, "limit"),
        ("[" * 100_000, "nested too deeply"),
        ({**skin_content(), "sensors": None}, "'sensors' must be a list, got None"),
        (skin_content(5), "sensor 0 must be an object, got 5"),
        (skin_content({**SENSOR, "link": 3}), "sensor 0: 'link' must be a name, got 3"),
        (skin_content({**SENSOR, "type": [1]}), r"sensor 0: there is no type \[1\]"),
        ({**skin_content(SENSOR), "robot": 4}, "'robot' must be a name, got 4"),
        ({**skin_content(SENSOR), "types": [1]}, "'types' must be an object, got"),
        ({**skin_content(SENSOR), "types": {"a": 3}}, "type 'a' must be an object"),
        *(
            (
                {**skin_content(SENSOR), "types": {"a": {"coverage": "ray", **entry}}},
                f"type 'a': {message}",
            )
            for entry, message in (
                ({"coverage": ["ray"]}, "'coverage' must be one of field, ray"),
                ({"grid": 5}, r"'grid' must be like \[8, 8\], got 5"),
                ({"grid": [8.5, 8]}, "grid must be two positive integers"),
                ({"fov_deg": 10**400}, "fov_deg must fit into 64 bits"),
                ({"fov_deg": "63"}, "'fov_deg' must be like 63.0, got '63'"),
                ({"measure": 1.5}, "'measure' must be like \"beam\", got 1.5"),
                ({"sub_beams": 3}, "'sub_beams' was removed; only 1 .* got 3"),
            )
        ),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_its_fault(tmp_path, content, message):
    path = tmp_path / "bad.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=f"bad.json: .*{message}"):
        Skin.load(path)


def test_a_type_of_an_older_file_is_the_same_without_what_was_dropped():
    ray = {"fov": "diagonal", "beams": "centres", "sub_beams": 1, "measure": "depth"}
    types = {
        "ray": {"coverage": "ray", "grid": [4, 4], **ray},
        "field": {"coverage": "field", "half_angle_deg": 90.0, "measure": "surface"},
    }
    skin = Skin.from_dict({**skin_content(SENSOR), "types": types})
    assert skin.types == {
        "ray": Ray(grid=(4, 4), measure="depth"),
        "field": Field(half_angle_deg=90),
    }


def test_a_skin_of_another_robot_is_refused_though_its_links_are_named_alike(tmp_path):
    path = tmp_path / "other.json"
    path.write_text(json.dumps({**skin_content(SENSOR), "robot": "g1"}))
    with pytest.raises(ValueError, match=r"other.json: made for the robot 'g1', not"):
        SkinConfig(path=path).build(H1_2)
    path.write_text(json.dumps(skin_content(SENSOR)))
    assert SkinConfig(path=path).build(H1_2).links == ("torso_link",)


def test_a_missing_file_is_refused_with_its_name():
    with pytest.raises(ValueError, match=r"nowhere.json: .*No such file"):
        Skin.load(Path("nowhere.json"))


@pytest.mark.parametrize("name", ["position", "normal"])
def test_arrays_of_the_wrong_shape_are_refused(name):
    with pytest.raises(ValueError, match=rf"{name} must be \(1, 3\), got \(2, 3\)"):
        replace(make_skin([0, 0, 1]), **{name: np.zeros((2, 3))})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"position": [[0, 0, 120.0]]}, "sensor 0 lies 120 m .* in metres"),
        ({"radius": [math.inf]}, "radius holds values that are infinite"),
    ],
)
def test_what_no_file_may_hold_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        replace(make_skin([0, 0, 1]), **values)


def test_sensors_are_selected_by_index_or_flag(skin):
    for index in ([0, 2], np.array([0, 2]), np.isin(np.arange(64), [0, 2])):
        assert skin.select(index).position.tolist() == skin.position[[0, 2]].tolist()
    assert skin.select([2, 0]).links == (skin.links[2], skin.links[0])
    with pytest.raises(ValueError, match=r"must be \(64,\), one for each, got \(2,\)"):
        skin.select([True, False])
    with pytest.raises(ValueError, match="no sensor 64: there are 64"):
        skin.select([0, 64])


@pytest.mark.parametrize("coverage", [Ray(), ("ray",)])
def test_a_coverage_that_is_none_is_refused(coverage):
    with pytest.raises(ValueError, match="a Ray or None for each sensor, got"):
        replace(make_skin([0, 0, 1]), coverage=coverage)


def test_lists_are_taken_for_arrays_and_a_name_for_links_is_refused():
    lists = {"position": [[0, 0, 1]], "normal": [[0, 0, 1]], "range": [2]}
    skin = Skin(robot="h1_2", links=("torso_link",), **lists)
    assert skin.position.tolist() == [[0, 0, 1]]
    with pytest.raises(
        ValueError, match="links must be one name per sensor, got 'base'"
    ):
        Skin(robot="h1_2", links="base", **lists)


def test_an_unknown_link_is_refused_with_the_closest_name():
    skin = make_skin([[0, 0, 1]] * 2, links=("torso_link", "left_elbo_link"))
    with pytest.raises(
        ValueError, match=r"sensor 1 .*did you mean 'left_elbow_link'\?"
    ):
        skin.check_links(H1_2.links)
    skin = make_skin([0, 0, 1], links=("xyz",))
    with pytest.raises(
        ValueError,
        match=r"sensor 0 sits on 'xyz', which h1_2 does not have \(links: ",
    ):
        skin.check_links(H1_2.links)
    # Where it is checked for another robot than its own.
    with pytest.raises(ValueError, match="which other does not have"):
        skin.check_links(H1_2.links, "other")


def test_placing_sensors_beside_a_skin_file_is_refused(tmp_path):
    config = SkinConfig(path=tmp_path / "my.json", num_sensors=10)
    with pytest.raises(ValueError, match=r"skin\.num_sensors has no effect with"):
        config.build(H1_2)
