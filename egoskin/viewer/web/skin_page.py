"""The page of a robot without a policy: its joints, its skin, and visible directions.

Contract: as in `egoskin.viewer.web.page`, one thread handles the requests of visitors.
The map of directions seen takes seconds, so another thread computes it.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Sequence

import numpy as np
import viser

from egoskin.evaluation.approaches import direction_grid, unit_vectors
from egoskin.evaluation.visibility import see_directions
from egoskin.robots.config import RobotConfig
from egoskin.sensors import Skin
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.pipeline import SensorPipeline
from egoskin.shapes import Sphere
from egoskin.viewer.web.body import Body
from egoskin.viewer.web.scene import RobotScene, set_stage
from egoskin.viewer.web.server import ServedPage, slider_value
from egoskin.viewer.web.session import Frame

# Point size relative to the sphere's radius; slider limit of an unlimited joint [rad].
_POINT_SIZE, _ANY_TURN = 0.013, math.pi
# Colours of directions first seen late or early, and of those never seen.
_LATE, _EARLY, _NEVER = np.array([88, 60, 140]), np.array([70, 205, 120]), (200, 30, 40)
_MOST_IN_FOLDER = 12
_LEGEND = (
    "Each point is a direction from which a ball flies straight at the base: "
    "**green** seen at the sensors' full range, **violet** only nearby, "
    "**red** never. Directions through the floor are omitted."
)


def colour_directions(share: np.ndarray) -> np.ndarray:
    """Return the colours of directions, ``[n, 3]`` uint8.

    Args:
        share: Clearance when first seen, divided by the range, ``[n]``; 0 if never.
    """
    colours = _LATE + share[:, None].clip(0, 1) * (_EARLY - _LATE)
    return np.where(share[:, None] > 0, colours, _NEVER).astype(np.uint8)


def group_joints(names: Sequence[str]) -> dict[str, list[int]]:
    """Return joint indices in small groups, by the first word of the joints' names."""
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name.split("_")[0], []).append(i)
    if not 1 < len(groups) <= 6:
        groups = {"joints": list(range(len(names)))}
    small = {}
    for name, members in groups.items():
        for k in range(0, len(members), _MOST_IN_FOLDER):
            number = f" {k // _MOST_IN_FOLDER + 1}" * (len(members) > _MOST_IN_FOLDER)
            small[f"{name}{number}"] = members[k : k + _MOST_IN_FOLDER]
    return small


