"""The second reader, written from codec/SPEC.md alone, reads what the codec writes."""

import json
import zlib
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kiteline_codec.schema import RECORD_TYPES, Key, KeyframeHeader, SubmapPlacement, WireError, messages
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.framing import frame
from kiteline_codec.transport.packet import PROTOCOL_VERSION
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, keyframe_id, submap_id
from tests.codec.second_reader import Source, read_code, varint

GOLDEN = Path(__file__).parent / "golden"


def assert_agree(read: dict[str, Any], record: Any) -> None:
    for name, value in read.items():
        if name in ("size", "floats", "stereo", "T_b_c"):
            c = record.camera
            floats = (c.fx, c.fy, c.cx, c.cy, c.baseline_m)
            ours: Any = {"size": (c.width, c.height), "floats": floats, "stereo": c.stereo, "T_b_c": c.T_b_c[:3]}[name]
        else:
            ours = getattr(record.scan if hasattr(record, "scan") and hasattr(record.scan, name) else record, name)
            ours = ours.reshape(-1) if name == "cells" else list(ours) if name == "images" else ours
        assert ours is value is None or np.allclose(ours, value, rtol=1e-7, atol=1e-12, equal_nan=True), name


def test_records() -> None:
    entries = json.loads((GOLDEN / "records.json").read_text())
    assert {entry["key"][0] for entry in entries} == set(RECORD_TYPES)
    for entry in entries:
        kind, id_, part = entry["key"]
        code = bytes.fromhex(entry["code"])
        assert_agree(read_code(kind, id_, code, part), messages.decode(Key(*entry["key"]), code))


def test_a_recognised_placement_has_one_byte_more() -> None:
    S_w_m = se3.exp(np.array([0.4, 0.1, -0.2, 0.3, 0.0, 0.05]))
    plain, recognised = (SubmapPlacement(submap_id(1, 1, 2), S_w_m, known) for known in (False, True))
    code = messages.encode(recognised)
    assert code == messages.encode(plain) + b"\1"
    key = messages.key(recognised)
    assert_agree(read_code(key.kind, key.id, code), messages.decode(key, code))
    assert messages.encode(messages.decode(key, code)) == code
    with pytest.raises(WireError, match="a byte of 0"):
        messages.decode(key, code[:-1] + b"\0")
    with pytest.raises(WireError, match="above 0"):
        messages.decode(key, code + b"\0")
    with pytest.raises(WireError, match="too many"):
        messages.decode(key, code + b"\1\1")


def test_the_deviation_of_a_placement_costs_no_byte_beside_another_one() -> None:
    S_w_m = sim3.of(0.98, se3.exp(np.array([0.4, 0.1, -0.2, 0.3, 0.0, 0.05])))
    record = SubmapPlacement(submap_id(1, 1, 2), S_w_m, True, 7, 0.0112)
    code = messages.encode(record)
    assert len(code) == len(messages.encode(SubmapPlacement(submap_id(1, 1, 2), S_w_m, True, 7)))
    read = messages.decode(messages.key(record), code)
    assert isinstance(read, SubmapPlacement) and read.scale_sigma == pytest.approx(0.0112, rel=0.06)
    assert_agree(read_code(21, messages.key(record).id, code), read)


def exchange() -> list[tuple[str, bytes]]:
    """A conversation with greeting, values, a long value, a removal, acknowledgements and digests."""
    config = SyncConfig(packet_bytes=200)
    ends = {"agent": Endpoint(config, 5), "base": Endpoint(config, 700)}
    wire: list[tuple[str, bytes]] = []
    for tick in range(60):
        now_ns = tick * 30_000_000
        if tick == 0:
            for entry in json.loads((GOLDEN / "records.json").read_text()):
                side = "agent" if entry["key"][0] < 16 else "base"
                ends[side].put(Key(*entry["key"]), bytes.fromhex(entry["code"]))
        if tick == 20:
            ends["base"].remove(next(iter(ends["agent"].peer_values())))
        for name, other in (("agent", "base"), ("base", "agent")):
            while (packet := ends[name].poll(now_ns)) is not None:
                wire.append((name, packet))
                ends[other].receive(packet, now_ns)
    assert ends["agent"].digest_equal
    assert ends["base"].digest_equal
    return wire


