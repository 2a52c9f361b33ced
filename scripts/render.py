"""Render an episode: a film, and a contact sheet of the moments that tell it best.

python scripts/render.py runs/NAME --bank-seed 0 --episode 7 --out dodge.mp4
python scripts/render.py --hold --sensor.range 1 --out rigid.gif
"""

from __future__ import annotations

from egoskin.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()

# isort: split

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

try:
    import mujoco  # noqa: F401
except (AttributeError, ImportError, RuntimeError) as fault:
    # MuJoCo loads the library that MUJOCO_GL names at once; the fault's own text is
    # PyOpenGL's and does not say so.
    backend = os.environ.get("MUJOCO_GL", "")
    print(
        f"error: MuJoCo cannot be imported with MUJOCO_GL={backend!r} ({fault}); "
        "install the library (Debian: `apt-get install libegl1` for egl, `apt-get "
        "install libosmesa6` for osmesa)",
        file=sys.stderr,
    )
    raise SystemExit(2) from None

from egoskin.cli import clear_errors
from egoskin.draws import check_seed
from egoskin.evaluation import throw_seed
from egoskin.film import (
    FILM_SUFFIXES,
    check_path,
    contact_sheet,
    save_film,
    save_picture,
)
from egoskin.make import EnvConfig
from egoskin.policies import load_policy
from egoskin.rendering import CameraConfig, render_episode


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Render an episode of a trained policy, or of the zero action without one."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package; None: action 0, which asks the motors for the
    default pose."""
    out: Path = Path("episode.mp4")
    """Film to write, .mp4 or .gif."""
    sheet: Path | None = None
    """Contact sheet to write, .png; None: beside the film, under the same name."""
    bank_seed: int = 0
    """Seed of the bank of throws, as in evaluate.py --standard run."""
    episode: int = 0
    """Which episode of the bank."""
    seconds: float | None = None
    """Stop at this age at the latest [s]; None: the whole episode."""
    fps: float = 30.0
    """Pictures for each second of the episode, at most the control rate."""
    slowdown: float = 1.0
    """The film plays this many times slower than real time."""
    size: tuple[int, int] = (960, 540)
    """Width and height of the film [px]."""
    hold: bool = False
    """Hold the robot rigid in its default pose."""
    camera: CameraConfig = field(default_factory=CameraConfig)
    """Where the camera is."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    """Robot, task, skin, sensors; a policy brings its own."""

    def __post_init__(self) -> None:
        """Raise ValueError for what cannot be rendered or written."""
        check_path(self.out, FILM_SUFFIXES)
        check_path(self.sheet_path, (".png",))
        check_seed(self.bank_seed, "bank_seed")
        if not 0 < self.slowdown <= 100:
            raise ValueError(f"slowdown must be in (0, 100], got {self.slowdown}")
        if self.policy is not None and self.env != EnvConfig():
            raise ValueError(
                "a policy brings its own robot, task, skin and sensors: leave their "
                "options out, or leave out the policy"
            )

    @property
    def sheet_path(self) -> Path:
        """Where the contact sheet goes."""
        return self.out.with_suffix(".png") if self.sheet is None else self.sheet


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(RenderConfig, args=args)
    if config.policy is None:
        policy, env_config = None, config.env
        skin = env_config.skin.build(env_config.robot_config)
    else:
        policy = load_policy(config.policy)
        env_config, skin = policy.env_config, policy.skin
    frames = render_episode(
        env_config,
        skin,
        policy,
        seed=throw_seed(env_config, config.bank_seed),
        row=config.episode,
        max_seconds=config.seconds,
        fps=config.fps,
        size=config.size,
        camera=config.camera,
        hold=config.hold,
    )
    sheet = contact_sheet(frames)
    save_film(config.out, frames, config.fps / config.slowdown)
    save_picture(config.sheet_path, sheet)
    last = frames[-1]
    print(
        f"episode {config.episode} of bank {config.bank_seed}: {last.time:.2f} s, ends "
        f"with: {last.ending}; film {config.out}, contact sheet {config.sheet_path}"
    )


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
