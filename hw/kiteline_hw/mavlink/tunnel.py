"""Packets through a flight controller's telemetry radio, in MAVLink's TUNNEL message (385). Pure.

A packet goes in pieces of at most `chunk_bytes`: one byte of packet number, one of place (index, count), then bytes of
the packet. Pieces leave evenly at a rate that follows the radio's free buffer as PX4's own streams do (in its
mavlink_main.cpp, update_radio_status), so that the controller's telemetry keeps its place. Both ends send heartbeats:
routers on the way learn by them where to send.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from kiteline_hw.mavlink.messages import COMPONENT_VIO, MavlinkCodec, RadioStatus, Tunnel

_HEAD_BYTES = 2
_MAX_CHUNKS = 16
_MAVLINK_BYTES = 12 + 5  # frame of MAVLink 2, and TUNNEL's own fields before the payload
_HEARTBEAT_NS = 1_000_000_000
_OUTBOX_CHUNKS = 16  # waiting; what is older is better made anew by the sender
_HALF_PACKETS = 8  # packets whose pieces are waited for


@dataclass(frozen=True, slots=True)
class TunnelConfig:
    """One end of a tunnel. The agent's is system 1, component 197; the base's is 255, 197."""

    system: int = 1
    component: int = COMPONENT_VIO
    peer_system: int = 255
    peer_component: int = COMPONENT_VIO
    payload_type: int = 0xB17E  # any above 32767 is for private use
    chunk_bytes: int = 64  # of payload; 128 at most, 80 with the radio's error correction: short ones delay others less
    rate_bytes_s: int = 1000  # on the wire, MAVLink's own bytes included, while the radio has room
    low_percent: int = 35  # free buffer below which the rate falls slowly (PX4: RADIO_BUFFER_LOW_PERCENTAGE)
    critical_percent: int = 25  # below which it falls fast
    half_percent: int = 50  # above which it rises
    least_bytes_s: int = 60  # never below: a heartbeat and a pose now and then

    def __post_init__(self) -> None:
        if not 32767 < self.payload_type < 65536:
            raise ValueError(f"payload_type is {self.payload_type}, expected 32768..65535")
        if not 8 <= self.chunk_bytes <= 128:
            raise ValueError(f"chunk_bytes is {self.chunk_bytes}, expected 8..128")


AGENT_END = TunnelConfig()
BASE_END = TunnelConfig(system=255, peer_system=1, rate_bytes_s=500)


@dataclass(slots=True)
class TunnelCounters:
    """What passed."""

    sent_packets: int = 0
    sent_bytes: int = 0  # on the wire
    refused_packets: int = 0
    received_packets: int = 0
    incomplete_packets: int = 0
    foreign: int = 0  # tunnels of other payload types or for others


class TunnelEnd:
    """One end: packets in, MAVLink messages out, and back. Time is handed in."""

    def __init__(self, config: TunnelConfig) -> None:
        self.config = config
        self.codec = MavlinkCodec(config.system, config.component)
        self.counters = TunnelCounters()
        self.rate_bytes_s = float(config.rate_bytes_s)
        self._outbox: deque[bytes] = deque()
        self._number = 0
        self._room = 0.0  # bytes that may leave now
        self._filled_ns: int | None = None
        self._heartbeat_ns = -_HEARTBEAT_NS
        self._halves: dict[int, dict[int, bytes]] = {}
        self._done: deque[tuple[int, int]] = deque(maxlen=_HALF_PACKETS)

    @property
    def max_packet_bytes(self) -> int:
        """The longest packet that fits."""
        return _MAX_CHUNKS * (self.config.chunk_bytes - _HEAD_BYTES)

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False when too much waits."""
        size = self.config.chunk_bytes - _HEAD_BYTES
        pieces = [packet[i : i + size] for i in range(0, len(packet), size)] or [b""]
        if len(pieces) > _MAX_CHUNKS or len(self._outbox) + len(pieces) > _OUTBOX_CHUNKS:
            self.counters.refused_packets += 1
            return False
        self._number = (self._number + 1) % 256
        for i, piece in enumerate(pieces):
            self._outbox.append(bytes((self._number, i << 4 | (len(pieces) - 1))) + piece)
        self.counters.sent_packets += 1
        return True

    def poll(self, now_ns: int) -> list[bytes]:
        """The messages to write now: a heartbeat each second, and pieces as the rate allows."""
        c = self.config
        out = []
        if now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            out.append(self.codec.heartbeat())
        if self._filled_ns is not None:
            self._room += (now_ns - self._filled_ns) * 1e-9 * self.rate_bytes_s
        self._filled_ns = now_ns
        self._room = min(self._room, float(c.chunk_bytes + _MAVLINK_BYTES))
        while self._outbox and self._room >= min(len(self._outbox[0]) + _MAVLINK_BYTES, c.chunk_bytes):
            message = self.codec.tunnel(c.peer_system, c.peer_component, c.payload_type, self._outbox.popleft())
            self._room -= len(message)
            self.counters.sent_bytes += len(message)
            out.append(message)
        return out

    def receive(self, data: bytes, *, datagram: bool = False) -> list[bytes]:
        """The packets that these bytes complete."""
        packets = []
        for message in self.codec.receive(data, datagram=datagram):
            if isinstance(message, RadioStatus):
                self._follow(message.txbuf)
            elif isinstance(message, Tunnel):
                packet = self._take(message)
                if packet is not None:
                    self.counters.received_packets += 1
                    packets.append(packet)
        return packets

    def _follow(self, txbuf: int) -> None:
        c = self.config
        if txbuf < c.critical_percent:
            self.rate_bytes_s *= 0.80
        elif txbuf < c.low_percent:
            self.rate_bytes_s *= 0.975
        elif txbuf > c.half_percent:
            self.rate_bytes_s *= 1.025
        self.rate_bytes_s = min(max(self.rate_bytes_s, float(c.least_bytes_s)), float(c.rate_bytes_s))

    def _take(self, m: Tunnel) -> bytes | None:
        c = self.config
        ours = m.payload_type == c.payload_type and m.target_system in (0, c.system)
        if not ours or m.target_component not in (0, c.component) or len(m.data) < _HEAD_BYTES:
            self.counters.foreign += 1
            return None
        number, index, count = m.data[0], m.data[1] >> 4, (m.data[1] & 15) + 1
        if index >= count or (number, count) in self._done:
            return None
        pieces = self._halves.setdefault(number, {})
        pieces[index] = m.data[_HEAD_BYTES:]
        if len(pieces) == count and max(pieces) == count - 1:
            del self._halves[number]
            self._done.append((number, count))
            return b"".join(pieces[i] for i in range(count))
        while len(self._halves) > _HALF_PACKETS:
            self._halves.pop(next(iter(self._halves)))
            self.counters.incomplete_packets += 1
        return None
