"""GenTact exports: all dialects, errors with their places, and export."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, Skin
from egoskin.sensors.skin.gentact import load_gentact, save_gentact
from egoskin.sensors.skin.gentact.description import Xml

CURRENT = "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent,Object Name in Blender"
PLAIN = "Index,X,Y,Z,Radius,Parent"
PRINT = "Index,X,Y,Z,Stem X,Stem Y,Stem Z,Radius,Parent"
ARM = "/root/bot/left_elbow_link/visuals"


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Skin]:
    """Function that returns the H1-2 skin of a file's content and options."""

    def read(content: str | bytes, name: str = "export", **options) -> Skin:
        path = tmp_path / name
        raw = content.encode() if isinstance(content, str) else content
        path.write_bytes(raw)
        robot = {
            "robot_name": H1_2.name,
            "links": H1_2.links,
            "primitives": H1_2.primitives,
        }
        return load_gentact(path, **{**robot, **options})

    return read


def current(*rows: str) -> str:
    return "\n".join((CURRENT, *rows)) + "\n"


# Two sensors in front of the torso and behind it, in each dialect.
FRONT, BACK = (0.093, 0.02, 0.2), (-0.093, -0.01, 0.3)
TORSO = "/root/bot/torso_link/visuals"
DIALECTS = {
    CURRENT: [
        f"0,0.093,0.02,0.2,1.0,0.0,0.0,0.004,{TORSO},visuals.004",
        f"1,-0.093,-0.01,0.3,-1.0,0.0,0.0,0.1,{TORSO},visuals.004",
    ],
    "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent": [
        f"0,0.093,0.02,0.2,1.0,0.0,0.0,0.004,{TORSO}",
        f"1,-0.093,-0.01,0.3,-1.0,0.0,0.0,0.1,{TORSO}",
    ],
    PLAIN: [
        f"0,0.093,0.02,0.2,0.004,{TORSO}",
        f"1,-0.093,-0.01,0.3,0.1,{TORSO}",
    ],
    "SensorNum,RelX,RelY,RelZ,Radius,path": [
        "0,0.093,0.02,0.2,0.004,/bot/torso_link",
        "1,-0.093,-0.01,0.3,0.1,/bot/torso_link",
    ],
    PRINT: [
        f"1,93.0,20,200.0,85.0,20,200.0,0.004,{TORSO}",
        f"2,-93.0,-10,300.0,-85.0,-10,300.0,0.1,{TORSO}",
    ],
}


# --- tables -----------------------------------------------------------------------


@pytest.mark.parametrize("header", DIALECTS)
def test_every_dialect_gives_the_same_skin(header, load):
    skin = load("\n".join((header, *DIALECTS[header])))
    assert skin.robot == "h1_2"
    assert skin.links == ("torso_link",) * 2
    np.testing.assert_allclose(skin.position, [FRONT, BACK], atol=1e-15)
    # Without normals in the file, those of the torso's box are used.
    np.testing.assert_allclose(skin.normal, [[1, 0, 0], [-1, 0, 0]], atol=1e-9)
    np.testing.assert_array_equal(skin.radius, [0.004, np.nan])
    assert skin.provenance["dialect"] == header
    assert skin.provenance["radius_unknown"] == 1
    has_normals = "NormX" in header
    assert ("file's" in skin.provenance["normals"]) == has_normals


def test_a_print_export_has_clips_names_and_blanks_between_its_sensors(load):
    # Also fewer cells than columns; radii are in metres, positions are not.
    skin = load(
        f"{PRINT}\n,,,,,,,,\nvisuals.002\n"
        f"CLIP,1,2,3,,,,0.1,{TORSO}\n"
        f"1,93.0,20,200.0,,,,0.004,{TORSO}\n"
        f"CLIP,3,2,1\n\n,,,,,,,,\nvisuals.003,,,,,,,,\n"
        f"2,-93.0,-10,300.0,,,,,{TORSO}\n"
    )
    np.testing.assert_allclose(skin.position, [FRONT, BACK], atol=1e-15)
    np.testing.assert_array_equal(skin.radius, [0.004, np.nan])
    assert skin.provenance["skipped"] == {"headings": 2, "clips": 2}
    assert skin.provenance["metres_per_unit"] == 1e-3


def test_an_old_print_export_needs_its_unit(load):
    # Once it had the header of the table in metres, and clips give it away. Its radii
    # are in the unit of its positions: 1.6 cm.
    content = f"{PLAIN}\nCLIP,1,2,3,0.1,{TORSO}\n1,9.3,2,20,1.6,{TORSO}\n"
    with pytest.raises(ValueError, match="old 3-D print export is unknown; give scale"):
        load(content)
    skin = load(content, scale=0.01)
    np.testing.assert_allclose(skin.position, [FRONT], atol=1e-15)
    assert skin.radius == pytest.approx(0.016)
    metres = content.replace("9.3,2,20,1.6", "0.093,0.02,0.2,0.016")
    np.testing.assert_allclose(load(metres, scale=1.0).radius, 0.016)


def test_a_print_export_with_headings_has_its_radii_in_metres(load):
    # This exporter scales only the positions.
    row = f"1,93,20,200,0.016,{TORSO}"
    content = f"{PLAIN}\n,,,,,\nvisuals.002,,,,,\nCLIP,1,2,3,0.1,{TORSO}\n{row}\n"
    skin = load(content, scale=1e-3)
    np.testing.assert_allclose(skin.position, [FRONT], atol=1e-15)
    assert skin.radius == pytest.approx(0.016)


