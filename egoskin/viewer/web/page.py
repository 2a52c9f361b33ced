"""The page of `egoskin view`: robots in motion, and balls thrown by visitors.

Contract: one thread, that of `Page.run`, computes and draws; requests of visitors reach
it as functions in a queue. Without visitors it only waits for that queue.
"""

from __future__ import annotations

import math
import queue
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from egoskin.policies.policy import (
    load_critic,
    load_policy,
    policy_file,
    shipped_policies,
)
from egoskin.viewer.web.panel import MEMORY, Panel, Wishes
from egoskin.viewer.web.scene import RobotScene, set_stage
from egoskin.viewer.web.server import open_server, stop_server
from egoskin.viewer.web.session import Frame, Session, Throw

_PAUSE_AFTER_END = 1.2
"""Time for which the end of an episode is shown before the next begins [s]."""
_PICTURE_HZ, _LEAST_PICTURE_HZ, _PANEL_HZ = 30.0, 10.0, 6.0
_FOLLOW_PERIOD = 2.0
"""Time between checks for a newer policy of a run [s]."""
_TOO_LATE = 0.25
"""Beyond this delay, lost time is not made up for [s]."""
_SPACING = 2.6
"""Distance between neighbouring robots [m]."""
_FIELD_OF_VIEW = 0.75
"""Vertical field of view [rad]."""
_HALF_WIDTH, _HALF_HEIGHT = 1.2, 1.75
"""Visible space beside the outer robots, and above and below their middle [m]."""
_PANEL_WIDTH, _USUAL_SIZE = 340, (1440, 900)
"""Width of the panel, and size of a usual window [px]."""
_PICK_RADIUS = 0.035
"""A click this close to a sensor selects it [m]."""


