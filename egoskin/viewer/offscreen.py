"""Pictures of states: the robot, its sensors, the balls, and the detections.

MuJoCo selects its OpenGL backend when first imported. Without a display, call
`egoskin.viewer.draw_without_display` before, or set ``MUJOCO_GL`` to egl or osmesa.

Contract: pictures are drawn only from keys of the environment (``base_pose``,
``joint_pos``, ``object_pose``, ``object_active``, ``distance``, ``balls_avoided``),
never from live simulation; a stored tensordict with these keys can be drawn as well.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase

from egoskin.bounds import POSITIVE, check_bounds
from egoskin.make import EnvConfig
from egoskin.robots.config import RobotConfig
from egoskin.sensors import Ray, Skin
from egoskin.shapes import Shape
from egoskin.viewer.film import Frame

# Colours (r, g, b, a). A line is coloured by the kind of the detecting sensor: blue for
# fields, yellow for rays.
_IDLE_RGBA = (0.16, 0.2, 0.3, 1.0)
_LIT_RGBA = (0.1, 0.95, 1.0, 1.0)
_FIELD_LINE_RGB = (0.1, 0.35, 1.0)
_RAY_LINE_RGB = (1.0, 0.8, 0.0)
_BALL_RGBA = (0.95, 0.35, 0.08, 1.0)
# Drawn radii [m]: an idle sensor, a detecting sensor, a line.
_IDLE_RADIUS, _LIT_RADIUS, _LINE_RADIUS = 0.017, 0.03, 0.006
_NORMAL_LENGTH, _NORMAL_RADIUS = 0.08, 0.003
_NORMAL_RGBA = (0.1, 0.95, 1.0, 1.0)
# Opacity of lines falls linearly with length, to 0 at this [m], but not below this.
_FADE_LENGTH, _FAINTEST = 2.5, 0.25
# The camera's look-at point follows the base with this time constant [s]; its height,
# for a robot as tall as the H1-2 (1.78 m) [m].
_FOLLOW_TIME, _LOOK_HEIGHT, _REFERENCE_HEIGHT = 0.4, 1.0, 1.78
_IS_LINUX = sys.platform == "linux"


class RenderingError(ValueError):
    """No OpenGL context can be created; the text says how to get one."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Placement of the camera relative to the robot that it follows."""

    distance: Annotated[float, POSITIVE] = 3.4
    """Distance to a robot as tall as the H1-2 (1.78 m) [m]; it is scaled with the
    robot's height, or with its length if its base is fixed."""
    azimuth_deg: float = 30.0
    """Azimuth of the camera, relative to the robot's initial heading [deg]."""
    elevation_deg: float = 10.0
    """Angle by which the camera looks down [deg]."""

    def __post_init__(self) -> None:
        """Raise ValueError for numbers out of bounds."""
        check_bounds(self)


def painter_of(
    config: EnvConfig,
    skin: Skin,
    *,
    size: tuple[int, int] = (960, 540),
    camera: CameraConfig | None = None,
) -> Painter:
    """Return a painter of an environment's states, to be used in a ``with`` block.

    Args:
        config: Environment configuration.
        skin: The sensors.
        size: Width and height of the pictures [px].
        camera: Placement of the camera.

    Raises:
        RenderingError: If no OpenGL context can be created.
        ValueError: If the size is odd or below 16.
    """
    sensors = config.pipeline(skin)
    return Painter(
        config.robot_config,
        sensors.skin if sensors.groups else None,
        config.task.throws.balls,
        size=size,
        camera=camera,
    )


