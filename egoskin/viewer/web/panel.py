"""The panel of the page: buttons, sliders, figures and plots.

Contract: the panel computes nothing and changes nothing; it shows the values that it
receives and passes requests to the page, by one function for each kind of request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args, get_type_hints

import numpy as np
import viser
from viser import uplot

from egoskin.sensors.config import SensorConfig
from egoskin.viewer.web.scene import colour_of
from egoskin.viewer.web.server import slider_value
from egoskin.viewer.web.session import HEIGHTS, SPEEDS, Session

SIDES = {"Front": 0.0, "Left": 90.0, "Behind": 180.0, "Right": -90.0}
"""Directions to throw from: bearing relative to the robot's heading [deg]."""
_KINDS = {
    "field": {"coverage": "field", "reduce": "none"},
    "ray, closest beam": {"coverage": "ray", "reduce": "min"},
    "ray, all beams": {"coverage": "ray", "reduce": "none"},
}
_OPTIONS = get_type_hints(SensorConfig)
_SIGNALS = get_args(_OPTIONS["signal"])
_CORRUPTIONS = get_args(_OPTIONS["corruption"])
_COLOURS = ("#e8590c", "#1c7ed6")
MEMORY = 5.0
"""Length of the recording that is plotted, replayed and saved [s]."""
EPISODES = 200
"""Number of the last episodes that are plotted."""
# A scale that begins at 0 and reaches at least 1, with room above.
_FROM_ZERO = {
    "min": {"soft": 0.0, "pad": 0.0, "mode": 1},
    "max": {"soft": 1.0, "pad": 0.1, "mode": 1},
}
_MASK_HELP = "Click a sensor on the robot to mask it, click again to unmask it."
_HELP = (
    "**Click** the robot: a ball is thrown at that point from your viewpoint. "
    "**Click** the floor: a ball is thrown from there."
)


@dataclass(frozen=True, kw_only=True)
class Callbacks:
    """Functions of the page that the panel calls."""

    throw: Callable[[float | None], None]
    """Throw a ball from a bearing [deg]; None for a random one."""
    pause: Callable[[], None]
    """Pause or resume."""
    step: Callable[[], None]
    """Pause, and advance one control step."""
    reset: Callable[[], None]
    """Restart all episodes."""
    replay: Callable[[], None]
    """Replay the recorded frames."""
    save: Callable[[viser.ClientHandle | None], None]
    """Send a visitor a page with the recorded frames."""
    mask: Callable[[bool], None]
    """Mask all sensors, or none."""
    sense: Callable[[str], None]
    """Apply a sensor setting of the panel."""
    load: Callable[[int, str], None]
    """Load another policy for a robot."""


