"""Carries packets through a flight controller's telemetry radio, in MAVLink's TUNNEL message (385). Pure.

A packet is sent in chunks of at most `chunk_bytes`: one byte packet number, one byte chunk index and count, then data.
Chunks are sent evenly at a rate that follows the radio's free buffer as PX4's own streams do (mavlink_main.cpp,
update_radio_status), so that the controller's telemetry keeps its share. Both ends send heartbeats, from which routers
on the way learn where to forward.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import COMPONENT_VIO, Heartbeat, RadioStatus, Tunnel

_HEAD_BYTES = 2
_MAX_CHUNKS = 16
_MAVLINK_BYTES = 12 + 5  # frame of MAVLink 2, and TUNNEL's own fields before the payload
_HEARTBEAT_NS = 1_000_000_000
_OUTBOX_CHUNKS = 16  # waiting to be sent; packets beyond that are refused, because the sender builds newer ones
_INCOMPLETE_PACKETS = 8  # packets whose chunks are collected at a time


@dataclass(frozen=True, slots=True)
class TunnelConfig:
    """One end of a tunnel. The agent's is system 1, component 197; the base's is 255, 197."""

    system: int = 1
    component: int = COMPONENT_VIO
    peer_system: int = 255
    peer_component: int = COMPONENT_VIO
    payload_type: int = 0xB17E  # any above 32767 is for private use
    chunk_bytes: int = (
        64  # of payload; at most 128, or 80 with the radio's error correction: short ones delay other messages less
    )
    rate_bytes_s: int = 1000  # on the wire, MAVLink's framing included, while the radio's buffer has room
    low_percent: int = 35  # free buffer below which the rate falls slowly (PX4: RADIO_BUFFER_LOW_PERCENTAGE)
    critical_percent: int = 25  # below which it falls fast
    high_percent: int = 50  # above which it rises
    min_bytes_s: int = 60  # lower limit: a heartbeat and an occasional pose

    def __post_init__(self) -> None:
        if not 32767 < self.payload_type < 65536:
            raise ValueError(f"payload_type is {self.payload_type}, expected 32768..65535")
        if not 8 <= self.chunk_bytes <= 128:
            raise ValueError(f"chunk_bytes is {self.chunk_bytes}, expected 8..128")


AGENT_END = TunnelConfig()
BASE_END = TunnelConfig(system=255, peer_system=1, rate_bytes_s=500)


@dataclass(slots=True)
class TunnelCounters:
    """Packets of one end of a tunnel."""

    sent_packets: int = 0
    sent_bytes: int = 0  # on the wire
    refused_packets: int = 0
    received_packets: int = 0
    incomplete_packets: int = 0
    foreign: int = 0  # chunks of other payload types or for other targets


class TunnelEnd:
    """One end: packets in, MAVLink messages out, and back. Time is handed in."""

    def __init__(self, config: TunnelConfig) -> None:
        self.config = config
        self.codec = MavlinkCodec(config.system, config.component)
        self.counters = TunnelCounters()
        self.rate_bytes_s = float(config.rate_bytes_s)
        self._outbox: deque[bytes] = deque()
        self._number = 0
        self._allowance = 0.0  # bytes that may be sent now
        self._filled_ns: int | None = None
        self._heartbeat_ns = -_HEARTBEAT_NS
        self._incomplete: dict[int, dict[int, bytes]] = {}
        self._done: deque[tuple[int, int]] = deque(maxlen=_INCOMPLETE_PACKETS)

    @property
    def max_packet_bytes(self) -> int:
        """The longest packet that fits."""
        return _MAX_CHUNKS * (self.config.chunk_bytes - _HEAD_BYTES)

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if too much is queued already."""
        size = self.config.chunk_bytes - _HEAD_BYTES
        chunks = [packet[i : i + size] for i in range(0, len(packet), size)] or [b""]
        if len(chunks) > _MAX_CHUNKS or len(self._outbox) + len(chunks) > _OUTBOX_CHUNKS:
            self.counters.refused_packets += 1
            return False
        self._number = (self._number + 1) % 256
        for i, chunk in enumerate(chunks):
            self._outbox.append(bytes((self._number, i << 4 | (len(chunks) - 1))) + chunk)
        self.counters.sent_packets += 1
        return True

    def poll(self, now_ns: int) -> list[bytes]:
        """The frames to send now: a heartbeat each second, and chunks as the rate allows."""
        c = self.config
        out = []
        if now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            out.append(self.codec.encode(Heartbeat()))
        if self._filled_ns is not None:
            self._allowance += (now_ns - self._filled_ns) * 1e-9 * self.rate_bytes_s
        self._filled_ns = now_ns
        self._allowance = min(self._allowance, float(c.chunk_bytes + _MAVLINK_BYTES))
        while self._outbox and self._allowance >= min(len(self._outbox[0]) + _MAVLINK_BYTES, c.chunk_bytes):
            chunk = Tunnel(c.peer_system, c.peer_component, c.payload_type, self._outbox.popleft())
            message = self.codec.encode(chunk)
            self._allowance -= len(message)
            self.counters.sent_bytes += len(message)
            out.append(message)
        return out

    def receive(self, data: bytes, *, datagram: bool = False) -> list[bytes]:
        """Process received bytes; the packets that they complete."""
        packets = []
        for message in self.codec.receive(data, datagram=datagram):
            if isinstance(message, RadioStatus):
                self._adapt_rate(message.txbuf)
            elif isinstance(message, Tunnel):
                packet = self._add_chunk(message)
                if packet is not None:
                    self.counters.received_packets += 1
                    packets.append(packet)
        return packets

    def _adapt_rate(self, txbuf: int) -> None:
        c = self.config
        if txbuf < c.critical_percent:
            self.rate_bytes_s *= 0.80
        elif txbuf < c.low_percent:
            self.rate_bytes_s *= 0.975
        elif txbuf > c.high_percent:
            self.rate_bytes_s *= 1.025
        self.rate_bytes_s = min(max(self.rate_bytes_s, float(c.min_bytes_s)), float(c.rate_bytes_s))

    def _add_chunk(self, m: Tunnel) -> bytes | None:
        """The packet that this chunk completes, or None."""
        c = self.config
        ours = m.payload_type == c.payload_type and m.target_system in (0, c.system)
        if not ours or m.target_component not in (0, c.component) or len(m.data) < _HEAD_BYTES:
            self.counters.foreign += 1
            return None
        number, index, count = m.data[0], m.data[1] >> 4, (m.data[1] & 15) + 1
        if index >= count or (number, count) in self._done:
            return None
        chunks = self._incomplete.setdefault(number, {})
        chunks[index] = m.data[_HEAD_BYTES:]
        if len(chunks) == count and max(chunks) == count - 1:
            del self._incomplete[number]
            self._done.append((number, count))
            return b"".join(chunks[i] for i in range(count))
        while len(self._incomplete) > _INCOMPLETE_PACKETS:
            self._incomplete.pop(next(iter(self._incomplete)))
            self.counters.incomplete_packets += 1
        return None