class Painter:
    """Draws states of one robot with its sensors and balls.

    It is a context manager, because it holds an OpenGL context.

    Args:
        robot: The robot.
        skin: Sensors to draw; None for none.
        objects: Shape of each of the ``O`` objects.
        size: Width and height of the pictures [px].
        camera: Placement of the camera.

    Raises:
        RenderingError: If no OpenGL context can be created.
        ValueError: If the size is odd or below 16.
    """

    def __init__(
        self,
        robot: RobotConfig,
        skin: Skin | None,
        objects: Sequence[Shape],
        *,
        size: tuple[int, int] = (960, 540),
        camera: CameraConfig | None = None,
    ) -> None:
        if min(size) < 16 or size[0] % 2 or size[1] % 2:
            # H.264 stores colour for blocks of 2 x 2 pixels; the text needs some room.
            raise ValueError(
                f"size must be two even numbers of at least 16, got {size}"
            )
        self._skin, self._objects = skin, tuple(objects)
        self._model = _build_model(robot, objects, size)
        self._data = mujoco.MjData(self._model)
        self._camera_config = camera or CameraConfig()
        self._size = (robot.standing_height or _REFERENCE_HEIGHT) / _REFERENCE_HEIGHT
        self._camera = mujoco.MjvCamera()
        self._last_time: float | None = None
        model = self._model
        joints = [model.joint(name).id for name in robot.joints]
        self._joints = model.jnt_qposadr[joints]
        # Where the base is in the positions, and where to look if it is fixed.
        self._base: slice | None = None
        self._centre: np.ndarray | None = None
        if robot.floats:
            start = model.jnt_qposadr[model.body(robot.base).jntadr[0]]
            self._base = slice(start, start + 7)
        else:
            self._data.qpos[self._joints] = robot.default_joint_pos
            mujoco.mj_kinematics(model, self._data)
            low, high = _bounds(model, self._data, robot.links)
            self._centre = (low + high) / 2
            self._size = float(np.linalg.norm(high - low)) / _REFERENCE_HEIGHT or 1.0
        base = self._data.body(robot.base)
        self._base_pose = np.concatenate((base.xpos, base.xquat))
        self._link_of_sensor = [
            model.body(name).id for name in (skin.links if skin else ())
        ]
        self._object_geoms = [model.geom(f"object_{i}").id for i in range(len(objects))]
        self._robot_geoms = [
            geom
            for geom in range(model.ngeom)
            if model.body_rootid[model.geom_bodyid[geom]] == model.body(robot.base).id
        ]
        most = model.ngeom + 2 * len(self._link_of_sensor) + 100
        self._renderer = _renderer(model, size, most)

    def __enter__(self) -> Painter:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def draw(
        self,
        state: TensorDictBase,
        detecting: np.ndarray | None = None,
        *,
        time: float,
        num_avoided: int = 0,
        ending: str | None = None,
    ) -> Frame:
        """Return the picture of a state.

        Args:
            state: One row with ``base_pose [7]`` (ignored if the base is fixed),
                ``joint_pos [J]``, ``object_pose [O, 7]`` and ``object_active [O]``.
            detecting: Whether each sensor detects something, ``[S]`` bool.
            time: Age of the episode [s]; the camera follows the base over time and is
                reset when time decreases.
            num_avoided: Balls avoided so far, for the frame.
            ending: Why the episode ends here, for the frame.
        """
        active = np.asarray(state["object_active"])
        if self._base is not None:
            self._base_pose = np.asarray(state["base_pose"], float)
        self._follow(time)
        self._place(state, active)
        self._renderer.update_scene(self._data, self._camera)
        if self._skin is None:
            detecting = np.zeros(0, dtype=bool)
        else:
            if detecting is None:
                detecting = np.zeros(len(self._skin), dtype=bool)
            pose = np.asarray(state["object_pose"], float)
            self._draw_sensors(detecting, pose[active], active)
        return Frame(
            image=self.image(),
            time=time,
            gap=self._gap(active),
            num_detecting=int(detecting.sum()),
            num_sensors=len(detecting),
            num_avoided=num_avoided,
            ending=ending,
        )

    def _draw_line(
        self, start: np.ndarray, end: np.ndarray, radius: float, rgba: Sequence[float]
    ) -> None:
        """Add a line between two points of the world to the state drawn last."""
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        geom = self._add(kind, rgba, glows=True)
        mujoco.mjv_connector(geom, kind, radius, start, end)

    def draw_normals(self) -> None:
        """Add the sensors' normals to the state drawn last, until the next `draw`."""
        if self._skin is None:
            return
        starts = self._in_world(self._skin.position)
        ends = self._in_world(self._skin.position + _NORMAL_LENGTH * self._skin.normal)
        for start, end in zip(starts, ends, strict=True):
            self._draw_line(start, end, _NORMAL_RADIUS, _NORMAL_RGBA)

    def image(self) -> np.ndarray:
        """Return the picture of the state drawn last, ``[H, W, 3]`` uint8."""
        return self._renderer.render()

    def _place(self, state: TensorDictBase, active: np.ndarray) -> None:
        """Move the robot and the balls of the visual model to the poses of a state."""
        if self._base is not None:
            self._data.qpos[self._base] = self._base_pose
        self._data.qpos[self._joints] = state["joint_pos"]
        pose = np.asarray(state["object_pose"], float)
        lamp = np.array([*self._camera.lookat[:2], 0.0])
        half = math.radians(self._camera.azimuth) / 2
        turn = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
        self._data.mocap_pos[:] = [*pose[:, :3], lamp]
        self._data.mocap_quat[:] = [*pose[:, 3:], turn]
        # Fully transparent geoms are not drawn.
        self._model.geom_rgba[self._object_geoms, 3] = active
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def _follow(self, time: float) -> None:
        """Move the look-at point towards the base, or look at a fixed robot."""
        camera, config = self._camera, self._camera_config
        goal = self._centre
        if goal is None:
            goal = np.array([*self._base_pose[:2], self._size * _LOOK_HEIGHT])
        if self._last_time is None or time < self._last_time:
            w, _, _, z = self._base_pose[3:]
            # The heading of an upright base is twice the angle of (w, z).
            heading = math.degrees(2 * math.atan2(z, w))
            camera.lookat[:] = goal
            camera.distance = self._size * config.distance
            # MuJoCo's azimuth is the direction in which the camera looks.
            camera.azimuth = heading + config.azimuth_deg + 180.0
            camera.elevation = -config.elevation_deg
        else:
            weight = 1 - math.exp((self._last_time - time) / _FOLLOW_TIME)
            camera.lookat[:] += weight * (goal - camera.lookat)
        self._last_time = time

    def _draw_sensors(
        self, detecting: np.ndarray, active_pose: np.ndarray, active: np.ndarray
    ) -> None:
        """Add the sensors, and a line from each that detects to the nearest ball."""
        assert self._skin is not None
        points = self._in_world(self._skin.position)
        for point, is_lit in zip(points, detecting, strict=True):
            radius = _LIT_RADIUS if is_lit else _IDLE_RADIUS
            rgba = _LIT_RGBA if is_lit else _IDLE_RGBA
            geom = self._add(mujoco.mjtGeom.mjGEOM_SPHERE, rgba, glows=bool(is_lit))
            geom.size[:], geom.pos[:] = radius, point
        if not (detecting.any() and active.any()):
            return
        points = points[detecting]
        shapes = [s for s, on in zip(self._objects, active, strict=True) if on]
        found = zip(shapes, active_pose, strict=True)
        ends = np.stack([closest_point(shape, pose, points) for shape, pose in found])
        length = np.linalg.norm(ends - points, axis=-1)
        nearest = length.argmin(0)
        kinds = np.array([isinstance(own, Ray) for own in self._skin.coverage])
        colours = [_RAY_LINE_RGB if k else _FIELD_LINE_RGB for k in kinds[detecting]]
        for i, point in enumerate(points):
            fade = max(1 - length[nearest[i], i] / _FADE_LENGTH, _FAINTEST)
            end, rgba = ends[nearest[i], i], (*colours[i], fade)
            self._draw_line(point, end, _LINE_RADIUS, rgba)

    def _in_world(self, points: np.ndarray) -> np.ndarray:
        """Return one point of each sensor's link in the world [m], ``[S, 3]``."""
        rotation = self._data.xmat[self._link_of_sensor].reshape(-1, 3, 3)
        offset = (rotation @ points[:, :, None])[..., 0]
        return self._data.xpos[self._link_of_sensor] + offset

    def _add(
        self, kind: mujoco.mjtGeom, rgba: Sequence[float], *, glows: bool
    ) -> mujoco.MjvGeom:
        """Add a geom to the scene, with zero size and at the origin."""
        scene = self._renderer.scene
        assert scene.ngeom < scene.maxgeom
        geom = scene.geoms[scene.ngeom]
        zero, colour = np.zeros(3), np.array(rgba, np.float32)
        mujoco.mjv_initGeom(geom, kind, zero, zero, np.eye(3).ravel(), colour)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        geom.emission = float(glows)
        scene.ngeom += 1
        return geom

    def _gap(self, active: np.ndarray) -> float:
        """Return the smallest distance from the robot to an active ball [m], or inf."""
        far = 100.0
        gaps = [
            mujoco.mj_geomDistance(self._model, self._data, ours, ball, far, None)
            for ball, is_active in zip(self._object_geoms, active, strict=True)
            if is_active
            for ours in self._robot_geoms
        ]
        return min(gaps, default=math.inf)