class Panel:
    """Buttons, sliders, figures and plots of the page.

    Args:
        server: The page.
        sessions: The robots.
        policies: Policies that can be selected.
        callbacks: Functions to call for each request.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        sessions: Sequence[Session],
        policies: Sequence[str],
        callbacks: Callbacks,
    ) -> None:
        self._gui, self._callbacks = server.gui, callbacks
        self._status = server.gui.add_markdown("")
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Play"):
            self._add_play()
        with tabs.add_tab("Sensors"):
            self._add_sensors()
        with tabs.add_tab("Plots"):
            self._add_plots(sessions)
        with tabs.add_tab("Policy"):
            self._add_policies(sessions, policies)
        self.show_sensors(sessions)

    # --- controls -------------------------------------------------------------

    def _add_play(self) -> None:
        gui, callbacks = self._gui, self._callbacks
        throw = gui.add_button("Throw a ball", icon=viser.Icon.BALL_BASEBALL)
        throw.on_click(lambda _: callbacks.throw(None))
        sides = gui.add_button_group("From", list(SIDES))
        sides.on_click(lambda event: callbacks.throw(SIDES[event.target.value]))
        self.speed = gui.add_slider("Speed [m/s]", *SPEEDS, 0.5, 6.0)
        self.height = gui.add_slider("Height [m]", *HEIGHTS, 0.1, 2.5)
        self.tempo = gui.add_slider(
            "Balls per minute", 0, 60, 1, 15, hint="Thrown automatically; 0: none"
        )
        gui.add_divider()
        self.slowdown = gui.add_slider("Slowdown", 1, 20, 1, 1)
        actions = {
            "Pause": callbacks.pause,
            "Step": callbacks.step,
            "Reset": callbacks.reset,
        }
        times = gui.add_button_group("Time", list(actions))
        times.on_click(lambda event: actions[event.target.value]())
        last = gui.add_button_group(
            "Last 5 s",
            ["Replay", "Save"],
            hint="Save: an HTML page that plays them without a server",
        )

        def again(event: viser.GuiEvent) -> None:
            if event.target.value == "Save":
                callbacks.save(event.client)
            else:
                callbacks.replay()

        last.on_click(again)
        self._map = gui.add_image(_EMPTY, label="Readings, last five seconds")
        gui.add_markdown(_HELP)

    def _add_sensors(self) -> None:
        gui, callbacks = self._gui, self._callbacks
        self._masked = gui.add_markdown("")
        masks = gui.add_button_group("Mask", ["All", "None"])
        masks.on_click(lambda event: callbacks.mask(event.target.value == "All"))
        gui.add_divider()
        self._kind = gui.add_dropdown("Kind", list(_KINDS))
        self._signal = gui.add_dropdown("Signal", _SIGNALS)
        self._range = gui.add_slider("Range [m]", 0.1, 5.0, 0.1, 2.0)
        self._corruption = gui.add_dropdown("Imperfection", _CORRUPTIONS)
        self._settings = {
            "kind": self._kind,
            "signal": self._signal,
            "range": self._range,
            "corruption": self._corruption,
        }
        for name, handle in self._settings.items():
            # A change made by the page itself has no client.
            handle.on_update(lambda event, n=name: event.client and callbacks.sense(n))
        self._readable = gui.add_markdown("")

    def _add_plots(self, sessions: Sequence[Session]) -> None:
        gui = self._gui
        nothing = tuple(np.zeros(1) for _ in range(1 + len(sessions)))
        series = [uplot.Series()]
        for i in range(len(sessions)):
            name = ("left", "right")[i] if len(sessions) > 1 else "robot"
            series.append(uplot.Series(label=name, stroke=_COLOURS[i], width=2))
        axis = uplot.Axis(stroke="#495057", grid={"stroke": "#e9ecef", "width": 1})
        whole = uplot.Axis({**axis, "incrs": (1, 2, 5, 10, 20, 50, 100, 200, 500)})
        seconds = uplot.Scale(time=False, range=(-MEMORY, 0.0))
        episodes = uplot.Scale(time=False)
        share, upward = uplot.Scale(range=(0.0, 1.05)), uplot.Scale(range=_FROM_ZERO)

        def plot(
            x: str, scale: uplot.Scale, y: uplot.Scale, along: uplot.Axis = axis
        ) -> viser.GuiUplotHandle:
            return gui.add_uplot(
                nothing,
                (uplot.Series(label=x), *series[1:]),
                scales={"x": scale, "y": y},
                axes=(along, axis),
                # Without live values at the cursor.
                legend=uplot.Legend(show=len(sessions) > 1, live=False),
                height=150 if len(sessions) == 1 else 130,
            )

        gui.add_markdown("**Strongest reading** (1: touching), last five seconds")
        self._nearest = plot("time [s]", seconds, share)
        self._value_title = gui.add_markdown("**Value of the state**, from the critic")
        self._value = plot("time [s]", seconds, uplot.Scale(auto=True))
        gui.add_markdown(f"**Untouched** [s], last {EPISODES} episodes")
        self._survival = plot("episode", episodes, upward, whole)

    def _add_policies(self, sessions: Sequence[Session], names: Sequence[str]) -> None:
        gui, callbacks = self._gui, self._callbacks
        self._policies = []
        for i, session in enumerate(sessions):
            label = ("Left", "Right")[i] if len(sessions) > 1 else "Policy"
            given = [session.source, *(n for n in names if n != session.source)]
            handle = gui.add_dropdown(label, given, initial_value=session.source)
            handle.on_update(
                lambda event, i=i: (
                    event.client and callbacks.load(i, event.target.value)
                )
            )
            self._policies.append(handle)
        self._about = gui.add_markdown("")

    # --- requested settings ---------------------------------------------------

    def sensor_changes(self, name: str) -> dict | None:
        """Return the fields of the sensor configuration that a setting selects.

        None for a range outside the slider's limits: it is still being typed.

        Args:
            name: The setting: "kind", "signal", "range" or "corruption".
        """
        value = self._settings[name].value
        if name == "range" and value != slider_value(self._range):
            return None
        return _KINDS[value] if name == "kind" else {name: value}

    # --- display --------------------------------------------------------------

    def show_status(self, lines: Sequence[str]) -> None:
        """Show the status, in lines of Markdown."""
        text = "\n".join(lines)
        if text != self._status.content:
            self._status.content = text

    def show_policies(self, sessions: Sequence[Session], notes: Sequence[str]) -> None:
        """Show the loaded policies, their sensors and length of training."""
        texts = []
        for session, note in zip(sessions, notes, strict=True):
            sensor, trained = session.config.sensor, session.policy.policy_spec.frames
            texts.append(
                f"**{session.source}**: {sensor.label()}, trained for "
                f"{trained / 1e6:.1f} M steps. {note}"
            )
        self._about.content = "\n\n".join(texts)

    def select_policy(self, i: int, source: str) -> None:
        """Show that a robot has a policy."""
        self._policies[i].value = source

    def show_sensors(self, sessions: Sequence[Session]) -> None:
        """Show the sensors of the first robot that has any."""
        for session in sessions:
            if session.skin is not None:
                break
        else:
            self._masked.content = "No robot here has a skin."
            self._readable.content = ""
            for handle in self._settings.values():
                handle.disabled = True
            return
        assert session.skin is not None
        own, sensor = session.policy.env_config.sensor, session.config.sensor
        kinds = [k for k, v in _KINDS.items() if session.readable(**v) is not None]
        signals = [s for s in _SIGNALS if session.readable(signal=s) is not None]
        flaws = [c for c in _CORRUPTIONS if session.readable(corruption=c) is not None]
        chosen = {"coverage": sensor.coverage, "reduce": sensor.reduce}
        # None if sensors that the skin file sets are mixed with others.
        kind = next((k for k, v in _KINDS.items() if v == chosen), None)
        for handle, options, value in (
            (self._kind, kinds, kind),
            (self._signal, signals, sensor.signal),
            (self._corruption, flaws, sensor.corruption),
        ):
            handle.disabled = value is None or len(options) < 2
            if value is not None:
                handle.options, handle.value = options, value
        self._range.disabled = False
        self._range.value = min(max(sensor.range, 0.1), 5.0)
        # What the skin file sets cannot be changed.
        skin = session.policy.skin
        self._kind.visible = kind is not None and None in skin.coverage
        self._range.visible = bool(np.isnan(skin.range).any())
        size = session.pipeline.signal_size
        self._readable.content = (
            f"The policy was trained with {own.label()}; its signal has {size} values. "
            "Only options with as many values can be selected, and the policy may do "
            "worse with them. The number and positions of the sensors are fixed."
        )
        self.show_masked(sessions)

    def show_masked(self, sessions: Sequence[Session]) -> None:
        """Show how many sensors of each robot that has any are masked."""
        counts = " and ".join(
            f"{len(session.masked)} of {len(session.skin)}"
            for session in sessions
            if session.skin is not None
        )
        self._masked.content = f"**{counts}** sensors masked. {_MASK_HELP}"

    def show_map(self, readings: Sequence[np.ndarray], steps: int) -> None:
        """Show readings over time.

        Args:
            readings: Readings of each robot with sensors, ``[T, S]``, the newest last.
            steps: Longest ``T``.
        """
        rows = []
        for reading in readings:
            padded = np.zeros((steps, reading.shape[1]))
            padded[steps - len(reading) :] = reading
            colours = colour_of(padded.T.ravel()).reshape(-1, steps, 3)
            rows += [np.full((1, steps, 3), 255, np.uint8)] * bool(rows)
            rows.append(colours)
        self._map.visible = bool(rows)
        if rows:
            image = np.concatenate(rows)
            self._map.image = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)

    def show_plots(
        self,
        time: np.ndarray,
        strongest: Sequence[np.ndarray],
        value: Sequence[np.ndarray],
        survival: Sequence[Sequence[float]],
        has_critic: Mapping[str, bool],
    ) -> None:
        """Show curves.

        Args:
            time: Time of each step [s], ``[T]``.
            strongest: The strongest reading of each robot, ``[T]`` each.
            value: The critic's value, ``[T]`` each, NaN without one.
            survival: Untouched time of each robot in its last episodes [s].
            has_critic: Whether each policy has a critic.
        """
        self._nearest.data = (time, *strongest)
        self._value.visible = any(has_critic.values())
        lacking = [name for name, has in has_critic.items() if not has]
        title = "**Value of the state**, from the critic"
        if lacking:
            names = ", ".join(lacking)
            title += f": none for {names}, saved by an older version"
        self._value_title.content = title
        if self._value.visible:
            self._value.data = (time, *value)
        longest = max(1, *(len(s) for s in survival))
        padded = [np.array([*s, *[np.nan] * (longest - len(s))]) for s in survival]
        self._survival.data = (np.arange(1.0, longest + 1), *padded)


_EMPTY = np.zeros((2, 2, 3), np.uint8)
