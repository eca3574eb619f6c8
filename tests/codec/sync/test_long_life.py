"""What an endpoint holds, in memory and in its spill, does not grow with the time that it runs."""

import random
from collections import Counter
from pathlib import Path

import pytest

from kiteline_codec.schema import FusedLandmarks, Key, KeyframeHeader, KeyframePose, Observations, RefinedLandmarks
from kiteline_codec.sync import archive
from kiteline_codec.sync.archive import Archive, Row
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_hw.logs.spill_file import SpillFile
from tests.entries import entries_of

TICK_NS = 50_000_000
KEYFRAMES = 10  # of a map
LIVES = 16


@pytest.mark.parametrize("base_restarts", [False, True])
def test_maps_that_come_are_corrected_and_deleted_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, base_restarts: bool
) -> None:
    monkeypatch.setattr(archive, "_MOST_WRITTEN", 12)
    draw, spill, now_ns = random.Random(1), SpillFile(tmp_path), 0
    agent = Endpoint(SyncConfig(resident_bytes=8_000, resident_inbox_bytes=4_000), 1, spill=spill)
    base = Endpoint(SyncConfig(resident_inbox_bytes=8_000), 1)
    base.received.earlier.is_gone = lambda key: key.id < gone_below
    gone_below = 0
    held, disk = list[Counter[str]](), list[int]()

    def put(end: Endpoint, kind: int, keyframe: int) -> None:
        end.put(Key(kind, keyframe), draw.randbytes(draw.randrange(50, 300)))

    for life in range(LIVES):
        keyframes = range(KEYFRAMES * life, KEYFRAMES * (life + 1))
        ticks = 0
        for keyframe in keyframes:
            for kind in (KeyframeHeader.KIND, Observations.KIND):
                put(agent, kind, keyframe)
            for other in draw.sample(range(keyframes[0], keyframe + 1), min(4, keyframe + 1 - keyframes[0])):
                for kind in (KeyframePose.KIND, RefinedLandmarks.KIND, FusedLandmarks.KIND):
                    put(base, kind, other)
            now_ns = exchange(agent, base, now_ns)
        if base_restarts and life % 3 == 2:
            own = base.own_values()
            base = Endpoint(SyncConfig(resident_inbox_bytes=8_000), base.session + 1)
            for key, code in own.items():
                base.put(key, code)
        while not (agent.digest_equal and base.digest_equal):
            now_ns, ticks = exchange(agent, base, now_ns), ticks + 1
            assert ticks < 2000
        assert agent.stats.archived or base_restarts
        for end in (agent, base):
            for key in end.own_values():
                end.remove(key)
        gone_below = keyframes[-1] + 1
        while not (agent.digest_equal and base.digest_equal):
            now_ns, ticks = exchange(agent, base, now_ns), ticks + 1
            assert ticks < 2000
        held.append(entries_of((agent, base)))
        disk.append(spill._size)
    assert agent.peer_values() == base.peer_values() == {}
    early, late = ([max(one[name] for one in part) for name in held[-1]] for part in (held[4:10], held[10:]))
    assert {name for name, before, after in zip(held[-1], early, late) if after > 1.3 * before + 10} == set()
    assert max(disk[10:]) <= 1.1 * max(disk[4:10])


def test_pages_that_come_and_go_behind_an_older_one_leave_nothing(tmp_path: Path) -> None:
    pages = Archive(SpillFile(tmp_path))

    def put(id_: int, version: int) -> None:
        pages.put(id_, [Row(KeyframeHeader.KIND, 0, version, False, False, False, 1, b"a")], 0)

    put(1, 1)  # waits all the time
    for n in range(1000):
        put(2, 2 + n)
        pages.take(2)
        assert pages.newest_unacknowledged() == 1
        assert pages.oldest_unacknowledged() == (1, 1)
    assert sum(entries_of((pages,)).values()) < 400


def exchange(a: Endpoint, b: Endpoint, now_ns: int) -> int:
    """Exchange what may be sent now. Returns the time of the next exchange."""
    for end, other in ((a, b), (b, a)):
        while (packet := end.poll(now_ns)) is not None:
            other.receive(packet, now_ns)
    return now_ns + TICK_NS
