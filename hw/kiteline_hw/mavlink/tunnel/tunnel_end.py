"""Carries packets through a flight controller's telemetry radio, in MAVLink's TUNNEL message (385). Pure.

A packet is sent in chunks of at most `chunk_bytes`: one byte packet number, one byte chunk index and count, then data.
Chunks are sent evenly at a rate that follows the radio's free buffer as PX4's own streams do (mavlink_main.cpp,
update_radio_status), so that the controller's telemetry keeps its share. Where no RADIO_STATUS comes (ArduPilot does
not forward it) the rate follows the reports in which each end tells the other what has arrived. Both ends send
heartbeats, from which routers on the way learn where to forward.
"""

from collections import deque
from dataclasses import dataclass

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import COMPONENT_VIO, Heartbeat, MavlinkMessage, RadioStatus, Tunnel
from kiteline_hw.mavlink.tunnel.tunnel_reports import Arrivals, Departures, is_of_base

_HEAD_BYTES = 2
_MAX_CHUNKS = 16
_MAVLINK_BYTES = 12 + 5  # frame of MAVLink 2, and TUNNEL's own fields before the payload
_HEARTBEAT_NS = 1_000_000_000
_OUTBOX_CHUNKS = 16  # waiting to be sent; packets beyond that are refused, because the sender builds newer ones
_INCOMPLETE_PACKETS = 8  # packets whose chunks are collected at a time


@dataclass(frozen=True, slots=True)
class TunnelConfig:
    """One end of a tunnel. The agent's is system 1, component 197; the base's is 255, 197.

    peer_system: addressed until the peer is heard. payload_type: of packets; the next number is that of reports.
    learns_system: system is taken over from the flight controller on the way.
    """

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
    report_ns: int = 1_000_000_000  # ns between two reports; 21 bytes each
    radio_ns: int = 5_000_000_000  # ns after a RADIO_STATUS in which reports do not set the rate
    silent_ns: int = 10_000_000_000  # ns of silence after which a peer with another system id may take over
    learns_system: bool = False
    is_base: bool = False

    def __post_init__(self) -> None:
        if not 32767 < self.payload_type < 65535:
            raise ValueError(f"payload_type is {self.payload_type}, expected 32768..65534")
        if not 8 <= self.chunk_bytes <= 128:
            raise ValueError(f"chunk_bytes is {self.chunk_bytes}, expected 8..128")


AGENT_END = TunnelConfig(learns_system=True)
BASE_END = TunnelConfig(system=255, peer_system=1, rate_bytes_s=500, is_base=True)


@dataclass(slots=True)
class TunnelCounters:
    """Packets of one end of a tunnel."""

    received_packets: int = 0
    foreign: int = 0  # chunks of other payload types or for other targets


