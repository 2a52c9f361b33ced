"""Drawing of a robot, its skin and the balls on the page.

Contract: a picture is made from a `Frame` alone, so recorded frames can be drawn too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import trimesh
import viser

from egoskin.sensors import Ray, Skin
from egoskin.shapes import Shape
from egoskin.viewer.web.body import Body, mesh_of
from egoskin.viewer.web.session import Frame

# Colours (r, g, b).
_IDLE, _MASKED = np.array([22, 28, 48]), np.array([214, 216, 221])
_FAR, _NEAR = np.array([0, 170, 255]), np.array([255, 30, 90])
_FIELD_LINE, _RAY_LINE = (26, 89, 255), (255, 196, 0)
_BALL, _TRAIL_END = np.array([242, 100, 25]), np.array([236, 238, 242])
_FLOOR, _TILES = (214, 218, 225), (178, 184, 194)
# Radius of an idle sensor [m], and its scale at the largest reading.
_SENSOR_RADIUS, _LARGEST = 0.014, 2.0
# Balls farther from the robot than this are not drawn [m].
_FARTHEST = 12.0
# A ball that moved farther than this between two pictures was thrown again [m].
_JUMP = 1.0
_TRAIL_LENGTH = 24
# Links that move or turn less than this are not sent [m], [1].
_STILL = 1e-4
_WORD_HEIGHT = 1.95


def colour_of(reading: np.ndarray) -> np.ndarray:
    """Return the colours of readings, ``[n, 3]`` uint8.

    Args:
        reading: Readings, ``[n]``: 1 is contact, 0 is no detection.
    """
    colour = _FAR + reading[:, None] * (_NEAR - _FAR)
    return np.where(reading[:, None] > 0, colour, _IDLE).round().astype(np.uint8)


def set_stage(server: viser.ViserServer) -> None:
    """Add floor and background, and set the up direction."""
    scene = server.scene
    scene.set_up_direction("+z")
    scene.world_axes.visible = False
    sky = np.linspace((206, 216, 230), (244, 246, 249), 256)
    scene.set_background_image(np.repeat(sky[:, None].astype(np.uint8), 8, axis=1))
    scene.add_grid(
        "/floor",
        infinite_grid=True,
        cell_size=1.0,
        section_size=5.0,
        cell_color=_TILES,
        section_color=_TILES,
        plane_color=_FLOOR,
        plane_opacity=1.0,
        shadow_opacity=0.25,
        fade_distance=25.0,
        fade_from="origin",
    )
    server.initial_camera.up = (0.0, 0.0, 1.0)


class RobotScene:
    """One robot with its sensors and balls on the page.

    Args:
        server: The page.
        name: Name of its node in the scene tree.
        body: The robot.
        skin: Its sensors; None for none.
        balls: Shapes of the balls.
        place: Position of its origin on the page [m], ``(x, y)``.
        title: Text above it; "" for none.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        body: Body,
        skin: Skin | None,
        balls: Sequence[Shape] = (),
        place: tuple[float, float] = (0.0, 0.0),
        title: str = "",
    ) -> None:
        self._server, self._body, self._title = server, body, title
        self.skin = skin
        """The sensors; their kind may change, but not their number or positions."""
        self.place = np.array([*place, 0.0])
        self._root = server.scene.add_frame(name, show_axes=False, position=self.place)
        # Only link frames move: poses reach the browser faster than other updates.
        links = {part.body for part in body.parts()}
        if skin is not None:
            links |= set(body.link_indices(skin))
        self._links = {
            i: server.scene.add_frame(f"{name}/link_{i}", show_axes=False)
            for i in sorted(links)
        }
        for i, part in enumerate(body.parts()):
            *rgb, opacity = part.rgba
            server.scene.add_mesh_simple(
                f"{name}/link_{part.body}/part_{i}",
                part.vertices,
                part.faces,
                color=_rgb_255(rgb),
                opacity=None if opacity == 1 else opacity,
            )
        meshes = map(mesh_of, balls)
        self._balls = [
            server.scene.add_mesh_simple(
                f"{name}/ball_{i}",
                mesh.vertices,
                mesh.faces,
                color=_BALL,
                visible=False,
            )
            for i, mesh in enumerate(meshes)
        ]
        self._trails = [deque(maxlen=_TRAIL_LENGTH) for _ in balls]
        self._trail = _lines(server, f"{name}/trail", 0.02)
        self._lines = _lines(server, f"{name}/lines", 0.008)
        self._word = server.scene.add_label(
            f"{name}/word", title, anchor="bottom-center", visible=bool(title)
        )
        self._sensors = [] if skin is None else self._add_sensors(name, skin)

    def _add_sensors(
        self, name: str, skin: Skin
    ) -> list[tuple[np.ndarray, viser.BatchedMeshHandle]]:
        """Add the sensors of each link; return their indices and meshes, by link."""
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_SENSOR_RADIUS)
        owner = np.array(self._body.link_indices(skin))
        added = []
        for link in np.unique(owner):
            which = np.flatnonzero(owner == link)
            mesh = self._server.scene.add_batched_meshes_simple(
                f"{name}/link_{link}/sensors",
                ball.vertices,
                ball.faces,
                batched_positions=skin.position[which],
                batched_wxyzs=np.tile([1.0, 0, 0, 0], (len(which), 1)),
                batched_scales=np.ones(len(which)),
                batched_colors=np.tile(_IDLE, (len(which), 1)).astype(np.uint8),
                material="toon5",
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            added.append((which, mesh))
        return added

    def draw(self, frame: Frame) -> None:
        """Draw a frame."""
        data = self._body.data
        self._body.place(frame.qpos)
        for index, link in self._links.items():
            # A new visitor waits the longer, the more messages were ever sent.
            if np.abs(link.position - data.xpos[index]).max() > _STILL:
                link.position = data.xpos[index]
            if np.abs(link.wxyz - data.xquat[index]).max() > _STILL:
                link.wxyz = data.xquat[index]
        if self._sensors:
            self._draw_sensors(frame)
        self._draw_balls(frame)
        self._draw_word(frame)

    def _draw_sensors(self, frame: Frame) -> None:
        assert self.skin is not None
        points = self._body.sensor_points(self.skin)
        colours = colour_of(frame.reading)
        colours[list(frame.masked)] = _MASKED
        scales = 1 + (_LARGEST - 1) * np.sqrt(frame.reading)
        for which, mesh in self._sensors:
            if not np.array_equal(colours[which], mesh.batched_colors):
                mesh.batched_colors = colours[which]
                mesh.batched_scales = scales[which].astype(np.float32)
        seeing = np.isfinite(frame.line[:, 0])
        ends = np.stack((points[seeing], frame.line[seeing]), 1)
        is_ray = np.array([isinstance(own, Ray) for own in self.skin.coverage])
        colour = np.where(is_ray[seeing, None, None], _RAY_LINE, _FIELD_LINE)
        _set_lines(self._lines, ends, np.repeat(colour, 2, axis=1))

    def _draw_balls(self, frame: Frame) -> None:
        pieces, shades = [], []
        for i, (ball, trail) in enumerate(zip(self._balls, self._trails, strict=True)):
            centre = frame.balls[i]
            near = np.linalg.norm(centre[:2] - frame.qpos[:2]) < _FARTHEST
            ball.visible = bool(frame.active[i] and near)
            if not ball.visible or (
                trail and np.linalg.norm(centre - trail[-1]) > _JUMP
            ):
                trail.clear()
            if ball.visible:
                ball.position = centre
                trail.append(centre)
            if len(trail) > 1:
                way = np.array(trail)
                pieces.append(np.stack((way[:-1], way[1:]), 1))
                age = np.linspace(0, 1, len(way))[:, None]
                shade = _TRAIL_END + age * (_BALL - _TRAIL_END)
                shades.append(np.stack((shade[:-1], shade[1:]), 1))
        if pieces:
            _set_lines(self._trail, np.concatenate(pieces), np.concatenate(shades))
        else:
            self._trail.visible = False

    def _draw_word(self, frame: Frame) -> None:
        words = {"hit": "HIT", "fall": "FELL"}
        word = self._title
        if frame.ending is not None:
            cause = words.get(frame.ending, frame.ending.upper())
            word = f"{word}: {cause}" if word else cause
        if word != self._word.text:
            self._word.text = word
        self._word.visible = bool(word)
        self._word.position = (*frame.qpos[:2], _WORD_HEIGHT)

    def remove(self) -> None:
        """Remove the robot and everything with it from the page."""
        self._root.remove()


def _rgb_255(rgb: Sequence[float]) -> tuple[int, int, int]:
    """Return a colour in integers, as viser takes it."""
    red, green, blue = (round(255 * c) for c in rgb)
    return red, green, blue


def _lines(
    server: viser.ViserServer, name: str, thickness: float
) -> viser.LineSegmentsHandle:
    """Add a set of lines, empty at first."""
    return server.scene.add_line_segments(
        name,
        np.zeros((1, 2, 3), np.float32),
        np.zeros((1, 2, 3), np.uint8),
        thickness=thickness,
        visible=False,
    )


def _set_lines(
    lines: viser.LineSegmentsHandle, ends: np.ndarray, colours: np.ndarray
) -> None:
    """Replace a set of lines, by none or more.

    Args:
        lines: The set of lines.
        ends: Both ends of each line [m], ``[n, 2, 3]``.
        colours: Colours of the ends, ``[n, 2, 3]``.
    """
    lines.visible = len(ends) > 0
    if len(ends):
        lines.points = ends.astype(np.float32)
        lines.colors = colours.round().astype(np.uint8)
