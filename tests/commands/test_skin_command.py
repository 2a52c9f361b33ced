"""The command `egoskin skin`: placing, converting and showing skins."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calling import call, fail, succeed
from egoskin.commands.skin import bare_links
from egoskin.robots.builtin import H1_2
from egoskin.sensors import Field, Ray, Skin, place_sensors

TABLE = """Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent,Object Name in Blender
0,0.093,0.02,0.2,1.0,0.0,0.0,0.004,/bot/torso_link/visuals,visuals.004
1,0.05,-0.03,-0.01,0.0,-1.0,0.0,0.1,/bot/arm/visuals,visuals.011
"""


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path: Path) -> None:
    """Run in the test's temporary folder."""
    monkeypatch.chdir(tmp_path)


def run(*args: str) -> str:
    """Return what the command prints."""
    return succeed("skin", *args)


def test_a_placed_skin_is_a_file_that_training_reads():
    out = run("place", "--num-sensors", "20", "--seed", "3", "--out", "skin.json")
    skin = Skin.load(Path("skin.json"))
    assert len(skin) == 20
    skin.check_links(H1_2.links)
    expected = place_sensors(H1_2, 20, seed=3)
    np.testing.assert_array_equal(skin.position, expected.position)
    assert "skin.json: 20 sensors" in out
    run("place", "--num-sensors", "20", "--seed", "3", "--out", "again.json")
    assert Path("again.json").read_bytes() == Path("skin.json").read_bytes()
    one = run("place", "--num-sensors", "1", "--out", "one.json")
    assert one.startswith("one.json: 1 sensor on links of h1_2\n")


def test_the_options_of_a_placement_reach_it():
    run(
        *("place", "--num-sensors", "12", "--method", "poisson_disk"),
        *("--links", "torso_link", "left_elbow_link", "--stand-off", "0.009"),
        *("--density", "torso_link=1", "left_elbow_link=0", "--spacing", "0.05"),
        *("--out", "skin.json"),
    )
    skin = Skin.load(Path("skin.json"))
    assert set(skin.links) == {"torso_link"}
    gaps = np.linalg.norm(skin.position[:, None] - skin.position, axis=-1)
    assert gaps[~np.eye(12, dtype=bool)].min() >= 0.05 - 1e-5
    options = {"num_sensors": 12, "method": "poisson_disk", "seed": 0}
    options |= {"spacing": 0.05, "stand_off": 0.009}
    assert {name: skin.provenance[name] for name in options} == options


def test_a_skin_can_be_placed_on_meshes():
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    Path("meshes").mkdir()
    box = trimesh.creation.box((0.4, 0.5, 0.6))
    box.export("meshes/torso_link.stl")
    run(
        *("place", "--meshes", "meshes", "--links", "torso_link"),
        *("--num-sensors", "10", "--stand-off", "0.01", "--out", "skin.json"),
    )
    skin = Skin.load(Path("skin.json"))
    # 1 cm off a box with these half sizes.
    beyond = np.abs(skin.position) - [0.2, 0.25, 0.3]
    np.testing.assert_allclose(beyond.max(-1), 0.01, atol=1e-5)


def test_a_gentact_file_goes_in_and_comes_out():
    Path("gentact.csv").write_text(TABLE)
    out = run(
        *("import", "gentact.csv", "--link-map", "arm=left_elbow_link"),
        *("--out", "skin.json"),
    )
    assert "skin.json: 2 sensors" in out
    skin = Skin.load(Path("skin.json"))
    assert skin.links == ("torso_link", "left_elbow_link")
    assert "out.csv: 2 sensors" in run("export", "skin.json", "--out", "out.csv")
    run("import", "out.csv", "--out", "back.json")
    back = Skin.load(Path("back.json"))
    np.testing.assert_array_equal(back.position, skin.position)
    np.testing.assert_array_equal(back.radius, skin.radius)


CRANE = """<robot name="crane"><link name="foot"/>
<joint name="turn" type="continuous"><parent link="foot"/><child link="boom"/></joint>
<link name="boom"><collision><geometry><box size="2 .2 .2"/></geometry></collision>
</link><joint name="grip" type="fixed"><parent link="boom"/><child link="hook"/></joint>
<link name="hook"><collision><geometry><cylinder radius=".1" length=".2"/></geometry>
</collision></link></robot>"""


def test_files_of_any_robot_make_one_skin():
    Path("crane.urdf").write_text(CRANE)
    Path("boom.csv").write_text(
        "Index,X,Y,Z,Radius,Parent\n0,0.5,0.11,0,0.01,/r/boom\n1,9,0,0,0.01,/r/boom"
    )
    Path("hook.csv").write_text(
        "Index,X,Y,Z,NormX,NormY,NormZ,Parent\n0,0.1,0,0,1,0,0,/r/claw/visuals"
    )
    args = (
        *("import", "boom.csv", "hook.csv", "--robot", "crane.urdf"),
        *("--link-map", "claw=hook", "arm=boom", "--out", "skin.json"),
    )
    fail("skin", *args)
    out = run(*args, "--skip-invalid")
    assert "skin.json: 2 sensors on links of crane" in out
    assert "note: no file uses 'arm' of --link-map" in out
    assert "left out: boom.csv:3: the sensor lies 9 m" in out
    skin = Skin.load(Path("skin.json"))
    assert skin.links == ("boom", "hook")
    # The first normal is from the box; the hook's cylinder is not a primitive.
    np.testing.assert_allclose(skin.normal, [[0, 1, 0], [1, 0, 0]], atol=1e-6)


