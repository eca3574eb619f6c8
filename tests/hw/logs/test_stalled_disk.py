"""Logs that are written beside a loop that waits for no disk."""

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from kiteline_hw.logs import whole_file
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.log_parts import WholeLog
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.whole_file import BesideFile, LineFile
from tests.hw.logs.disks import SlowFolder, SmallDisk, StalledDisk, until


def test_a_log_beside_waits_for_no_disk_and_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with LogWriter(tmp_path / "plain.mcap", {}) as plain:
        disk = StalledDisk(monkeypatch)
        log, lines = LogWriter(tmp_path / "log.mcap", {}, beside=True), LineFile(tmp_path / "a.tum", beside=True)
        for k in range(200):
            log.blob("/a", k, bytes([k]) * 2000)
            lines.write(f"{k}\n")
        assert not log.waits_for and log.dropped == lines.lost == 0
        disk.go.set()
        log.close()
        lines.close()
        monkeypatch.undo()
        for k in range(200):
            plain.blob("/a", k, bytes([k]) * 2000)
    assert (tmp_path / "log.mcap").read_bytes() == (tmp_path / "plain.mcap").read_bytes()
    assert (tmp_path / "a.tum").read_text().split() == [str(k) for k in range(200)]


def test_what_a_stalled_disk_does_not_take_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole_file, "_CLOSE_S", 0.2)
    disk, file = StalledDisk(monkeypatch), BesideFile(tmp_path / "file", most_bytes=10)
    file.write(b"123456")
    assert file.waits_for == "the disk does not answer"
    with pytest.raises(OSError, match="does not answer"):
        file.write(b"abcdef")
    file.close()
    assert file.closed and file.unwritten == 1
    disk.go.set()


def test_a_log_beside_goes_on_once_the_full_disk_has_room(
    tmp_path: Path, small_disk: Callable[[int], SmallDisk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole_file, "_RETRY_S", 0.01)
    disk, budget = small_disk(100_000), LogBudget(tmp_path, "log", 800_000, 0)
    log = LogWriter(tmp_path / "log00001.mcap", {}, budget=budget, beside=True)
    for k in range(100):
        log.blob("/a", k, k.to_bytes(2, "little") * 1000)
    end_s = time.monotonic() + 5.0
    while log.waits_for != os.strerror(errno.ENOSPC):
        assert time.monotonic() < end_s
        time.sleep(0.01)
    disk.room = 10**9
    log.close()
    assert log.dropped == 0 and log.why == ""
    with WholeLog(tmp_path / "log00001.mcap") as read:
        assert [int.from_bytes(m.blob()[:2], "little") for m in read.messages()] == list(range(100))


def test_a_log_beside_on_a_disk_that_stays_full_says_so(tmp_path: Path, small_disk: Callable[[int], SmallDisk]) -> None:
    small_disk(100_000)
    log, lines = LogWriter(tmp_path / "log.mcap", {}, beside=True), LineFile(tmp_path / "a.tum", beside=True)
    for k in range(200):
        log.blob("/a", k, k.to_bytes(2, "little") * 1000)
    log.close()
    lines.write("one\n")
    lines.close()
    assert log.dropped > 0 and "No space" in log.why and lines.lost == 1 and "No space" in lines.why
    with LogReader(tmp_path / "log.mcap") as read:
        found = [int.from_bytes(m.blob()[:2], "little") for m in read.messages()]
    assert found == list(range(len(found))) and found


def write_steps(log: LogWriter, steps: range) -> None:
    for k in steps:
        log.json("/step", k, {"k": k})
        log.blob("/a", k, k.to_bytes(2, "little") * 500)
        log.flush()


def steps_of(path: Path) -> list[int]:
    with WholeLog(path) as read:
        assert read.cut is None
        return [m.json()["k"] for m in read.messages() if m.topic == "/step"]


def test_the_next_part_of_a_log_is_created_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, path = SlowFolder(monkeypatch, "boot00008_1"), tmp_path / "boot00008.mcap"
    budget = LogBudget(tmp_path, "boot", 800_000, 0)
    log = LogWriter(path, {}, budget=budget, part_topic="/step", beside=True)
    begin_s = time.monotonic()
    write_steps(log, range(150))
    assert folder.tries == 1 and time.monotonic() - begin_s < 5.0
    folder.go.set()
    until(lambda: log._coming is not None and log._coming.done)
    write_steps(log, range(150, 200))
    assert log._part == 1
    log.close()
    assert log.dropped == 0 and steps_of(path) == list(range(200))


def test_a_log_whose_next_part_cannot_be_created_goes_on_in_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, path = SlowFolder(monkeypatch, "_1", OSError(errno.EROFS, "read-only")), tmp_path / "boot00008.mcap"
    folder.go.set()
    log = LogWriter(path, {}, budget=LogBudget(tmp_path, "boot", 800_000, 0), part_topic="/step", beside=True)
    write_steps(log, range(200))
    log.close()
    assert folder.tries > 1 and log._part == 0 and log.dropped == 0
    assert steps_of(path) == list(range(200))


@pytest.mark.parametrize("late", [False, True])
def test_a_part_that_was_not_begun_when_the_log_ends_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late: bool
) -> None:
    monkeypatch.setattr(whole_file, "_CLOSE_S", 0.2 if late else 5.0)
    folder, path = SlowFolder(monkeypatch, "_1"), tmp_path / "boot00008.mcap"
    log = LogWriter(path, {}, budget=LogBudget(tmp_path, "boot", 800_000, 0), part_topic="/step", beside=True)
    write_steps(log, range(150))
    coming = log._coming
    assert coming is not None and not coming.done
    if not late:
        folder.go.set()
    begin_s = time.monotonic()
    log.close()
    assert time.monotonic() - begin_s < 3.0
    folder.go.set()
    until(lambda: not coming._thread.is_alive())
    assert steps_of(path) == list(range(150)) and [p.name for p in tmp_path.iterdir()] == ["boot00008.mcap"]