class SkinPage(ServedPage):
    """A local page with a standing robot and sliders for its joints.

    Args:
        robot: The robot.
        skin: Its skin, if it has one.
        port: Port of 127.0.0.1; 0 for any free one.

    Raises:
        ValueError: If the skin was made for another robot or other links.
        OSError: If the port cannot be used.
    """

    def __init__(self, robot: RobotConfig, skin: Skin | None, port: int = 0) -> None:
        self.robot, self.skin = robot, skin
        if skin is not None:
            skin.check_robot(robot.name, robot.links)
        self.body = Body(robot)
        super().__init__(port)
        self.joint_pos = robot.default_joint_pos.copy()
        """Joint positions [rad], [m] for slide joints, ``[J]``."""
        self._computing: threading.Thread | None = None
        set_stage(self.server)
        resolved = skin and SensorPipeline(SensorConfig(), robot, skin).skin
        self._scene = RobotScene(self.server, "/robot", self.body, resolved)
        size = float(np.ptp(self.body.bounds(), axis=0).max())
        centre = self.body.bounds().mean(0)
        camera = self.server.initial_camera
        camera.position = centre + size * np.array([2.1, -0.7, 0.4])
        camera.look_at, camera.fov = centre + size * np.array([0, 0.25, 0]), 0.75
        self._add_panel()
        self.draw()

    def _add_panel(self) -> None:
        gui, robot = self.server.gui, self.robot
        number = 0 if self.skin is None else len(self.skin)
        text = f"**{robot.name}**, {len(robot.joints)} joints, {number} sensors"
        gui.add_markdown(text)
        tabs = gui.add_tab_group()
        self._sliders: dict[int, viser.GuiSliderHandle] = {}
        with tabs.add_tab("Joints"):
            reset = gui.add_button("Default pose")
            reset.on_click(lambda _: self._ask(self.reset))
            low, high = robot.joint_range
            for k, (name, members) in enumerate(group_joints(robot.joints).items()):
                with gui.add_folder(name, expand_by_default=k == 0):
                    for i in members:
                        self._add_slider(i, low[i], high[i])
        if self.skin is None:
            return
        with tabs.add_tab("Visibility"):
            self._kind = gui.add_dropdown("Sensors", ("field", "ray"))
            self._range = gui.add_slider("Range [m]", 0.1, 3.0, 0.1, 0.5)
            self._button = gui.add_button("Show what is seen in this pose")
            self._button.on_click(lambda _: self._ask(self.look))
            self._result = gui.add_markdown(_LEGEND)

    def _add_slider(self, i: int, low: float, high: float) -> None:
        start = self.joint_pos[i]
        if math.isinf(low):
            low, high = -_ANY_TURN, _ANY_TURN
        low, high = min(low, start), max(high, start)
        slider = self.server.gui.add_slider(
            _short(self.robot.joints[i], self.robot.joints),
            round(low, 3),
            round(high, 3),
            0.001,
            round(start, 3),
        )

        def move(event: viser.GuiEvent) -> None:
            if event.client:
                self._ask(self.move, i, slider_value(slider))

        slider.on_update(move)
        self._sliders[i] = slider

    # --- requests of visitors -------------------------------------------------

    def run(self) -> None:
        """Handle the requests of visitors until the process ends."""
        while True:
            self._do(self._commands.get())

    def move(self, joint: int, position: float) -> None:
        """Move a joint to a position [rad], [m] for a slide joint."""
        self.joint_pos[joint] = position
        self.draw()

    def reset(self) -> None:
        """Go back to the default pose."""
        self.joint_pos[:] = self.robot.default_joint_pos
        for i, slider in self._sliders.items():
            slider.value = round(self.joint_pos[i], 3)
        self.draw()

    def draw(self) -> None:
        """Draw the robot in its pose, without the directions seen in another."""
        number = 0 if self.skin is None else len(self.skin)
        frame = Frame(
            qpos=self.body.standing(self.joint_pos),
            balls=np.zeros((0, 3)),
            active=np.zeros(0, bool),
            reading=np.zeros(number),
            line=np.full((number, 3), np.nan),
        )
        with self.server.atomic():
            self._scene.draw(frame)
            self.server.scene.remove_by_name("/directions")
        if self.skin is not None and self._computing is None:
            self._result.content = _LEGEND

    def look(self) -> None:
        """Start to compute the directions seen in this pose; show them when done."""
        if self._computing is not None:
            return
        assert self.skin is not None
        self._button.disabled = True
        self.show_error("")
        pose = dict(zip(self.robot.joints, self.joint_pos.tolist(), strict=True))
        robot = dataclasses.replace(self.robot, default_pose=pose)
        max_range = slider_value(self._range)
        sensor = SensorConfig(coverage=self._kind.value, range=max_range)
        self._computing = threading.Thread(
            target=self._compute,
            args=(robot, self.skin, sensor, self.joint_pos.copy()),
            daemon=True,
        )
        self._computing.start()

    def _compute(
        self, robot: RobotConfig, skin: Skin, sensor: SensorConfig, pose: np.ndarray
    ) -> None:
        def tell(what: str, share: float) -> None:
            self._result.content = f"Computing: {share:.0%}"

        tell("", 0.0)
        try:
            ball = Sphere(radius=0.15)
            seen = see_directions(robot, skin, sensor, ball, progress=tell)
        except Exception as error:
            self._ask(self.show_error, f"{type(error).__name__}: {error}")
            self._ask(self._end, _LEGEND)
        else:
            # A range in the skin file takes precedence.
            used = skin.resolved(sensor.default_coverage, sensor.range)
            self._ask(self._finish, pose, seen, float(used.range.max()))

    def _finish(self, pose: np.ndarray, seen: np.ndarray, max_range: float) -> None:
        if np.array_equal(pose, self.joint_pos):
            self.show(seen, max_range)
        else:
            self._end(f"The robot moved meanwhile.\n\n{_LEGEND}")

    def _end(self, text: str) -> None:
        self._computing, self._button.disabled = None, False
        self._result.content = text

    def show(self, clearance: np.ndarray, max_range: float) -> None:
        """Show directions on a sphere around the robot.

        Args:
            clearance: Clearance at which a ball is first seen [m], in the order of
                `direction_grid`; 0 if never, NaN where no ball can come from.
            max_range: Longest range of the sensors [m].
        """
        azimuth, elevation = (angle.ravel() for angle in direction_grid())
        share = clearance.ravel() / max_range
        comes = np.isfinite(share)
        outward = unit_vectors(azimuth[comes], elevation[comes])
        bounds = self.body.bounds()
        centre = self.body.standing(self.joint_pos)[:3]
        radius = 1.05 * np.abs(bounds - centre).max()
        self.server.scene.add_point_cloud(
            "/directions",
            centre + radius * outward,
            colour_directions(share[comes]),
            point_size=_POINT_SIZE * radius,
            point_shape="circle",
            point_shading="flat",
        )
        solid = np.cos(elevation[comes])
        seen = float(solid[share[comes] > 0].sum() / solid.sum())
        self._end(f"**{seen:.1%}** of the directions are seen.\n\n{_LEGEND}")


def _short(name: str, names: Sequence[str]) -> str:
    """Return a joint's name without ``_joint`` if all names end in it."""
    common = "_joint"
    alike = all(other.endswith(common) for other in names)
    return name.removesuffix(common) if alike else name