@pytest.mark.parametrize(
    ("header", "row", "options"),
    [
        # Radii in another unit than assumed: 16 um, 16 m.
        (PLAIN, "CLIP,,,,,\n1,93,20,200,0.016,", {"scale": 1e-3}),
        (PRINT, "1,93,20,200,,,,16,", {}),
    ],
)
def test_a_radius_that_no_sensor_has_is_refused(header, row, options, load):
    content = f"{header}\n{row}{TORSO}\n"
    with pytest.raises(ValueError, match=r"the radius is 1\.?6.* in the header"):
        load(content, **options)
    unit = "m" if "0.016" in row else "mm"
    skin = load(content.replace("Radius", f"Radius [{unit}]"), **options)
    assert skin.radius == pytest.approx(0.016)


@pytest.mark.parametrize(
    "header",
    [
        "Sensor Name, X Offset, Y Offset, Z Offset, Norm X, Norm Y, Norm Z, Radius, "
        "Parent Path",
        "index,x [m],y [m],z [m],norm_x,norm_y,norm_z,radius (m),PARENTS",
        "Sensor Number,RelX,RelY,RelZ,nx,ny,nz,Radii,Path",
        "id,Pos X,Pos Y,Pos Z,Normal.X,Normal.Y,Normal.Z,Sensor Radius,Link",
    ],
)
def test_columns_are_known_by_other_names_too(header, load):
    rows = [r.rpartition(",")[0] for r in DIALECTS[CURRENT]]
    skin, expected = load("\n".join((header, *rows))), load(current(*DIALECTS[CURRENT]))
    np.testing.assert_array_equal(skin.position, expected.position)
    np.testing.assert_array_equal(skin.normal, expected.normal)
    np.testing.assert_array_equal(skin.radius, expected.radius)
    assert skin.links == expected.links


def test_sensors_may_have_names_and_stand_in_another_order_of_columns(load):
    skin = load(
        "Parent Path,Sensor Name,Z Offset,Y Offset,X Offset\n"
        f"{TORSO},palm 1,0.2,0.02,0.093\n{TORSO},palm 2,0.3,-0.01,-0.093"
    )
    np.testing.assert_array_equal(skin.position, [FRONT, BACK])
    assert np.isnan(skin.radius).all()


def test_the_oldest_table_has_neither_radius_nor_normal(load):
    skin = load(
        "SensorNum, RelX, RelY, RelZ, path\n1,0.093,0.02,0.2,/Ant/Arm_01/Upper_Arm",
        link_map={"Upper_Arm": "torso_link"},
    )
    np.testing.assert_array_equal(skin.position, [FRONT])
    assert skin.links == ("torso_link",)


def test_a_table_without_parents_takes_the_users(load):
    content = "Index,X,Y,Z,NormX,NormY,NormZ\n0,0,0,0,1,0,0\n1,0,0,0,1,0,0"
    assert load(content, parent="pelvis").links == ("pelvis", "pelvis")
    # Reported once, not for each row.
    with pytest.raises(ValueError, match="export:1: the file does not name") as error:
        load(content)
    assert str(error.value).count("does not name") == 1


def test_units_in_the_header_count(load):
    content = f"Index,X [mm],Y [mm],Z [mm],Radius [cm],Parent\n0,93,20,200,0.4,{TORSO}"
    skin = load(content)
    np.testing.assert_allclose(skin.position, [FRONT], atol=1e-15)
    assert skin.radius == pytest.approx(0.004)
    assert load(content, scale=1e-3).radius == pytest.approx(0.004)
    with pytest.raises(ValueError, match=r"header gives .* 0\.001 m, but scale is 1"):
        load(content, scale=1.0)
    # The radius has the unit of the positions; 100 mm also means no radius.
    content = content.replace("Radius [cm]", "Radius").replace(",0.4,", ",4,")
    assert load(content).radius == pytest.approx(0.004)
    assert np.isnan(load(content.replace(",4,", ",100,")).radius).all()


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("Index,X,Y,Z,Radius,Parent,Path", "'Parent' and 'Path' are both the sensor's"),
        ("Index,X,RelX,Y,Z,Parent", "'X' and 'RelX' are both the sensor's x"),
        ("Index,X,Y,Parent", "there is no column z"),
        ("Index,X,Y,Z,NormX,NormZ,Parent", "there is no column normy"),
        ("Index,X [mm],Y [mm],Z [cm],Parent", "x, y and z must have the same unit"),
        ("Index,X [mm],Y,Z,Parent", "x, y and z must have the same unit"),
        ("Index,X [furlong],Y,Z,Parent", r"unit of 'X \[furlong\]' must be one of m"),
        ("Index,X,Y,Z,Roll,Parent", "remove the column 'Roll'"),
        ("Index,X,Y,Z,,Parent", "remove the column ''"),
        ("Index,X,Y,Z", "these are vertices"),
    ],
)
def test_a_header_that_may_mean_two_things_is_refused(header, expected, load):
    with pytest.raises(ValueError, match=f"export:1: .*{expected}"):
        load(f"{header}\n0,1,2,3,4,5,6")


@pytest.mark.parametrize("skip", [False, True])
def test_all_bad_rows_are_told_at_once_or_left_out(skip, load):
    bad = {
        3: f"1,nan,0,0,1,0,0,0,{TORSO},v",
        4: f"2,0,0,0,1,0,0,-1,{TORSO},v",
        5: f"3,0,0,0,0.5,0,0,0,{TORSO},v",
        6: "4,0,0,0,1,0,0,0,/bot/chest,v",
        7: "5,0,0",
        8: f"0,0,0,0,1,0,0,0,{TORSO},v",
        9: f"7,9,0,0,1,0,0,0,{TORSO},v",
        10: f"8,0,0,0,1,0,0,50,{TORSO},v",
        11: "9,0,0,0,1,0,0,0,/bot/torso_link/head_link/visuals,v",
        12: "10,0,0,0,1,0,0,0,,v",
    }
    content = current(GOOD, *bad.values(), GOOD.replace("0,", "11,", 1))
    if skip:
        skin = load(content, skip_invalid=True)
        np.testing.assert_array_equal(skin.position, [FRONT, FRONT])
        listed = skin.provenance["left_out"]
        assert len(listed) == len(bad)
    else:
        with pytest.raises(ValueError, match="10 sensors cannot be read") as error:
            load(content)
        listed = str(error.value).splitlines()
        # The remedy is given once for all rows.
        assert str(error.value).count("the links of h1_2 are") == 1
    for line in bad:
        assert sum(f"export:{line}: " in text for text in listed) == 1


