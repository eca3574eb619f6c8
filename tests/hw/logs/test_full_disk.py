"""Logs on a small or full disk: budgets, spill files, whole pieces."""

import errno
import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kiteline_hw.logs import whole_file
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.log_parts import WholeLog
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.logs.whole_file import BesideFile, LineFile, WholeFile


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


class StalledDisk:
    """Answers no write until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go = threading.Event()
        self._pwrite = os.pwrite
        monkeypatch.setattr(os, "pwrite", self.pwrite)

    def pwrite(self, fd: int, data: bytes, offset: int) -> int:
        assert threading.current_thread() is not threading.main_thread()
        self.go.wait(10.0)
        return self._pwrite(fd, data, offset)


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


def put(folder: Path, name: str, size: int, age: int) -> None:
    (folder / name).write_bytes(b"x" * size)
    os.utime(folder / name, (1_700_000_000 - age, 1_700_000_000 - age))


def test_the_oldest_logs_go_until_there_is_room_and_nothing_else(tmp_path: Path) -> None:
    for number in range(1, 5):
        put(tmp_path, f"boot{number:05d}.mcap", 300, 10 - number)
    for name in ("boot", "odometry.tum", "bootcamp.mcap", "session1.mcap", "rig.toml"):
        put(tmp_path, name, 1000, 99)
    budget = LogBudget(tmp_path, "boot", 800, 0)
    budget.make_room()
    assert (budget.part_bytes, budget.deleted) == (100, 2)
    assert sorted(path.name for path in tmp_path.glob("boot0*")) == ["boot00003.mcap", "boot00004.mcap"]
    assert all((tmp_path / name).exists() for name in ("boot", "odometry.tum", "bootcamp.mcap", "session1.mcap"))


@pytest.mark.parametrize("number", [3, 8])
def test_a_clock_that_was_set_back_does_not_make_the_flight_under_way_the_oldest(tmp_path: Path, number: int) -> None:
    """A computer without a battery for its clock; a lost state folder may give a start a lower number, too."""
    for start, age in ((7, 0), (number, 2000)):
        for part in range(12):
            put(tmp_path, f"boot{start:05d}_{part}.mcap" if part else f"boot{start:05d}.mcap", 100, age - part)
    LogBudget(tmp_path, "boot", 1600, 0).make_room(tmp_path / f"boot{number:05d}_11.mcap")
    left = {path.stem for path in tmp_path.iterdir()}
    assert left == {f"boot00007_{part}" for part in (10, 11)} | {
        f"boot{number:05d}{f'_{part}' if part else ''}" for part in range(12)
    }
    LogBudget(tmp_path, "boot", 800, 0).make_room(tmp_path / f"boot{number:05d}_11.mcap")
    assert {path.stem for path in tmp_path.iterdir()} == {f"boot{number:05d}_{part}" for part in range(5, 12)}


def test_trajectories_are_deleted_with_the_last_part_of_their_log(tmp_path: Path) -> None:
    names = ["boot00007.mcap", "boot00007_1.mcap", "boot00008.mcap"]
    lines = [f"boot{number:05d}.{kind}.tum" for number in (7, 8) for kind in ("live", "odometry")]
    for name in [*names, *lines, "live.tum", "boot.live.tum"]:
        put(tmp_path, name, 100, 0)
    LogBudget(tmp_path, "boot", 760, 0).make_room(tmp_path / "boot00008.mcap")  # 700, and a part of 95 is to come
    assert not (tmp_path / "boot00007.mcap").exists() and all((tmp_path / name).exists() for name in lines)
    LogBudget(tmp_path, "boot", 680, 0).make_room(tmp_path / "boot00008.mcap")
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["boot.live.tum", "boot00008.live.tum", "boot00008.mcap", "boot00008.odometry.tum", "live.tum"]


def test_logs_without_numbers_are_as_old_as_their_last_change(tmp_path: Path) -> None:
    for part, age in ((1, 5), (2, 9), (3, 1)):
        put(tmp_path, f"turn_{part}.mcap", 100, age)
    LogBudget(tmp_path, "turn", 280, 0).make_room()
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["turn_1", "turn_3"]


def test_logs_within_the_limit_stay(tmp_path: Path) -> None:
    put(tmp_path, "boot00001.mcap", 300, 1)
    put(tmp_path, "boot00002_1.mcap", 200, 0)
    LogBudget(tmp_path, "boot", 1000, 0).make_room()
    assert len(list(tmp_path.iterdir())) == 2


def test_logs_leave_room_on_a_disk_that_others_fill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(1, 5):
        put(tmp_path, f"boot{number:05d}.mcap", 300, 10 - number)

    class Disk:
        f_bavail, f_frsize = 100, 1

    monkeypatch.setattr(os, "statvfs", lambda _: Disk())
    budget = LogBudget(tmp_path, "boot", 8000, 500)
    budget.make_room(tmp_path / "boot00001.mcap")
    # All take 1200 and 100 are free; 500 are to be left free, and a part of an eighth of the limit is to come.
    assert [path.name for path in tmp_path.iterdir()] == ["boot00001.mcap"]  # being written: it stays
    assert budget.deleted == 3


def test_a_log_goes_on_in_parts_that_stand_alone_while_the_oldest_go(tmp_path: Path) -> None:
    put(tmp_path, "boot00007.mcap", 30_000, 100)
    budget = LogBudget(tmp_path, "boot", 160_000, 0)
    log = LogWriter(tmp_path / "boot00008.mcap", {"role": "agent"}, budget=budget, part_topic="/step")
    for k in range(300):
        log.json("/step", k, {"k": k})
        log.blob("/a", k, k.to_bytes(2, "little") * 500)
        log.flush()
        if budget._deleting is not None:
            budget._deleting.join()
    log.close()
    left = sorted(tmp_path.glob("boot*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    assert sum(path.stat().st_size for path in left) < 1.1 * 160_000
    assert log.dropped == 0 and tmp_path / "boot00007.mcap" not in left and len(left) >= 4
    steps = []
    for path in left:
        with LogReader(path) as read:
            assert read.cut is None and int(read.metadata["part"]) > 0
            messages = list(read.messages())
            assert messages[0].topic == "/step"  # no step is cut in two
            steps += [m.json()["k"] for m in messages if m.topic == "/step"]
    assert steps == list(range(steps[0], 300))


def test_stored_bytes_are_read_back_and_leave_no_file(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "agent0")
    places = [spill.put(bytes([i]) * (100 * i)) for i in range(5)]
    for i, where in reversed(list(enumerate(places))):
        assert where is not None
        assert spill.get(where, 100 * i) == bytes([i]) * (100 * i)
    assert list((tmp_path / "agent0").iterdir()) == []
    assert spill.get(10**6, 4) is None
    assert spill.failures == 1
    spill.close()
    spill.close()
    assert spill.put(b"late") is None
    assert spill.get(0, 0) is None


def test_an_unwritable_folder_is_counted(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    spill = SpillFile(tmp_path / "file" / "agent0")
    assert spill.put(b"x") is None
    assert spill.failures == 2
    gone = SpillFile(tmp_path)
    assert gone._file is not None
    os.close(gone._file)
    assert gone.put(b"x") is None
    assert gone.get(0, 1) is None
    assert gone.failures == 2
    gone._file = None


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 9)), max_size=60))
def test_freed_places_serve_again_and_none_holds_two_things(sizes: list[tuple[int, int]]) -> None:
    spill, held = SpillFile(Path(tempfile.gettempdir())), dict[int, tuple[int, bytes]]()
    for i, (size, replaced) in enumerate(sizes):
        if (old := held.pop(replaced, None)) is not None:
            spill.free(old[0], len(old[1]))
        data = bytes([i]) * size
        where = spill.put(data)
        assert where is not None
        held[replaced] = where, data
        assert all(spill.get(where, len(data)) == data for where, data in held.values())
    spill.close()


def test_a_file_whose_contents_change_does_not_grow(tmp_path: Path) -> None:
    spill, held, sizes = SpillFile(tmp_path), dict[int, tuple[int, int]](), list[int]()
    for i in range(4000):
        if (old := held.pop(i % 50, None)) is not None:
            spill.free(*old)
        size = 4000 + (i * 7919) % 1000
        where = spill.put(bytes(size))
        assert where is not None
        held[i % 50] = where, size
        sizes.append(spill._size)
    assert sizes[-1] == sizes[2000] < 2 * 50 * 5000