def test_packets() -> None:
    wire = exchange()
    golden = json.loads((GOLDEN / "packets.json").read_text())
    assert [[name, packet.hex()] for name, packet in wire] == golden
    held: dict[str, dict[tuple[int, int, int], tuple[int, bytes]]] = {"agent": {}, "base": {}}
    parts: dict[tuple[int, int, int, int], dict[int, bytes]] = {}
    compared = set()
    for name, packet in wire:
        assert zlib.crc32(packet[:-4]) == int.from_bytes(packet[-4:], "little")
        s = Source(packet[:-4])
        assert s.u8() == PROTOCOL_VERSION == 7
        flags = s.u8()
        assert s.varint() == {"agent": 5, "base": 700}[name]
        assert s.varint() in (0, {"agent": 700, "base": 5}[name])
        if flags & 1:
            last, missing = s.varint(), s.varint()
            assert last > 0 == missing
        values = held[name]
        if flags & 2:
            newest, digest = s.varint(), s.raw(16)
            total = 0
            for (kind, id_, part), (version, code) in values.items():
                head = b"".join(varint(x) for x in (kind, id_, part, version))
                total += int.from_bytes(blake2b(head + code, digest_size=16).digest(), "little")
            assert digest == (total % 2**128).to_bytes(16, "little")
            assert newest >= max((v for v, _ in values.values()), default=0)
            compared.add(name)
        for flag in (4, 8, 16):
            if flags & flag:
                s.varint()
        if flags & 32:
            s.varint()
            watermark, id_ = s.varint(), 0
            while s.at < len(s.data):
                tag = s.u8()
                id_ += s.signed()
                key = (tag & 63, id_, s.varint())
                version = s.varint() + watermark + 1
                if tag & 128:
                    del values[key]
                    continue
                length = s.varint()
                offset, total = (s.varint(), s.varint()) if tag & 64 else (0, length)
                got = parts.setdefault((*key, version), {})
                got[offset] = s.raw(length)
                if sum(map(len, got.values())) == total:
                    values[key] = (version, b"".join(got[o] for o in sorted(got)))
    assert compared == {"agent", "base"}
    entries = json.loads((GOLDEN / "records.json").read_text())
    ours = {tuple(e["key"]): bytes.fromhex(e["code"]) for e in entries}
    read = {k: code for side in held.values() for k, (_, code) in side.items()}
    assert len(ours) - len(read) == 1  # the removed one
    assert all(ours[k] == code for k, code in read.items())


def test_frames() -> None:
    packet = bytes(range(7)) * 60
    coded = frame(packet)
    assert coded[0] == coded[-1] == 0
    body, at = b"", 1
    while at < len(coded) - 1:
        n = coded[at]
        body += coded[at + 1 : at + n] + (b"\0" if n < 255 else b"")
        at += n
    assert body[:-1] == packet + zlib.crc32(packet).to_bytes(4, "little")


def test_the_names_in_the_specification_exist() -> None:
    text = (Path(__file__).parents[2] / "codec" / "SPEC.md").read_text()
    for kind, record_type in RECORD_TYPES.items():
        assert f"| {kind} | {record_type.__name__} |" in text
    assert f"The protocol version is **{PROTOCOL_VERSION}**" in text


def test_gravity_is_at_most_five_bytes_of_a_keyframe() -> None:
    plain = KeyframeHeader(keyframe_id(submap_id(1, 1, 2), 3), 5, NO_KEYFRAME, np.eye(4), 7)
    known = replace(plain, up=np.array([0.48, -0.6, 0.64]), up_rad=0.01)
    code, key = messages.encode(known), messages.key(known)
    assert code[:-5] == messages.encode(plain)
    assert_agree(read_code(key.kind, key.id, code), messages.decode(key, code))
    assert messages.encode(messages.decode(key, code)) == code
    with pytest.raises(WireError, match="above 0"):
        messages.decode(key, code[:-5] + bytes([code[-5] & 128]) + code[-4:])
    with pytest.raises(WireError, match="half of the sphere"):
        messages.decode(key, code[:-4] + b"\xfe\x7f\xfe\x7f")
    with pytest.raises(WireError, match="end within"):
        messages.decode(key, code[:-1])