@pytest.mark.parametrize(
    ("number", "expected"),
    [(150, "150 sensors cannot(.|\n)*and 50 more"), (5000, "more than 1,000 sensors")],
)
def test_of_very_many_bad_rows_some_are_told(number, expected, load):
    with pytest.raises(ValueError, match=expected) as error:
        load(current(GOOD, *["1,2"] * number))
    assert "export:3: expected 10 values" in str(error.value)
    assert len(str(error.value).splitlines()) < 110


def test_bad_sensors_of_descriptions_are_left_out_too(load):
    tags = [sensor_tag(i, (0, 0, 1), UPRIGHT) for i in range(3)]
    tags[1] = tags[1].replace('normal_x="0.0"', 'normal_x="2"')
    with pytest.raises(ValueError, match="--skip-invalid"):
        load(xacro(*tags), parent="left_elbow_link")
    skin = load(xacro(*tags), parent="left_elbow_link", skip_invalid=True)
    assert len(skin) == 2
    content = urdf("", '<origin xyz="0 0"/>')
    assert len(load(content, skip_invalid=True)) == 1
    with pytest.raises(
        ValueError, match=r"no sensor can be read; first error: .*export:2"
    ):
        load(current(f"0,9,9,9,1,0,0,0,{TORSO},v"), skip_invalid=True)


def test_scale_turns_positions_and_radii_into_metres(load):
    skin = load(current(f"0,93,20,200,1,0,0,4,{TORSO},v"), scale=1e-3)
    np.testing.assert_allclose(skin.position, [FRONT], atol=1e-15)
    assert skin.radius == pytest.approx(0.004)


@pytest.mark.parametrize(
    ("header", "row", "length"),
    [
        (CURRENT, f"0,93,20,200,1,0,0,0.01,{TORSO},v", "221"),
        (PRINT, f"1,0.093,0.02,0.2,,,,0.01,{TORSO}", "0.000221"),
    ],
)
def test_a_wrong_unit_is_noticed(header, row, length, load):
    with pytest.raises(ValueError, match=rf"export:2: the sensor lies {length} m"):
        load(f"{header}\n{row}\n")


def test_one_sensor_may_be_at_the_origin_of_its_link(load):
    rows = [f"1,0,0,1,,,,0.01,{TORSO}", f"2,93,20,200,,,,0.01,{TORSO}"]
    skin = load("\n".join((PRINT, *rows)))
    np.testing.assert_allclose(skin.position, [[0, 0, 0.001], FRONT], atol=1e-15)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "  \n").replace(",", " , "),
        lambda text: text.replace(TORSO, f' "{TORSO}"').replace("\n", " \n"),
        lambda text: "\n\n" + text.replace("\n", "\n\n"),
        lambda text: text.replace("\n", ",,\n"),
        lambda text: text.upper().replace(TORSO.upper(), TORSO),
        lambda text: text.rstrip("\n"),
        lambda text: "# Of May\n" + text.replace("\n", "\n #, the next\n"),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: "# a, b\n" + text.replace(",", ";").replace("0.", "0,"),
        lambda text: text.replace(",", ";").replace("0.02", "2,0e-02"),
    ],
    ids=[
        *("CRLF", "BOM", "spaces", "quotes", "blank", "commas", "capitals", "no-end"),
        *("comments", "semicolons", "tabs", "decimal commas", "exponents"),
    ],
)
def test_the_form_of_a_table_does_not_matter(change, load):
    expected = load(current(*DIALECTS[CURRENT]))
    skin = load(change(current(*DIALECTS[CURRENT])))
    np.testing.assert_array_equal(skin.position, expected.position)
    np.testing.assert_array_equal(skin.normal, expected.normal)
    assert skin.links == expected.links


