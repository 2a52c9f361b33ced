"""A headless browser that visits the page, and takes a picture of it.

python tests/browser.py docs/view.jpg
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
# Reading of the moment that is taken.
_NEAR = 0.7
_OPTIONS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@contextmanager
def browsing(width: int = 1440, height: int = 900) -> Iterator:
    """Yield a browser's context, of windows of a size [px]."""
    from playwright.sync_api import (  # pyright: ignore[reportMissingImports]
        sync_playwright,
    )

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        context = driver.chromium.launch_persistent_context(
            folder,
            executable_path=CHROMIUM,
            headless=True,
            args=list(_OPTIONS),
            viewport={"width": width, "height": height},
            accept_downloads=True,
        )
        try:
            yield context
        finally:
            context.close()


def main(path: str, width: int = 1440) -> None:
    """Take a picture of `egoskin view` at the moment when a ball is near the robot."""
    from egoskin.viewer.web.page import Page

    page = Page(["field_proximity"])
    page.panel.tempo.value = 0
    page.throw_from(-60.0)
    while page.sessions[0].frame.reading.max() < _NEAR:
        page.play()
        page._draw(page._memory[-1])
    page.pause()
    threading.Thread(target=page.run, daemon=True).start()
    with browsing(width) as context:
        tab = context.pages[0]
        tab.set_default_timeout(120_000)
        tab.goto(page.address)
        tab.wait_for_selector("canvas")
        tab.wait_for_timeout(15_000)
        # The browser's warning about drawing without a graphics card.
        for notice in tab.locator(".mantine-Notification-closeButton").all():
            notice.click()
        tab.wait_for_timeout(2000)
        kind = "jpeg" if path.endswith("jpg") else "png"
        quality = 80 if kind == "jpeg" else None
        tab.screenshot(path=Path(path), type=kind, quality=quality)
    page.close()


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
