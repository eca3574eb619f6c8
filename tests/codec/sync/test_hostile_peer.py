"""A peer with a sound key that means harm: memory stays bounded, and nothing but refusals comes of it."""

import struct
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from kiteline_codec.channel import UNUSED_BYTES, coded_channel
from kiteline_codec.coding.packing import Writer
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import (
    CameraIntrinsics,
    GravityAlignment,
    GridTile,
    Key,
    KeyframeHeader,
    LivePose,
    NewLandmarks,
    Record,
    SubmapScale,
    WireError,
    messages,
)
from kiteline_codec.sync import resumption
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport import packet as packets
from kiteline_codec.transport.packet import Header, Item, add_checksum, write_header, write_item
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from tests.codec.sync.endpoint_pair import PLAIN

CAMERA = RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.1, True, np.eye(4))


class Sender:
    """Writes any packets, with right numbers and checksums."""

    def __init__(self, session: int = 1) -> None:
        self.session = session
        self.number = self.version = 0

    def packet(self, items: Sequence[Item], watermark: int = 0) -> bytes:
        self.number += 1
        data, last_id = Writer(), 0
        write_header(data, Header(self.session, 1, values=(self.number, watermark)))
        for item in items:
            write_item(data, item, last_id, watermark)
            last_id = item.key.id
        return add_checksum(data)

    def item(self, key: Key, total: int | None, offset: int, data: bytes, version: int = 0) -> Item:
        self.version = version or self.version + 1
        return Item(key, self.version, total, offset, data)

    def whole(self, key: Key, data: bytes) -> Item:
        return self.item(key, len(data), 0, data)

    def record(self, record: Record) -> Item:
        return self.whole(messages.key(record), messages.encode(record))


def header_of(agent: int, sequence: int, keypoints: int = 300) -> KeyframeHeader:
    keyframe = keyframe_id(submap_id(agent, 0, 0), sequence)
    return KeyframeHeader(keyframe, 1, NO_KEYFRAME, np.eye(4), keypoints)


@pytest.mark.parametrize("version", [1 << 63, (1 << 64) - 2, 1 << 64])
def test_versions_beyond_63_bits_are_refused_with_a_residual_code_too(version: int) -> None:
    """They did not fit the checksum of a residual code: struct.error ended the base."""
    sender, end = Sender(), Endpoint(PLAIN, 1, coder=ResidualCoder())
    watermark = min(version - 1, (1 << 63) - 1)
    key = Key(NewLandmarks.KIND, 1)
    item = Item(key, version, 3, 0, b"abc")
    assert end.receive(sender.packet([item], watermark), 0) == []
    residual = Item(Key(5, 1), version + 1, 40, 0, bytes(range(40)), residual=True)
    assert end.receive(sender.packet([item, residual], watermark), 0) == []
    assert end.stats.rejected == 2 and end.stats.values == 0


def test_faults_of_python_become_the_rooms_error(monkeypatch: pytest.MonkeyPatch) -> None:
    coder, key = ResidualCoder(), Key(NewLandmarks.KIND, 1)
    for fault in (RecursionError(), OverflowError("too large"), MemoryError(), struct.error("format")):

        def fail(*_: object, fault: Exception = fault) -> None:
            raise fault

        monkeypatch.setattr(coder._coders[key.kind], "expand", fail)
        with pytest.raises(WireError):
            coder.expand(key, b"x", lambda k: None)
        monkeypatch.setattr(LivePose, "read", fail)
        with pytest.raises(WireError):
            messages.decode(Key(LivePose.KIND, 1), b"x")


def test_a_packet_longer_than_any_is_refused() -> None:
    end, sender = Endpoint(PLAIN, 1), Sender()
    long = sender.packet([sender.whole(Key(GridTile.KIND, i), bytes(900)) for i in range(100)])
    assert len(long) > packets.MAX_PACKET_BYTES
    assert end.receive(long, 0) == [] and end.stats.values == 0


def memory_of(end: Endpoint) -> int:
    got = end.received
    return got.present.held_bytes + got.present.assembly_bytes + got.earlier.bytes + got.claims.bytes