GOOD = f"0,0.093,0.02,0.2,1,0,0,0.01,{TORSO},v"


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "export: the file is empty"),
        ("\n \n", "export: the file is empty"),
        (CURRENT, "export: no sensors found"),
        ("a,b\n1,2", "export:1: unknown header 'a,b'; GenTact writes 'Index,X,"),
        ('{"format": 1}', "export:1: unknown header"),
        ("Index,X,Y,Z,Object Name\n1,0,0,0,v", "export:1: these are vertices"),
        (current(GOOD, f"1,nan,0,0,1,0,0,0.01,{TORSO},v"), "export:3: x must be a "),
        (current(GOOD, "", f"1,0,inf,0,1,0,0,0,{TORSO},v"), "export:4: y must be a "),
        (current(GOOD, f"1,0,0,zero,1,0,0,0,{TORSO},v"), "number, got 'zero'"),
        (
            current(GOOD, f"1,1e308,1e308,0,1,0,0,0,{TORSO},v"),
            "export:3: .* lies 1.41e.308 m",
        ),
        (
            current(GOOD, f"1,0,0,0,1e308,1e308,0,0,{TORSO},v"),
            "length 1, got 1.414e.308",
        ),
        (current(GOOD, f"1,0,0,0,1,0,0,-1,{TORSO},v"), "export:3: the radius must no"),
        (current(GOOD, f"1,0,0,0,1,0,0,big,{TORSO},v"), "export:3: the radius must be"),
        (current(GOOD, f"1,0,0,0,0,0,0,0.01,{TORSO},v"), "length 1, got 0"),
        (current(GOOD, f"1,0,0,0,0.9,0,0,0.01,{TORSO},v"), "export:3: the normal mus"),
        (current(GOOD, "1,0,0,0,1,0,0"), "export:3: expected 10 values"),
        (current(GOOD, GOOD + ",more"), "export:3: expected 10 values"),
        (current(GOOD, "clips and names only in print exports"), "export:3: expected"),
        (current(GOOD).replace(",", ";").replace("0.093", "1.000,5"), "got '1.000,5'"),
        (current("#", GOOD, "1,0"), "export:4: expected 10 values"),
        (current(GOOD, GOOD), "export:3: duplicate sensor '0' .*export:2"),
        (current(GOOD, CURRENT), "export:3: index must be a finite number"),
        (current(GOOD, "1,0,0,0,1,0,0,0.01,,v"), "export:3: the file does not name"),
        (current(GOOD.replace(TORSO, f'"{TORSO}')), "quoted value must end on its l"),
        (b"\xff\xfe" + current(GOOD).encode("utf-16-le"), "not UTF-8"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_with_its_line(content, expected, load):
    with pytest.raises(ValueError, match=expected):
        load(content)


def test_the_scale_must_be_positive(load):
    with pytest.raises(ValueError, match="scale must be positive"):
        load(current(GOOD), scale=0.0)


def test_normals_a_few_percent_off_become_unit_vectors(load):
    skin = load(current(GOOD, f"1,0,0,0,0.6,0.0,0.83,0.01,{TORSO},v"))
    # |(0.6, 0, 0.83)| = 1.0242
    np.testing.assert_allclose(skin.normal[1], [0.58585, 0, 0.81042], atol=1e-5)
    assert skin.provenance["normals"] == "the file's; 1 made unit vectors"


# --- links ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parent", "link"),
    [
        (ARM, "left_elbow_link"),
        ("left_elbow_link", "left_elbow_link"),
        ("/left_elbow_link/", "left_elbow_link"),
        ("/bot/left_elbow_link.003/visuals.011", "left_elbow_link"),
        # A real tree: the last body counts.
        ("/h1/pelvis/torso_link/left_elbow_link/visuals", "left_elbow_link"),
        # Siblings joined by mistake: the last is the sensors' own.
        ("/bot/torso_link/geometry/left_elbow_link/right_elbow_link", None),
    ],
)
def test_the_last_body_of_a_parent_is_the_link(parent, link, load):
    skin = load(current(f"0,0,0,0,1,0,0,0.01,{parent},v"))
    assert skin.links == (link or "right_elbow_link",)
    assert skin.provenance["parents"] == {parent: skin.links[0]}


def test_a_part_that_may_be_a_sibling_is_refused(load):
    row = "{},0,0,0,1,0,0,0.01,{},v"
    rows = [row.format(0, "/bot/torso_link"), row.format(1, "/bot/torso_link/collar")]
    with pytest.raises(ValueError, match=r"export:3: 'collar' of .* may be a part of"):
        load(current(*rows))
    # Names that Isaac Sim gives to parts of a link are not siblings.
    rows[1] = rows[1].replace("collar", "visuals")
    assert load(current(*rows)).links == ("torso_link",) * 2
    rows[1] = rows[1].replace("visuals", "collar")
    skin = load(current(*rows), link_map={"/bot/torso_link/collar": "pelvis"})
    assert skin.links == ("torso_link", "pelvis")


@pytest.mark.parametrize(
    ("below", "kept"),
    [
        ("visuals", True),
        ("visuals.004", True),
        ("collisions_1/geometry", True),
        ("geometry2/visuals.001", True),
        ("head_link/visuals", False),
        ("visuals/head_link", False),
        ("torso_mesh/ID71_001", False),
    ],
)
def test_below_a_link_there_may_only_be_its_shapes(below, kept, load):
    # A link that the robot lacks is not its parent: it sits elsewhere, and may turn.
    content = current(f"0,0,0,0,1,0,0,0.01,/r/torso_link/{below},v")
    if kept:
        assert load(content).links == ("torso_link",)
        return
    with pytest.raises(
        ValueError, match=r"a link that h1_2 lacks; .* link_map"
    ) as error:
        load(content)
    # As the error suggests.
    part = re.search(r"--link-map (.*)=", str(error.value))
    assert part is not None
    assert load(content, link_map={part[1]: "pelvis"}).links == ("pelvis",)


@pytest.mark.parametrize(
    ("parent", "hint"),
    [
        ("/bot/chest/visuals", "map a part or all of it"),
        ("/bot/torso_lnk", "did you mean torso_link?"),
        ("/bot/left_elbow_linktorso_link", "torso_link or left_elbow_link"),
    ],
)
def test_a_parent_without_a_body_is_refused(parent, hint, load):
    with pytest.raises(ValueError, match="export:2: no part of the Parent") as error:
        load(current(f"0,0,0,0,1,0,0,0.01,{parent},v"))
    assert hint in str(error.value)


