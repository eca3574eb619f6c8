"""Temporary storage on disk, also on one that is full or stalls."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_hw.logs import spill_file
from kiteline_hw.logs.spill_file import SpillFile
from tests.hw.logs.disks import SmallDisk, StalledDisk, until


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
    gone._file.close()
    assert gone.put(b"x") is None
    assert gone.get(0, 1) is None
    assert gone.failures == 2
    gone._file = None


@pytest.mark.parametrize("beside", [False, True])
@given(sizes=st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 9)), max_size=60))
def test_freed_places_serve_again_and_none_holds_two_things(beside: bool, sizes: list[tuple[int, int]]) -> None:
    spill, held = SpillFile(Path(tempfile.gettempdir()), beside=beside), dict[int, tuple[int, bytes]]()
    for i, (size, replaced) in enumerate(sizes):
        if (old := held.pop(replaced, None)) is not None:
            spill.free(old[0], len(old[1]))
        data = bytes([i]) * size
        where = spill.put(data)
        assert where is not None
        held[replaced] = where, data
        assert all(spill.get(where, len(data)) == data for where, data in held.values())
    spill.close()


def test_a_stalled_disk_delays_nobody_who_stores_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spill_file, "_MOST_WAITING_BYTES", 10_000)
    disk, spill = StalledDisk(monkeypatch), SpillFile(tmp_path, beside=True)
    begin_s = time.monotonic()
    first, second = spill.put(b"a" * 4000), spill.put(b"b" * 4000)
    assert first is not None and second is not None
    assert spill.get(first, 4000) == b"a" * 4000 and spill.get(second, 4000) == b"b" * 4000
    assert spill.put(b"c" * 4000) is None and spill.failures == 1, "memory is bounded"
    spill.free(first, 4000)
    third = spill.put(b"c" * 4000)  # in the place that the thread is writing
    assert third == first and spill.get(first, 4000) == b"c" * 4000
    assert time.monotonic() - begin_s < 1.0
    disk.go.set()
    assert isinstance(spill._file, spill_file._BesideFile)
    until(lambda: not spill._file._bytes)
    assert spill._file._file.read(first, 4000) == b"c" * 4000 and spill._file._file.read(second, 4000) == b"b" * 4000
    assert spill.get(second, 4000) == b"b" * 4000


def test_bytes_that_a_full_disk_refused_are_stored_once_there_is_room(
    tmp_path: Path, small_disk: Callable[[int], SmallDisk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spill_file, "_RETRY_S", 0.01)
    disk, spill = small_disk(1000), SpillFile(tmp_path, beside=True)
    places = [spill.put(bytes([i]) * 800) for i in range(5)]
    assert all(where is not None and spill.get(where, 800) == bytes([i]) * 800 for i, where in enumerate(places))
    disk.room = 10**6
    assert isinstance(spill._file, spill_file._BesideFile)
    until(lambda: not spill._file._bytes)
    assert all(where is not None and spill.get(where, 800) == bytes([i]) * 800 for i, where in enumerate(places))
    assert spill.failures == 0


def test_a_spill_file_on_a_stalled_disk_is_closed_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, spill = StalledDisk(monkeypatch), SpillFile(tmp_path, beside=True)
    assert spill.put(b"a") == 0
    begin_s = time.monotonic()
    spill.close()
    assert time.monotonic() - begin_s < 1.0 and spill.put(b"a") is None
    disk.go.set()


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
