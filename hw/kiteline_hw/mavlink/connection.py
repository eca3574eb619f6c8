"""A connection to a flight controller over UDP or a serial port that carries whole MAVLink messages. Never blocks."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from kiteline_hw.links.kinds import MAVLINK_FORMS
from kiteline_hw.ports import LinkError
from kiteline_hw.system.serial_port import SerialPort, parse_serial

_MAX_DATAGRAMS = 64  # read per tick; a flood must not keep messages from being sent
_DATAGRAM_BYTES = 2048  # larger than any MAVLink message


@dataclass(frozen=True, slots=True)
class MavlinkUrl:
    """Address of a flight controller. kind: "udpout", "udpin" or "serial"; port: UDP port or baud rate."""

    kind: str
    address: str
    port: int


def parse_mavlink_url(url: str) -> MavlinkUrl:
    """Parse udp:HOST:PORT, udpout:…, udpin:…, serial:DEVICE:BAUD. Raises LinkError."""
    kind, _, rest = url.partition(":")
    if kind == "serial":
        return MavlinkUrl("serial", *parse_serial(rest))
    host, _, port = rest.removeprefix("//").rpartition(":")
    if kind not in ("udp", "udpout", "udpin") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise LinkError(f"flight controller {url!r}: expected {MAVLINK_FORMS}")
    return MavlinkUrl("udpin" if kind == "udpin" else "udpout", host, int(port))


class MavlinkUdp:
    """A UDP socket that never blocks. Listening, it answers the last sender; else it receives from its target only."""

    def __init__(self, url: MavlinkUrl) -> None:
        try:
            info = socket.getaddrinfo(url.address, url.port, type=socket.SOCK_DGRAM)[0]
            self.socket = socket.socket(info[0], socket.SOCK_DGRAM)
        except OSError as error:
            raise LinkError(f"flight controller at {url.address}:{url.port}: {error}") from error
        self.socket.setblocking(False)
        self._host = info[4][0]
        self._listens = url.kind == "udpin"
        self._peer = None if self._listens else info[4]
        if self._listens:
            try:
                self.socket.bind(info[4])
            except OSError as error:
                self.socket.close()
                raise LinkError(
                    f"cannot listen on UDP {url.address}:{url.port}: {error}. Is another program using the port?"
                ) from error

    def send(self, message: bytes) -> bool:
        """Send one datagram; False if there is no peer or it could not be sent."""
        if self._peer is None:
            return False
        try:
            self.socket.sendto(message, self._peer)
        except OSError:  # no route, no listener or a full buffer: loss, not an error
            return False
        return True

    def receive(self) -> bytes | None:
        """A datagram of the peer, b"" for one of another sender, None if there is none."""
        try:
            data, sender = self.socket.recvfrom(_DATAGRAM_BYTES)
        except BlockingIOError:
            return None
        except OSError:  # an earlier datagram reached no listener
            return b""
        if self._listens:
            self._peer = sender
        elif sender[0] != self._host:
            return b""
        return data


class MavlinkConnection:
    """Sends messages, and calls back from a thread: `on_data` for received bytes, `on_tick` every `tick_s`.

    on_data: gets bytes, and whether they are one whole datagram. on_tick: is also called after each datagram. Both are
    called without any lock held. max_queued: messages waiting for a slow serial port, the oldest are dropped; 0: no
    limit.
    """

    def __init__(
        self, url: str, name: str, on_data: Callable[[bytes, bool], None], on_tick: Callable[[], None], tick_s: float,
        max_queued: int, *, required: bool,
    ) -> None:  # fmt: skip
        self._url, self._required = parse_mavlink_url(url), required
        self._on_data, self._on_tick, self._tick_s = on_data, on_tick, tick_s
        self._outbox: deque[bytes] = deque(maxlen=max_queued or None)
        self._closed = threading.Event()
        self._udp: MavlinkUdp | None = None
        self._serial: SerialPort | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Open the port and start the thread. Raises LinkError."""
        url = self._url
        if url.kind == "serial":
            self._serial = SerialPort(
                url.address, url.port, lambda data: self._on_data(data, False), self._next_out, required=self._required
            )
        else:
            self._udp = MavlinkUdp(url)
        self._thread.start()

    def send(self, message: bytes) -> bool:
        """Send or queue a message; False if it, or an older one in its place, is lost."""
        if self._udp is not None:
            return self._udp.send(message)
        if self._serial is None or not self._serial.connected:
            return False
        has_room = self._outbox.maxlen is None or len(self._outbox) < self._outbox.maxlen
        self._outbox.append(message)
        self._serial.wake()
        return has_room

    @property
    def device_fault(self) -> str:
        """Why the serial port is not open; "" if it is, or if there is none."""
        return "" if self._serial is None else self._serial.fault

    def _next_out(self) -> bytes:
        return self._outbox.popleft() if self._outbox else b""

    def _run(self) -> None:
        while not self._closed.is_set():
            if self._udp is None:
                self._closed.wait(self._tick_s)
            else:
                with contextlib.suppress(OSError, ValueError):  # closed by another thread
                    select.select([self._udp.socket], [], [], self._tick_s)
                for _ in range(_MAX_DATAGRAMS):
                    data = None if self._closed.is_set() else self._udp.receive()
                    if data is None:
                        break
                    self._on_data(data, True)
            if not self._closed.is_set():
                self._on_tick()

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._closed.set()
        if self._serial is not None:
            self._serial.close()
        if self._thread.is_alive():
            self._thread.join(1.0)
        if self._udp is not None:
            self._udp.socket.close()