def test_the_users_map_goes_before_names_and_a_path_before_its_parts(load):
    content = current(
        "0,0,0,0,1,0,0,0.01,/bot/chest/visuals,v",
        f"1,0,0,0,1,0,0,0.01,{ARM},v",
        "2,0,0,0,1,0,0,0.01,/bot/chest/lamp,v",
    )
    link_map = {
        "chest": "torso_link",
        "left_elbow_link": "right_elbow_link",
        "/bot/chest/lamp": "pelvis",
    }
    skin = load(content, link_map=link_map)
    assert skin.links == ("torso_link", "right_elbow_link", "pelvis")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"link_map": {"chest": "torso_lnk"}}, "did you mean 'torso_link'"),
        ({"parent": "torso_link"}, "parent has no effect"),
        ({"parent": "chest"}, "no link 'chest'"),
    ],
)
def test_what_the_user_says_in_vain_is_refused(options, expected, load):
    with pytest.raises(ValueError, match=expected):
        load(current(GOOD), **options)


def test_one_map_and_one_call_serve_the_files_of_a_whole_robot(tmp_path):
    parts = {"chest": "torso_link", "arm": "left_elbow_link", "tail": "pelvis"}
    files = [tmp_path / name for name in ("chest", "arm")]
    for path in files:
        path.write_text(current(f"0,0.1,0,0,1,0,0,0.01,/bot/{path.name}/visuals,v"))
    options = {"robot_name": "h1_2", "links": H1_2.links, "link_map": parts}
    alone = load_gentact(files[0], **options)
    assert alone.links == ("torso_link",)
    assert alone.provenance["unused_link_map"] == ["arm", "tail"]
    skin = load_gentact(files, **options)
    assert skin.links == ("torso_link", "left_elbow_link")
    assert skin.provenance["unused_link_map"] == ["tail"]
    assert [f["file"] for f in skin.provenance["files"]] == ["chest", "arm"]
    assert skin.provenance["files"][1]["parents"] == {"/bot/arm/visuals": parts["arm"]}
    with pytest.raises(ValueError, match="at least one file"):
        load_gentact([], **options)


def test_the_map_may_name_the_skin_of_a_xacro(load):
    content = xacro(sensor_tag(0, (0, 0, 1), UPRIGHT))
    skin = load(content, link_map={"left_elbow_skin": "left_elbow_link"})
    assert skin.links == ("left_elbow_link",)


def test_the_users_parent_holds_for_rows_without_one(load):
    rows = current(GOOD, "1,0,0,0,1,0,0,0.01,,v")
    assert load(rows, parent="pelvis").links == ("torso_link", "pelvis")


# --- normals from the robot -------------------------------------------------------

SHAPES = """
  <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>
  <geom type="capsule" size="0.1 0.2" pos="-0.2 0.1 0.1" euler="50 10 0"/>
  <geom type="sphere" size="0.15" pos="0 -0.4 0"/>"""


def test_missing_normals_are_mujocos_direction_from_the_nearest_shape(
    small_robot, tmp_path
):
    robot = small_robot(SHAPES)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    spec = robot.spec()
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0], name="probe")
    model = spec.compile()
    data, fromto = mujoco.MjData(model), np.zeros(6)
    expected = np.full((len(points), 3), np.nan)
    for i, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        best, probe_id = np.inf, model.geom("probe").id
        for geom in set(range(model.ngeom)) - {probe_id}:
            gap = mujoco.mj_geomDistance(model, data, geom, probe_id, 9.0, fromto)
            if gap < best:
                best, way = gap, fromto[3:] - fromto[:3]
                # Inside and very close to the surface, witness points are unreliable.
                far = np.linalg.norm(way) if gap > 1e-3 else np.nan
                expected[i] = way / far
    outside = np.isfinite(expected).all(-1)
    assert outside.sum() > 100
    lines = [f"{i},{x},{y},{z},0.1,/base" for i, (x, y, z) in enumerate(points)]
    path = tmp_path / "points.csv"
    path.write_text("\n".join((PLAIN, *lines)))
    skin = load_gentact(
        path,
        robot_name="small",
        links=robot.links,
        primitives=robot.primitives,
    )
    np.testing.assert_allclose(skin.normal[outside], expected[outside], atol=1e-5)


def test_missing_normals_need_a_shape_with_a_surface_nearby(small_robot, load):
    robot = small_robot(SHAPES)
    content = f"{PLAIN}\n0,0,-0.4,0,0.1,/base"
    options = {"robot_name": "small", "links": robot.links}
    with pytest.raises(
        ValueError, match=r"export:2: .* base has no primitive shape to compute one"
    ):
        load(content, **options, primitives=())
    # The centre of the sphere.
    with pytest.raises(ValueError, match="nearest surface point of base is not unique"):
        load(content, **options, primitives=robot.primitives)


def test_distances_from_the_surface_are_those_of_known_surfaces(small_robot, load):
    robot = small_robot("<geom size='.2'/><body name='bare'/>")
    options = {"robot_name": "small", "links": robot.links}
    options |= {"primitives": robot.primitives, "skip_invalid": True}
    row = "{},{},0,0,1,0,0,{},{},v"
    bare = row.format(2, 0.1, 0.01, "bare")
    content = current(
        row.format(0, 0.203, 0.01, "base"),
        row.format(1, 0.26, 0.01, "base"),
        bare,
        # Left out: its radius is 50 m.
        row.format(3, 1.2, 50, "base"),
    )
    skin = load(content, **options)
    assert skin.links == ("base", "base", "bare")
    assert skin.provenance["distance_to_primitives"] == [0.003, 0.06]
    assert "distance_to_primitives" not in load(current(bare), **options).provenance


# --- xacro and URDF ---------------------------------------------------------------

UPRIGHT = 'xyz="0 0 0" rpy="0 0 0"'


def sensor_tag(number: int, normal, origin: str, kind: str = "self_cap_sensor") -> str:
    values = (
        ""
        if normal is None
        else "".join(
            f' normal_{a}="{float(v)!r}"' for a, v in zip("xyz", normal, strict=True)
        )
    )
    return (
        f'<xacro:{kind} robot_namespace="${{namespace}}"\n parent="${{namespace}}_skin"'
        f' sensor_number="{number}" sensor_radius="${{sensor_radius}}"{values}>'
        f"<origin {origin}/></xacro:{kind}>"
    )


