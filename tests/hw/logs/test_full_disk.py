"""Logs on a small or full disk: budgets, whole pieces."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.whole_file import LineFile, WholeFile
from tests.hw.logs.disks import SmallDisk


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


def test_the_part_that_is_about_to_be_written_is_not_deleted(tmp_path: Path) -> None:
    """The log would go on in a file without a name."""
    for name, size in (("boot00008.mcap", 5000), ("boot00008_1.mcap", 5000), ("boot00008_2.mcap", 0)):
        put(tmp_path, name, size, 100)
    LogBudget(tmp_path, "boot", 10**9, reserve_bytes=10**18).make_room(tmp_path / "boot00008_1.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["boot00008_1.mcap", "boot00008_2.mcap"]


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