def test_millimetres_and_a_link_that_the_file_leaves_out():
    Path("gentact.csv").write_text(
        "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent\n0,93,20,200,1,0,0,4,\n"
    )
    run(
        *("import", "gentact.csv", "--scale", "0.001", "--parent", "torso_link"),
        *("--out", "skin.json"),
    )
    skin = Skin.load(Path("skin.json"))
    np.testing.assert_allclose(skin.position, [[0.093, 0.02, 0.2]])
    assert skin.links == ("torso_link",)


@pytest.mark.parametrize(("height", "told"), [("200", False), ("970", True)])
def test_sensors_far_from_the_robot_are_told(height: str, told: bool):
    Path("gentact.csv").write_text(
        "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent\n"
        f"0,93,20,{height},1,0,0,4,torso_link\n"
    )
    out = run("import", "gentact.csv", "--scale", "0.001", "--out", "skin.json")
    assert ("m off the robot's surface" in out) is told


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """A skin of three kinds of sensor."""
    path = tmp_path / "mixed.json"
    Skin(
        robot="h1_2",
        links=("torso_link", "torso_link", "pelvis"),
        position=np.array([[0.1, 0, 0.2], [0.1, 0, 0.3], [0.1, 0, 0]]),
        normal=np.tile([1.0, 0, 0], (3, 1)),
        coverage=(Field(), Ray(grid=(4, 4)), None),
        range=np.array([0.5, np.nan, np.nan]),
        provenance={"placement": "by hand"},
    ).save(path)
    return path


def test_a_summary_counts_links_types_and_ranges(mixed):
    head, *rows = run("show", str(mixed)).splitlines()
    assert head == f"{mixed}: 3 sensors on links of h1_2"
    assert [" ".join(row.split()) for row in rows] == [
        "link sensors type range",
        "pelvis 1 as configured as configured",
        "torso_link 1 field 0.5 m",
        "torso_link 1 ray grid=(4, 4) as configured",
        "placement: by hand",
    ]


def test_an_export_says_what_it_leaves_out(mixed):
    out = run("export", str(mixed), "--out", "out.csv")
    assert "does not hold coverage, range" in out


def test_a_picture_shows_sensors_and_normals_from_both_sides(mixed):
    done = call("skin", "show", str(mixed), "--picture", "skin.png")
    if "OpenGL" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    image = np.asarray(Image.open("skin.png"), int)
    assert image.shape == (960, 1280, 3)
    red, green, blue = np.moveaxis(image, -1, 0)
    # Only normals are cyan; all three point at the front camera.
    lines = (green - red > 100) & (blue - red > 100)
    front, back = lines[:, :640], lines[:, 640:]
    assert front.sum() > 30
    assert back.sum() == 0


# Fixed far from the origin, tilted.
ARM = """<mujoco><worldbody>
  <body name="stand" pos="4 0 2" euler="90 0 0"><geom type="box" size=".1 .1 .5"/>
    <body name="boom" pos="0 0 .5"><joint axis="0 1 0"/>
      <geom type="capsule" size=".1" fromto="0 0 0 1 0 0"/></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(("file", "text"), [("crane.urdf", CRANE), ("arm.xml", ARM)])
def test_a_picture_shows_a_robot_with_a_fixed_base(file: str, text: str):
    Path(file).write_text(text)
    robot, links = ("--robot", file), ("--links", "boom")
    run("place", *robot, *links, "--num-sensors", "40", "--out", "skin.json")
    done = call("skin", "show", "skin.json", *robot, "--picture", "skin.png")
    if "OpenGL" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    red, green, blue = np.moveaxis(np.asarray(Image.open("skin.png"), int), -1, 0)
    normals = (green - red > 100) & (blue - red > 100)
    for view in (normals[:, :640], normals[:, 640:]):
        # The whole boom is seen, and from near.
        rows, columns = np.nonzero(view)
        assert len(rows) > 50
        assert max(np.ptp(rows), np.ptp(columns)) > 50
        assert columns.min() > 5
        assert columns.max() < 635


BRICK = """<mujoco><asset>
  <mesh name="m" vertex="0 0 0  .4 0 0  0 .4 0  0 0 .4"/></asset><worldbody>
  <body name="base" pos="0 0 1"><freejoint/><geom type="mesh" mesh="m"/></body>