def xacro(*sensors: str, dermis: str = UPRIGHT, radius: str = "0.0") -> str:
    """As written by GenTact: a leading newline, properties not yet substituted."""
    return f"""
<?xml version="1.0"?>
<robot xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:macro name="left_elbow_skin" params="parent namespace">
  <xacro:property name="mesh_file" value="REPLACE_ME" />
  <xacro:property name="sensor_radius" value="{radius}" />
  <!-- <xacro:self_cap_sensor sensor_number="99"/> -->
  <xacro:dermis_base_macro robot_namespace="${{namespace}}" parent="${{parent}}"
    mesh_file="${{mesh_file}}"><origin {dermis}/></xacro:dermis_base_macro>
  {"".join(sensors)}
</xacro:macro>
</robot>"""


def urdf(*joints: str) -> str:
    """The relevant part of the H1-2 down to its left arm, with sensors."""
    names = [f"left_elbow_sensor_{i}" for i in range(len(joints))]
    fixed = "".join(
        f'<joint name="{name}_joint" type="fixed"><parent link="left_elbow_skin"/>'
        f'<child link="{name}"/>{joint}</joint><link name="{name}">'
        '<visual><geometry><sphere radius="0.005"/></geometry></visual>'
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        'iyz="0"/></inertial></link>'
        for name, joint in zip(names, joints, strict=True)
    )
    return f"""<?xml version="1.0" ?>
<robot name="h1_2"><mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>
<link name="torso_link"/>
<joint name="left_elbow_joint" type="revolute"><origin xyz="0 0.2 0.3"/>
  <parent link="torso_link"/><child link="left_elbow_link"/><axis xyz="0 1 0"/>
  <limit effort="1" velocity="1" lower="-1" upper="1"/></joint>
<link name="left_elbow_link"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="left_elbow_bracket_joint" type="fixed">
  <origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/>
  <parent link="left_elbow_link"/><child link="left_elbow_bracket"/></joint>
<link name="left_elbow_bracket"/>
<joint name="left_elbow_base_joint" type="fixed">
  <origin xyz="0.04 0.05 0.06" rpy="-1.5 0.4 2.5"/>
  <parent link="left_elbow_bracket"/><child link="left_elbow_skin"/></joint>
<link name="left_elbow_skin"/>
{fixed}</robot>"""


ANGLE = st.floats(-3.1, 3.1)
ORIGIN = st.tuples(*[st.floats(-0.3, 0.3)] * 3, ANGLE, st.floats(-1.5, 1.5), ANGLE)


def origin(numbers) -> str:
    values = [repr(float(v)) for v in numbers]
    return f'xyz="{" ".join(values[:3])}" rpy="{" ".join(values[3:])}"'


def rotation(rpy) -> np.ndarray:
    """MuJoCo's reading of URDF angles: about the fixed axes x, y, z in turn."""
    quat, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quat, np.asarray(rpy, float), "XYZ")
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def read(folder: Path, content: str, **options) -> Skin:
    path = folder / "export"
    path.write_text(content)
    return load_gentact(path, robot_name=H1_2.name, links=H1_2.links, **options)


@given(
    dermis=ORIGIN,
    sensor=ORIGIN,
    normal=st.sampled_from(("own", "zero", "none")),
    has_macro=st.booleans(),
)
def test_the_frame_of_a_xacro_is_the_frame_of_the_sensor(
    tmp_path_factory, dermis, sensor, normal, has_macro
):
    own = rotation(sensor[3:])
    # Exporters write (0, 0, 0) for a normal that rpy tells.
    normals = {"own": own[:, 2], "zero": (0, 0, 0), "none": None}
    tag = sensor_tag(0, normals[normal], origin(sensor))
    folder = tmp_path_factory.getbasetemp()
    content = xacro(tag, dermis=origin(dermis))
    if not has_macro:
        content = re.sub("</?xacro:macro.*>", "", content)
    skin = read(folder, content, parent="left_elbow_link")
    base = rotation(dermis[3:])
    position = base @ sensor[:3] + dermis[:3]
    np.testing.assert_allclose(skin.position[0], position, atol=1e-12)
    # Roll below 0.1 degrees is left out: 0.00175 rad.
    np.testing.assert_allclose(skin.rotation()[0], base @ own, atol=2e-3)
    np.testing.assert_allclose(skin.normal[0], (base @ own)[:, 2], atol=1e-9)


def test_a_sensor_tag_left_open_is_read_as_if_closed(load):
    # Seen in GenTact's exports: normal_z="..." and then <origin> without a > between.
    tags = [sensor_tag(i, (0, 0, 1), 'xyz="0.1 0 0" rpy="0 0 0"') for i in (0, 1)]
    closed = xacro("\n".join(tags))
    left_open = closed.replace("><origin", "\n  <origin")
    # The dermis is not a sensor, and its element was closed.
    left_open = left_open.replace('mesh_file}"\n', 'mesh_file}">\n')
    options = {"parent": "left_elbow_link"}
    same, skin = load(closed, **options), load(left_open, **options)
    np.testing.assert_array_equal(skin.position, same.position)
    np.testing.assert_array_equal(skin.normal, same.normal)
    # Line numbers still refer to the file.
    wrong = left_open.replace('normal_x="0.0"', 'normal_x="x"')
    line = 1 + wrong[: wrong.index("<xacro:self_cap_sensor rob")].count("\n")
    with pytest.raises(ValueError, match=f":{line}: normal_x must be a finite number"):
        load(wrong, **options)


