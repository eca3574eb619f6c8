"""Packets through a flight controller's radio: chunks, flow control, and the delay of telemetry."""

import random
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, RadioStatus, Tunnel
from kiteline_hw.mavlink.tunnel.tunnel_end import AGENT_END, BASE_END, TunnelConfig, TunnelEnd
from kiteline_hw.mavlink.tunnel.tunnel_link import MavlinkTunnelLink, open_base_end
from kiteline_hw.sim.links.telemetry_radio import RadioConfig, RoutingController, TelemetryConfig
from tests.hw.processes import free_port

MS, S = 1_000_000, 1_000_000_000
BASE = TunnelConfig(system=255, peer_system=1, is_base=True)


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
    b = TunnelEnd(TunnelConfig(system=255, peer_system=1, is_base=True, rate_bytes_s=max(1, rate_bytes_s // 2)))
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


def test_behind_a_controller_that_keeps_radio_status_to_itself() -> None:
    slow = RadioConfig(air_bytes_s=2200, buffer_bytes=4096, forwards_status=False)
    _, a, b = fly(2000, radio=slow, seconds=120)
    assert a.rate_bytes_s < 900
    assert b.counters.received_packets > 120
    delay_ms, a, b = fly(1000, radio=RadioConfig(forwards_status=False))
    assert delay_ms < 1.2 * fly(0)[0]
    assert b.counters.received_packets * 150 / 60 > 500  # B/s of packets


def test_tunnel_over_udp_both_ways() -> None:
    with (
        MavlinkTunnelLink(
            "udpin:127.0.0.1:14611", TunnelConfig(system=255, peer_system=1, is_base=True, rate_bytes_s=50_000)
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


def carry(
    a: TunnelEnd, b: TunnelEnd, seconds: float, forwards: Callable[[bytes], bool] = lambda _: True
) -> list[bytes]:
    """Exchange messages with no delay; the packets that b got."""
    got = []
    for tick in range(round(seconds * 100)):
        now_ns = tick * 10 * MS
        for end, other in ((a, b), (b, a)):
            for message in end.poll(now_ns):
                if forwards(message):
                    packets = other.receive(message)
                    got += packets if other is b else []
        a.send(b"packet")
    return got


@pytest.mark.parametrize(("vehicle", "ground"), [(1, 255), (3, 250), (7, 255)])
def test_ends_find_each_other_with_any_system_ids(vehicle: int, ground: int) -> None:
    agent, base = TunnelEnd(AGENT_END), TunnelEnd(replace(BASE_END, system=ground))
    agent.receive(MavlinkCodec(vehicle, 1).encode(Heartbeat(2, 3)))
    assert not base.heard

    def router(message: bytes) -> bool:
        """As ArduPilot: messages for a system go where it was heard, those for all everywhere."""
        if message[7] != 385 % 256:
            return True
        found = MavlinkCodec().receive(message)[0]
        assert isinstance(found, Tunnel)
        return found.target_system in (0, vehicle, ground)

    assert len(carry(agent, base, 5.0, router)) > 20
    assert base.heard and agent.heard and agent.codec.system == vehicle


def test_agents_on_one_network_do_not_take_each_other_for_a_base() -> None:
    one, two = TunnelEnd(AGENT_END), TunnelEnd(replace(AGENT_END, system=2, learns_system=False))
    carry(one, two, 3.0)
    assert not one.heard and not two.heard


def test_another_agent_does_not_take_over_a_base() -> None:
    base, one, two = TunnelEnd(BASE_END), TunnelEnd(AGENT_END), TunnelEnd(replace(AGENT_END, system=2))
    carry(one, base, 1.0)
    assert two.send(b"intruder")
    assert [p for m in two.poll(S) + two.poll(2 * S) for p in base.receive(m)] == []


def limited(rate_bytes_s: int, queue_bytes: int, seconds: int = 60) -> tuple[TunnelEnd, TunnelEnd, list[int]]:
    """An agent that sends all it may over a line without RADIO_STATUS; and the queue in it, tick by tick."""
    a, b = TunnelEnd(TunnelConfig(rate_bytes_s=4000)), TunnelEnd(BASE_END)
    queue: deque[bytes] = deque()
    room, sizes = 0.0, []
    for tick in range(seconds * 100):
        now_ns = tick * 10 * MS
        while a.send(bytes(100)):
            pass
        for message in a.poll(now_ns):
            if sum(map(len, queue)) + len(message) <= queue_bytes:
                queue.append(message)
        room = min(room + rate_bytes_s / 100, 200.0)
        while queue and room >= len(queue[0]):
            room -= len(queue[0])
            b.receive(queue.popleft())
        for message in b.poll(now_ns):
            a.receive(message)
        sizes.append(sum(map(len, queue)))
    return a, b, sizes


def test_without_radio_status_the_rate_follows_what_arrives() -> None:
    for queue_bytes in (600, 4000):  # a short queue loses chunks, a long one delays them
        a, b, sizes = limited(1000, queue_bytes)
        assert 500 < a.rate_bytes_s < 1500
        arrived = b.counters.received_packets * 100 / 60
        assert arrived > 250
        assert np.mean(sizes[3000:]) < 0.7 * 4000
    a, _, _ = limited(100_000, 10_000)
    assert a.rate_bytes_s == 4000


def test_the_rate_falls_when_reports_stop_and_comes_back() -> None:
    a, b = TunnelEnd(AGENT_END), TunnelEnd(BASE_END)
    carry(a, b, 5.0)
    for tick in range(500, 3000):
        a.poll(tick * 10 * MS)
        a.send(b"into nothing")
    assert a.rate_bytes_s < 100
    for tick in range(3000, 12_000):
        for end, other in ((a, b), (b, a)):
            for message in end.poll(tick * 10 * MS):
                other.receive(message)
        a.send(b"packet")
    assert a.rate_bytes_s > 900


def test_garbage_is_no_report() -> None:
    end = TunnelEnd(AGENT_END)
    for data in (b"", b"\1", bytes(6), bytes(50)):
        end.receive(MavlinkCodec(255, 197).encode(Tunnel(1, 197, AGENT_END.payload_type + 1, data)))
    assert end.rate_bytes_s == AGENT_END.rate_bytes_s


def test_a_base_knows_no_agent_before_a_message_came() -> None:
    port = free_port(socket.SOCK_DGRAM)
    hub = open_base_end(f"udpin:127.0.0.1:{port}?system=250", LinkOptions(agent=4))
    try:
        assert hub.links() == {} and hub.alive() == frozenset()
        with MavlinkTunnelLink(f"udp:127.0.0.1:{port}", AGENT_END) as agent:
            end_s, down = time.monotonic() + 5.0, []
            while time.monotonic() < end_s and not down:
                time.sleep(0.02)
                for link in hub.links().values():
                    link.send(b"down")
                down = agent.receive()
            assert down and set(hub.links()) == {4} and hub.alive() == {4}
    finally:
        hub.close()
