"""See a policy in the browser, and throw balls at it; or a skin, or a robot.

egoskin view field_proximity
egoskin view runs/NAME
egoskin view field_proximity blind
egoskin view --skin skin.json
egoskin view --robot arm.urdf
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import tyro

from egoskin.bounds import Interval, check_bounds
from egoskin.commands.errors import check_packages

if TYPE_CHECKING:
    from egoskin.viewer.web.skin_page import SkinPage


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """See a policy in the browser, and throw balls at it; or a skin, or a robot."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Run folder (followed while it trains), checkpoint, policy file, or the name of a
    policy that comes with the package; two are shown side by side with the same throws.
    Without any, field_proximity."""
    skin: Path | None = None
    """A skin file, shown on its robot without a policy."""
    robot: str | None = None
    """A robot without a policy: its name, a folder with robot.toml,
    my_robot.py:ROBOT, or an MJCF or URDF file."""
    port: Annotated[int, Interval(ge=0, le=65535)] = 8080
    """Port of 127.0.0.1; 0: any free port."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)
        if len(self.policies) > 2:
            raise ValueError(f"at most two policies, got {len(self.policies)}")
        if self.policies and (self.skin or self.robot):
            raise ValueError(
                "a policy brings its own robot and skin: leave out --skin and --robot, "
                "or the policy"
            )


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(ViewConfig, args=args, description=__doc__)
    check_packages("egoskin view", "view", "viser")
    # One robot uses at most one core; more threads would only slow it down.
    torch.set_num_threads(1)
    if config.skin is None and config.robot is None:
        from egoskin.viewer.web.page import Page

        page = Page(config.policies or ("field_proximity",), config.port)
    else:
        page = _skin_page(config)
    try:
        print(f"{page.address}   (Ctrl-C to stop)", flush=True)
        page.run()
    finally:
        page.close()
        # Skips a last garbage collection at exit, which would take seconds.
        gc.freeze()


def _skin_page(config: ViewConfig) -> SkinPage:
    """Return the page of a robot, of a skin, or of a skin on a robot."""
    from egoskin.robots.builtin import ROBOTS
    from egoskin.robots.own import find_robot
    from egoskin.sensors import Skin
    from egoskin.viewer.web.skin_page import SkinPage

    skin = None if config.skin is None else Skin.load(config.skin)
    name = config.robot
    if name is None:
        assert skin is not None
        name = skin.robot
        if name not in ROBOTS:
            raise ValueError(
                f"{config.skin} is for the robot {name!r}, which is not in the "
                "package: add --robot PATH (folder, my_robot.py:ROBOT, MJCF or URDF)"
            )
    return SkinPage(find_robot(name), skin, config.port)
