"""Films of synthetic frames: text, moments, sheets, files; OpenGL is not needed."""

from __future__ import annotations

import math
import multiprocessing
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from calling import limit_file_size
from egoskin.viewer.film import (
    Frame,
    annotate,
    contact_sheet,
    pick_moments,
    save_film,
    save_picture,
)


def frame(
    time: float = 0.0,
    gap: float = 1.0,
    ending: str | None = None,
    num_sensors: int = 64,
    value: int = 100,
) -> Frame:
    return Frame(
        image=np.full((90, 160, 3), value, np.uint8),
        time=time,
        gap=gap,
        num_detecting=0,
        num_sensors=num_sensors,
        num_avoided=2,
        ending=ending,
    )


def approach(n: int, closest: int) -> list[Frame]:
    """Return frames with the ball closest in one; each has its own brightness."""
    return [
        frame(i / 10, 0.1 * (1 + abs(i - closest)), value=40 + 10 * (i % 20))
        for i in range(n)
    ]


def test_moments_hold_the_start_the_end_and_the_closest_approach():
    frames = approach(20, closest=13)
    picked = pick_moments(frames, 6)
    assert picked == sorted(set(picked))
    assert len(picked) == 6
    assert {0, 13, 19} <= set(picked)


def test_moments_lie_closer_together_when_a_ball_is_near():
    picked = np.array(pick_moments(approach(100, closest=50), 12))
    step, is_near = np.diff(picked), np.abs(picked[:-1] - 50) < 10
    assert step[is_near].mean() < step[~is_near].mean() / 2


def test_a_short_film_gives_each_frame_once():
    assert pick_moments(approach(4, closest=2), 12) == [0, 1, 2, 3]
    assert pick_moments([frame()], 12) == [0]


def test_moments_without_a_ball_are_evenly_spaced():
    frames = [frame(i / 10, math.inf) for i in range(9)]
    assert pick_moments(frames, 5) == [0, 2, 4, 6, 8]


def test_text_tells_the_time_and_what_there_is_besides():
    picture = annotate(frame())
    assert picture.shape == (90, 160, 3)
    # Beside the middle of the picture.
    assert (picture[:30] != 100).any()
    assert (picture[45:] == 100).all()
    # A blind robot without a ball in flight leaves only the time.
    bare = annotate(frame(gap=math.inf, num_sensors=0))
    assert (bare[:, 40:] == 100).all()
    assert (bare != 100).any()


def test_an_end_by_a_hit_is_written_in_red():
    def red(ending: str | None) -> bool:
        picture = annotate(frame(ending=ending)).astype(int)
        return bool((picture[..., 0] - picture[..., 1] > 100).any())

    assert [red(ending) for ending in ("hit", "time limit", None)] == [
        True,
        False,
        False,
    ]


def test_a_sheet_is_a_grid_filled_up_with_white():
    sheet = contact_sheet(approach(5, closest=2))
    assert sheet.shape == (840, 2240, 3)
    assert (sheet[420:, 560:] == 255).all()
    # The frames are in order: each is brighter than the previous one.
    cells = [sheet[350, 280 + 560 * i, 0] for i in range(4)] + [sheet[770, 280, 0]]
    assert cells == sorted(set(cells))


# imageio_ffmpeg does not close the pipe of an ffmpeg process that ended by itself.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("name", ["film.gif", "film.mp4", "12:30.mp4"])
def test_a_film_holds_the_frames_and_the_last_one_stands(
    name: str, tmp_path: Path, monkeypatch
):
    # A bare name, which ffmpeg may take for an address.
    monkeypatch.chdir(tmp_path)
    path = Path(name)
    save_film(path, approach(5, closest=2), fps=10)
    # 5 frames of 100 ms, and one second of the last one.
    _, seconds = imageio_ffmpeg.count_frames_and_secs(tmp_path / path)
    assert seconds == pytest.approx(1.5, abs=0.05)
    assert list(tmp_path.iterdir()) == [tmp_path / path]
    reader = imageio_ffmpeg.read_frames(tmp_path / path)
    width, height = next(reader)["size"]
    assert (width, height) == (160, 90)
    # Below the text each is brighter than the previous one.
    last = [np.frombuffer(each, np.uint8)[-1] for each in reader][:5]
    assert last == sorted(set(last))


def test_a_picture_is_written_as_it_is(tmp_path: Path):
    path = tmp_path / "sheet.png"
    image = np.arange(12 * 8 * 3, dtype=np.uint8).reshape(12, 8, 3)
    save_picture(path, image)
    with Image.open(path) as written:
        assert (np.asarray(written) == image).all()


@pytest.mark.parametrize("name", ["film.mp3", "film", "no/film.mp4"])
def test_a_bad_path_is_an_error_that_says_what_is_expected(tmp_path: Path, name: str):
    with pytest.raises(ValueError, match=r"\.mp4 or \.gif|there is no folder"):
        save_film(tmp_path / name, [frame()], fps=10)


def test_a_film_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "film.mp4"
    path.write_text("old")
    broken = Frame(**{**vars(frame()), "image": np.zeros((90, 160), np.float32)})
    with pytest.raises((TypeError, ValueError)):
        save_film(path, [frame(), broken], fps=10)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def save_on_a_full_disk(paths: list[Path]) -> None:
    limit_file_size(400)
    for path in paths:
        text = f"{path.name}: ffmpeg could not write the film"
        with pytest.raises(OSError, match=text):
            save_film(path, approach(20, closest=2), fps=10)


def test_a_film_on_a_full_disk_is_an_error_and_the_old_file_stays(tmp_path: Path):
    paths = [tmp_path / "film.gif", tmp_path / "film.mp4"]
    for path in paths:
        path.write_text("old")
    # In another process: the limit is for the whole process.
    spawn = multiprocessing.get_context("spawn")
    child = spawn.Process(target=save_on_a_full_disk, args=(paths,))
    child.start()
    child.join(120)
    assert child.exitcode == 0
    assert [path.read_text() for path in paths] == ["old", "old"]
    assert sorted(tmp_path.iterdir()) == paths


@pytest.mark.parametrize(
    ("script", "text"),
    [
        ("exit 3", "exit status 3"),
        ("cat > /dev/null; kill -9 $$", "exit status -9"),
        # Many errors, the last from a part of ffmpeg.
        (
            "yes | head -n 50000 >&2; echo '[mp4 @ 0x1] No space' >&2; exit 1",
            "No space",
        ),
    ],
)
def test_a_film_fails_with_the_reason_of_ffmpeg(
    script: str, text: str, tmp_path: Path, monkeypatch
):
    ffmpeg, path = tmp_path / "ffmpeg", tmp_path / "film.mp4"
    ffmpeg.write_text(f"#!/bin/sh\n{script}\n")
    ffmpeg.chmod(0o700)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(ffmpeg))
    with pytest.raises(OSError, match=f"could not write the film: {text}$"):
        save_film(path, approach(20, closest=2), fps=10)
    assert list(tmp_path.iterdir()) == [ffmpeg]
