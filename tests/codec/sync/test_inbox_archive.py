"""The base's values of keyframes over hours: beyond a limit they are archived, and none is lost."""

import random

from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    Key,
    KeyframePose,
    RefinedLandmarks,
    RemovedObservations,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from tests.codec.sync.spill_memory import Memory

TICK_NS = 50_000_000
LIMIT = 100_000
KINDS = (KeyframePose.KIND, RefinedLandmarks.KIND, FusedLandmarks.KIND, RemovedObservations.KIND, CulledLandmarks.KIND)


class Line:
    """Base (a) and agent (b)."""

    def __init__(self, spill: Memory | None) -> None:
        self.spill = spill
        self.a, self.b = Endpoint(SyncConfig(), 1), self.agent(1)
        self.draw = random.Random(1)
        self.now_ns = 0

    def agent(self, session: int) -> Endpoint:
        return Endpoint(SyncConfig(resident_inbox_bytes=LIMIT), session, spill=self.spill)

    def say(self, keyframe: int) -> None:
        for kind in KINDS:
            self.a.put(Key(int(kind), keyframe), self.draw.randbytes(self.draw.randrange(400)))
        self.settle()

    def settle(self, ticks: int = 400) -> None:
        for _ in range(ticks):
            self.now_ns += TICK_NS
            for end, other in ((self.a, self.b), (self.b, self.a)):
                while (packet := end.poll(self.now_ns)) is not None:
                    other.receive(packet, self.now_ns)
            if self.a.digest_equal and self.b.digest_equal:
                return
        raise AssertionError("the two ends do not agree")


def test_memory_is_bounded_and_the_two_sides_agree() -> None:
    line = Line(Memory())
    most = 0
    for keyframe in range(300):
        line.say(keyframe)
        most = max(most, line.b.received.present.resident_bytes)
    pages = 300 * (300 + 5 * 20)
    assert most <= LIMIT + pages
    assert line.b.stats.values == 1500
    line.say(3)  # an old one is corrected
    assert line.b.peer_value(Key(RefinedLandmarks.KIND, 3)) == line.a.own_value(Key(RefinedLandmarks.KIND, 3))
    line.a.remove(Key(FusedLandmarks.KIND, 7))
    line.settle()
    assert line.b.peer_values() == line.a.own_values()
    assert line.b.received.present.resident_bytes <= LIMIT + pages


def test_values_of_the_last_base_stay_readable() -> None:
    line = Line(Memory())
    for keyframe in range(100):
        line.say(keyframe)
    held = line.b.peer_values()
    line.a = Endpoint(SyncConfig(), 2)
    line.settle()
    assert line.b.earlier_values() == held


def test_a_full_disk_loses_nothing() -> None:
    line = Line(Memory(room=20_000))
    for keyframe in range(200):
        line.say(keyframe)
    assert line.b.peer_values() == line.a.own_values()
    assert line.b.stats.mismatches == line.a.stats.mismatches == 0


def test_what_a_disk_has_lost_is_sent_again() -> None:
    spill = Memory()
    line = Line(spill)
    for keyframe in range(200):
        line.say(keyframe)
    spill.forgets = 1  # every one
    line.say(3)
    spill.forgets = 0
    line.settle()
    assert line.b.peer_values() == line.a.own_values()


def test_without_a_spill_old_values_are_packed() -> None:
    line = Line(None)
    for keyframe in range(300):
        line.say(keyframe)
    packed = line.b.received.present
    assert len(packed._values) < 200 and len(packed) == 1500
    assert packed._resident.bytes <= LIMIT
    held = sum(len(page.packed or b"") for page in packed._archive._pages.values())
    assert held + sum(len(code) for _, code in packed._values.values()) == packed.value_bytes
    line.say(3)
    assert line.b.peer_value(Key(RefinedLandmarks.KIND, 3)) == line.a.own_value(Key(RefinedLandmarks.KIND, 3))
    line.a.remove(Key(FusedLandmarks.KIND, 7))
    line.settle()
    assert line.b.peer_values() == line.a.own_values()
    assert line.b.stats.mismatches == line.a.stats.mismatches == 0


def test_values_are_read_where_they_are_packed() -> None:
    """After a full bundle hundreds of corrections are predicted from old values: none of those moves for that."""
    line = Line(None)
    for keyframe in range(60):
        line.say(keyframe)
    inbox = line.b.received.present
    packed = list(inbox._archive)
    assert len(packed) > 20
    own = line.a.own_values()
    assert all(line.b.peer_value(key) == code for key, code in own.items())
    assert line.b.peer_value(Key(RefinedLandmarks.KIND, packed[0], 7)) is None
    assert list(inbox._archive) == packed
    line.say(packed[0])  # a new version of one that is packed
    assert line.b.peer_values() == line.a.own_values()
