"""Endpoints that start again: what the other end keeps, and what it asks for."""

import zlib

from kiteline_codec.schema import Key, KeyframePose, NewLandmarks
from kiteline_codec.sync.endpoint import Endpoint
from tests.codec.sync.endpoint_pair import PLAIN, Pair, fill


def test_a_base_that_starts_again_gets_everything_again() -> None:
    pair = Pair(loss=0.2)
    ours = fill(pair.a, 1, 30, NewLandmarks.KIND)
    theirs = fill(pair.b, 2, 30, KeyframePose.KIND, 20)
    pair.settle()
    pair.restart(1)
    pair.run(1000)
    pair.b.put(Key(KeyframePose.KIND, 1000), b"new")
    pair.settle()
    assert pair.b.peer_values() == ours
    assert pair.a.stats.restarts == 1
    assert pair.a.peer_values() == {Key(KeyframePose.KIND, 1000): b"new"}
    assert pair.a.earlier_values() == {k: v for k, v in theirs.items() if k.id != 1000}


def test_an_agent_that_starts_again_leaves_its_old_values_readable() -> None:
    pair = Pair(loss=0.2)
    old = fill(pair.a, 1, 30, NewLandmarks.KIND)
    pair.settle()
    pair.restart(0)
    pair.a.put(Key(NewLandmarks.KIND, 5), b"new")
    pair.settle()
    assert pair.b.peer_values() == {Key(NewLandmarks.KIND, 5): b"new"}
    assert pair.b.earlier_values() == old
    assert pair.b.peer_session == 2


def test_packets_of_dead_sessions_change_nothing() -> None:
    pair = Pair()
    fill(pair.a, 1, 10, NewLandmarks.KIND)
    pair.settle()
    old = [packet for _, packet in pair.sent[0]]
    pair.restart(0)
    pair.settle()
    for packet in old:
        assert pair.b.receive(packet, pair.now_ns) == []
    pair.restart(1)
    current = [packet for _, packet in pair.sent[0] if packet not in old]
    for packet in current:  # for the forerunner of b
        assert pair.b.receive(packet, pair.now_ns) == []
    reasons = dict(pair.b.stats.reasons)
    assert reasons["for an earlier session of this side"] > 0
    pair.settle()
    assert pair.b.peer_values() == {}


def test_a_session_number_that_went_back_is_overtaken() -> None:
    for side in (0, 1):
        pair = Pair()
        fill(pair.a, 1, 10, NewLandmarks.KIND)
        for _ in range(70):
            pair.restart(side)
        pair.settle()
        known = pair.ends[side].session
        pair.ends[side] = Endpoint(PLAIN, 5)  # its state was lost
        fill(pair.ends[side], 2, 10, NewLandmarks.KIND)
        pair.settle()
        assert pair.ends[side].session > known and pair.ends[side].session % 64 == 5
        assert pair.ends[1 - side].peer_values() == pair.ends[side].own_values() != {}


def test_two_ends_with_one_number_do_not_overtake_each_other_for_ever() -> None:
    pair = Pair()
    twin, raised = Endpoint(PLAIN, 7), set()
    for _ in range(400):
        pair.step()
        while (packet := twin.poll(pair.now_ns)) is not None:
            pair.b.receive(packet, pair.now_ns)
        for _, packet in pair.sent[1]:
            twin.receive(packet, pair.now_ns)
        pair.sent[1].clear()
        raised |= {pair.a.session, twin.session}
    assert 2 < len(raised) <= 8
    reasons = {reason for end in (pair.a, twin) for reason, _ in end.stats.reasons}
    assert any("does another one run with its number?" in reason for reason in reasons)


def test_another_protocol_version_is_refused_by_name() -> None:
    a, b = Endpoint(PLAIN, 1), Endpoint(PLAIN, 1)
    packet = a.poll(0)
    other = bytes([9]) + packet[1:-4]
    assert b.receive(other + zlib.crc32(other).to_bytes(4, "little"), 0) == []
    assert b.stats.reasons == (("the other side speaks protocol version 9, this one 7", 1),)
    assert b.receive(packet[:-1] + b"?", 0) == []
    assert b.stats.rejected == 2
    assert b.peer_session is None
