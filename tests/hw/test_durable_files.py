"""Numbers and files that survive a crash."""

import os
from pathlib import Path

import pytest

from kiteline_hw.durable_files import next_number, write_atomically


def test_numbers_only_grow(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "boot"
    assert [next_number(path) for _ in range(3)] == [1, 2, 3]


def test_an_unreadable_number_raises(tmp_path: Path) -> None:
    path = tmp_path / "boot"
    path.write_text("rubbish")
    with pytest.raises(ValueError, match="boot"):
        next_number(path)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "values"
    write_atomically(path, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
