"""The page in a real browser: the scene moves, and the controls have an effect."""

from __future__ import annotations

import dataclasses
import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

pytest.importorskip("viser")
pytest.importorskip("playwright")

from browser import CHROMIUM, browsing
from calling import wait_for
from egoskin.viewer.web.page import Page

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium here"),
]
# Without a graphics card a picture may take seconds.
_WAIT = 90.0
SIZE = (800, 600)
_PANEL = 340


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    page = Page(["field_proximity"])
    page.panel.tempo.value = 0
    threading.Thread(target=page.run, daemon=True).start()
    yield page
    page.close()


class Visit:
    """A page as a visitor sees it."""

    def __init__(self, context, address: str) -> None:
        self.tab = context.new_page()
        self.tab.set_default_timeout(1000 * _WAIT)
        self.faults: list[str] = []
        self.tab.on(
            "console",
            lambda m: m.type == "error" and self.faults.append(m.text),
        )
        self.tab.on("pageerror", lambda error: self.faults.append(str(error)))
        self.tab.goto(address)
        self.tab.wait_for_selector("canvas")

    def press(self, name: str) -> None:
        self.tab.get_by_role("button", name=name, exact=True).click()

    def canvas(self, width: int = 440, height: int = 400) -> np.ndarray:
        """Return the picture left of the panel, at the bottom, ``[H, W, 3]``."""
        top = self.tab.viewport_size["height"] - height
        clip = {"x": 0, "y": top, "width": width, "height": height}
        picture = self.tab.screenshot(clip=clip, timeout=1000 * _WAIT)
        return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)

    def still(self) -> np.ndarray:
        """Return the picture once it has stopped to change, as `canvas`."""
        before, now = None, self.canvas()
        while before is None or differs(before, now):
            time.sleep(5)
            before, now = now, self.canvas()
        return now


@pytest.fixture
def visit(page: Page) -> Iterator[Visit]:
    with browsing(*SIZE) as context:
        # A browser without a graphics card draws a still scene sooner.
        page.is_paused = True
        visit = Visit(context, page.address)
        wait_for(lambda: is_drawn(visit.canvas()))
        page.is_paused = False
        yield visit
        assert visit.faults == []
    wait_for(lambda: not page.server.get_clients())


def is_drawn(picture: np.ndarray) -> bool:
    """Return whether a robot shows: dark joints, light shells, grey floor behind."""
    level = picture.sum(-1) / 3
    return (level < 90).mean() > 0.002 and np.ptp(level) > 120


def differs(one: np.ndarray, other: np.ndarray) -> bool:
    return bool((np.abs(one - other).max(-1) > 40).mean() > 0.002)


def test_the_picture_moves_with_the_robot_and_not_in_a_pause(page: Page, visit: Visit):
    visit.press("Pause")
    wait_for(lambda: page.is_paused)
    visit.press("Reset")
    wait_for(lambda: page.sessions[0].frame.step == 0)
    time.sleep(3)
    still = visit.canvas()
    assert not differs(still, visit.canvas())
    # The policy leaves the default pose, without a ball.
    visit.press("Pause")
    wait_for(lambda: differs(still, visit.canvas()))
    assert not any(frames[0].active.any() for frames in page._memory)


def test_the_whole_robot_is_seen_beside_the_panel(page: Page):
    page.is_paused = True
    for width in (1440, 800):
        with browsing(width, 900) as context:
            visit = Visit(context, page.address)
            wait_for(lambda: is_drawn(visit.canvas(width - _PANEL, 900)))  # noqa: B023
            dark = visit.canvas(width - _PANEL, 900).sum(-1) < 3 * 90
            for axis in (0, 1):
                found = np.flatnonzero(dark.any(axis))
                assert found[0] > 5
                assert found[-1] < dark.shape[1 - axis] - 5
            assert visit.faults == []


def test_a_throw_is_seen_by_the_sensors(page: Page, visit: Visit):
    page._ask(page.reset)
    visit.press("Front")
    wait_for(lambda: page.sessions[0].frame.reading.max(initial=0) > 0.3)
    visit.press("Pause")
    wait_for(lambda: page.is_paused)
    # The step of the strongest reading, and the same step if nothing were sensed.
    (seen,) = max(page._memory, key=lambda frames: frames[0].reading.max())
    numb = dataclasses.replace(
        seen, reading=0 * seen.reading, line=np.full_like(seen.line, np.nan)
    )
    page._ask(lambda: page._draw([numb]))
    dark = visit.still()
    page._ask(lambda: page._draw([seen]))
    wait_for(lambda: differs(dark, visit.canvas()))
    visit.press("Pause")
    wait_for(lambda: not page.is_paused)


def test_a_click_on_the_floor_throws_a_ball(page: Page, visit: Visit):
    page._ask(page.reset)
    wait_for(lambda: page.sessions[0].frame.step > 0)
    visit.tab.mouse.click(60, 540)
    wait_for(lambda: page.sessions[0].frame.active.any())


def test_another_policy_is_chosen(page: Page, visit: Visit):
    visit.tab.get_by_role("tab", name="Policy").click()
    # The one field of that tab.
    visit.tab.locator("input:visible").last.click()
    visit.tab.get_by_role("option", name="localization").click()
    wait_for(lambda: page.sessions[0].source == "localization")
    assert page.error == ""
    page._ask(page.load, 0, "field_proximity")
    wait_for(lambda: page.sessions[0].source == "field_proximity")
    wait_for(lambda: is_drawn(visit.canvas()))


def test_an_error_is_shown_and_the_page_lives_on(page: Page, visit: Visit):
    page._ask(page.load, 0, "nobody")
    visit.tab.wait_for_selector("text=no policy nobody")
    page._ask(page.reset)
    steps = page.steps
    wait_for(lambda: page.steps > steps + 5)


def test_a_recording_is_a_page_that_plays_alone(
    page: Page, visit: Visit, tmp_path: Path
):
    wait_for(lambda: len(page._memory) > 60)
    with visit.tab.expect_download() as download:
        visit.press("Save")
    path = tmp_path / "saved.html"
    download.value.save_as(path)
    alone = Visit(visit.tab.context, path.as_uri())
    wait_for(lambda: is_drawn(alone.canvas()))
    assert alone.faults == []


def test_other_visitors_and_lost_connections_disturb_nobody(page: Page, visit: Visit):
    process = psutil.Process()
    threads, memory = [], []
    visit.press("Pause")
    wait_for(lambda: page.is_paused)
    time.sleep(3)
    still = visit.canvas()
    for _ in range(4):
        other = Visit(visit.tab.context, page.address)
        wait_for(lambda: len(page.server.get_clients()) == 2)
        wait_for(lambda: is_drawn(other.canvas()))  # noqa: B023
        assert other.faults == []
        assert not differs(still, visit.canvas())
        other.tab.close()
        wait_for(lambda: len(page.server.get_clients()) == 1)
        threads.append(process.num_threads())
        memory.append(process.memory_info().rss)
    # The server keeps a pool of threads that it fills once.
    assert threads[-1] - threads[0] <= 8
    assert memory[-1] - memory[0] < 50e6
    visit.press("Pause")
    steps = page.steps
    wait_for(lambda: page.steps > steps + 5)
    page.server._websock_server.disconnect_all_clients()
    # The browser reconnects by itself.
    wait_for(lambda: len(page.server.get_clients()) == 1)
    steps = page.steps
    wait_for(lambda: page.steps > steps + 5)
    # Its messages about the connection that was cut.
    visit.faults[:] = [text for text in visit.faults if "WebSocket" not in text]
