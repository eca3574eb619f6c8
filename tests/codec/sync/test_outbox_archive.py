"""A long outage of the link: memory stays bounded, and archived values arrive when the link is back."""

import random

import pytest

from kiteline_codec.schema import Key, KeyframeHeader, LivePose, NewLandmarks, Observations
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.packet import parse
from tests.codec.sync.spill_memory import Memory

TICK_NS = 50_000_000
LIMIT = 200_000
LIVE = Key(LivePose.KIND, 0)


class Line:
    """Agent (a) and base (b), and whether they hear each other."""

    def __init__(self, spill: Memory | None, budget_bytes: int | None = None) -> None:
        config = SyncConfig(resident_bytes=LIMIT, budget_bytes=budget_bytes)
        self.a, self.b = Endpoint(config, 1, spill=spill), Endpoint(SyncConfig(), 1)
        self.draw = random.Random(1)
        self.now_ns = 0
        self.keyframes = 0
        self.most = 0

    def run(self, ticks: int, up: bool, flying: bool = True) -> list[bytes]:
        sent = []
        for tick in range(ticks):
            self.now_ns += TICK_NS
            if flying:
                self.a.put(LIVE, self.draw.randbytes(29))
                if tick % 4 == 0:
                    self.keyframe()
            self.most = max(self.most, self.a.stats.resident_bytes)
            for end, other in ((self.a, self.b), (self.b, self.a)):
                while (packet := end.poll(self.now_ns)) is not None:
                    if end is self.a:
                        sent.append(packet)
                    if up:
                        other.receive(packet, self.now_ns)
            if not flying and self.a.digest_equal and self.b.digest_equal:
                break
        return sent

    def keyframe(self) -> None:
        k, self.keyframes = self.keyframes, self.keyframes + 1
        self.a.put(Key(KeyframeHeader.KIND, k), self.draw.randbytes(26))
        for part in range(7):
            self.a.put(Key(NewLandmarks.KIND, k, part), self.draw.randbytes(300))
        self.a.put(Key(Observations.KIND, k), self.draw.randbytes(150))


def test_what_was_written_while_the_link_was_down_arrives() -> None:
    line = Line(Memory())
    line.run(200, up=True)
    before = line.b.peer_values()[LIVE]
    line.run(1600, up=False)
    assert line.a.stats.archived > 2500
    line.now_ns += 2 * 10**9
    first = line.run(1, up=True, flying=False)[0]
    assert parse(first, 1 << 20)[1][0].key.kind == LivePose.KIND  # the pose leaves before anything else
    line.run(400, up=True, flying=False)
    assert line.a.digest_equal
    assert line.b.peer_values()[LIVE] != before
    assert len(line.b.peer_values()) == 9 * line.keyframes + 1
    assert line.b.peer_values() == line.a.own_values()
    assert line.b.stats.mismatches == line.a.stats.dropped == 0
    assert line.most <= LIMIT + 500_000  # what is on its way comes on top: 64 packets of 4 values


def test_memory_stays_bounded_while_all_arrives() -> None:
    line = Line(Memory())
    line.run(1600, up=True)
    assert line.most <= 2 * LIMIT  # 400 pages of 450 bytes among it
    assert line.a.stats.archived > 2500
    line.run(100, up=True, flying=False)
    assert line.b.peer_values() == line.a.own_values()
    line.b = Endpoint(SyncConfig(), 2)  # a base that lost everything
    line.run(800, up=True, flying=False)
    assert line.a.digest_equal
    assert line.b.peer_values() == line.a.own_values()


def test_on_a_thin_link_old_values_do_not_starve() -> None:
    line = Line(Memory(), budget_bytes=20_000)
    line.run(100, up=True)
    line.run(800, up=False)
    for _ in range(4):
        line.run(100, up=True)
    missing = line.a.own_values().keys() - line.b.peer_values().keys()
    assert min(k.id for k in missing if k.kind == KeyframeHeader.KIND) > 32  # 25 came before the gap
    line.run(4000, up=True, flying=False)
    assert line.b.peer_values() == line.a.own_values()


def test_without_a_spill_old_values_are_dropped_by_priority() -> None:
    line = Line(None)
    line.run(80, up=True)
    line.run(400, up=False)
    assert line.most <= 1.2 * LIMIT
    assert line.a.stats.dropped > 500
    line.run(400, up=True, flying=False)
    assert line.a.digest_equal
    assert line.b.stats.mismatches == 0
    held = line.b.peer_values()
    late = range(line.keyframes - 5, line.keyframes)
    assert all(Key(KeyframeHeader.KIND, k) in held for k in late)
    whole = [k for k in range(line.keyframes) if Key(NewLandmarks.KIND, k, 6) in held]
    assert whole[-1] == line.keyframes - 1
    described = sum(Key(NewLandmarks.KIND, k, 0) in held for k in range(line.keyframes))
    assert described > len(whole)
    assert len([k for k in held if k.kind == KeyframeHeader.KIND]) > described


def test_a_base_that_begins_anew_gets_what_is_left() -> None:
    line = Line(None)
    line.run(800, up=True)
    assert line.a.stats.dropped == 0
    assert line.a.stats.archived > 0
    line.b = Endpoint(SyncConfig(), 2)
    line.run(400, up=True, flying=False)
    assert line.a.digest_equal
    assert line.a.stats.dropped > 0
    assert line.b.peer_values() == line.a.own_values()
    line.a.put(Key(KeyframeHeader.KIND, 0), b"anew")
    line.run(100, up=True, flying=False)
    assert line.b.peer_values()[Key(KeyframeHeader.KIND, 0)] == b"anew"


@pytest.mark.parametrize("spill", [Memory(forgets=5), Memory(room=100_000), Memory(room=0)])
def test_a_disk_that_fails_costs_values_but_no_agreement(spill: Memory) -> None:
    line = Line(spill)
    line.run(200, up=True)
    line.run(800, up=False)
    for _ in range(3):
        line.run(100, up=True)
        line.run(100, up=False)
    line.run(800, up=True, flying=False)
    assert line.a.digest_equal
    assert line.b.stats.mismatches == 0
    assert line.a.stats.dropped > 0
    assert len(line.b.peer_values()) > 300