class TunnelEnd:
    """One end: packets in, MAVLink messages out, and back. Time is handed in.

    codec: of a connection that serves a flight controller too, and sends its own heartbeats; None: one of its own.
    """

    def __init__(self, config: TunnelConfig, codec: MavlinkCodec | None = None) -> None:
        self.config = config
        self.codec = codec or MavlinkCodec(config.system, config.component)
        self._beats = codec is None
        self.counters = TunnelCounters()
        self.rate_bytes_s = float(config.rate_bytes_s)
        self._outbox: deque[bytes] = deque()
        self._number = 0
        self._allowance = 0.0  # bytes that may be sent now
        self._filled_ns: int | None = None
        self._now_ns = 0
        self._heartbeat_ns = -_HEARTBEAT_NS
        self._report_ns: int | None = None  # of the last report
        self._radio_ns: int | None = None  # of the last RADIO_STATUS
        self._peer: tuple[int, int] | None = None  # system id of the peer, and when it was heard
        self._arrivals, self._departures = Arrivals(), Departures()
        self._incomplete: dict[int, dict[int, bytes]] = {}
        self._done: deque[tuple[int, int]] = deque(maxlen=_INCOMPLETE_PACKETS)

    @property
    def heard(self) -> bool:
        """True once anything of the peer came."""
        return self._peer is not None

    def heard_within(self, ns: int, now_ns: int) -> bool:
        """True if anything of the peer came in the last so many ns."""
        return self._peer is not None and now_ns - self._peer[1] <= ns

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if too much is queued already."""
        size = self.config.chunk_bytes - _HEAD_BYTES
        chunks = [packet[i : i + size] for i in range(0, len(packet), size)] or [b""]
        if len(chunks) > _MAX_CHUNKS or len(self._outbox) + len(chunks) > _OUTBOX_CHUNKS:
            return False
        self._number = (self._number + 1) % 256
        for i, chunk in enumerate(chunks):
            self._outbox.append(bytes((self._number, i << 4 | (len(chunks) - 1))) + chunk)
        return True

    def poll(self, now_ns: int) -> list[bytes]:
        """The frames to send now: a heartbeat each second, and chunks as the rate allows."""
        c = self.config
        out = []
        self._now_ns = now_ns
        if self._beats and now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            out.append(self.codec.encode(Heartbeat()))
        if self._report_ns is None or now_ns - self._report_ns >= c.report_ns:
            self._report_ns = now_ns
            report = self._arrivals.report(is_base=c.is_base)
            # A peer that is not known yet is looked for everywhere.
            to = 0 if self._peer is None else self._peer[0]
            out.append(self.codec.encode(Tunnel(to, c.peer_component, c.payload_type + 1, report)))
            if not self._has_radio(now_ns):
                self._scale_rate(self._departures.factor_of_silence(now_ns))
        if self._filled_ns is not None:
            self._allowance += (now_ns - self._filled_ns) * 1e-9 * self.rate_bytes_s
        self._filled_ns = now_ns
        self._allowance = min(self._allowance, float(c.chunk_bytes + _MAVLINK_BYTES))
        while self._outbox and self._allowance >= min(len(self._outbox[0]) + _MAVLINK_BYTES, c.chunk_bytes):
            data = self._outbox.popleft()
            self._departures.add(data[0], data[1], now_ns)
            to = c.peer_system if self._peer is None else self._peer[0]
            chunk = Tunnel(to, c.peer_component, c.payload_type, data)
            message = self.codec.encode(chunk)
            self._allowance -= len(message)
            out.append(message)
        return out

    def receive(self, data: bytes, *, datagram: bool = False) -> list[bytes]:
        """Process received bytes; the packets that they complete."""
        taken = [self.take(message) for message in self.codec.receive(data, datagram=datagram)]
        return [packet for packet in taken if packet is not None]

    def take(self, message: MavlinkMessage, now_ns: int | None = None) -> bytes | None:
        """Process a message of any kind; the packet that it completes. now_ns: None: as at the last poll."""
        packet = None
        self._now_ns = self._now_ns if now_ns is None else now_ns
        if isinstance(message, RadioStatus):
            self._radio_ns = self._now_ns
            self._adapt_rate(message.txbuf)
        elif isinstance(message, Heartbeat) and message.is_autopilot and self.config.learns_system and self._beats:
            self.codec.system = message.system
        elif isinstance(message, Tunnel):
            packet = self._take_tunnel(message)
            self.counters.received_packets += packet is not None
        return packet

    def _take_tunnel(self, m: Tunnel) -> bytes | None:
        """The packet that a chunk completes; a report sets the rate."""
        c = self.config
        is_report = m.payload_type == c.payload_type + 1
        ours = (is_report or m.payload_type == c.payload_type) and m.target_system in (0, self.codec.system)
        if is_report and is_of_base(m.data) in (c.is_base, None):
            ours = False  # of another agent, where several share a network
        if not ours or m.target_component not in (0, c.component) or not self._is_peer(m.system):
            self.counters.foreign += 1
            return None
        if not is_report:
            return self._add_chunk(m)
        factor = self._departures.factor(m.data, self._now_ns)
        if not self._has_radio(self._now_ns):
            self._scale_rate(factor)
        return None

    def _is_peer(self, system: int) -> bool:
        """True if the peer has this system id. The first one heard is the peer; another follows only a long silence."""
        known = self._peer
        if known is not None and known[0] != system and self._now_ns - known[1] < self.config.silent_ns:
            return False
        self._peer = system, self._now_ns
        return True

    def _has_radio(self, now_ns: int) -> bool:
        return self._radio_ns is not None and now_ns - self._radio_ns < self.config.radio_ns

    def _scale_rate(self, factor: float) -> None:
        c = self.config
        self.rate_bytes_s = min(max(self.rate_bytes_s * factor, float(c.min_bytes_s)), float(c.rate_bytes_s))

    def _adapt_rate(self, txbuf: int) -> None:
        c = self.config
        if txbuf < c.critical_percent:
            self._scale_rate(0.80)
        elif txbuf < c.low_percent:
            self._scale_rate(0.975)
        elif txbuf > c.high_percent:
            self._scale_rate(1.025)

    def _add_chunk(self, m: Tunnel) -> bytes | None:
        """The packet that this chunk completes, or None."""
        if len(m.data) < _HEAD_BYTES:
            self.counters.foreign += 1
            return None
        self._arrivals.add(m.data[0], m.data[1], self._now_ns)
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
        return None
