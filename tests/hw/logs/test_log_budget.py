"""The logs of all starts, those of this one included, stay within their limit; the oldest go first."""

import os
from pathlib import Path

import pytest

from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.mcap_log import LogReader, LogWriter


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