def test_gentacts_own_frames_have_no_roll(load):
    # rpy as GenTact computes it: x = normalise(z_link x n), here (0, 1, 0).
    level = origin((0.1, 0, 0, np.pi / 2, 0, np.pi / 2))
    skin = load(xacro(sensor_tag(0, (1, 0, 0), level)), parent="left_elbow_link")
    assert skin.roll_deg == 0.0
    expected = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(skin.rotation()[0], expected, atol=1e-9)
    # Without rpy, only the normal is known.
    flat = sensor_tag(0, (1, 0, 0), 'xyz="0.1 0 0" rpy="0 0 0"')
    same = load(xacro(flat), parent="left_elbow_link")
    np.testing.assert_allclose(same.rotation(), skin.rotation(), atol=1e-9)


def test_a_sensor_of_a_urdf_is_where_mujoco_puts_it(load):
    rng = np.random.default_rng(1)
    origins = rng.uniform(-0.3, 0.3, (6, 6))
    origins[:, 3:] *= [10, 5, 10]
    joints = [
        f"<origin {origin(o)}/>"
        # Converters write 0 0 0 for a joint without an axis.
        + ["", '<axis xyz="0 0 0"/>', "<axis xyz='{} {} {}'/>"][i % 3].format(
            *rotation(o[3:])[:, 2]
        )
        for i, o in enumerate(origins)
    ]
    content = urdf(*joints)
    model = mujoco.MjModel.from_xml_string(content)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    skin = load(content)
    assert skin.links == ("left_elbow_link",) * 6
    arm = data.body("left_elbow_link")
    turn = arm.xmat.reshape(3, 3)
    for i, frame in enumerate(skin.rotation()):
        body = data.body(f"left_elbow_sensor_{i}")
        point = turn.T @ (body.xpos - arm.xpos)
        np.testing.assert_allclose(skin.position[i], point, atol=1e-9)
        own = turn.T @ body.xmat.reshape(3, 3)
        np.testing.assert_allclose(frame, own, atol=2e-3)
        np.testing.assert_allclose(skin.normal[i], own[:, 2], atol=1e-9)
    np.testing.assert_array_equal(skin.radius, 0.005)


@pytest.mark.parametrize("name", ["left_elbow/sensor", "sensor", "a/b_tof_sensor"])
def test_namespaces_are_divided_as_one_likes(name, load):
    content = urdf('<origin xyz="0.1 0 0"/>', "")
    skin = load(content.replace("left_elbow_sensor", name))
    np.testing.assert_array_equal(skin.radius, [0.005, 0.005])
    np.testing.assert_array_equal(skin.position, load(content).position)


def test_a_link_on_two_joints_is_refused(load):
    twice = (
        '<joint name="j" type="fixed"><parent link="pelvis"/><child link="{}"/></joint>'
    )
    content = urdf("").replace("</robot>", twice.format("left_elbow_skin") + "</robot>")
    with pytest.raises(
        ValueError, match="'left_elbow_skin' is already the child of a j"
    ):
        load(content)


def test_a_long_row_of_links_is_climbed_once(load, monkeypatch):
    fixed = (
        '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{2}"/>'
        '<origin xyz="0 0 0.001"/></joint>'
    )
    rows, above = [], "pelvis"
    for i in range(1000):
        rows.append(fixed.format(f"j{i}", above, f"l{i}"))
        rows.append(fixed.format(f"a_sensor_{i}_joint", f"l{i}", f"s{i}"))
        above = f"l{i}"
    calls = 0
    frame = Xml.frame

    def counted(*args):
        nonlocal calls
        calls += 1
        return frame(*args)

    monkeypatch.setattr(Xml, "frame", counted)
    skin = load(f"<robot name='r'>{''.join(rows)}</robot>")
    # Sensor i is i + 2 steps of 1 mm below the pelvis.
    heights = 1e-3 * (np.arange(1000) + 2)
    np.testing.assert_allclose(skin.position[:, 2], heights, atol=1e-12)
    assert calls == 2000


@pytest.mark.parametrize("kind", ["a named pipe", "a device"])
def test_only_files_are_imported(kind, tmp_path):
    path = Path("/dev/zero") if kind == "a device" else tmp_path / "pipe"
    if kind != "a device":
        os.mkfifo(path)
    with pytest.raises(ValueError, match=f"must be a file, but is {kind}"):
        load_gentact(path, robot_name="h1_2", links=H1_2.links)


def test_a_link_of_the_urdf_can_be_mapped(load):
    content = urdf("<origin/>")
    skin = load(content, link_map={"left_elbow_skin": "pelvis"})
    assert skin.links == ("pelvis",)
    np.testing.assert_array_equal(skin.position, [[0, 0, 0]])


def test_magnetic_sensors_are_left_out_and_counted(load):
    tags = [sensor_tag(0, (0, 0, 1), UPRIGHT)]
    tags += [sensor_tag(i, None, UPRIGHT, "mag_sensor") for i in range(2)]
    tags += [sensor_tag(0, None, UPRIGHT, "tof_sensor")]
    skin = load(xacro(*tags), parent="left_elbow_link")
    assert len(skin) == 2
    assert skin.provenance["skipped"] == {"mag_sensor": 2}
    content = urdf("", "").replace("elbow_sensor_1_joint", "elbow_mag_sensor_1_joint")
    skin = load(content)
    assert len(skin) == 1
    assert skin.provenance["skipped"] == {"mag_sensor": 1}


@pytest.mark.parametrize(
    ("radius", "expected"),
    [("0.0", np.nan), ("REPLACE_ME", np.nan), ("0.1", np.nan), ("0.004", 0.004)],
)
def test_properties_of_a_xacro_are_put_in(radius, expected, load):
    tag = sensor_tag(0, (0, 0, 1), UPRIGHT)
    skin = load(xacro(tag, radius=radius), parent="left_elbow_link")
    np.testing.assert_array_equal(skin.radius, [expected])


