"""The tunnel through a flight controller as a ByteLink, over UDP or a serial port."""

from __future__ import annotations

import threading
import time
from collections import deque

from kiteline_hw.links.ends import LinkOptions, OneLinkHub
from kiteline_hw.mavlink.connection import MavlinkConnection
from kiteline_hw.mavlink.tunnel import AGENT_END, BASE_END, TunnelConfig, TunnelCounters, TunnelEnd
from kiteline_hw.ports import LinkHub
from kiteline_hw.system.closing import Closing

_TICK_S = 0.01  # s between two checks of the send rate
_INBOX_PACKETS = 1024


class MavlinkTunnelLink(Closing):
    """A ByteLink. url: udp:HOST:PORT, udpin:HOST:PORT or serial:DEVICE:BAUD. Raises LinkError."""

    def __init__(self, url: str, config: TunnelConfig, *, required: bool = True) -> None:
        self._lock = threading.Lock()
        self._end = TunnelEnd(config)
        self._inbox: deque[bytes] = deque(maxlen=_INBOX_PACKETS)
        self._connection = MavlinkConnection(
            url, "mavlink-tunnel", self._on_data, self._on_tick, _TICK_S, 0, required=required
        )
        self._connection.start()

    @property
    def counters(self) -> TunnelCounters:
        """Packets sent, received and lost so far."""
        return self._end.counters

    @property
    def rate_bytes_s(self) -> float:
        """The send rate that the radio allows at present, MAVLink's framing included."""
        return self._end.rate_bytes_s

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if too much is queued already. Never blocks."""
        with self._lock:
            return self._end.send(packet)

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call."""
        with self._lock:
            packets = list(self._inbox)
            self._inbox.clear()
        return packets

    def _on_data(self, data: bytes, datagram: bool) -> None:
        with self._lock:
            self._inbox.extend(self._end.receive(data, datagram=datagram))

    def _on_tick(self) -> None:
        with self._lock:
            messages = self._end.poll(time.monotonic_ns())
        for message in messages:
            self._connection.send(message)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._connection.close()


def open_agent_end(address: str, options: LinkOptions) -> MavlinkTunnelLink:
    """Open the agent's end. Raises LinkError."""
    return MavlinkTunnelLink(address, AGENT_END, required=options.required)


def open_base_end(address: str, options: LinkOptions) -> LinkHub:
    """Open the base's end, with one agent at the other. Raises LinkError."""
    return OneLinkHub(MavlinkTunnelLink(address, BASE_END, required=options.required), options.agent)