def test_a_part_that_is_deleted_on_a_full_disk_is_closed_and_leaves_its_room(
    tmp_path: Path, small_disk: Callable[[int], SmallDisk], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waited for the room that it took itself, and so did the part that the log went on in: both were lost."""
    monkeypatch.setattr(whole_file, "_RETRY_S", 0.01)
    small_disk(5)
    file = BesideFile(tmp_path / "log.mcap")
    file.write(b"123456")
    until(lambda: bool(file.waits_for))
    file.end()
    time.sleep(0.05)
    assert not file._file.closed, "there may still be room for it"
    (tmp_path / "log.mcap").unlink()
    until(lambda: file._file.closed)
    assert file.unwritten == 1 and "No space" in str(file.fault)


def test_a_log_that_is_deleted_meanwhile_takes_no_more_and_says_so(tmp_path: Path) -> None:
    log, lines = LogWriter(tmp_path / "log.mcap", {}, beside=True), LineFile(tmp_path / "a.tum", beside=True)
    log.blob("/a", 0, bytes(100_000))
    lines.write("0\n")
    log.flush()
    until(lambda: (tmp_path / "log.mcap").stat().st_size > 100_000 and (tmp_path / "a.tum").stat().st_size > 0)
    for path in tmp_path.iterdir():
        path.unlink()
    written = 0

    def lost() -> bool:
        nonlocal written
        written += 1
        log.blob("/a", written, bytes(100_000))  # a chunk of its own: nothing waits in memory for long
        lines.write("1\n")
        return bool(log.dropped and lines.lost)

    until(lost)
    assert not log.waits_for
    log.close()
    lines.close()
    assert log.why == "the file was deleted while it was written"
    assert log.why in lines.why
    assert 1 <= log.dropped <= written + 1
    assert list(tmp_path.iterdir()) == []
