"""Two endpoints over a bad link: what each property of the endpoint promises."""

import random
from collections import deque
from dataclasses import replace

import pytest

from kiteline_codec.schema import (
    GridTile,
    Key,
    KeyframeHeader,
    KeyframePose,
    KeyframeScan,
    LivePose,
    NewLandmarks,
    Observations,
    RefinedLandmarks,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.digest import hash_value
from kiteline_codec.transport.packet import parse
from tests.codec.sync.endpoint_pair import MS, PLAIN, Pair, fill


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("packet_bytes", [128, 1200, 65536])
def test_both_sides_agree_whatever_the_link_does(loss: float, packet_bytes: int) -> None:
    pair = Pair(replace(PLAIN, packet_bytes=packet_bytes), loss, (1, 90))
    ours = fill(pair.a, 1, 40, NewLandmarks.KIND, 3000)
    theirs = fill(pair.b, 2, 60, KeyframePose.KIND, 20)
    pair.run(200)
    for key in list(ours)[::3]:
        pair.a.remove(key)
        del ours[key]
    ours |= fill(pair.a, 3, 10, NewLandmarks.KIND)
    pair.settle()
    assert pair.b.peer_values() == ours
    assert pair.a.peer_values() == theirs
    assert pair.a.stats.mismatches == pair.b.stats.mismatches == 0
    if loss and packet_bytes < 65536:
        assert pair.a.stats.lost > 0
    elif not loss:
        assert pair.a.stats.rejected == pair.b.stats.rejected == 0
    seen: dict[Key, bytes] = {}
    for key, code in pair.updates[1]:
        seen.pop(key, None)
        if code is not None:
            seen[key] = code
    assert seen == ours  # the updates alone tell the state


def test_without_loss_little_is_sent_twice() -> None:
    pair = Pair(delay_ms=(5, 30))
    total = sum(map(len, fill(pair.a, 1, 300, NewLandmarks.KIND).values()))
    pair.settle()
    assert pair.a.stats.bytes_sent < 1.2 * total


def test_the_newest_version_is_what_is_sent() -> None:
    pair = Pair()
    pair.run(50)
    for i in range(100):
        pair.a.put(Key(LivePose.KIND, 1), bytes([i]) * 30)
    pair.settle()
    assert pair.updates[1] == [(Key(LivePose.KIND, 1), bytes([99]) * 30)]


def test_the_same_code_again_costs_nothing() -> None:
    pair = Pair()
    pair.a.put(Key(KeyframePose.KIND, 1), b"x")
    pair.settle()
    before = pair.a.stats.bytes_sent
    pair.a.put(Key(KeyframePose.KIND, 1), b"x")
    assert pair.a.digest_equal
    assert pair.a.poll(pair.now_ns) is None
    assert pair.a.stats.bytes_sent == before


def test_digests_of_a_value_that_changes_all_the_time_are_few() -> None:
    pair = Pair()
    pair.run(100)
    for i in range(50):
        pair.a.put(Key(LivePose.KIND, 1), bytes([i]) * 30)
        pair.run(100)
    digests = [at_ns for at_ns, packet in pair.sent[0] if parse(packet, 1 << 20)[0].digest is not None]
    assert 4 <= len(digests) <= 6  # one a second
    pair.settle(1200)


@pytest.mark.parametrize(
    ("size", "pose_after_ms", "left_after_ms"),
    [(100, 50, 50), (100, 500, 90), (700, 50, 0)],
    ids=["goes with the pose", "does not wait for long", "fills a packet"],
)
def test_a_scan_waits_for_a_packet_that_leaves_anyway(size: int, pose_after_ms: int, left_after_ms: int) -> None:
    pair = Pair(replace(PLAIN, heartbeat_ns=10**11))
    pair.a.put(Key(LivePose.KIND, 1), b"a pose")
    pair.settle()
    pair.run(2000)
    pair.a.put(Key(LivePose.KIND, 1), b"another one")
    pair.step()
    put_ns = pair.now_ns
    pair.run(20)
    pair.a.put(Key(KeyframeScan.KIND, 7), b"s" * size)
    for _ in range(20):
        if pair.now_ns - put_ns == pose_after_ms * MS - 10 * MS:
            pair.a.put(Key(LivePose.KIND, 1), b"a third one")
        pair.step()
    left = [
        at_ns
        for at_ns, packet in pair.sent[0]
        if any(i.key.kind == KeyframeScan.KIND for i in parse(packet, 1 << 20)[1])
    ]
    assert len(left) == 1
    assert abs(left[0] - put_ns - max(left_after_ms, 30) * MS) <= 10 * MS


def test_order_of_sending() -> None:
    pair = Pair()
    pair.run(50)
    for kind, id_, part in (
        (GridTile.KIND, 9, 0), (NewLandmarks.KIND, 1, 1), (NewLandmarks.KIND, 1, 0), (NewLandmarks.KIND, 2, 0),
        (Observations.KIND, 2, 0), (KeyframeHeader.KIND, 1, 0), (KeyframePose.KIND, 1, 0), (LivePose.KIND, 0, 0),
    ):  # fmt: skip
        pair.a.put(Key(kind, id_, part), b"x" * 100)
    pair.settle()
    got = [(key.kind, key.id, key.part) for key, _ in pair.updates[1]]
    assert got == [
        (LivePose.KIND, 0, 0), (KeyframePose.KIND, 1, 0), (KeyframeHeader.KIND, 1, 0),
        (NewLandmarks.KIND, 2, 0), (NewLandmarks.KIND, 1, 0), (NewLandmarks.KIND, 1, 1),
        (Observations.KIND, 2, 0), (GridTile.KIND, 9, 0),
    ]  # fmt: skip


def test_nothing_starves() -> None:
    pair = Pair(replace(PLAIN, budget_bytes=4000))
    pair.a.put(Key(GridTile.KIND, 1), b"t" * 100)
    pair.run(100)
    for i in range(1500):
        for part in range(3):
            pair.a.put(Key(NewLandmarks.KIND, i, part), b"b" * 300)
        pair.step()
    assert Key(GridTile.KIND, 1) in pair.b.peer_values()
    assert Key(NewLandmarks.KIND, 0, 2) in pair.b.peer_values()


@pytest.mark.parametrize(("budget", "overhead"), [(500, 28), (1000, 28), (8000, 17), (300, 0)])
def test_the_budget_holds_in_every_window(budget: int, overhead: int) -> None:
    pair = Pair(SyncConfig(budget_bytes=budget, overhead_bytes=overhead), 0.2, (1, 300))
    for i in range(1500):
        if i % 7 == 0:
            pair.a.put(Key(LivePose.KIND, 1), i.to_bytes(40, "big"))
            pair.a.put(Key(NewLandmarks.KIND, i), random.Random(i).randbytes(700))
        pair.step()
    window: deque[tuple[int, int]] = deque()
    total = used = 0
    for at, packet in pair.sent[0]:
        window.append((at, len(packet) + overhead))
        total += window[-1][1]
        while at - window[0][0] > 1_000_000_000:
            total -= window.popleft()[1]
        assert total <= budget
        used += len(packet) + overhead
    assert used == pair.a.stats.bytes_sent
    assert used > 0.7 * 15 * budget  # a full link is used


def test_a_thin_link_carries_the_live_pose_first() -> None:
    pair = Pair(SyncConfig(budget_bytes=1000), delay_ms=(20, 40))
    pair.run(500)
    ages = []
    for i in range(600):
        pair.a.put(Key(NewLandmarks.KIND, i // 20, i % 8), random.Random(i).randbytes(900))
        pair.a.put(Key(LivePose.KIND, 1), i.to_bytes(40, "big"))
        pair.step()
        live = pair.b.peer_values().get(Key(LivePose.KIND, 1))
        if live is not None:
            ages.append(i - int.from_bytes(live, "big"))
    assert sum(ages) / len(ages) * 10 < 400  # ms


def test_long_values_cross_in_fragments() -> None:
    pair = Pair(replace(PLAIN, packet_bytes=128, budget_bytes=20_000), 0.1)
    long = random.Random(0).randbytes(20_000)
    pair.a.put(Key(GridTile.KIND, 1), long)
    pair.run(300)
    assert pair.b.peer_values() == {}
    assert not pair.b.quiet
    long = long[::-1]
    pair.a.put(Key(GridTile.KIND, 1), long)
    pair.settle()
    assert pair.b.peer_values() == {Key(GridTile.KIND, 1): long}
    assert pair.updates[1] == [(Key(GridTile.KIND, 1), long)]
    assert pair.b.received.present.assembly_bytes == 0


def test_removals_are_forgotten_once_they_have_arrived_and_old_packets_do_not_undo_them() -> None:
    pair = Pair()
    keys = list(fill(pair.a, 1, 30, KeyframePose.KIND, 40))
    pair.settle()
    for key in keys:
        pair.a.remove(key)
    pair.settle()
    assert pair.b.peer_values() == {}
    assert not pair.b.received.present._removed
    assert len(pair.a._out) == 0
    for _, packet in pair.sent[0]:
        pair.b.receive(packet, pair.now_ns)
    assert pair.b.peer_values() == {}
    assert pair.b.stats.duplicates > 0


def test_a_value_that_was_never_sent_is_removed_silently() -> None:
    pair = Pair()
    pair.a.put(Key(KeyframePose.KIND, 1), b"x")
    pair.a.remove(Key(KeyframePose.KIND, 1))
    pair.a.remove(Key(KeyframePose.KIND, 2))
    pair.settle()
    assert pair.updates[1] == []


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_states_that_differ_are_found_and_mended(end: int, loss: float) -> None:
    pair = Pair(loss=loss)
    values = [fill(pair.a, 1, 20, NewLandmarks.KIND), fill(pair.b, 2, 20, KeyframePose.KIND, 30)]
    pair.settle()
    inbox = pair.ends[end].received.present
    first = min(inbox._values)
    inbox._drop_value(first)  # as if memory had been damaged
    inbox._values[Key(60, 1)] = (3, b"never sent")
    pair.ends[1 - end].put(Key(LivePose.KIND, 2), b"anything new makes them compare")
    values[1 - end][Key(LivePose.KIND, 2)] = b"anything new makes them compare"
    inbox.digest.add(hash_value(Key(60, 1), 3, b"never sent"))
    pair.settle()
    assert pair.ends[end].stats.mismatches >= 1
    assert pair.ends[end].peer_values() == values[1 - end]
    assert pair.ends[1 - end].peer_values() == values[end]


def test_an_idle_link_carries_only_heartbeats() -> None:
    pair = Pair(SyncConfig())
    fill(pair.a, 1, 5, KeyframePose.KIND, 20)
    pair.settle()
    pair.run(500)
    before, sent = pair.a.stats.bytes_sent, len(pair.sent[0])
    pair.run(10_000)
    assert 9 <= len(pair.sent[0]) - sent <= 11
    assert pair.a.stats.bytes_sent - before < 11 * 50


def test_a_silent_peer_costs_little_and_is_found_again() -> None:
    pair = Pair()
    pair.settle()
    pair.loss = 1.0
    fill(pair.a, 1, 200, NewLandmarks.KIND)
    pair.run(10_000)
    sent = len(pair.sent[0])
    pair.run(10_000)
    assert len(pair.sent[0]) - sent < 25
    assert pair.a.stats.in_flight <= 1
    pair.loss = 0.0
    pair.settle(5000)


def test_a_lost_packet_that_nothing_follows_is_sent_again_once_before_the_time_out() -> None:
    pair = Pair(delay_ms=(100, 400))
    for i in range(30):
        pair.a.put(Key(KeyframePose.KIND, i), b"%d" % i)
        pair.run(500)
    pair.settle()
    timeout_ns = pair.a._round_trip.timeout_ns
    pair.a.put(Key(KeyframePose.KIND, 99), b"the last")
    pair.loss = 1.0
    pair.step()
    before = len(pair.sent[0])
    pair.run(timeout_ns // MS - 20)
    again = [sent_ns for sent_ns, packet in pair.sent[0][before:] if parse(packet, 1 << 20)[1]]
    assert len(again) == 1
    pair.loss = 0.0
    pair.settle()


def test_several_last_packets_are_sent_again_no_more_often_than_time_outs_allow() -> None:
    pair = Pair(delay_ms=(5, 8))
    for i in range(10):
        pair.a.put(Key(KeyframePose.KIND, i), b"%d" % i)
        pair.run(200)
    pair.settle()
    for i in range(8):
        pair.a.put(Key(KeyframePose.KIND, 99 + i), bytes(800))
    pair.loss = 1.0
    before = len(pair.sent[0])
    pair.run(2000)
    again = [packet for _, packet in pair.sent[0][before:] if parse(packet, 1 << 20)[1]]
    assert len(again) < 40
    pair.loss = 0.0
    pair.settle()


def test_the_same_inputs_give_the_same_packets() -> None:
    runs = []
    for _ in range(2):
        pair = Pair(loss=0.3, delay_ms=(1, 50))
        fill(pair.a, 1, 50, NewLandmarks.KIND)
        fill(pair.b, 2, 50, RefinedLandmarks.KIND)
        pair.settle()
        runs.append(pair.sent)
    assert runs[0] == runs[1]