def closest_point(shape: Shape, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points of an object that are closest to query points.

    Args:
        shape: The object's shape.
        pose: Its pose in the world, position [m] and quaternion, ``[7]``.
        points: Query points in the world [m], ``[n, 3]``.

    Returns:
        Points in the world [m], ``[n, 3]``; the query point itself if it is inside.
    """
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, pose[3:])
    rotation = rotation.reshape(3, 3)
    local = torch.from_numpy((points - pose[:3]) @ rotation)
    closest = torch.stack(shape.closest_point(*local.unbind(-1)), -1).numpy()
    return closest @ rotation.T + pose[:3]


def _bounds(
    model: mujoco.MjModel, data: mujoco.MjData, links: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around links and their shapes [m], ``[3]`` each.

    The box may be slightly too large.
    """
    bodies = [model.body(name).id for name in links]
    geoms = np.isin(model.geom_bodyid, bodies)
    centre = np.concatenate((data.xpos[bodies], data.geom_xpos[geoms]))
    reach = np.append(np.zeros(len(bodies)), model.geom_rbound[geoms])[:, None]
    return (centre - reach).min(0), (centre + reach).max(0)


def _build_model(
    robot: RobotConfig, objects: Sequence[Shape], size: tuple[int, int]
) -> mujoco.MjModel:
    """Return a model of the robot with tiled floor, sky, light and mocap balls.

    The floor is at height 0, or lower if a fixed robot reaches lower.
    """
    spec = robot.spec()
    # A URDF would lose materials: those of the floor, too.
    spec.compiler.discardvisual = False
    world = spec.worldbody
    ground = 0.0
    if not robot.floats:
        data = mujoco.MjData(robot.model)
        mujoco.mj_kinematics(robot.model, data)
        lowest = data.body(robot.base).xpos[2] - robot.default_base_height
        ground = min(ground, float(lowest))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.headlight.ambient = [0.38, 0.38, 0.4]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.visual.quality.shadowsize = 4096
    spec.visual.rgba.haze = [0.86, 0.88, 0.91, 1]
    # Extent scales near plane, fog and shadow of the scene [m].
    spec.stat.extent, spec.stat.center = 3.0, [0, 0, 1]
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 12.0
    spec.visual.map.shadowclip = 3.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.72, 0.77, 0.84],
        rgb2=[0.86, 0.88, 0.91],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.60, 0.62, 0.65],
        rgb2=[0.68, 0.70, 0.73],
        mark=mujoco.mjtMark.mjMARK_EDGE,
        markrgb=[0.78, 0.79, 0.81],
        width=512,
        height=512,
    )
    # The texture has 2 x 2 tiles and is 2 m wide, so tiles are 1 m wide.
    tiles = spec.add_material(name="tiles", texuniform=True, texrepeat=[1, 1])
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    # New geoms start from these defaults, not from the robot's (a hidden group, say).
    plain = mujoco.MjSpec()
    world.add_geom(
        default=plain.default,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        pos=[0, 0, ground],
        material="tiles",
    )
    for i, shape in enumerate(objects):
        body = world.add_body(name=f"ball_{i}", mocap=True)
        shape.add_geom(body, default=plain.default, name=f"object_{i}", rgba=_BALL_RGBA)
    # The light moves with the camera, so its shadow map covers the robot's vicinity.
    world.add_body(name="lamp", mocap=True).add_light(
        pos=[-1.6, 1.2, 4.0],
        dir=[0.4, -0.3, -1.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        diffuse=[0.55, 0.55, 0.53],
        specular=[0.2, 0.2, 0.2],
    )
    return spec.compile()


def _renderer(
    model: mujoco.MjModel, size: tuple[int, int], max_geoms: int
) -> mujoco.Renderer:
    """Return MuJoCo's renderer.

    Raises:
        RenderingError: If no OpenGL context can be created.
        ValueError: If the picture size is not supported.
    """
    backend = os.environ.get("MUJOCO_GL", "")
    has_display = any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))
    # Otherwise glfw prints warnings about the missing display before it fails.
    if mujoco.GLContext.__module__ == "mujoco.glfw" and _IS_LINUX and not has_display:
        raise RenderingError(no_gl_text(backend))
    try:
        return mujoco.Renderer(model, size[1], size[0], max_geoms)
    # PyOpenGL reports a missing library as a missing attribute of None.
    except (ImportError, AttributeError, RuntimeError) as error:
        raise RenderingError(no_gl_text(backend)) from error
    except mujoco.FatalError as error:
        raise ValueError(
            f"cannot render {size} pixels on this machine: {error}"
        ) from error


def no_gl_text(backend: str) -> str:
    """Return the error text for an OpenGL backend that does not work."""
    return (
        f"cannot render: no OpenGL context from {backend or 'the default backend'!r}; "
        "install one (Debian: `apt-get install libegl1`, or `apt-get install "
        "libosmesa6` and set MUJOCO_GL=osmesa); in Python, call egoskin.viewer."
        "draw_without_display before mujoco is imported"
    )
