"""Films of episodes: frames and their figures, text, contact sheets, files."""

from __future__ import annotations

import io
import math
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from threading import Thread

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from egoskin.storage.files import check_output, write_file

# Pictures of a contact sheet, and of them in a line; width and height of each [px].
_SHEET, _SHEET_CELL = (12, 4), (560, 420)
# Time for which the last picture is held [s].
_LAST_PICTURE = 1.0
# One palette of 256 colours for the whole film: without it a GIF flickers.
_GIF_PALETTE = (
    "[0:v]split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer"
    ":bayer_scale=4:diff_mode=rectangle"
)
_GIF = ("-c:v", "gif", "-pix_fmt", "pal8", "-filter_complex", _GIF_PALETTE)
# H.264 needs an even width and height.
_EVEN = "scale=ceil(iw/2)*2:ceil(ih/2)*2"
_MP4 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "10", "-vf", _EVEN)
FILM_SUFFIXES = (".mp4", ".gif")
"""Supported suffixes of film files."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One picture of an episode with its figures."""

    image: np.ndarray
    """Picture without text, ``[height, width, 3]`` uint8."""
    time: float
    """Age of the episode [s]."""
    gap: float
    """Distance from the robot to the surface of the nearest active ball [m], or inf."""
    num_detecting: int
    """Number of sensors that detect something."""
    num_sensors: int
    """Number of sensors (0 for a blind robot)."""
    num_avoided: int
    """Balls avoided so far."""
    ending: str | None
    """Why the episode ends here ("hit", "fall", ...); None while it goes on."""


