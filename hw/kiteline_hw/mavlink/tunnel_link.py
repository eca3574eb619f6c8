"""The tunnel through a flight controller as a ByteLink, over UDP or a serial port."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType
from typing import Self

from kiteline_hw.mavlink.tunnel import TunnelConfig, TunnelCounters, TunnelEnd
from kiteline_hw.mavlink.wire import MavlinkWire

_TICK_S = 0.01  # s between looks at the rate
_INBOX_PACKETS = 1024


class MavlinkTunnelLink:
    """A ByteLink. url: udp:HOST:PORT, udpin:HOST:PORT or serial:DEVICE:BAUD. Raises LinkError."""

    def __init__(self, url: str, config: TunnelConfig, *, required: bool = True) -> None:
        self._lock = threading.Lock()
        self._end = TunnelEnd(config)
        self._inbox: deque[bytes] = deque(maxlen=_INBOX_PACKETS)
        self._wire = MavlinkWire(url, "mavlink-tunnel", self._on_data, self._turn, _TICK_S, 0, required=required)
        self._wire.start()

    @property
    def counters(self) -> TunnelCounters:
        """What passed."""
        return self._end.counters

    @property
    def rate_bytes_s(self) -> float:
        """What the radio leaves for this link at present, MAVLink's own bytes included."""
        return self._end.rate_bytes_s

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False when too much waits. Never blocks."""
        with self._lock:
            return self._end.send(packet)

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call."""
        with self._lock:
            packets = list(self._inbox)
            self._inbox.clear()
        return packets

    def _on_data(self, data: bytes, whole: bool) -> None:
        with self._lock:
            self._inbox.extend(self._end.receive(data, datagram=whole))

    def _turn(self) -> None:
        with self._lock:
            messages = self._end.poll(time.monotonic_ns())
        for message in messages:
            self._wire.send(message)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._wire.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
