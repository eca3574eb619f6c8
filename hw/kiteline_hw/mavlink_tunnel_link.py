"""The tunnel through a flight controller as a ByteLink, over UDP or a serial port."""

from __future__ import annotations

import contextlib
import select
import threading
import time
from collections import deque
from types import TracebackType
from typing import Self

from kiteline_hw.mavlink_out import MavlinkUdp, parse_mavlink_url
from kiteline_hw.mavlink_tunnel import TunnelConfig, TunnelCounters, TunnelEnd
from kiteline_hw.serial_port import SerialPort

_TICK_S = 0.01  # s between looks at the rate
_INBOX_PACKETS = 1024


class MavlinkTunnelLink:
    """A ByteLink. url: udp:HOST:PORT, udpin:HOST:PORT or serial:DEVICE:BAUD. Raises LinkError."""

    def __init__(self, url: str, config: TunnelConfig, *, required: bool = True) -> None:
        where = parse_mavlink_url(url)
        self._lock = threading.Lock()
        self._end = TunnelEnd(config)
        self._inbox: deque[bytes] = deque(maxlen=_INBOX_PACKETS)
        self._outbox: deque[bytes] = deque()
        self._closed = threading.Event()
        self._udp: MavlinkUdp | None = None
        self._serial: SerialPort | None = None
        if where.kind == "serial":
            self._serial = SerialPort(where.address, where.port, self._on_data, self._next_out, required=required)
        else:
            self._udp = MavlinkUdp(where)
        self._thread = threading.Thread(target=self._run, name="mavlink-tunnel", daemon=True)
        self._thread.start()

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

    def _on_data(self, data: bytes) -> None:
        with self._lock:
            self._inbox.extend(self._end.receive(data))

    def _next_out(self) -> bytes:
        return self._outbox.popleft() if self._outbox else b""

    def _run(self) -> None:
        while not self._closed.is_set():
            if self._udp is None:
                self._closed.wait(_TICK_S)
            else:
                with contextlib.suppress(OSError, ValueError):  # closed meanwhile
                    select.select([self._udp.socket], [], [], _TICK_S)
            with self._lock:
                if self._closed.is_set():
                    return
                while self._udp is not None and (data := self._udp.receive()) is not None:
                    self._inbox.extend(self._end.receive(data, datagram=True))
                messages = self._end.poll(time.monotonic_ns())
            for message in messages:
                if self._udp is not None:
                    self._udp.send(message)
                elif self._serial is not None and self._serial.connected:
                    self._outbox.append(message)
                    self._serial.wake()

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._closed.set()
        if self._serial is not None:
            self._serial.close()
        self._thread.join(1.0)
        if self._udp is not None:
            self._udp.socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
