"""The serial link on pseudo terminals: noise, full buffers, hang-ups and reopening."""

import os
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from cobs import cobs

from kiteline_hw.links.ends import OneLinkHub
from kiteline_hw.links.queued_link import OUTBOX_PACKETS
from kiteline_hw.links.serial_link import SerialHub, SerialLink
from kiteline_hw.ports import LinkError
from kiteline_hw.sim.links.serial_pair import SerialPair
from kiteline_hw.system.serial_port import parse_serial
from tests.hw.processes import wait_for


class CobsFramer:
    """COBS with a CRC-32 and zeros around: the smallest framing that can stand noise."""

    def __init__(self) -> None:
        self._buffer = b""

    def encode(self, packet: bytes) -> bytes:
        coded: bytes = cobs.encode(packet + zlib.crc32(packet).to_bytes(4, "little"))
        return b"\0" + coded + b"\0"

    def feed(self, data: bytes) -> list[bytes]:
        *frames, self._buffer = (self._buffer + data).split(b"\0")
        packets = []
        for frame in frames:
            try:
                body = cobs.decode(frame)
            except cobs.DecodeError:
                continue
            if len(body) >= 4 and zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"):
                packets.append(body[:-4])
        return packets


def gather(link: SerialLink, into: list[bytes], count: int) -> Callable[[], bool]:
    def enough() -> bool:
        into.extend(link.receive())
        return len(into) >= count

    return enough


def test_packets_both_ways_whole_and_in_order() -> None:
    packets = [os.urandom(1 + 13 * i) for i in range(60)]
    with (
        SerialPair() as pair,
        SerialLink(pair.a, 921600, CobsFramer()) as a,
        SerialLink(pair.b, 921600, CobsFramer()) as b,
    ):
        for packet in packets:
            assert a.send(packet) and b.send(packet[::-1])
        at_a: list[bytes] = []
        at_b: list[bytes] = []
        wait_for(gather(b, at_b, 60))
        wait_for(gather(a, at_a, 60))
        assert at_b == packets
        assert at_a == [packet[::-1] for packet in packets]
        assert a.counters.sent_packets == b.counters.received_packets == 60


def test_noise_loses_packets_but_forges_none() -> None:
    packets = [b"%03d" % i + bytes(100) for i in range(200)]
    with (
        SerialPair(bit_errors=0.002) as pair,
        SerialLink(pair.a, 57600, CobsFramer()) as a,
        SerialLink(pair.b, 57600, CobsFramer()) as b,
    ):
        received: list[bytes] = []
        for packet in packets:
            assert a.send(packet)
            wait_for(lambda: not a.pending())
        wait_for(lambda: pair.pumped_bytes[0] >= 200 * 108)
        time.sleep(0.05)
        received = b.receive()
        assert 120 < len(received) < 200
        assert set(received) <= set(packets)
        assert received == sorted(received)


def test_a_full_cable_blocks_no_caller() -> None:
    master, slave = os.openpty()
    os.set_blocking(master, False)
    link = SerialLink(os.ttyname(slave), 57600, CobsFramer())
    try:
        refused, longest_s = 0, 0.0
        for _ in range(OUTBOX_PACKETS + 200):
            began = time.monotonic()
            refused += not link.send(bytes(500))
            longest_s = max(longest_s, time.monotonic() - began)
        assert refused > 0
        assert longest_s < 0.1
        framer = CobsFramer()
        received: list[bytes] = []  # and what waits half written goes on where it stopped
        deadline_s = time.monotonic() + 5.0
        while len(received) < OUTBOX_PACKETS and time.monotonic() < deadline_s:
            try:
                received += framer.feed(os.read(master, 4096))
            except BlockingIOError:
                time.sleep(0.001)
        assert received[:OUTBOX_PACKETS] == [bytes(500)] * OUTBOX_PACKETS
    finally:
        link.close()
        os.close(master)
        os.close(slave)


def test_reopened_after_a_hang_up(tmp_path: Path) -> None:
    device = tmp_path / "ttyRADIO"
    first, second = SerialPair(), SerialPair()
    device.symlink_to(first.a)
    with SerialLink(str(device), 57600, CobsFramer()) as a, SerialLink(second.b, 57600, CobsFramer()) as b:
        assert a.send(b"lost")
        assert a.take_messages() == []
        first.close()
        wait_for(lambda: not a.connected)
        assert not a.send(b"refused")
        told = a.take_messages()
        assert len(told) == 1 and str(device) in told[0] and "tried again" in told[0]
        assert a.take_messages() == []
        device.unlink()
        device.symlink_to(second.a)
        wait_for(lambda: a.connected)
        assert OneLinkHub(a, 3).take_messages() == [f"serial port {device} is back"]
        assert a.counters.reconnects == 2
        assert a.send(b"back")
        received: list[bytes] = []
        wait_for(gather(b, received, 1))
        assert received[-1] == b"back"
        began = time.monotonic()
        a.close()
        a.close()
        assert time.monotonic() - began < 1.0
    second.close()


def test_a_port_in_use_or_missing_is_named() -> None:
    with SerialPair() as pair:
        with SerialLink(pair.a, 57600, CobsFramer()), pytest.raises(LinkError, match="used by another program"):
            SerialLink(pair.a, 57600, CobsFramer())
        with pytest.raises(LinkError, match="/dev/ttyNONE at 57600"):
            SerialLink("/dev/ttyNONE", 57600, CobsFramer())
        with SerialLink("/dev/ttyNONE", 57600, CobsFramer(), required=False) as waiting:
            assert not waiting.connected and not waiting.send(b"x") and waiting.receive() == []
            assert waiting.take_messages() == ["serial port /dev/ttyNONE: the device is missing; it is tried again"]


def test_a_framer_that_raises_is_counted() -> None:
    class Broken(CobsFramer):
        def feed(self, data: bytes) -> list[bytes]:
            raise RuntimeError("broken")

    with SerialPair() as pair, SerialLink(pair.a, 57600, CobsFramer()) as a, SerialLink(pair.b, 57600, Broken()) as b:
        a.send(b"x")
        wait_for(lambda: b.counters.callback_errors > 0)
        b.send(b"still alive")
        received: list[bytes] = []
        wait_for(gather(a, received, 1))


def test_specs() -> None:
    assert parse_serial("/dev/ttyUSB0:57600") == ("/dev/ttyUSB0", 57600)
    assert parse_serial("/dev/serial/by-path/pci-0000:00:14.0:921600") == (
        "/dev/serial/by-path/pci-0000:00:14.0",
        921600,
    )
    for bad in ("", "/dev/ttyUSB0", "/dev/ttyUSB0:", ":57600", "/dev/ttyUSB0:fast", "/dev/ttyUSB0:0"):
        with pytest.raises(LinkError, match="expected DEVICE:BAUD"):
            parse_serial(bad)


def test_an_agent_is_reachable_while_packets_of_it_come(tmp_path: Path) -> None:
    now_ns = 0
    with SerialLink(str(tmp_path / "none"), 57600, CobsFramer(), required=False) as missing:
        assert SerialHub(missing, 3).alive() == frozenset()
    with (
        SerialPair() as pair,
        SerialLink(pair.a, 57600, CobsFramer()) as a,
        SerialLink(pair.b, 57600, CobsFramer(), clock=lambda: now_ns) as b,
    ):
        hub = SerialHub(b, 3)
        assert hub.alive() == frozenset()
        assert a.send(b"here")
        wait_for(gather(b, [], 1))
        assert hub.alive() == frozenset([3])
        now_ns = 11_000_000_000
        assert hub.alive() == frozenset()