</worldbody></mujoco>"""


def test_a_robot_that_collides_as_meshes_wears_a_skin_and_is_drawn():
    pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    Path("brick.xml").write_text(BRICK)
    robot = ("--robot", "brick.xml")
    run(
        *("place", *robot, "--meshes", "brick.xml", "--num-sensors", "10"),
        *("--out", "skin.json"),
    )
    done = call("skin", "show", "skin.json", *robot, "--picture", "skin.png")
    if "OpenGL" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr


def test_meshes_that_are_not_the_robots_are_left_out():
    pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    mesh = '<geom type="mesh" mesh="m"/>'
    text = BRICK.replace("</worldbody>", f"{mesh}</worldbody>")
    text = text.replace(mesh, f'{mesh}<body name="cap" pos="0 0 .5">{mesh}</body>', 1)
    text = text.replace("<asset>", '<compiler fusestatic="true"/><asset>')
    Path("brick.xml").write_text(text)
    args = ("place", "--meshes", "brick.xml", "--num-sensors", "50")
    run(*args, "--robot", "brick.xml", "--out", "skin.json")
    assert set(Skin.load(Path("skin.json")).links) == {"base", "cap"}
    # None is the robot's.
    Path("other.xml").write_text(BRICK.replace('"base"', '"trunk"'))
    told = fail("skin", *args, "--robot", "other.xml", "--out", "b.json")
    assert "has no link 'world' for a mesh; its links are trunk" in told


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["import", "none.csv", "--out", "a.json"], "none.csv"),
        (["import", "bad.csv", "--out", "a.json"], "bad.csv:2: expected 10 values"),
        (["import", "bad.csv", "--out", "a.csv"], "must end in .json"),
        (["import", "bad.csv", "--out", "no/a.json"], "there is no folder"),
        (["import", "bad.csv", "--link-map", "arm", "--out", "a.json"], "name=value"),
        (["import", "--out", "a.json"], "at least one file"),
        (["import", "bad.csv", "./bad.csv", "--out", "a.json"], "file is given twice"),
        (["import", "pipe", "--out", "a.json"], "pipe must be a file"),
        (
            ["import", "bad.csv", "--robot", "h1", "--out", "a.json"],
            "it must be one of h1_2, g1, a folder",
        ),
        (["import", "bad.csv", "--robot", "bad.csv", "--out", "a.json"], "(.urdf, .x"),
        (["show", "pipe"], "skin file pipe: pipe must be a file, but is a named pipe"),
        (["show", "/dev/zero"], "skin file /dev/zero: /dev/zero must be a file"),
        (["export", "deep.json", "--out", "a.csv"], "skin file deep.json: nested"),
        (["export", "bad.csv", "--out", "a.csv"], "skin file bad.csv"),
        (["show", "other.json"], "did you mean 'torso_link'"),
        (
            ["show", "alien.json", "--picture", "a.png"],
            "for the robot 'alien': give its path with --robot PATH",
        ),
        (
            ["show", "alien.json", "--robot", "h1_2"],
            "alien.json: made for the robot 'alien', not 'h1_2'; if it fits, change",
        ),
        (["show", "alien.json", "--picture", "a.jpg"], "must end in .png"),
        (["place", "--density", "torso_link=x", "--out", "a.json"], "must be a number"),
        (
            ["place", "--density", "torso_link=1", "torso_link=5", "--out", "a.json"],
            "--density has a name twice",
        ),
        (["place", "--density", "torso_link=", "--out", "a.json"], "takes name=value"),
        (["place", "--links", "torso_lnk", "--out", "a.json"], "torso_lnk"),
        (["place", "--num-sensors", "0", "--out", "a.json"], "0"),
        (["place", "--meshes", "none", "--out", "a.json"], "none"),
        (["place", "--method", "grid", "--out", "a.json"], "poisson_disk"),
        (["paint"], "place"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_clear_message(args, expected):
    Path("bad.csv").write_text(f"{TABLE.splitlines()[0]}\n0,1,2\n")
    content = """{"format": "egoskin-skin-1", "robot": "ROBOT", "sensors": [
      {"link": "torso_lnk", "position": [0, 0, 0], "normal": [1, 0, 0]}]}"""
    Path("other.json").write_text(content.replace("ROBOT", "h1_2"))
    Path("alien.json").write_text(content.replace("ROBOT", "alien"))
    Path("deep.json").write_text("[" * 100_000)
    os.mkfifo("pipe")
    before = sorted(Path().iterdir())
    assert expected in fail("skin", *args)
    assert sorted(Path().iterdir()) == before


def test_links_that_cannot_carry_sensors_are_told(small_robot):
    robot = small_robot(
        "<geom size='.1'/><body name='seen'><geom size='.1' contype='0'"
        " conaffinity='0'/></body><body name='frame'/>"
    )
    links = ("base", "seen", "frame")
    note = "no collision shape on seen: no sensors there"
    assert bare_links(robot, links) == [note]
    assert bare_links(robot, ["base", "frame"]) == []