def test_a_xacro_whose_parent_is_written_out_names_its_link(load):
    tag = sensor_tag(0, (0, 0, 1), UPRIGHT)
    content = xacro(tag).replace("${parent}", "right_elbow_link")
    assert load(content).links == ("right_elbow_link",)


TAG = sensor_tag(0, (0, 0, 1), UPRIGHT)
ARM_LINK = {"parent": "left_elbow_link"}
DOCTYPE = '\n<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><robot>&b;</robot>'
TWO_MACROS = xacro(TAG).replace(
    "</robot>",
    f'<xacro:macro name="b" params="parent">{TAG}</xacro:macro></robot>',
)


@pytest.mark.parametrize(
    ("content", "options", "expected"),
    [
        # Line 4, counted with the newline before the declaration.
        (
            xacro(TAG),
            {},
            r"export:4: .*\(--parent\), did you mean 'left_elbow_l",
        ),
        (xacro(TAG, TAG), ARM_LINK, "export:1[0-9]: duplicate .*cap_sensor 0'"),
        (xacro(TAG).replace('xyz="0 0 0"', 'xyz="0 0"'), ARM_LINK, "three numbers"),
        (xacro(TAG).replace("0 0 0", "0 0 ${pi}"), ARM_LINK, "finite .*{pi}"),
        (xacro(TAG).replace('_x="0.0"', '_x="NaN"'), ARM_LINK, "normal_x must be a "),
        (xacro(TAG).replace('_x="0.0"', '_x="0.9"'), ARM_LINK, "must have length 1"),
        (xacro(TAG).replace("sensor_number", "number"), ARM_LINK, "sensor_number and"),
        (TWO_MACROS, ARM_LINK, "expected one macro with sensors, got 2"),
        (xacro(), ARM_LINK, "no GenTact sensors found"),
        ("<robot><link></robot>", {}, "export:1: mismatched tag"),
        (DOCTYPE, {}, "export:2: a DOCTYPE is not allowed"),
        (urdf(""), ARM_LINK, "parent has no effect"),
        (urdf("").replace("elbow_link", "arm"), {}, "to 'left_arm', which is neither"),
        (
            urdf("").replace('"left_elbow_skin"', '"x"', 1),
            {},
            "attached to 'left_elbow_skin'",
        ),
        (urdf("").replace("<child link", "<child x"), {}, "has no <child link=...>"),
        (
            urdf("").replace(
                'link="left_elbow_link"/><child', 'link="left_elbow_skin"/><child'
            ),
            {},
            "attached to 'left_elbow_skin'",
        ),
    ],
)
def test_a_description_that_cannot_be_read_is_refused(content, options, expected, load):
    with pytest.raises(ValueError, match=expected):
        load(content, **options)


def test_a_normal_beside_another_frame_is_refused(load):
    tilted = origin((0, 0, 0, 0.5, 0, 0))
    content = xacro(sensor_tag(0, (1, 0, 0), tilted))
    with pytest.raises(ValueError, match=r"the same direction, got 90\.0 deg"):
        load(content, **ARM_LINK)
    joint = f'<origin {tilted}/><axis xyz="1 0 0"/>'
    with pytest.raises(ValueError, match="must have the same direction"):
        load(urdf(joint))


# --- export -----------------------------------------------------------------------

NUMBERS = st.floats(-1, 1)
UNIT = (
    arrays(float, (3, 3), elements=NUMBERS)
    .filter(lambda v: np.linalg.norm(v, axis=-1).min() > 0.1)
    .map(lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True))
)


@given(
    position=arrays(float, (3, 3), elements=NUMBERS),
    normal=UNIT,
    radius=arrays(float, 3, elements=st.floats(1e-3, 0.09) | st.just(np.nan)),
    links=st.tuples(*[st.sampled_from(H1_2.links)] * 3),
)
def test_what_is_exported_comes_back_to_the_last_digit(
    tmp_path_factory, position, normal, radius, links
):
    skin = Skin(
        robot="h1_2", links=links, position=position, normal=normal, radius=radius
    )
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    assert save_gentact(skin, path) == ()
    back = load_gentact(path, robot_name="h1_2", links=H1_2.links)
    assert back.links == skin.links
    np.testing.assert_array_equal(back.position, skin.position)
    np.testing.assert_array_equal(back.normal, skin.normal)
    np.testing.assert_array_equal(back.radius, skin.radius)


def test_an_export_is_gentacts_current_table(skin, tmp_path):
    save_gentact(skin, tmp_path / "skin.csv")
    header, first, *_ = (tmp_path / "skin.csv").read_text().splitlines()
    assert header == CURRENT
    cells = first.split(",")
    assert cells[0] == "0"
    assert [float(c) for c in cells[1:4]] == skin.position[0].tolist()
    assert cells[7:] == ["0.1", f"/h1_2/{skin.links[0]}/visuals", "visuals"]


def test_an_export_says_what_it_cannot_hold(tmp_path):
    fields = {
        "robot": "h1_2",
        "links": ("torso_link",),
        "position": np.zeros((1, 3)),
        "normal": np.array([[1.0, 0, 0]]),
    }
    typed = Skin(
        **fields,
        coverage=(Field(),),
        range=np.array([1.0]),
        roll_deg=np.array([30.0]),
    )
    lost = save_gentact(typed, tmp_path / "skin.csv")
    assert lost == ("coverage", "range", "roll_deg")
    with pytest.raises(ValueError, match="the separator of GenTact's paths"):
        save_gentact(Skin(**{**fields, "links": ("a/b",)}), tmp_path / "skin.csv")
