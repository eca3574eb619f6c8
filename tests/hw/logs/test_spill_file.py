"""Temporary storage on disk."""

from __future__ import annotations

import os
from pathlib import Path

from kiteline_hw.logs.spill_file import SpillFile


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
