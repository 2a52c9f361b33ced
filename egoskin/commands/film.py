"""Render an episode as a film and a contact sheet of its key moments.

egoskin film runs/NAME --longest-of 16 --out dodge.mp4
egoskin film runs/NAME --throw-set 0 --episode 7 --standard run
egoskin film --hold --sensor.range 1 --out rigid.gif
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from egoskin.bounds import COUNT, NOT_NEGATIVE, Interval, check_bounds
from egoskin.evaluation.throw_set import standard_task
from egoskin.make import EnvConfig
from egoskin.policies.policy import load_policy
from egoskin.progress import StatusLine, counted
from egoskin.rng import check_seed
from egoskin.storage.files import check_output
from egoskin.viewer.film import (
    FILM_SUFFIXES,
    contact_sheet,
    save_film,
    save_picture,
)
from egoskin.viewer.offscreen import CameraConfig, painter_of
from egoskin.viewer.recording import check_film, record_longest, render_recording

# Browsers show a picture of a GIF for 100 ms if its delay, whole centiseconds, is
# below 20 ms.
_GIF_FPS = 50.0
# Frames per second if the control rate allows it.
_FPS = 30.0


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Render an episode of a trained policy, or of the zero action without one."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package; None: action 0, whose target is the default
    pose."""
    out: Path = Path("episode.mp4")
    """Film to write, .mp4 or .gif."""
    sheet: Path | None = None
    """Contact sheet to write, .png; None: beside the film, under the same name."""
    throw_set: int = 0
    """Seed of the throw set, as in `egoskin evaluate`."""
    episode: Annotated[int, NOT_NEGATIVE] = 0
    """Index of the episode in the throw set."""
    longest_of: Annotated[int, COUNT] = 1
    """Show the longest of this many episodes, from --episode on."""
    standard: Literal["2", "1", "paper", "run"] = "2"
    """Version of the standard throw; run: the throws and terminations of training,
    without its randomisation."""
    seconds: float | None = None
    """Stop at this age at the latest [s]; None: the whole episode."""
    fps: float | None = None
    """Frames per second of the episode, at most the control rate; None: 30, or the
    control rate if that is lower. In a .gif, at most 50 per second played."""
    slowdown: Annotated[float, Interval(gt=0, le=100)] = 1.0
    """The film plays this many times slower than real time."""
    size: tuple[int, int] = (960, 540)
    """Width and height of the film [px]."""
    hold: bool = False
    """Hold the robot rigid in its default pose."""
    camera: CameraConfig = field(default_factory=CameraConfig)
    """Position of the camera."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors; a policy brings its own."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values or files that cannot be written."""
        check_output(self.out, "--out", FILM_SUFFIXES)
        check_output(self.sheet_path, "--sheet", (".png",))
        check_seed(self.throw_set, "throw_set")
        check_bounds(self)
        played = (self.fps or _FPS) / self.slowdown
        if self.out.suffix.lower() == ".gif" and played > _GIF_FPS:
            raise ValueError(
                f"browsers play a GIF with at most {_GIF_FPS:g} pictures per second, "
                f"got {played:g} (--fps divided by --slowdown): lower --fps, or write "
                "an .mp4"
            )
        if self.policy is not None and self.env != EnvConfig():
            raise ValueError(
                "a policy brings its own robot, task, skin and sensors: leave their "
                "options out, or leave out the policy"
            )
        if self.policy is None and self.standard != "2":
            raise ValueError(
                "--standard needs a policy: without one, the options of --task set the "
                "throws"
            )

    @property
    def sheet_path(self) -> Path:
        """Path of the contact sheet."""
        return self.out.with_suffix(".png") if self.sheet is None else self.sheet


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(RenderConfig, args=args)
    if config.policy is None:
        policy, env_config = None, config.env
        skin = env_config.skin.build(env_config.robot_config)
    else:
        policy = load_policy(config.policy)
        env_config = standard_task(policy.env_config, config.standard)
        skin = policy.skin
    hz = env_config.task.physics.control_hz
    fps = min(_FPS, hz) if config.fps is None else config.fps
    check_film(hz, fps, config.seconds)
    # Created before playing, so that errors in drawing appear early.
    painter = painter_of(env_config, skin, size=config.size, camera=config.camera)
    line = StatusLine(f"playing {counted(config.longest_of, 'episode')}")
    with painter:
        recording = record_longest(
            env_config,
            skin,
            policy,
            throw_set=config.throw_set,
            first=config.episode,
            episodes=config.longest_of,
            hold=config.hold,
            on_step=lambda step, running: line.show(
                f"{step / hz:.2f} s played, {running} still running"
            ),
        )
        frames = render_recording(
            painter,
            env_config,
            skin,
            recording,
            max_seconds=config.seconds,
            fps=fps,
            on_picture=lambda done, total: line.show(f"{done} of {total} pictures"),
        )
    sheet = contact_sheet(frames)
    save_film(config.out, frames, fps / config.slowdown)
    save_picture(config.sheet_path, sheet)
    line.finish()
    last = frames[-1]
    print(
        f"episode {recording.row} of throw set {config.throw_set}: {last.time:.2f} s, "
        f"{counted(last.num_avoided, 'ball')} avoided, ends with: {last.ending}; film "
        f"{config.out}, contact sheet {config.sheet_path}"
    )
