"""See a policy in the browser, and throw balls at it.

egoskin view field_proximity
egoskin view runs/NAME
egoskin view field_proximity blind
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
import tyro

from egoskin.bounds import Interval, check_bounds
from egoskin.commands.errors import check_packages


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """See a policy in the browser, and throw balls at it."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ("field_proximity",)
    """Run folder (its newest policy is taken up while it trains), checkpoint, policy
    file, or the name of a policy that comes with the package; two stand side by side
    and meet the same throws."""
    port: Annotated[int, Interval(ge=0, le=65535)] = 8080
    """Port of 127.0.0.1; 0: any that is free."""

    def __post_init__(self) -> None:
        """Raise ValueError for what cannot be shown."""
        check_bounds(self)
        if len(self.policies) > 2:
            raise ValueError(f"at most two policies, got {len(self.policies)}")


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(ViewConfig, args=args, description=__doc__)
    check_packages("egoskin view", "view", "viser")
    from egoskin.viewer.web.page import Page

    # One robot keeps one core busy at most; threads would only get in each other's way.
    torch.set_num_threads(1)
    page = Page(config.policies, config.port)
    try:
        print(f"{page.address}   (Ctrl-C ends it)", flush=True)
        page.run()
    finally:
        page.close()
