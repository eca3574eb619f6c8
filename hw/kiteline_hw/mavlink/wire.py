"""A wire to a flight controller, over UDP or a serial port, that speaks whole MAVLink messages and never blocks."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from kiteline_hw.ports import LinkError
from kiteline_hw.system.serial_port import SerialPort, parse_serial

MAVLINK_FORMS = "udp:HOST:PORT (send to), udpin:HOST:PORT (listen), serial:DEVICE:BAUD"
_DATAGRAMS_A_TURN = 64  # datagrams; a flood must not keep messages from being sent
_DATAGRAM_BYTES = 2048  # bytes; larger than any MAVLink message


@dataclass(frozen=True, slots=True)
class MavlinkUrl:
    """Where a flight controller is. kind: "udpout", "udpin" or "serial"; port: UDP port or baud rate."""

    kind: str
    address: str
    port: int


def parse_mavlink_url(url: str) -> MavlinkUrl:
    """Understand udp:HOST:PORT, udpout:…, udpin:…, serial:DEVICE:BAUD. Raises LinkError."""
    kind, _, rest = url.partition(":")
    if kind == "serial":
        device, baud = parse_serial(rest)
        return MavlinkUrl("serial", device, baud)
    host, _, port = rest.removeprefix("//").rpartition(":")
    if kind not in ("udp", "udpout", "udpin") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise LinkError(f"flight controller {url!r}: expected {MAVLINK_FORMS}")
    return MavlinkUrl("udpin" if kind == "udpin" else "udpout", host, int(port))


class MavlinkUdp:
    """A UDP socket that never blocks. Listening, it answers whoever last spoke; else it hears its target only."""

    def __init__(self, url: MavlinkUrl) -> None:
        try:
            info = socket.getaddrinfo(url.address, url.port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(info[0], socket.SOCK_DGRAM)
        except OSError as error:
            raise LinkError(f"flight controller at {url.address}:{url.port}: {error}") from error
        self._socket.setblocking(False)
        self._host = info[4][0]
        self._peer = None if url.kind == "udpin" else info[4]
        self._listens = url.kind == "udpin"
        if self._listens:
            try:
                self._socket.bind(info[4])
            except OSError as error:
                self._socket.close()
                raise LinkError(
                    f"cannot listen on UDP {url.address}:{url.port}: {error}. Is another program using the port?"
                ) from error

    @property
    def socket(self) -> socket.socket:
        return self._socket

    def send(self, message: bytes) -> bool:
        if self._peer is None:
            return False
        try:
            self._socket.sendto(message, self._peer)
        except OSError:  # no route, nobody listens, buffer full: that is how links are
            return False
        return True

    def receive(self) -> bytes | None:
        """A datagram of the peer, b"" for one of somebody else, None when there is none."""
        try:
            data, sender = self._socket.recvfrom(_DATAGRAM_BYTES)
        except BlockingIOError:
            return None
        except OSError:  # an earlier datagram found nobody
            return b""
        if self._listens:
            self._peer = sender
        elif sender[0] != self._host:
            return b""
        return data


class MavlinkWire:
    """Sends messages and hands out what comes, with a thread that calls `turn` every `tick_s` and whenever a datagram
    came.

    on_data: gets bytes, and whether they are one whole datagram; called in a thread, outside of any lock. turn: called
    with nothing. queued: messages that wait for a slow serial port at most, the oldest are dropped; 0: any number.
    Raises LinkError.
    """

    def __init__(
        self, url: str, name: str, on_data: Callable[[bytes, bool], None], turn: Callable[[], None], tick_s: float,
        queued: int, *, required: bool,
    ) -> None:  # fmt: skip
        self._where, self._required = parse_mavlink_url(url), required
        self._on_data, self._turn, self._tick_s = on_data, turn, tick_s
        self._outbox: deque[bytes] = deque(maxlen=queued or None)
        self._closed = threading.Event()
        self._udp: MavlinkUdp | None = None
        self._serial: SerialPort | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Open it, begin to listen and to call `turn`. Raises LinkError."""
        where = self._where
        if where.kind == "serial":
            self._serial = SerialPort(
                where.address, where.port, lambda data: self._on_data(data, False), self._next_out,
                required=self._required,
            )  # fmt: skip
        else:
            self._udp = MavlinkUdp(where)
        self._thread.start()

    def send(self, message: bytes) -> bool:
        """Whether somebody may get this message."""
        if self._udp is not None:
            return self._udp.send(message)
        if self._serial is None or not self._serial.connected:
            return False
        room = self._outbox.maxlen is None or len(self._outbox) < self._outbox.maxlen
        self._outbox.append(message)
        self._serial.wake()
        return room

    def _next_out(self) -> bytes:
        return self._outbox.popleft() if self._outbox else b""

    def _run(self) -> None:
        while not self._closed.is_set():
            if self._udp is None:
                self._closed.wait(self._tick_s)
            else:
                with contextlib.suppress(OSError, ValueError):  # closed meanwhile
                    select.select([self._udp.socket], [], [], self._tick_s)
                for _ in range(_DATAGRAMS_A_TURN):
                    data = None if self._closed.is_set() else self._udp.receive()
                    if data is None:
                        break
                    self._on_data(data, True)
            if not self._closed.is_set():
                self._turn()

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._closed.set()
        if self._serial is not None:
            self._serial.close()
        if self._thread.is_alive():
            self._thread.join(1.0)
        if self._udp is not None:
            self._udp.socket.close()
