"""Numbers of starts only grow, on full, failing and lost disks, and are not repeated by other processes or machines."""

import errno
import multiprocessing
import os
from pathlib import Path

import pytest

from kiteline_core.ids import MAX_BOOTS, MAX_SUBMAPS, submap_id
from kiteline_hw.system.start_numbers import NAME, DiskFolder, Start, StartNumbers, machine_identity, numbers_in


def numbers(folder: Path, machine: str = "a", drawn: int = 0) -> StartNumbers:
    return StartNumbers(DiskFolder(folder), machine, lambda below: drawn % below)


def test_numbers_only_grow_and_boots_go_round(tmp_path: Path) -> None:
    first = numbers(tmp_path / "agent0", drawn=MAX_BOOTS - 3).next()
    starts = [first, *(numbers(tmp_path / "agent0").next() for _ in range(20))]
    assert [s.order for s in starts] == list(range(first.order, first.order + 21))
    assert [s.boot for s in starts] == [(MAX_BOOTS - 3 + k) % MAX_BOOTS for k in range(21)]
    assert all(submap_id(255, s.boot, 0) >= 0 and s.kept == "" for s in starts)


def test_more_starts_than_16384_do_not_end_an_agent() -> None:
    assert submap_id(0, 16_384, 0) > submap_id(0, 16_383, 0)
    assert submap_id(0, (MAX_BOOTS - 1 + 1) % MAX_BOOTS, 0) == 0


def test_a_torn_slot_leaves_the_other(tmp_path: Path) -> None:
    before = numbers(tmp_path).next()
    newest = numbers(tmp_path).next()
    content = (tmp_path / NAME).read_bytes()
    for at in (40, 552):
        torn = bytearray(content)
        torn[at] ^= 1
        (tmp_path / NAME).write_bytes(torn)
        assert numbers(tmp_path).next().order in (before.order, before.order + 1, newest.order + 1)
    (tmp_path / NAME).write_bytes(b"rubbish")
    assert numbers(tmp_path, drawn=777).next() == Start(778, 777, 777 % (MAX_SUBMAPS // 2))


def test_a_cloned_card_draws_others(tmp_path: Path) -> None:
    before, submap = numbers(tmp_path).next(), 5000 % (MAX_SUBMAPS // 2)
    here, there = numbers(tmp_path, drawn=5000).next(), numbers(tmp_path, "b", drawn=5000).next()
    assert here == Start(before.order + 1, before.boot + 1, submap)
    assert there == Start(here.order + 5001, 5000, submap)
    assert numbers(tmp_path, "b").next() == Start(there.order + 1, 5001)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_takes_nothing_does_not_stop_a_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    before = numbers(tmp_path).next()

    def full(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "pwrite", full)
    start = numbers(tmp_path, drawn=900).next()
    assert (start.order, start.boot, start.kept) == (before.order + 901, 900, os.strerror(number))
    assert numbers(tmp_path / "new", drawn=900).next().kept == os.strerror(number)


def test_a_folder_that_is_none_does_not_stop_a_start(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    start = numbers(tmp_path / "file" / "agent0", drawn=900).next()
    assert (start.order, start.boot) == (901, 900) and start.kept


def test_a_full_disk_takes_the_next_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers(tmp_path).next()
    size = (tmp_path / NAME).stat().st_size
    monkeypatch.setattr(os, "replace", lambda *_: pytest.fail("a new file takes room"))
    assert numbers(tmp_path).next().kept == ""
    assert (tmp_path / NAME).stat().st_size == size


def _take(folder: str, count: int, out: "multiprocessing.Queue[list[int]]") -> None:
    out.put([numbers_in(Path(folder)).next().order for _ in range(count)])


def test_processes_that_start_together_get_different_numbers(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    out = context.Queue()
    processes = [context.Process(target=_take, args=(str(tmp_path), 25, out)) for _ in range(4)]
    for process in processes:
        process.start()
    found = [order for _ in processes for order in out.get(timeout=60)]
    for process in processes:
        process.join()
    assert len(set(found)) == 100


def test_an_order_that_a_base_asked_for_is_kept(tmp_path: Path) -> None:
    first = numbers(tmp_path).next()
    numbers(tmp_path).raise_to(500)
    numbers(tmp_path).raise_to(3)
    assert numbers(tmp_path).next() == Start(501, first.boot + 1)


def test_the_identity_of_a_machine_is_that_of_its_hardware(tmp_path: Path) -> None:
    for name, address, device in (("eth0", "b8:27:eb:00:00:01", True), ("wlan0", "02:00:00:00:00:09", True),
                                  ("veth1", "b8:27:eb:00:00:02", False)):  # fmt: skip
        card = tmp_path / "sys/class/net" / name
        card.mkdir(parents=True)
        (card / "address").write_text(address)
        if device:
            (card / "device").mkdir()
    here = machine_identity(tmp_path)
    for name in ("wlan0", "veth1"):
        (tmp_path / "sys/class/net" / name / "address").write_text("02:00:00:00:00:07")
    assert machine_identity(tmp_path) == here
    (tmp_path / "sys/class/net/eth0/address").write_text("b8:27:eb:00:00:03")
    assert machine_identity(tmp_path) != here
