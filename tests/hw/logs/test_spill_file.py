"""Temporary storage on disk."""

import os
import tempfile
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

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
