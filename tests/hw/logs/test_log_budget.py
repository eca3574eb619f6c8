from __future__ import annotations

import os
from pathlib import Path

from kiteline_hw.logs.log_budget import make_room


def put(folder: Path, name: str, size: int, age: int) -> None:
    (folder / name).write_bytes(b"x" * size)
    os.utime(folder / name, (1_700_000_000 - age, 1_700_000_000 - age))


def test_the_oldest_logs_go_until_half_is_free_and_nothing_else(tmp_path: Path) -> None:
    for number in range(1, 5):
        put(tmp_path, f"boot{number:05d}.mcap", 300, 10 - number)
    for name in ("boot", "odometry.tum", "bootcamp.mcap", "session1.mcap", "rig.toml"):
        put(tmp_path, name, 1000, 99)
    assert make_room(tmp_path, "boot", 1000) == 700
    assert sorted(path.name for path in tmp_path.glob("boot0*")) == ["boot00004.mcap"]
    assert all((tmp_path / name).exists() for name in ("boot", "odometry.tum", "bootcamp.mcap", "session1.mcap"))


def test_logs_within_half_of_the_limit_stay(tmp_path: Path) -> None:
    put(tmp_path, "boot00001.mcap", 300, 1)
    put(tmp_path, "boot00002_1.mcap", 200, 0)
    assert make_room(tmp_path, "boot", 1000) == 500
    assert len(list(tmp_path.iterdir())) == 2
