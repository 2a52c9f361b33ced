"""Make, convert and look at skins.

egoskin skin place --num-sensors 64 --method poisson_disk --out skin.json
egoskin skin import gentact.xacro --parent torso_link --out skin.json
egoskin skin import *.csv --robot panda.urdf --out skin.json
egoskin skin export skin.json --out gentact.csv
egoskin skin show skin.json --picture skin.png
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from tensordict import TensorDict

from egoskin.commands.errors import parse_subcommand
from egoskin.progress import counted
from egoskin.robots.builtin import ROBOTS
from egoskin.robots.config import RobotConfig
from egoskin.robots.own import find_robot
from egoskin.sensors import Skin
from egoskin.sensors.skin.coverage import Coverage
from egoskin.sensors.skin.fit import FAR_OFF, fit_notes
from egoskin.sensors.skin.gentact import load_gentact, save_gentact
from egoskin.sensors.skin.mesh_surface import Meshes, meshes_in_folder, meshes_of_mjcf
from egoskin.sensors.skin.placement import place_sensors
from egoskin.storage.files import check_output
from egoskin.viewer.film import save_picture
from egoskin.viewer.offscreen import CameraConfig, Painter

# Placing this many sensors takes long enough for a message.
_MANY = 10_000
# Size of each of the two views of the picture [px].
_VIEW_SIZE = (640, 960)


def _pairs(values: Sequence[str], option: str) -> dict[str, str]:
    """Return the names and values of options of the form ``name=value``."""
    for value in values:
        if not all(value.rpartition("=")[::2]):
            raise ValueError(f"{option} takes name=value, got {value!r}")
    pairs = {v.rpartition("=")[0]: v.rpartition("=")[2] for v in values}
    if len(pairs) < len(values):
        raise ValueError(f"{option} has a name twice: {', '.join(values)}")
    return pairs


def _meshes(path: Path, robot: RobotConfig) -> Meshes:
    """Return the meshes of a robot's links from a folder or a MuJoCo model."""
    try:
        if path.is_dir():
            return meshes_in_folder(path, robot.links)
        meshes = meshes_of_mjcf(path)
    except ImportError as error:
        # It names the missing package, which the user can install: not a bug.
        raise ValueError(f"--meshes: {error}") from error
    # The world and other bodies may have meshes, too. With none left, it is an error.
    return {k: v for k, v in meshes.items() if k in robot.links} or meshes


@dataclass(frozen=True, kw_only=True)
class Place:
    """Place sensors at random on a robot's surface."""

    out: Path
    """Skin file to write (JSON)."""
    robot: str = "h1_2"
    """Name of the robot, or path of its folder, Python file, MJCF or URDF."""
    num_sensors: int | None = 64
    """Number of sensors; None: as many as the spacing allows."""
    method: Literal["area_uniform", "poisson_disk"] = "area_uniform"
    """Independent positions, or with a minimum distance between them."""
    seed: int = 0
    """Seed of the placement."""
    links: tuple[str, ...] | None = None
    """Links to cover, by name or shell pattern; None: the robot's skin_links."""
    density: tuple[str, ...] = ()
    """Relative density of sensors on links, LINK=WEIGHT, where LINK may be a shell
    pattern; 1 on the others."""
    spacing: float | None = None
    """Least distance between sensors [m] (poisson_disk); None: as large as possible."""
    stand_off: float = 0.0
    """Height of the sensors above the surface [m]."""
    meshes: Path | None = None
    """Folder of meshes named after links, or MJCF with meshes; None: the robot's
    primitives."""

    def run(self) -> None:
        """Write the skin."""
        check_output(self.out, "--out", (".json",))
        density = {}
        for link, weight in _pairs(self.density, "--density").items():
            try:
                density[link] = float(weight)
            except ValueError:
                raise ValueError(
                    f"--density: the weight of {link} must be a number, got {weight!r}"
                ) from None
        robot = find_robot(self.robot)
        if self.num_sensors is None:
            many = self.spacing is not None
        else:
            many = self.num_sensors >= _MANY
        if many:
            print("placing many sensors: this may take some minutes", flush=True)
        skin = place_sensors(
            robot,
            self.num_sensors,
            self.seed,
            method=self.method,
            links=self.links,
            density=density or None,
            spacing=self.spacing,
            stand_off=self.stand_off,
            meshes=None if self.meshes is None else _meshes(self.meshes, robot),
        )
        skin.save(self.out)
        print(table(skin, str(self.out)))
        for text in bare_links(robot, skin.provenance["links"]):
            print(f"note: {text}")


