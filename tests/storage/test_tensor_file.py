"""Checkpoint files: exact, written atomically; other files are refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from egoskin.storage.tensor_file import load_tensors, part, prefixed, save_tensors

TENSORS = {
    "a/x": torch.arange(6.0).reshape(2, 3),
    "a/n": torch.tensor(7),
    "b": torch.ones(1),
}


def test_tensors_and_header_come_back_exactly(tmp_path: Path):
    path = tmp_path / "file.safetensors"
    save_tensors(path, TENSORS, {"frames": 3, "rate": 0.1})
    tensors, header = load_tensors(path)
    assert header == {"frames": 3, "rate": 0.1}
    assert tensors.keys() == TENSORS.keys()
    for key, value in TENSORS.items():
        assert tensors[key].dtype == value.dtype
        assert torch.equal(tensors[key], value)
    assert torch.equal(part("a", tensors)["n"], TENSORS["a/n"])
    assert prefixed("c", {"d": TENSORS["b"]}).keys() == {"c/d"}


def test_every_truncation_is_refused_with_the_name_of_the_file(tmp_path: Path):
    path = tmp_path / "file.safetensors"
    save_tensors(path, TENSORS, {})
    content = path.read_bytes()
    for size in range(0, len(content), 7):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"file\.safetensors is truncated"):
            load_tensors(path)


def test_a_failed_write_leaves_the_file_and_nothing_else(tmp_path: Path, monkeypatch):
    path = tmp_path / "file.safetensors"
    save_tensors(path, TENSORS, {"frames": 1})

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_tensors(path, TENSORS, {"frames": 2})
    assert load_tensors(path)[1] == {"frames": 1}
    assert os.listdir(tmp_path) == ["file.safetensors"]


def test_a_path_that_is_no_file_is_told_as_what_it_is(tmp_path: Path):
    with pytest.raises(ValueError, match=r"is a folder$"):
        load_tensors(tmp_path)
    with pytest.raises(ValueError, match="no such file"):
        load_tensors(tmp_path / "missing.safetensors")


def test_a_pickle_is_refused_and_not_run(tmp_path: Path):
    path = tmp_path / "file.safetensors"

    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "ran"),))

    torch.save(Trap(), path)
    with pytest.raises(ValueError, match="not an egoskin checkpoint"):
        load_tensors(path)
    assert not (tmp_path / "ran").exists()