def test_values_in_part_stay_within_their_limit_however_they_are_begun() -> None:
    """Many in one packet under one key, newer versions of one, and heads of two bytes counted as nothing before."""
    config = replace(PLAIN, max_assembly_bytes=3 << 20)
    end, sender, key = Endpoint(config, 1), Sender(), Key(GridTile.KIND, 1)
    mib = 1 << 20
    for _ in range(600):
        end.receive(sender.packet([sender.item(key, mib, 0, b"x")]), 0)  # a newer version
    assert end.received.present.assembly_bytes <= config.max_assembly_bytes
    for i in range(100):
        begun = [sender.item(Key(GridTile.KIND, 2 + 100 * i + j), mib, 0, b"x") for j in range(20)]
        end.receive(sender.packet(begun), 0)
    assert sum(len(a.data) for a in end.received.present._assemblies.values()) <= config.max_assembly_bytes
    for i in range(500):
        heads = [sender.item(Key(GridTile.KIND, 50_000 + 50 * i + j), 2, 0, b"x") for j in range(50)]
        end.receive(sender.packet(heads), 0)
    assert end.received.present.assembling <= config.max_assembly_bytes // 350
    assert dict(end.stats.reasons)["no memory left for it"] > 0


def test_a_value_in_a_thousand_pieces_is_dropped_before_it_costs_time() -> None:
    end, sender, key = Endpoint(PLAIN, 1), Sender(), Key(GridTile.KIND, 1)
    for i in range(20):
        end.receive(
            sender.packet([Item(key, 1, 1 << 20, 2 * (50 * i + j), b"x") for j in range(50)]), 0
        )  # every other byte
    pieces = [len(a.received) for a in end.received.present._assemblies.values()]
    assert all(n <= 256 for n in pieces)


def test_small_values_and_removals_count_with_what_they_take() -> None:
    config = replace(PLAIN, max_inbox_bytes=1 << 20)
    end, sender = Endpoint(config, 1), Sender()
    for i in range(200):
        end.receive(sender.packet([sender.whole(Key(GridTile.KIND, 60 * i + j), b"x") for j in range(60)]), 0)
    assert len(end.received.present) <= (1 << 20) // 350
    end = Endpoint(config, 1)
    sender = Sender()
    for i in range(200):
        end.receive(sender.packet([sender.item(Key(GridTile.KIND, 60 * i + j), None, 0, b"") for j in range(60)]), 0)
    assert len(end.received.present._removed) <= (1 << 20) // 350


def test_values_of_earlier_sessions_count() -> None:
    config = replace(PLAIN, max_inbox_bytes=1 << 20)
    end = Endpoint(config, 1)
    for session in range(1, 40):
        sender = Sender(session)
        for i in range(10):
            key = Key(GridTile.KIND, 1000 * session + i)
            end.receive(sender.packet([sender.whole(key, bytes(10_000))]), 0)
    assert sum(map(len, end.earlier_values().values())) <= 1 << 20
    assert memory_of(end) <= 2 << 20


def test_headers_claim_the_map_that_they_name() -> None:
    """A header of twenty bytes reserves 2048 keypoints of the base's map; removing it gives none back."""
    channel = coded_channel(1, peer=AgentId(3))
    object.__setattr__(channel.endpoint, "config", replace(channel.endpoint.config, max_inbox_bytes=16 << 20))
    sender, keypoints = Sender(), 0
    for i in range(400):
        header = header_of(3, i, 2048)
        received = channel.receive([sender.packet([sender.record(header)])], 0)
        keypoints += sum(r.keypoints for r in received if isinstance(r, KeyframeHeader))
        channel.receive([sender.packet([sender.item(messages.key(header), None, 0, b"")])], 0)
    assert 0 < keypoints * 86 <= 16 << 20


def test_headers_that_do_not_fit_wait_and_are_used_oldest_first() -> None:
    """They come newest first; each hangs on the one before, and what was of use makes room for more."""
    channel, sender, used = coded_channel(1, peer=AgentId(3)), Sender(), []
    claims = channel.endpoint.received.claims
    claims.is_of_use = lambda key, code, also: key.id - 1 in {0, *used} or any(k.id == key.id - 1 for k in also)

    def take(items: list[Item], now_ns: int) -> list[int]:
        return [r.keyframe for r in channel.receive([sender.packet(items)], now_ns) if isinstance(r, KeyframeHeader)]

    first = keyframe_id(submap_id(3, 0, 0), 0)
    headers = [header_of(3, i, 2000) for i in range(300)]  # 240 kB each of 32 MiB
    at_once = [k for h in reversed(headers) for k in take([sender.record(h)], 0)]
    assert at_once == [h.keyframe for h in headers[:-80:-1]][: len(at_once)] and 50 < len(at_once) < 79
    used = [first - 1]  # what the oldest one hangs on
    tile = Key(GridTile.KIND, 1)
    in_time = take([sender.whole(tile, b"x")], 10**9)
    assert in_time == [h.keyframe for h in headers[: len(in_time)]] and 20 < len(in_time) < 50
    used += in_time
    assert take([sender.whole(tile, b"y")], 2 * 10**9) == []
    changed = replace(headers[150], T_p_k=np.diag([1.0, -1.0, -1.0, 1.0]))
    assert take([sender.record(changed)], 2 * 10**9) == []  # a newer version waits as well
    claims.earned += 100 << 20
    rest = take([sender.whole(tile, b"z")], 3 * 10**9)
    assert sorted(at_once + in_time + rest) == [h.keyframe for h in headers]
    assert rest == sorted(rest)