def annotate(frame: Frame, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return a frame's picture with its figures written into it.

    Args:
        frame: The frame.
        size: Width and height to scale and crop to [px]; None for those of the
            picture.

    Returns:
        Picture, ``[height, width, 3]`` uint8.
    """
    picture = Image.fromarray(frame.image)
    if size is not None:
        picture = ImageOps.fit(picture, size, Image.Resampling.LANCZOS)
    parts = [f"{frame.time:5.2f} s"]
    if math.isfinite(frame.gap):
        parts.append(f"ball at {max(frame.gap, 0.0):.2f} m")
    if frame.num_sensors:
        parts.append(f"{frame.num_detecting} of {frame.num_sensors} sensors")
    parts.append(f"avoided {frame.num_avoided}")
    pen = ImageDraw.Draw(picture)
    unit = picture.height / 24
    _write(pen, (0.7 * unit, 0.5 * unit), "    ".join(parts), unit, (20, 24, 32))
    if frame.ending is not None:
        is_failure = frame.ending not in ("time limit", "cut")
        colour = (200, 20, 20) if is_failure else (20, 24, 32)
        place = (0.7 * unit, 2.0 * unit)
        _write(pen, place, frame.ending.upper(), 2.4 * unit, colour)
    return np.asarray(picture)


def _write(
    pen: ImageDraw.ImageDraw,
    place: tuple[float, float],
    text: str,
    size: float,
    colour: tuple[int, int, int],
) -> None:
    """Write text with a pale outline, legible on any background."""
    font = ImageFont.load_default(size)
    outline = max(1, round(size / 14))
    pen.text(
        place, text, colour, font, stroke_width=outline, stroke_fill=(245, 246, 248)
    )


def pick_moments(frames: Sequence[Frame], count: int) -> list[int]:
    """Return the indices of the most informative frames, in order.

    These are the first and the last, the closest approaches (at most half of
    ``count``), and then repeatedly the frame farthest from those already picked, on a
    clock that runs faster the nearer a ball is.

    Args:
        frames: Frames in order of time.
        count: Number of frames wanted; fewer if there are fewer.
    """
    gaps = np.array([np.inf, *(f.gap for f in frames), np.inf])
    inner = gaps[1:-1]
    is_minimum = np.isfinite(inner) & (inner <= gaps[:-2]) & (inner <= gaps[2:])
    minima = np.flatnonzero(is_minimum)
    closest = minima[inner[minima].argsort()][: count // 2]
    picked = list(dict.fromkeys([0, len(frames) - 1, *closest.tolist()]))[:count]
    # d clock / dt = 1 / (gap + 0.5 m); above 0 without a ball, as gaps are clipped
    clock = (1.0 / (np.clip(inner, 0.0, 10.0) + 0.5)).cumsum()
    while len(picked) < min(count, len(frames)):
        away = np.abs(clock[:, None] - clock[picked]).min(1)
        picked.append(int(away.argmax()))
    return sorted(picked)


def contact_sheet(frames: Sequence[Frame]) -> np.ndarray:
    """Return a grid of the 12 most informative frames of an episode, in lines of 4.

    Args:
        frames: Frames in order of time.

    Returns:
        Picture, ``[rows * height, columns * width, 3]`` uint8; empty cells are
        white.
    """
    count, columns = _SHEET
    cells = [annotate(frames[i], _SHEET_CELL) for i in pick_moments(frames, count)]
    while len(cells) % columns:
        cells.append(np.full_like(cells[0], 255))
    lines = [cells[i : i + columns] for i in range(0, len(cells), columns)]
    return np.concatenate([np.concatenate(line, axis=1) for line in lines])


def save_film(path: Path, frames: Sequence[Frame], fps: float) -> None:
    """Write annotated frames to an MP4 (H.264) or GIF file; the last one is held.

    An existing file is replaced only once the film is complete.

    Args:
        path: File, ``.mp4`` or ``.gif``.
        frames: Frames in order of time.
        fps: Pictures per second.

    Raises:
        ValueError: If the suffix is wrong, or the folder does not exist.
        OSError: If the film cannot be written, as on a full disk.
    """
    check_output(path, "path", FILM_SUFFIXES)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        failure = _encode(part, frames, fps)
        if failure:
            raise OSError(f"{path}: ffmpeg could not write the film: {failure}")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _encode(path: Path, frames: Sequence[Frame], fps: float) -> str:
    """Write a film and return why ffmpeg failed, or ""."""
    height, width = frames[0].image.shape[:2]
    # Not by imageio_ffmpeg.write_frames, which ignores ffmpeg's exit status.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(Fraction(fps).limit_denominator()), "-i", "-"]
    command += [*(_GIF if path.suffix.lower() == ".gif" else _MP4), f"file:{path}"]
    errors: list[bytes] = []
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        # Ctrl-C is for this process alone.
        start_new_session=True,
    ) as ffmpeg:
        assert ffmpeg.stdin is not None
        assert ffmpeg.stderr is not None
        # Read meanwhile: ffmpeg waits if the pipe of its errors is full.
        reader = Thread(target=lambda pipe: errors.extend(pipe), args=(ffmpeg.stderr,))
        reader.start()
        try:
            # If it ends early, its exit status says so.
            with suppress(BrokenPipeError), ffmpeg.stdin as pipe:
                for picture in _pictures(frames, fps):
                    pipe.write(picture.tobytes())
        except BaseException:
            ffmpeg.kill()
            raise
        finally:
            reader.join()
        status = ffmpeg.wait()
    if status == 0:
        return ""
    # Its last line, without the part of ffmpeg that it comes from.
    last = errors[-1].decode(errors="replace").strip() if errors else ""
    return last.rpartition("] ")[2] or f"exit status {status}"


def _pictures(frames: Sequence[Frame], fps: float) -> Iterator[np.ndarray]:
    """Yield the annotated pictures of a film; the last one is held."""
    yield from map(annotate, frames)
    for _ in range(round(_LAST_PICTURE * fps)):
        yield annotate(frames[-1])


def save_picture(path: Path, image: np.ndarray) -> None:
    """Write a picture ``[height, width, 3]`` uint8 to a PNG file, atomically.

    Raises:
        ValueError: If the suffix is wrong, or the folder does not exist.
    """
    check_output(path, "path", (".png",))
    file = io.BytesIO()
    Image.fromarray(image).save(file, "png")
    write_file(path, file.getvalue())