@dataclass(frozen=True, kw_only=True)
class Import:
    """Turn an export of GenTact's (CSV, xacro, URDF) into a skin file."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files exported from GenTact; their sensors are concatenated."""
    out: Path
    """Skin file to write (JSON)."""
    robot: str = "h1_2"
    """Name of the robot, or path of its folder, Python file, MJCF or URDF."""
    scale: float | None = None
    """Length of one unit of the files [m]; None: that of the dialect."""
    link_map: tuple[str, ...] = ()
    """Names of links, PART=LINK. PART is a part of a Parent path, a whole path, a link
    of the URDF or the name of a xacro's macro."""
    parent: str | None = None
    """Link of the sensors in a file that names none (xacro)."""
    skip_invalid: bool = False
    """Leave out sensors that cannot be read reliably, and list them."""

    def run(self) -> None:
        """Write the skin."""
        check_output(self.out, "--out", (".json",))
        if len({file.resolve() for file in self.files}) < len(self.files):
            raise ValueError(
                f"a file is given twice: {', '.join(map(str, self.files))}"
            )
        robot = find_robot(self.robot)
        skin = load_gentact(
            self.files,
            robot_name=robot.name,
            links=robot.links,
            primitives=robot.known_primitives,
            scale=self.scale,
            link_map=_pairs(self.link_map, "--link-map"),
            parent=self.parent,
            skip_invalid=self.skip_invalid,
        )
        skin.save(self.out)
        print(table(skin, str(self.out)))
        for name in skin.provenance.get("unused_link_map", ()):
            print(f"note: no file uses {name!r} of --link-map")
        for text in skin.provenance.get("left_out", ()):
            print(f"left out: {text}")
        files = skin.provenance.get("files", [skin.provenance])
        extents = [f.get("distance_to_primitives", (0, 0)) for f in files]
        off = max(abs(end) for extent in extents for end in extent)
        if off > FAR_OFF:
            print(
                f"warning: a sensor is {off:.2f} m off the robot's surface: check "
                "--scale and --link-map, and look at the picture of: egoskin skin "
                f"show {self.out} --picture skin.png"
            )


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a skin file as GenTact's CSV."""

    skin: Annotated[Path, tyro.conf.Positional]
    """Skin file (JSON)."""
    out: Path
    """CSV file to write."""

    def run(self) -> None:
        """Write the CSV."""
        check_output(self.out, "--out", (".csv",))
        skin = Skin.load(self.skin)
        lost = save_gentact(skin, self.out)
        note = f"; GenTact's format does not hold {', '.join(lost)}" if lost else ""
        print(f"{self.out}: {counted(len(skin), 'sensor')}{note}")