class Page:
    """A local page with one robot, or several that receive the same throws.

    Args:
        sources: Policy of each robot: name, file, checkpoint or run folder.
        port: Port of 127.0.0.1; 0 for any free one.
        seed: Random seed of the episodes and throws.

    Raises:
        ValueError: If a policy does not exist, or two have different control rates.
        OSError: If the port is taken.
    """

    def __init__(self, sources: Sequence[str], port: int = 0, seed: int = 0) -> None:
        self.sessions: list[Session] = []
        for source in sources:
            rate = self.hz if self.sessions else None
            self.sessions.append(Session(source, seed, rate))
        self.server = open_server(port)
        set_stage(self.server)
        self._commands: queue.Queue[Callable[[], object]] = queue.Queue()
        self._scenes = [self._scene_of(i) for i in range(len(sources))]
        self.panel = Panel(
            self.server,
            self.sessions,
            offered_policies(sources),
            Wishes(
                throw=lambda bearing: self._ask(self.throw_from, bearing),
                pause=lambda: self._ask(self.pause),
                step=lambda: self._ask(self.step_once),
                reset=lambda: self._ask(self.reset),
                replay=lambda: self._ask(self.replay),
                save=lambda client: self._ask(self.save, client),
                mask=lambda every: self._ask(self.mask_all, every),
                sense=lambda: self._ask(self.sense),
                load=lambda i, source: self._ask(self.load, i, source),
            ),
        )
        self.server.scene.on_click()(
            lambda event: self._ask(
                self.click,
                np.array(event.ray_origin),
                np.array(event.ray_direction),
            )
        )
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(lambda _: self._ask(lambda: None))
        self._look(self.server.initial_camera, _USUAL_SIZE)
        self.is_paused = False
        self.error = ""
        """Text of the last error; "" if there is none."""
        self.steps = 0
        """Control steps computed so far."""
        self._random = np.random.default_rng(seed)
        self._versions = [_version(source) for source in sources]
        self._notes = [""] * len(sources)
        self._looked = self._panel_shown = self._pictured = 0.0
        self._steps_shown, self._speed = 0, ""
        self._replayed: deque[list[Frame]] = deque()
        self._forget()

    def _scene_of(self, i: int) -> RobotScene:
        session = self.sessions[i]
        several = len(self.sessions) > 1
        return RobotScene(
            self.server,
            f"/robot_{i}",
            session.body,
            session.skin,
            session.config.task.throws.balls,
            # The camera looks along -x, so the first robot, on the left, has least y.
            (0.0, _SPACING * (i - (len(self.sessions) - 1) / 2) * several),
            _short(session.source) if several else "",
        )

    def _forget(self) -> None:
        """Reset all counts and recorded frames."""
        number = len(self.sessions)
        self._memory: deque[list[Frame]] = deque(maxlen=round(MEMORY * self.hz))
        self._avoided, self._came = [0] * number, [0] * number
        self._survival: list[list[float]] = [[] for _ in range(number)]
        self._ended_for = [0] * number
        self._since_throw = 0
        self._replayed.clear()

    @property
    def hz(self) -> float:
        """Control rate of all robots [Hz]."""
        return self.sessions[0].hz

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    # --- the loop ---------------------------------------------------------------

    def _ask(self, wish: Callable[..., object], *args: Any) -> None:
        """Queue a function for the loop; any thread may call this."""
        self._commands.put(lambda: wish(*args))

    def run(self) -> None:
        """Play in real time until the process ends."""
        due = time.monotonic()
        while True:
            if not self.server.get_clients():
                self._do(self._commands.get())
                due = self._panel_shown = time.monotonic()
                continue
            late = time.monotonic() - due
            self._do(partial(self.advance, late > 1 / self.hz))
            due += self.panel.slowdown.value / self.hz
            if late > _TOO_LATE:
                due = time.monotonic()
            # Handle requests until the next step is due, at least all queued so far.
            while True:
                try:
                    wish = self._commands.get(timeout=max(due - time.monotonic(), 0))
                except queue.Empty:
                    break
                self._do(wish)

    def close(self) -> None:
        """Close the page."""
        stop_server(self.server)

    def _do(self, wish: Callable[[], object]) -> None:
        """Call a function; an exception is shown on the page and does not end it."""
        try:
            wish()
        # A policy may be arbitrary code and raise anything.
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"
            self.panel.show_error(self.error)

    def advance(self, is_late: bool = False) -> None:
        """Advance one control step unless paused, and draw if a picture is due.

        Args:
            is_late: Whether the loop is behind the clock; pictures are then skipped.
        """
        if self._replayed:
            frames = self._replayed.popleft()
        elif not self.is_paused and not self.error:
            self.play()
            frames = [session.frame for session in self.sessions]
        else:
            frames = None
        now = time.monotonic()
        wait = 1 / (_LEAST_PICTURE_HZ if is_late else _PICTURE_HZ)
        # Half a step of tolerance: draw at the step nearest to the due time.
        if frames is not None and now - self._pictured > wait - 0.5 / self.hz:
            self._pictured = now
            self._draw(frames)
        if now - self._panel_shown > 1 / _PANEL_HZ:
            self._show()
        if now - self._looked > _FOLLOW_PERIOD:
            self._looked = now
            self._follow()

    def play(self) -> None:
        """Compute one control step of all robots."""
        self._since_throw += 1
        tempo = self.panel.tempo.value
        if tempo and self._since_throw >= 60 * self.hz / tempo:
            self.throw_from(None)
        # The pause after the end of an episode is not recorded.
        goes_on = any(session.frame.ending is None for session in self.sessions)
        frames = []
        for i, session in enumerate(self.sessions):
            if session.frame.ending is None:
                frame = session.step()
                if frame.ending is not None:
                    self._end(i)
            else:
                frame = session.frame
                self._ended_for[i] += 1
                if self._ended_for[i] > _PAUSE_AFTER_END * self.hz:
                    frame = session.reset()
            frames.append(frame)
        self.steps += 1
        if goes_on or not self._memory:
            self._memory.append(frames)

    def _end(self, i: int) -> None:
        """Add the results of an ended episode to the counts."""
        session = self.sessions[i]
        avoided, came = session.avoided
        self._avoided[i] += avoided
        self._came[i] += came
        self._survival[i].append(session.frame.survived)
        self._ended_for[i] = 0

    def _draw(self, frames: Sequence[Frame]) -> None:
        with self.server.atomic():
            for session, scene, frame in zip(
                self.sessions, self._scenes, frames, strict=True
            ):
                scene.draw(frame, session.masked)

    def _look(
        self,
        camera: viser.InitialCameraConfig | viser.CameraHandle,
        size: tuple[int, int],
    ) -> None:
        """Place a camera so that it sees all robots beside the panel.

        Args:
            camera: The camera.
            size: Width and height of its view [px].
        """
        width, height = size
        free = max(1 - _PANEL_WIDTH / width, 0.4)
        half = _HALF_WIDTH + _SPACING * (len(self.sessions) - 1) / 2
        # Half the visible height at a distance of 1 m [m].
        slope = math.tan(_FIELD_OF_VIEW / 2)
        away = max(_HALF_HEIGHT / slope, half / (slope * free * width / height))
        # Centre the robots in the area left of the panel.
        beside = (1 - free) * away * slope * width / height
        camera.fov = _FIELD_OF_VIEW
        # In this order: setting the position of a visitor's camera also moves look_at.
        camera.position = (0.92 * away, beside - 0.35 * away, 0.92 + 0.17 * away)
        camera.look_at = (0.0, beside, 0.92)

    # --- requests of visitors -------------------------------------------------

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Show all robots to a new visitor, for any window width."""
        camera = client.camera
        self._look(camera, (camera.image_width, camera.image_height))
        self._ask(self._greet)

    def _greet(self) -> None:
        """Draw the current frames and update the panel."""
        self._draw([session.frame for session in self.sessions])
        self._show()

    def throw(self, throw: Throw) -> None:
        """Throw one ball at each robot."""
        self._since_throw = 0
        self._replayed.clear()
        for session in self.sessions:
            session.throw(throw)

    def throw_from(self, bearing: float | None) -> None:
        """Throw a ball with the speed and height of the sliders.

        Args:
            bearing: Direction it comes from, relative to the robot's heading [deg];
                None for a random one.
        """
        if bearing is None:
            bearing = self._random.uniform(-180, 180)
        # All robots receive the same throw.
        self.throw(
            Throw(
                azimuth=np.radians(bearing),
                distance=self._random.uniform(*self.sessions[0].distances),
                target=self._random.uniform(),
                speed=self.panel.speed.value,
                height=self.panel.height.value,
            )
        )

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Mask the sensor that is clicked on, or throw a ball.

        A click on a robot throws a ball at that place from the visitor's side; a click
        on the floor throws one from there.

        Args:
            origin: Viewpoint of the visitor [m], ``[3]``.
            direction: Direction of the click, ``[3]``.
        """
        for i, (session, scene) in enumerate(
            zip(self.sessions, self._scenes, strict=True)
        ):
            local = origin - scene.place
            sensor = session.sensor_at(local, direction, _PICK_RADIUS)
            if sensor is not None:
                self.mask(i, session.masked ^ {sensor})
                return
            session.body.place(session.frame.qpos)
            place = session.body.hit(local, direction)
            if place is not None:
                self._throw_at(session, session.azimuth_of(local), place)
                return
        if direction[2] < 0:
            floor = origin - origin[2] / direction[2] * direction
            away = [np.linalg.norm(floor - s.place) for s in self._scenes]
            i = int(np.argmin(away))
            session, floor = self.sessions[i], floor - self._scenes[i].place
            azimuth, distance = session.azimuth_of(floor), session.distance_of(floor)
            self.throw(
                Throw(
                    azimuth=azimuth,
                    distance=distance,
                    speed=self.panel.speed.value,
                    height=self.panel.height.value,
                )
            )

    def _throw_at(self, session: Session, azimuth: float, place: np.ndarray) -> None:
        self.throw(
            Throw(
                azimuth=azimuth,
                distance=float(np.mean(session.distances)),
                target=session.target_near(place),
                speed=self.panel.speed.value,
                height=self.panel.height.value,
            )
        )

    def mask(self, i: int, sensors: set[int]) -> None:
        """Mask exactly these sensors of a robot."""
        session = self.sessions[i]
        session.mask(sensors)
        if session.skin is not None:
            self.panel.show_masked(len(sensors), len(session.skin))
        self._draw([session.frame for session in self.sessions])

    def mask_all(self, every: bool) -> None:
        """Mask all sensors of all robots, or none."""
        for i, session in enumerate(self.sessions):
            if session.skin is not None:
                self.mask(i, set(range(len(session.skin))) if every else set())

    def pause(self) -> None:
        """Pause or resume."""
        self.is_paused = not self.is_paused

    def step_once(self) -> None:
        """Pause, and advance one control step."""
        self.is_paused = True
        self.play()
        self._draw([session.frame for session in self.sessions])

    def reset(self) -> None:
        """Restart all episodes, with all counts at 0."""
        self._clear_error()
        for session in self.sessions:
            session.reset()
        self._forget()
        self._greet()

    def replay(self) -> None:
        """Replay the recorded frames."""
        self._replayed = deque(self._memory)

    def sense(self) -> None:
        """Apply the panel's sensor settings to all robots with a skin."""
        for i, session in enumerate(self.sessions):
            if session.skin is not None:
                sensor = session.readable(**self.panel.sensor_changes)
                if sensor is None:
                    self.panel.show_sensors(self.sessions)
                    raise ValueError("the policy cannot read these sensors")
                session.configure(sensor)
                self._exchange_scene(i)
        self.reset()
        self.panel.show_sensors(self.sessions)

    def load(self, i: int, source: str) -> None:
        """Load another policy for a robot.

        Raises:
            ValueError: If there is no such policy, or it has another control rate than
                that of a second robot.
        """
        # All robots have the same rate; a single one may change it.
        rate = self.hz if len(self.sessions) > 1 else None
        self.sessions[i].load(source, rate)
        self._versions[i], self._notes[i] = _version(source), ""
        self._exchange_scene(i)
        self.reset()
        self.panel.show_sensors(self.sessions)

    def _exchange_scene(self, i: int) -> None:
        self._scenes[i].remove()
        self._scenes[i] = self._scene_of(i)

    def _clear_error(self) -> None:
        self.error = ""
        self.panel.show_error("")

    # --- display --------------------------------------------------------------

    def _show(self) -> None:
        """Update the panel."""
        now = time.monotonic()
        passed, done = now - self._panel_shown, self.steps - self._steps_shown
        self._panel_shown, self._steps_shown = now, self.steps
        wanted = self.hz / self.panel.slowdown.value
        is_slow = 0 < done < 0.9 * wanted * passed - 1
        self._speed = f"Slow: {done / passed:.0f} of {wanted:.0f} steps per second."
        if not is_slow:
            self._speed = ""
        frames = list(self._memory)
        self.panel.show_status(self._status())
        self.panel.show_policies(self.sessions, self._notes)
        if not frames:
            return
        maps = [
            np.stack([f[i].reading for f in frames if len(f[i].reading)])
            for i, session in enumerate(self.sessions)
            if session.skin is not None
        ]
        self.panel.show_map(maps, round(MEMORY * self.hz))
        clock = (np.arange(len(frames)) - len(frames) + 1) / self.hz
        robots = range(len(self.sessions))
        self.panel.show_plots(
            clock,
            [np.array([f[i].reading.max(initial=0) for f in frames]) for i in robots],
            [np.array([_or_nan(f[i].value) for f in frames]) for i in robots],
            self._survival,
            {s.source: s.critic is not None for s in self.sessions},
        )

    def _status(self) -> list[str]:
        """Return the status, in lines of Markdown."""
        state = "**Paused.** " if self.is_paused else self._speed
        state = "**Replay.** " if self._replayed else state
        lines = ["| | avoided&ensp; | untouched&ensp; | best |", "|---|---|---|---|"]
        for i, session in enumerate(self.sessions):
            avoided, came = session.avoided
            if session.frame.ending is not None:
                # Counted already.
                avoided = came = 0
            now = session.frame.survived
            best = max([now, *self._survival[i]])
            lines.append(
                f"| {_short(session.source)}&ensp; "
                f"| **{self._avoided[i] + avoided}** of {self._came[i] + came} "
                f"| {now:.1f} s | {best:.1f} s |"
            )
        return [*lines, "", state] if state else lines

    def _follow(self) -> None:
        """Load newer policies of runs that are still in training."""
        for i, session in enumerate(self.sessions):
            if not Path(session.source).is_dir():
                continue
            version = _version(session.source)
            if version != self._versions[i]:
                self._versions[i] = version
                session.follow(load_policy(session.source), load_critic(session.source))
                clock = time.strftime("%H:%M:%S")
                self._notes[i] = f"Latest policy of the run, loaded at {clock}."

    def save(self, client: viser.ClientHandle | None) -> None:
        """Send a visitor the `recording` as a file."""
        if client is not None:
            client.send_file_download(
                "egoskin.html", self.recording().encode(), save_immediately=True
            )

    def recording(self) -> str:
        """Return an HTML page that plays the recorded frames without a server."""
        frames = list(self._memory)[:: round(self.hz / _PICTURE_HZ)]
        recorder = self.server.get_scene_serializer()
        # Visitors only see the last of these pictures.
        with self.server.atomic():
            for each in frames:
                self._draw(each)
                recorder.insert_sleep(1 / _PICTURE_HZ)
        return recorder.as_html()


def offered_policies(sources: Sequence[str]) -> list[str]:
    """Return the selectable policies: those given, those shipped, those in ``runs``."""
    runs = sorted(
        str(path.parent) for path in Path("runs").glob("*/checkpoint.safetensors")
    )
    return list(dict.fromkeys([*sources, *shipped_policies(), *runs]))


def _version(source: str) -> int:
    """Return the modification time of a policy's file [ns]."""
    return policy_file(source).stat().st_mtime_ns


def _short(source: str) -> str:
    """Return the name of a policy without its folder."""
    return Path(source).stem if "/" in source else source


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
