"""Recording of an episode of a throw set, and the pictures of a film of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from egoskin.evaluation.throw_set import play_throws
from egoskin.make import EnvConfig
from egoskin.sensors import Skin
from egoskin.viewer.film import Frame
from egoskin.viewer.offscreen import Painter

# Keys that a film and `ending_of` read, besides the distances.
_READ = (
    *("base_pose", "joint_pos", "object_pose", "object_active", "balls_avoided"),
    *("truncated", "hit", "fallen", "diverged", "terminated"),
)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """The states of one episode, from its start to the step that ends it."""

    row: int
    """Row of the episode in its throw set."""
    states: list[TensorDictBase]
    """State after each control step, the start first."""
    ending: str | None
    """Why the episode ended ("hit", "fall", "time limit", ...)."""


def record_longest(
    config: EnvConfig,
    skin: Skin,
    policy: nn.Module | TensorDictModuleBase | None,
    *,
    throw_set: int = 0,
    first: int = 0,
    episodes: int = 1,
    hold: bool = False,
    on_step: Callable[[int, int], None] | None = None,
) -> Recording:
    """Return a recording of the longest of some episodes of a throw set.

    Starts and throws are those of the throw set's rows. The motion is the same up to
    rounding: the last bits of a network's output depend on the batch size.

    Args:
        config: Environment configuration.
        skin: The sensors.
        policy: Writes ``action``; None for the zero action, whose position target is
            the default pose.
        throw_set: Seed of the throw set.
        first: Row of the first episode.
        episodes: Number of episodes; of several longest ones the first is recorded.
        hold: Whether the robot is held rigid in its default pose.
        on_step: Called with (steps done, episodes still running).
    """
    distances = (f"distance{g.suffix}" for g in config.pipeline(skin).groups)
    keys = [*_READ, *distances]
    # Episodes that may be the longest, and their states after each step: in one
    # tensordict, as those of single states need more memory than their content.
    kept, history = torch.arange(episodes), list[TensorDictBase]()
    last_step = torch.zeros(episodes, dtype=torch.int64)

    def watch(
        before: TensorDictBase, after: TensorDictBase, running: torch.Tensor
    ) -> None:
        nonlocal kept
        if not history:
            history.append(before.select(*keys)[kept])
        last_step[running] += 1
        left = running[kept]
        # Episodes that still run are longer than those that have ended. Not dropped one
        # by one, which would copy all states each time.
        if 2 * int(left.sum()) <= len(kept):
            kept = kept[left]
            for step, states in enumerate(history):
                history[step] = states[left]
        history.append(after.select(*keys)[kept])

    play_throws(
        policy,
        config,
        skin,
        throw_set=throw_set,
        first=first,
        episodes=episodes,
        hold=hold,
        on_step=on_step,
        watch=watch,
    )
    longest = int(last_step.argmax())
    (place,) = (kept == longest).nonzero()[:, 0].tolist()
    states = [state[place] for state in history[: int(last_step[longest]) + 1]]
    return Recording(row=first + longest, states=states, ending=ending_of(states[-1]))


def render_recording(
    painter: Painter,
    config: EnvConfig,
    skin: Skin,
    recording: Recording,
    *,
    max_seconds: float | None = None,
    fps: float = 30.0,
    on_picture: Callable[[int, int], None] | None = None,
) -> list[Frame]:
    """Return the pictures of one episode.

    Args:
        painter: Result of `egoskin.viewer.offscreen.painter_of`.
        config: Environment configuration of the recording.
        skin: The sensors.
        recording: The episode.
        max_seconds: Longest age shown [s]; None for the whole episode.
        fps: Pictures per second of simulated time, at most the control rate.
        on_picture: Called with (pictures done, total pictures).

    Returns:
        Frames in order of time: the start, then ``fps`` per second, and always the last
        step shown.

    Raises:
        ValueError: If ``fps`` or ``max_seconds`` is out of range.
    """
    hz = config.task.physics.control_hz
    check_film(hz, fps, max_seconds)
    last = len(recording.states) - 1
    steps = last if max_seconds is None else min(round(max_seconds * hz), last)
    ending = recording.ending if steps == last else "cut"
    due = [0]
    for step in range(1, steps + 1):
        if int(step * fps / hz) > int((step - 1) * fps / hz) or step == steps:
            due.append(step)
    sensors, frames = config.pipeline(skin), []
    for step in due:
        state = recording.states[step]
        frame = painter.draw(
            state,
            sensors.detecting(state),
            time=step / hz,
            num_avoided=int(state["balls_avoided"].sum()),
            ending=ending if step == steps else None,
        )
        frames.append(frame)
        if on_picture is not None:
            on_picture(len(frames), len(due))
    return frames


def check_film(hz: float, fps: float, max_seconds: float | None) -> None:
    """Raise ValueError for an invalid frame rate or duration of a film.

    Args:
        hz: Control rate [Hz].
        fps: Pictures per second.
        max_seconds: Longest age shown [s]; None for all.
    """
    if not 0 < fps <= hz:
        raise ValueError(f"fps must be in (0, {hz:g}], the control rate, got {fps:g}")
    if max_seconds is not None and not max_seconds * hz >= 1:
        raise ValueError(
            f"the film must last at least one control step, {1 / hz:.3g} s, got "
            f"{max_seconds:g} s"
        )


def ending_of(state: TensorDictBase) -> str | None:
    """Return why the episode of a row has ended; None if it has not."""
    if state["truncated"].item():
        return "time limit"
    names = {"hit": "hit", "fallen": "fall", "diverged": "diverged"}
    reasons = [name for key, name in names.items() if state[key].item()]
    if not reasons and state["terminated"].item():
        return "self-contact"
    return " + ".join(reasons) or None
