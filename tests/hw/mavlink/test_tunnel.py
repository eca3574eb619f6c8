"""Packets through a flight controller's radio: chunks, flow control, and the delay of telemetry."""

from __future__ import annotations

import random
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import RadioStatus, Tunnel
from kiteline_hw.mavlink.tunnel import TunnelConfig, TunnelEnd
from kiteline_hw.mavlink.tunnel_link import MavlinkTunnelLink
from kiteline_hw.sim.links.telemetry_radio import RadioConfig, RoutingController, TelemetryConfig

MS = 1_000_000
BASE = TunnelConfig(system=255, peer_system=1)


@given(st.lists(st.binary(max_size=900), max_size=8), st.integers(0, 1000))
def test_packets_arrive_whole_for_any_chunking(packets: list[bytes], seed: int) -> None:
    a, b = TunnelEnd(TunnelConfig(rate_bytes_s=1_000_000)), TunnelEnd(BASE)
    got, taken, now_ns = [], [], 0
    draw = random.Random(seed)
    for packet in packets:
        if a.send(packet):
            taken.append(packet)
        now_ns += 20 * MS
        for _ in range(20):
            now_ns += MS
            stream = b"".join(a.poll(now_ns))
            cut = draw.randrange(len(stream) + 1)
            got += b.receive(stream[:cut]) + b.receive(stream[cut:])
    assert got == taken == packets


def test_a_lost_chunk_loses_only_its_packet() -> None:
    a, b = TunnelEnd(TunnelConfig(rate_bytes_s=100_000)), TunnelEnd(BASE)
    got = []
    for i in range(30):
        assert a.send(bytes([i]) * 150)
        messages = [m for k in range(5) for m in a.poll((i * 5 + k) * 10 * MS) if m[7] != 0]
        got += [p for k, m in enumerate(messages) if not (i % 3 == 0 and k == 1) for p in b.receive(m)]
    assert [p[0] for p in got] == [i for i in range(30) if i % 3]


def test_foreign_tunnels_are_ignored() -> None:
    end = TunnelEnd(BASE)
    codec = MavlinkCodec(1, 197)
    assert end.receive(codec.encode(Tunnel(255, 197, 0x9000, b"\0\0other"))) == []
    assert end.receive(codec.encode(Tunnel(7, 197, BASE.payload_type, b"\0\0other"))) == []
    assert end.receive(codec.encode(Tunnel(255, 197, BASE.payload_type, b""))) == []
    assert end.counters.foreign == 3
    with pytest.raises(ValueError, match="payload_type"):
        TunnelConfig(payload_type=100)


def test_the_rate_follows_the_radio() -> None:
    end, radio = TunnelEnd(TunnelConfig(rate_bytes_s=1000)), MavlinkCodec(51, 68)
    for txbuf, factor in ((20, 0.8), (30, 0.975), (40, 1.0), (90, 1.025)):
        before = end.rate_bytes_s
        end.receive(radio.encode(RadioStatus(txbuf)))
        assert end.rate_bytes_s == pytest.approx(before * factor)
    for _ in range(100):
        end.receive(radio.encode(RadioStatus(0)))
    assert end.rate_bytes_s == end.config.min_bytes_s
    for _ in range(300):
        end.receive(radio.encode(RadioStatus(100)))
    assert end.rate_bytes_s == 1000


def fly(rate_bytes_s: int, seconds: int = 60, radio: RadioConfig | None = None) -> tuple[float, TunnelEnd, TunnelEnd]:
    """p95 of the telemetry's delay in ms, and both ends, with as much traffic as the rate allows."""
    controller = RoutingController(radio, TelemetryConfig(bytes_s=500))
    a = TunnelEnd(TunnelConfig(rate_bytes_s=max(1, rate_bytes_s)))
    b = TunnelEnd(TunnelConfig(system=255, peer_system=1, rate_bytes_s=max(1, rate_bytes_s // 2)))
    to_a: list[bytes] = []
    to_b: list[bytes] = []
    draw = random.Random(1)
    for tick in range(seconds * 100):
        now_ns = tick * 10 * MS
        for end, messages in ((a, to_a), (b, to_b)):
            for message in messages:
                end.receive(message)
            if rate_bytes_s:
                while end.send(draw.randbytes(150)):
                    pass
        out = (a.poll(now_ns), b.poll(now_ns)) if rate_bytes_s else ([], [])
        to_a, to_b = controller.step(*out, now_ns)
    return float(np.percentile(controller.up.telemetry_delay_ns, 95)) / MS, a, b


def test_telemetry_is_hardly_delayed() -> None:
    alone, _, _ = fly(0)
    shared, a, b = fly(1000)
    assert shared < 1.2 * alone
    assert b.counters.received_packets * 150 / 60 > 550  # B/s of packets
    assert a.counters.received_packets * 150 / 60 > 250


def test_a_radio_too_slow_for_both_is_not_flooded() -> None:
    slow = RadioConfig(air_bytes_s=2200, buffer_bytes=1000)
    _, a, b = fly(2000, radio=slow)
    assert a.rate_bytes_s < 900
    assert b.counters.received_packets > 60


def test_tunnel_over_udp_both_ways() -> None:
    with (
        MavlinkTunnelLink(
            "udpin:127.0.0.1:14611", TunnelConfig(system=255, peer_system=1, rate_bytes_s=50_000)
        ) as base,
        MavlinkTunnelLink("udp:127.0.0.1:14611", TunnelConfig(rate_bytes_s=50_000)) as agent,
    ):
        end_s = time.monotonic() + 5.0
        up: list[bytes] = []
        down: list[bytes] = []
        while time.monotonic() < end_s and not (up and down):
            agent.send(b"up" * 100)
            base.send(b"down" * 50)
            time.sleep(0.05)
            up += base.receive()
            down += agent.receive()
    assert up[0] == b"up" * 100
    assert down[0] == b"down" * 50