def test_an_agent_fills_no_more_than_its_first_share_until_something_was_of_use() -> None:
    """With the limits of every base: before, 2 GiB were taken from who had a key."""
    channel, sender = coded_channel(1, peer=AgentId(3)), Sender()

    def fill(first: int) -> int:
        for i in range(first, first + 1000):
            section = Key(NewLandmarks.KIND, keyframe_id(submap_id(3, 0, 0), i))
            channel.receive([sender.packet([sender.whole(section, bytes(60_000))])], 0)
            channel.receive([sender.packet([sender.record(header_of(3, i, 2048))])], 0)
        return memory_of(channel.endpoint)

    assert 0.9 * UNUSED_BYTES < fill(0) <= UNUSED_BYTES + (1 << 20)
    channel.endpoint.received.claims.earned += 8 << 20
    assert 0.9 * (UNUSED_BYTES + (8 << 20)) < fill(2000) <= UNUSED_BYTES + (9 << 20)
    channel.endpoint.received.claims.earned += 1 << 40
    assert channel.endpoint.received.claims.allowed_bytes(channel.endpoint.config) == 2 << 30


def test_what_a_store_holds_leaves_the_first_share_free() -> None:
    channel, sender = coded_channel(1, peer=AgentId(3)), Sender()
    held = {Key(NewLandmarks.KIND, keyframe_id(submap_id(3, 0, 0), i)): bytes(100_000) for i in range(500)}
    channel.endpoint.resume(held)
    new = header_of(3, 600)
    assert channel.receive([sender.packet([sender.record(new)])], 0)


def test_lists_of_held_values_are_bounded() -> None:
    out = Writer()
    for i in range(61):
        out.signed(1)
        out.u8(4)
        out.varint(i)
        out.raw(b"abc")
    with pytest.raises(WireError, match="at most 60"):
        resumption.read_summary(out.bytes())


FOREIGN = [
    CameraIntrinsics(AgentId(4), CAMERA),
    LivePose(AgentId(4), 5, keyframe_id(submap_id(4, 0, 0), 0), np.eye(4), 90),
    SubmapScale(submap_id(4, 0, 0), 2.0),
    GravityAlignment(submap_id(4, 0, 0), np.eye(4)),
    header_of(4, 0),
]


@pytest.mark.parametrize("record", FOREIGN, ids=lambda r: type(r).__name__)
def test_an_agent_writes_nothing_of_another_one(record: Record) -> None:
    """Neither camera, pose nor unit: it reaches neither the map nor, as before, memory and store."""
    channel, sender = coded_channel(1, peer=AgentId(3)), Sender()
    own = header_of(3, 0)
    got = channel.receive([sender.packet([sender.record(record), sender.record(own)])], 0)
    assert [messages.key(r) for r in got] == [messages.key(own)]
    assert channel.endpoint.peer_value(messages.key(record)) is None
    assert "a value that the peer may not write" in dict(channel.stats.reasons)


def test_an_agent_writes_nothing_of_the_base() -> None:
    channel, sender = coded_channel(1, peer=AgentId(3)), Sender()
    item = sender.whole(Key(16, keyframe_id(submap_id(3, 0, 0), 0)), b"pose")
    assert channel.receive([sender.packet([item])], 0) == []
    assert channel.endpoint.peer_values() == {}


@pytest.mark.parametrize("change", [{"fx": 1e-300}, {"fy": 1e300}, {"cx": 1e308}, {"baseline_m": 1e300}])
def test_cameras_whose_numbers_overflow_are_refused(change: dict[str, float]) -> None:
    record = CameraIntrinsics(AgentId(3), replace(CAMERA, **change))  # type: ignore[arg-type]
    with pytest.raises(WireError):
        messages.decode(messages.key(record), messages.encode(record))


def test_reasons_of_refusals_are_bounded() -> None:
    """Their texts name numbers that the peer chose."""
    end, sender = Endpoint(PLAIN, 1, coder=ResidualCoder()), Sender()
    for kind in range(1, 63):
        for part in (0, 1, 70_000 % 65_536):
            item = Item(Key(kind, 1, part), 1, 9, 0, bytes([kind]) * 9, residual=True)
            end.receive(sender.packet([item]), 0)
    for number in range(200):
        end._refuse(f"found the number {number}")
    assert len(end.stats.reasons) <= 65
    assert dict(end.stats.reasons)["other reasons"] >= 100
