"""Small files that outlive a process are whole, and the newest, after a loss of power: content first, then its name."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_hw.durable_files import write_atomically
from kiteline_hw.mavlink.transport.signing import StampFile
from kiteline_hw.system import key_store

WRITERS: dict[str, Callable[[Path], object]] = {
    "rig": lambda path: RigFile(str(path)).save(KnownRigConfig(rows_px=(0.5, 0.0, 0.0, 0.0, 0.0))),
    "stamp": lambda path: StampFile(path, lambda: 2e9),
    "keys": lambda path: key_store.new_key(path, 3),
    "number": lambda path: write_atomically(path, b"7"),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_the_content_is_on_the_disk_before_the_name(
    write: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def noted_fsync(fd: int) -> None:
        done.append("folder" if stat.S_ISDIR(os.fstat(fd).st_mode) else f"{os.fstat(fd).st_size} bytes")
        fsync(fd)

    def noted_replace(a: Path, b: Path) -> None:
        done.append("name")
        replace(a, b)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    path = tmp_path / "file"
    write(path)
    content = f"{path.stat().st_size} bytes"
    assert content != "0 bytes"
    assert done == [content, "name", "folder"]
