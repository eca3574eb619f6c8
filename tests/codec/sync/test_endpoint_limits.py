"""Endpoints in bounded memory and time, whatever arrives."""

import time
import zlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.schema import Key, KeyframePose, LivePose, NewLandmarks, WireError
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.packet import parse
from tests.codec.sync.endpoint_pair import MS, PLAIN, Pair, fill
from tests.yardstick import slowness


def test_memory_is_bounded_while_there_is_no_peer() -> None:
    a = Endpoint(PLAIN, 1)
    for i in range(5000):
        a.put(Key(LivePose.KIND, 1), i.to_bytes(4, "big"), (i % 7,))
        a.put(Key(KeyframePose.KIND, i), b"x")
        a.remove(Key(KeyframePose.KIND, i))
        a.poll(i * MS)
    out = a._out
    assert len(out) == 1
    assert max(len(out._queue), len(out.packets)) <= 70


def test_a_peer_that_sends_too_much_is_refused() -> None:
    pair = Pair()
    pair.ends[1] = Endpoint(replace(PLAIN, max_inbox_bytes=5000), 1)
    fill(pair.a, 1, 100, NewLandmarks.KIND)
    pair.run(3000)
    assert sum(map(len, pair.b.peer_values().values())) <= 5000
    assert dict(pair.b.stats.reasons)["no memory left for it"] > 0


@given(st.binary(max_size=200))
def test_any_bytes_are_harmless(packet: bytes) -> None:
    b = Endpoint(PLAIN, 1)
    assert b.receive(packet, 0) == []
    checked = packet + zlib.crc32(packet).to_bytes(4, "little")
    try:
        parse(checked, 1000)
    except WireError:
        assert b.receive(checked, 0) == []
        assert b.stats.rejected == 2


@given(st.integers(0, 1000), st.data())
def test_damaged_packets_with_a_good_checksum_are_harmless(seed: int, data: st.DataObject) -> None:
    pair = Pair()
    fill(pair.a, seed, 5, NewLandmarks.KIND, 2000)
    pair.run(60)
    body = bytearray(data.draw(st.sampled_from([p for _, p in pair.sent[0]]))[:-4])
    for _ in range(data.draw(st.integers(1, 3))):
        body[data.draw(st.integers(0, min(60, len(body) - 1)))] = data.draw(st.integers(0, 255))
    pair.b.receive(bytes(body) + zlib.crc32(body).to_bytes(4, "little"), pair.now_ns)
    while pair.b.poll(pair.now_ns) is not None:
        pass


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"packet_bytes": 100}, "packet_bytes"),
        ({"packet_bytes": 1 << 17}, "packet_bytes"),
        ({"budget_bytes": 100}, "too few"),
    ],
)
def test_impossible_configurations_are_refused(changes: dict[str, int], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        SyncConfig(**changes)  # type: ignore[arg-type]


def test_impossible_values_are_refused() -> None:
    a = Endpoint(PLAIN, 1)
    with pytest.raises(ValueError, match="does not fit"):
        a.put(Key(64, 0), b"")
    with pytest.raises(ValueError, match="expected at most"):
        a.put(Key(1, 0), bytes((1 << 20) + 1))
    with pytest.raises(ValueError, match="session"):
        Endpoint(PLAIN, 0)


def test_a_packet_takes_little_time() -> None:
    best = 1e9
    for _ in range(3):
        pair = Pair(delay_ms=(1, 1))
        fill(pair.a, 1, 1500, NewLandmarks.KIND, 100)
        start = time.process_time()
        pair.settle()
        best = min(best, (time.process_time() - start) / sum(map(len, pair.sent)))
    assert best < 1e-3 * slowness()  # typically 0.2 ms for both ends, twelve values a packet
