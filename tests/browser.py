"""A real browser without a display, as a visitor of the page; and its screenshot.

python tests/browser.py ADDRESS docs/view.jpg
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
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
    from playwright.sync_api import sync_playwright

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


def main(address: str, path: str, width: int = 1440) -> None:
    """Take a picture of `egoskin view` while a ball comes from the front."""
    with browsing(width) as context:
        page = context.pages[0]
        page.on("console", lambda m: print(m.type, m.text[:300], file=sys.stderr))
        page.on("pageerror", lambda e: print("pageerror", e, file=sys.stderr))
        page.goto(address)
        page.wait_for_selector("canvas", timeout=30_000)
        page.wait_for_timeout(8000)
        # What the browser says of drawing without a graphics card.
        for notice in page.locator(".mantine-Notification-closeButton").all():
            notice.click()
        page.get_by_role("button", name="Front", exact=True).click()
        page.wait_for_timeout(800)
        page.get_by_role("button", name="Pause", exact=True).click()
        page.wait_for_timeout(4000)
        kind = "jpeg" if path.endswith("jpg") else "png"
        quality = 80 if kind == "jpeg" else None
        page.screenshot(path=Path(path), type=kind, quality=quality, timeout=180_000)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
