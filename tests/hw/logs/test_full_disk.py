"""Logs on a disk that becomes full at any write: nothing is raised, what was written stays, and it is told."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.whole_file import LineFile, WholeFile


class SmallDisk:
    """Takes so many bytes, also of a write that does not fit, and then no more until there is room again."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._pwrite = os.pwrite

    def pwrite(self, fd: int, data: bytes, offset: int) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        n = self._pwrite(fd, bytes(data)[: self.room], offset)
        self.room -= n
        return n


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], SmallDisk]:
    def make(room: int) -> SmallDisk:
        disk = SmallDisk(room)
        monkeypatch.setattr(os, "pwrite", disk.pwrite)
        return disk

    return make


def test_a_piece_is_written_whole_or_not_at_all(tmp_path: Path, small_disk: Callable[[int], SmallDisk]) -> None:
    disk, file = small_disk(10), WholeFile(tmp_path / "file")
    file.write(b"123456")
    with pytest.raises(OSError, match="No space"):
        file.write(b"abcdef")
    assert (tmp_path / "file").read_bytes() == b"123456"
    disk.room = 100
    file.write(b"789")
    file.close()
    file.close()
    assert (tmp_path / "file").read_bytes() == b"123456789"


def test_lines_never_raise_and_are_counted(tmp_path: Path, small_disk: Callable[[int], SmallDisk]) -> None:
    disk, lines = small_disk(8), LineFile(tmp_path / "poses.tum")
    for text in ("one\n", "", "second\n", "third\n"):
        lines.write(text)
    assert (lines.lost, "No space" in lines.why) == (2, True)
    disk.room = 100
    lines.write("last\n")
    lines.close()
    assert (tmp_path / "poses.tum").read_text() == "one\nlast\n"
    nowhere = LineFile(tmp_path / "missing" / "poses.tum")
    nowhere.write("one\n")
    nowhere.close()
    assert nowhere.lost == 1 and "missing" in nowhere.why


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 300_000), st.integers(0, 100))
def test_a_log_loses_what_the_full_disk_did_not_take_and_nothing_else(
    tmp_path_factory: pytest.TempPathFactory, small_disk: Callable[[int], SmallDisk], room: int, lasts: int
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    disk = small_disk(room)
    log = LogWriter(path, {"role": "agent"})
    for k in range(200):
        log.blob(f"/topic{k // 20}", k * 100_000_000, k.to_bytes(2, "little") * 1000)  # new topics while it is full
        if disk.room <= 0:
            lasts -= 1
            if lasts < 0:
                disk.room = 10**9
    disk.room = 10**9
    log.close()
    with LogReader(path) as read:
        assert read.cut is None
        found = [int.from_bytes(m.blob()[:2], "little") for m in read.messages()]
        assert all(m.topic == f"/topic{int.from_bytes(m.blob()[:2], 'little') // 20}" for m in read.messages())
    assert found == sorted(found) and len(found) == 200 - log.dropped
    assert (log.why == "") == (log.dropped == 0)


def test_a_log_that_is_full_to_the_end_keeps_what_was_written(
    tmp_path: Path, small_disk: Callable[[int], SmallDisk]
) -> None:
    small_disk(100_000)
    log = LogWriter(tmp_path / "log.mcap", {})
    for k in range(200):
        log.blob("/a", k, k.to_bytes(2, "little") * 1000)
    log.close()
    with LogReader(tmp_path / "log.mcap") as read:
        found = [int.from_bytes(m.blob()[:2], "little") for m in read.messages()]
    assert found == list(range(len(found))) and len(found) >= 30