@dataclass(frozen=True, kw_only=True)
class Show:
    """Print the content of a skin file, and draw it."""

    skin: Annotated[Path, tyro.conf.Positional]
    """Skin file (JSON)."""
    picture: Path | None = None
    """Picture to write, .png: the robot from the front and from behind."""
    robot: str | None = None
    """Path of its robot, if that is not in the package: folder, Python file, MJCF or
    URDF."""

    def run(self) -> None:
        """Print the summary; write the picture."""
        check_output(self.picture, "--picture", (".png",))
        skin = Skin.load(self.skin)
        robot = ROBOTS.get(skin.robot)
        if self.robot is not None:
            robot = find_robot(self.robot)
        if robot is not None:
            skin.check_robot(robot.name, robot.links, str(self.skin))
        print(table(skin, str(self.skin)))
        for text in fit_notes(skin, robot) if robot is not None else ():
            print(f"note: {text}")
        if self.picture is not None:
            if robot is None:
                raise ValueError(
                    f"{self.skin} is for the robot {skin.robot!r}: give its path "
                    "with --robot PATH"
                )
            save_picture(self.picture, views(robot, skin))


def describe(coverage: Coverage | None) -> str:
    """Return a sensor's type as text: its kind and non-default values."""
    if coverage is None:
        return "as configured"
    default = type(coverage)()
    changed = [
        f"{f.name}={getattr(coverage, f.name)}"
        for f in fields(coverage)
        if getattr(coverage, f.name) != getattr(default, f.name)
    ]
    return " ".join([type(coverage).__name__.lower(), *changed])


def bare_links(
    robot: RobotConfig, links: Sequence[str], original: RobotConfig | None = None
) -> list[str]:
    """Return a line about links that look as if they could carry sensors, but cannot.

    Args:
        robot: The robot.
        links: The links.
        original: The robot with its visual shapes, if that is another one.
    """
    seen = original or robot
    bare = [
        link
        for link in links
        if not robot.has_shape(link)
        and (seen.is_urdf or seen.has_shape(link, visual=True))
    ]
    if not bare:
        return []
    hint = " (meshes of a URDF are left out: give them as --meshes)" * robot.is_urdf
    return [f"no collision shape on {', '.join(bare)}: no sensors there{hint}"]


def table(skin: Skin, title: str) -> str:
    """Return a table of the sensors on each link, by type and range."""

    def distance(value: float) -> str:
        return "as configured" if math.isnan(value) else f"{value:g} m"

    kinds = [describe(c) for c in skin.coverage]
    ranges = [distance(float(r)) for r in skin.range]
    groups = Counter(zip(skin.links, kinds, ranges, strict=True))
    rows = [("link", "sensors", "type", "range")]
    rows += [(link, str(n), kind, r) for (link, kind, r), n in sorted(groups.items())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"  {link:<{widths[0]}}  {number:>{widths[1]}}  {kind:<{widths[2]}}  {reach}"
        for link, number, kind, reach in rows
    ]
    head = f"{title}: {counted(len(skin), 'sensor')} on links of {skin.robot}"
    notes = [
        "  " + textwrap.shorten(f"{name}: {value}", 100, placeholder=" ...")
        for name, value in skin.provenance.items()
    ]
    return "\n".join([head, *lines, *notes])


def views(robot: RobotConfig, skin: Skin) -> np.ndarray:
    """Return the robot in its default pose with sensors and normals.

    Returns:
        Front and back view side by side, ``[height, width, 3]`` uint8.
    """
    height = robot.default_base_height
    state = TensorDict(
        {
            "base_pose": torch.tensor([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]),
            "joint_pos": torch.from_numpy(robot.default_joint_pos),
            "object_pose": torch.zeros(0, 7),
            "object_active": torch.zeros(0, dtype=torch.bool),
        }
    )
    images = []
    for azimuth in (0.0, 180.0):
        camera = CameraConfig(distance=3.4, azimuth_deg=azimuth, elevation_deg=12.0)
        painter = Painter(robot, skin, (), size=_VIEW_SIZE, camera=camera)
        with painter:
            painter.draw(state, time=0.0)
            painter.draw_normals()
            images.append(painter.image())
    return np.concatenate(images, axis=1)


def main(args: list[str]) -> None:
    """Run the command."""
    commands = {"place": Place, "import": Import, "export": Export, "show": Show}
    config = parse_subcommand(commands, args)
    config.run()
