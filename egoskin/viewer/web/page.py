"""The page of `egoskin view`: robots in motion, and balls thrown by visitors.

Contract: one thread, that of `Page.run`, computes and draws; requests of visitors reach
it as functions in a queue. Without visitors it only waits for that queue.
"""

from __future__ import annotations

import math
import queue
import time
from collections import deque
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import viser

from egoskin.policies.policy import CHECKPOINT_NAME, policy_file, shipped_policies
from egoskin.viewer.web.panel import EPISODES, MEMORY, Callbacks, Panel
from egoskin.viewer.web.scene import RobotScene, set_stage
from egoskin.viewer.web.server import ServedPage, slider_value
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
"""Width of the panel, and size of a usual window [CSS px]."""
_PICK_RADIUS = 0.035
"""A click this close to a sensor selects it [m]."""


class Page(ServedPage):
    """A local page with one robot, or several that receive the same throws.

    Args:
        sources: Policy of each robot: name, file, checkpoint or run folder.
        port: Port of 127.0.0.1; 0 for any free one.

    Raises:
        ValueError: If a policy does not exist, or two have different control rates.
        OSError: If the port cannot be used.
    """

    def __init__(self, sources: Sequence[str], port: int = 0) -> None:
        # Before loading: a checkpoint that is written meanwhile is newer.
        self._versions = [_version(source) for source in sources]
        self._notes = [""] * len(sources)
        self.sessions: list[Session] = []
        for source in sources:
            rate = self.hz if self.sessions else None
            self.sessions.append(Session(source, rate))
        super().__init__(port)
        set_stage(self.server)
        self._scenes = [self._scene_of(i) for i in range(len(sources))]
        self.panel = Panel(
            self.server,
            self.sessions,
            offered_policies(sources),
            Callbacks(
                throw=lambda bearing: self._ask(self.throw_from, bearing),
                pause=lambda: self._ask(self.pause),
                step=lambda: self._ask(self.step_once),
                reset=lambda: self._ask(self.reset),
                replay=lambda: self._ask(self.replay),
                save=lambda client: self._ask(self.save, client),
                mask=lambda every: self._ask(self.mask_all, every),
                sense=lambda name: self._ask(self.sense, name),
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
        self._look(self.server.initial_camera, _USUAL_SIZE)
        self.is_paused = False
        self.steps = 0
        """Control steps computed so far."""
        self._random = np.random.default_rng(0)
        self._looked = self._panel_shown = self._pictured = 0.0
        self._steps_shown, self._speed = 0, ""
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
        self._shown = [session.frame for session in self.sessions]
        self._memory: deque[list[Frame]] = deque(maxlen=round(MEMORY * self.hz))
        self._replayed: deque[list[Frame]] = deque()
        # Whether the last step failed, and whether a replay ends in a pause.
        self._has_failed = self._holds = False
        self._avoided, self._came = [0] * number, [0] * number
        self._survival = [deque[float](maxlen=EPISODES) for _ in range(number)]
        self._best, self._ended_at = [0.0] * number, [0.0] * number
        self._since_throw = 0

    @property
    def hz(self) -> float:
        """Control rate of all robots [Hz]."""
        return self.sessions[0].hz

    # --- the loop ---------------------------------------------------------------

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
            due += slider_value(self.panel.slowdown) / self.hz
            if late > _TOO_LATE:
                due = time.monotonic()
            # Handle requests until the next step is due, at least all queued so far.
            while True:
                try:
                    request = self._commands.get(timeout=max(due - time.monotonic(), 0))
                except queue.Empty:
                    break
                self._do(request)

    def advance(self, is_late: bool = False) -> None:
        """Advance one control step unless paused, and draw if a picture is due.

        Args:
            is_late: Whether the loop is behind the clock; pictures are then skipped.
        """
        now = time.monotonic()
        if not self.is_paused and (self._replayed or not self._has_failed):
            self._proceed()
            wait = 1 / (_LEAST_PICTURE_HZ if is_late else _PICTURE_HZ)
            # Half a step of tolerance: draw at the step nearest to the due time.
            if self.is_paused or now - self._pictured > wait - 0.5 / self.hz:
                self._pictured = now
                self._draw(self._shown)
        if now - self._panel_shown > 1 / _PANEL_HZ:
            self._show()
        if now - self._looked > _FOLLOW_PERIOD:
            self._looked = now
            self._follow()

    def _proceed(self) -> None:
        """Take the next frames of a replay, or compute one control step."""
        if self._replayed:
            self._shown = self._replayed.popleft()
            self.is_paused |= self._holds and not self._replayed
        else:
            self.play()

    def play(self) -> None:
        """Compute one control step of all robots; if this fails, stop until a reset."""
        self._has_failed = True
        self._since_throw += 1
        tempo = slider_value(self.panel.tempo)
        ended = [session.frame.ending is not None for session in self.sessions]
        # Not while an end is shown, which a throw would cut short.
        if tempo and self._since_throw >= 60 * self.hz / tempo and not any(ended):
            self.throw_from(None)
        for i, session in enumerate(self.sessions):
            if not ended[i]:
                session.step()
                if session.frame.ending is not None:
                    self._end(i)
            elif time.monotonic() - self._ended_at[i] > _PAUSE_AFTER_END:
                session.reset()
        self._has_failed = False
        self._shown = [session.frame for session in self.sessions]
        self.steps += 1
        # The pause after the end of an episode is not recorded.
        if not all(ended) or not self._memory:
            self._memory.append(self._shown)

    def _end(self, i: int) -> None:
        """Add the results of an ended episode to the counts."""
        session = self.sessions[i]
        avoided, came = session.avoided
        self._avoided[i] += avoided
        self._came[i] += came
        self._survival[i].append(session.frame.survived)
        self._best[i] = max(self._best[i], session.frame.survived)
        self._ended_at[i] = time.monotonic()

    def _draw(self, frames: Sequence[Frame]) -> None:
        with self.server.atomic():
            for scene, frame in zip(self._scenes, frames, strict=True):
                scene.draw(frame)

    def _look(
        self,
        camera: viser.InitialCameraConfig | viser.CameraHandle,
        size: tuple[int, int],
    ) -> None:
        """Place a camera so that it sees all robots beside the panel.

        Args:
            camera: The camera.
            size: Width and height of its view [device px].
        """
        width, height = size
        # The panel is as wide in CSS pixels, of which a view has fewer on a dense
        # screen. Their number is not known: assume no higher window than a usual one.
        density = max(height / _USUAL_SIZE[1], 1.0)
        free = max(1 - _PANEL_WIDTH * density / width, 0.4)
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
        """Draw the shown frames and update the panel."""
        self._draw(self._shown)
        self._show()

    def throw(self, throw: Throw) -> None:
        """Throw one ball at each robot."""
        self._since_throw = 0
        self._replayed.clear()
        # A reset would discard the throw.
        self._begin_episodes()
        for session in self.sessions:
            session.throw(throw)

    def _begin_episodes(self) -> None:
        """Reset the robots whose episode has ended."""
        for session in self.sessions:
            if session.frame.ending is not None:
                session.reset()

    def throw_from(self, bearing: float | None) -> None:
        """Throw a ball with the speed and height of the sliders.

        Args:
            bearing: Direction it comes from, relative to the robot's heading [deg];
                None for a random one.
        """
        if bearing is None:
            bearing = self._random.uniform(-180, 180)
        distance = self._random.uniform(*self.sessions[0].distances)
        self._throw(math.radians(bearing), distance)

    def _throw(
        self, azimuth: float, distance: float, target: float | None = None
    ) -> None:
        # All robots receive the same throw, also where it is random.
        if target is None:
            target = self._random.uniform()
        self.throw(
            Throw(
                azimuth=azimuth,
                distance=distance,
                target=target,
                speed=slider_value(self.panel.speed),
                height=slider_value(self.panel.height),
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
        direction = direction / np.linalg.norm(direction)
        origins = [origin - scene.place for scene in self._scenes]
        away = []
        for session, frame, local in zip(
            self.sessions, self._shown, origins, strict=True
        ):
            session.body.place(frame.qpos)
            away.append(session.body.hit(local, direction))
        nearest = min(away)
        for i, (session, local) in enumerate(zip(self.sessions, origins, strict=True)):
            sensor = session.sensor_at(local, direction, _PICK_RADIUS, nearest)
            if sensor is not None:
                self.mask(i, session.masked ^ {sensor})
                return
        if nearest < math.inf:
            i = away.index(nearest)
            session, local = self.sessions[i], origins[i]
            target = session.target_near(local + nearest * direction)
            distance = float(np.mean(session.distances))
            # The throw is relative to the pose in which it begins.
            self._begin_episodes()
            self._throw(session.azimuth_of(local), distance, target)
        elif direction[2] < 0:
            floor = [o - o[2] / direction[2] * direction for o in origins]
            i = int(np.argmin(np.linalg.norm(floor, axis=-1)))
            session, point = self.sessions[i], floor[i]
            self._begin_episodes()
            self._throw(session.azimuth_of(point), session.distance_of(point))

    def mask(self, i: int, sensors: Collection[int]) -> None:
        """Mask exactly these sensors of a robot."""
        self.sessions[i].mask(sensors)
        self.panel.show_masked(self.sessions)
        if not self._replayed:
            self._shown = [session.frame for session in self.sessions]
        self._draw(self._shown)

    def mask_all(self, every: bool) -> None:
        """Mask all sensors of all robots, or none."""
        for i, session in enumerate(self.sessions):
            if session.skin is not None:
                self.mask(i, range(len(session.skin)) if every else ())

    def pause(self) -> None:
        """Pause or resume, also a replay."""
        self.is_paused = not self.is_paused
        self._draw(self._shown)

    def step_once(self) -> None:
        """Pause, and advance one control step, also in a replay."""
        self.is_paused = True
        # The next episode begins at once.
        self._ended_at = [0.0] * len(self.sessions)
        self._proceed()
        self._draw(self._shown)

    def reset(self) -> None:
        """Restart all episodes, with all counts at 0."""
        self.show_error("")
        for session in self.sessions:
            session.reset()
        self._forget()
        self._greet()

    def replay(self) -> None:
        """Replay the recorded frames, then pause if the page is paused now."""
        self._holds = self.is_paused or bool(self._replayed and self._holds)
        self._replayed = deque(self._memory)
        self.is_paused &= not self._replayed

    def sense(self, name: str) -> None:
        """Apply a sensor setting of the panel to all robots with a skin, or to none.

        Args:
            name: The setting, as in `Panel.sensor_changes`.

        Raises:
            ValueError: If a policy cannot read such sensors.
        """
        changes = self.panel.sensor_changes(name)
        if changes is None:
            return
        wanted = []
        for session, scene in zip(self.sessions, self._scenes, strict=True):
            if session.skin is None:
                continue
            sensor = session.readable(**changes)
            if sensor is None:
                self.panel.show_sensors(self.sessions)
                raise ValueError(f"{session.source} cannot read these sensors")
            # A slider queues many requests, and the first applies its latest value.
            if sensor != session.config.sensor:
                wanted.append((session, scene, sensor))
        for session, scene, sensor in wanted:
            session.configure(sensor)
            scene.skin = session.skin
        if wanted:
            self.reset()

    def load(self, i: int, source: str) -> None:
        """Load another policy for a robot.

        Raises:
            ValueError: If there is no such policy, or it has another control rate than
                that of a second robot.
        """
        # All robots have the same rate; a single one may change it.
        rate = self.hz if len(self.sessions) > 1 else None
        try:
            version = _version(source)
            self.sessions[i].load(source, rate)
        finally:
            self.panel.select_policy(i, self.sessions[i].source)
        self._versions[i], self._notes[i] = version, ""
        self._scenes[i].remove()
        self._scenes[i] = self._scene_of(i)
        self.reset()
        self.panel.show_sensors(self.sessions)

    # --- display --------------------------------------------------------------

    def _show(self) -> None:
        """Update the panel."""
        now = time.monotonic()
        passed, done = now - self._panel_shown, self.steps - self._steps_shown
        self._panel_shown, self._steps_shown = now, self.steps
        wanted = self.hz / slider_value(self.panel.slowdown)
        is_slow = 0 < done < 0.9 * wanted * passed - 1
        self._speed = f"Slow: {done / passed:.0f} of {wanted:.0f} steps per second."
        if not is_slow:
            self._speed = ""
        frames = list(self._memory)
        self.panel.show_status(self._status())
        self.panel.show_policies(self.sessions, self._notes)
        # Without new steps, as in a pause, the plots are those already shown.
        if not frames or not done:
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
            [np.array([f[i].value for f in frames]) for i in robots],
            self._survival,
            {s.source: s.critic is not None for s in self.sessions},
        )

    def _status(self) -> list[str]:
        """Return the status, in lines of Markdown."""
        state = "**Replay.** " * bool(self._replayed) + "**Paused.** " * self.is_paused
        state = state or self._speed
        lines = ["| | avoided&ensp; | untouched&ensp; | best |", "|---|---|---|---|"]
        for i, session in enumerate(self.sessions):
            avoided, came = session.avoided
            if session.frame.ending is not None:
                # Counted already.
                avoided = came = 0
            now = session.frame.survived
            best = max(now, self._best[i])
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
            try:
                version = _version(session.source)
            except (ValueError, OSError) as error:
                self._notes[i] = f"Not followed: {error}."
                continue
            if version == self._versions[i]:
                continue
            self._versions[i] = version
            if not session.follow():
                self.load(i, session.source)
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
        stride = max(1, round(self.hz / _PICTURE_HZ))
        # The last frame is always one of them.
        frames = list(self._memory)[::-stride][::-1]
        recorder = self.server.get_scene_serializer()
        # Visitors do not see these pictures.
        with self.server.atomic():
            for each in frames:
                self._draw(each)
                recorder.insert_sleep(stride / self.hz)
            page = recorder.as_html()
            self._draw(self._shown)
        return page


def offered_policies(sources: Sequence[str]) -> list[str]:
    """Return the selectable policies: those given, those shipped, those in ``runs``."""
    runs = sorted(
        str(path.parent) for path in Path("runs").glob(f"*/{CHECKPOINT_NAME}")
    )
    return list(dict.fromkeys([*sources, *shipped_policies(), *runs]))


def _version(source: str) -> int:
    """Return the modification time of a policy's file [ns]."""
    return policy_file(source).stat().st_mtime_ns


def _short(source: str) -> str:
    """Return a policy's name without its folder, of a file in a run with the run's."""
    path = Path(source)
    name = path.name.removesuffix(".safetensors") or source
    if path.name == CHECKPOINT_NAME:
        return path.absolute().parent.name
    if path.parent.name == "policies":
        return f"{path.absolute().parents[1].name} {name.lstrip('0')}"
    return name
