"""Poses to a flight controller over UDP or a serial port."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from kiteline_core.se3 import F64
from kiteline_hw.mavlink_messages import Heartbeat, MavlinkCodec, Signing
from kiteline_hw.odometry_stream import OdometryConfig, OdometryCounters, OdometryStream
from kiteline_hw.ports import Clock, LinkError, PoseSample
from kiteline_hw.serial_port import SerialPort, parse_serial

MAVLINK_FORMS = "udp:HOST:PORT (send to), udpin:HOST:PORT (listen), serial:DEVICE:BAUD"
_TICK_S = 0.1  # s between looks at the heartbeat's time
_OUTBOX = 8  # messages that wait for a slow serial port; the oldest are dropped, a pose is worth little when late
_DATAGRAMS_A_TURN = 64  # datagrams; a flood must not keep poses from being sent
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


class MavlinkPoseSink:
    """A PoseSink that speaks MAVLink. Its thread sends heartbeats and answers TIMESYNC at once, from the same clock.

    url: see MAVLINK_FORMS. T_b_f: (4,4) mounting, see mavlink_frames. clock: the one that stamps poses. Raises
    LinkError.
    """

    def __init__(
        self,
        url: str,
        T_b_f: F64,
        clock: Clock,
        *,
        config: OdometryConfig | None = None,
        system: int = 1,
        signing: Signing | None = None,
        required: bool = True,
    ) -> None:
        where = parse_mavlink_url(url)
        self._clock = clock
        self._lock = threading.Lock()
        self._stream = OdometryStream(T_b_f, config, MavlinkCodec(system, signing=signing))
        self._outbox: deque[bytes] = deque(maxlen=_OUTBOX)
        self._closed = threading.Event()
        self.refused = 0  # messages that nobody took
        self._udp: MavlinkUdp | None = None
        self._serial: SerialPort | None = None
        if where.kind == "serial":
            self._serial = SerialPort(where.address, where.port, self._on_serial, self._next_out, required=required)
        else:
            self._udp = MavlinkUdp(where)
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self._thread.start()

    def push(self, pose: PoseSample, now_ns: int) -> None:
        """Send a pose if it is its turn. Never blocks."""
        with self._lock:
            self._send(self._stream.step(pose, now_ns))

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            if self._udp is not None:
                self.refused += not self._udp.send(message)
            elif self._serial is not None:
                self.refused += not self._serial.connected or len(self._outbox) == _OUTBOX
                self._outbox.append(message)
                self._serial.wake()

    def _next_out(self) -> bytes:
        return self._outbox.popleft() if self._outbox else b""

    def _on_serial(self, data: bytes) -> None:
        with self._lock:
            self._send(self._stream.receive(data, self._clock.now_ns()))

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
                for _ in range(_DATAGRAMS_A_TURN):
                    data = None if self._udp is None else self._udp.receive()
                    if data is None:
                        break
                    self._send(self._stream.receive(data, self._clock.now_ns(), datagram=True))
                self._send(self._stream.step(None, self._clock.now_ns()))

    @property
    def counters(self) -> OdometryCounters:
        """What was sent and why poses were not."""
        return self._stream.counters

    def autopilot(self) -> Heartbeat | None:
        """The flight controller at the other end, or None while it is silent."""
        with self._lock:
            return self._stream.autopilot(self._clock.now_ns())

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
