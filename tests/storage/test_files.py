"""Files of given paths: what is read or refused at once, and what is written."""

from __future__ import annotations

import errno
import os
import socket
import stat
from pathlib import Path

import pytest

from egoskin.storage.files import (
    check_regular,
    read_regular,
    write_file,
    write_output,
)


def test_a_file_is_read_whole_and_through_a_link(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"\x00ab\r\n")
    (tmp_path / "link").symlink_to("file")
    assert read_regular(tmp_path / "file") == b"\x00ab\r\n"
    assert read_regular(str(tmp_path / "link"), limit=5) == b"\x00ab\r\n"


@pytest.fixture
def odd(tmp_path: Path) -> dict[str, Path]:
    """Paths that are not regular files, by the name of their kind."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    return {
        "a folder": tmp_path,
        "a named pipe": tmp_path / "link",
        "a socket": tmp_path / "socket",
        "a device": Path("/dev/zero"),
    }


@pytest.mark.parametrize("kind", ["a folder", "a named pipe", "a socket", "a device"])
@pytest.mark.parametrize("use", [check_regular, read_regular])
def test_only_regular_files_are_read(use, kind, odd):
    # Opening a pipe without a writer would block until the test is killed.
    with pytest.raises(ValueError, match=f"{odd[kind]} must be a file, but is {kind}"):
        use(odd[kind])


def test_a_pipe_put_in_place_of_a_file_is_not_waited_for(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("text")
    real_open = os.open

    def swap(name, flags, *args, **options):
        path.unlink()
        os.mkfifo(path)
        return real_open(name, flags, *args, **options)

    monkeypatch.setattr(os, "open", swap)
    with pytest.raises(ValueError, match="named pipe"):
        read_regular(path)


@pytest.mark.parametrize("use", [check_regular, read_regular])
def test_a_file_may_be_as_large_as_the_limit_and_no_larger(use, tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    use(path, limit=5)
    with pytest.raises(ValueError, match="at most 4 bytes, but has 5"):
        use(path, limit=4)
    # A sparse file takes no disk space, but would take memory.
    os.truncate(path, 10**12)
    with pytest.raises(ValueError, match="but has 1,000,000,000,000"):
        use(path)


@pytest.mark.parametrize("use", [check_regular, read_regular])
def test_a_missing_file_is_named(use, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        use(tmp_path / "nowhere")


def test_an_output_that_cannot_be_written_leaves_the_old_file(
    tmp_path: Path, monkeypatch
):
    path = tmp_path / "a.json"
    write_output(path, b"old")
    assert path.read_bytes() == b"old"

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=rf"No space left on device: '{path}'"):
        write_output(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_content_and_name_of_a_file_are_on_disk_once_it_is_written(
    tmp_path: Path, monkeypatch
):
    path, synced = tmp_path / "a.json", []

    def note(descriptor: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        synced.append(("folder" if is_folder else "content", path.exists()))

    monkeypatch.setattr(os, "fsync", note)
    write_file(path, b"content")
    # After a power failure, a name in the folder leads to the whole content.
    assert synced == [("content", False), ("folder", True)]


def test_an_output_is_written_through_a_link_and_into_a_pipe(tmp_path: Path):
    (tmp_path / "link").symlink_to("file")
    write_output(tmp_path / "link", b"content")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_bytes() == b"content"
    # As /dev/stdout in a pipeline.
    read, write = os.pipe()
    write_output(Path(f"/dev/fd/{write}"), b"piped")
    assert os.read(read, 9) == b"piped"
    os.close(read)
    os.close(write)
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        write_output(Path("/dev/full"), b"lost")
