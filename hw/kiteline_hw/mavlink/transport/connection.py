"""A connection to a flight controller over UDP, TCP or a serial port that carries MAVLink messages. Never blocks."""

import contextlib
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from kiteline_hw.mavlink.transport.sockets import MavlinkTcp, MavlinkUdp
from kiteline_hw.mavlink.transport.url import MavlinkUrl
from kiteline_hw.system.serial_port import SerialPort

_MAX_READS = 64  # of a TCP stream per tick; a flood must not keep messages from being sent

Adopt = Callable[[], None]


class MavlinkConnection:
    """Sends messages, and calls back from a thread: `on_data` for received bytes, `on_tick` every `tick_s`.

    on_data: gets bytes, whether they are one whole datagram or the first after a gap, and, of a sender that is not
    served yet, a function that serves it from now on. Both are called without any lock held; what one of them raises is
    counted, and the first is printed: a message that is not understood must not end the others. max_queued: messages
    waiting for a slow serial port, the oldest are dropped; 0: no limit.
    """

    def __init__(
        self, url: MavlinkUrl, name: str, on_data: Callable[[bytes, bool, Adopt | None], None],
        on_tick: Callable[[], None], tick_s: float, max_queued: int, *, required: bool,
    ) -> None:  # fmt: skip
        self._url, self._required = url, required
        self._on_data, self._on_tick, self._tick_s = on_data, on_tick, tick_s
        self._outbox: deque[bytes] = deque(maxlen=max_queued or None)
        self.callback_errors = 0
        self._closed = threading.Event()
        self._udp: MavlinkUdp | None = None
        self._tcp: MavlinkTcp | None = None
        self._serial: SerialPort | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Open the port and start the thread. Raises LinkError."""
        url = self._url
        if url.kind == "serial":
            self._serial = SerialPort(
                url.address, url.port, lambda data: self._on_data(data, False, None), self._next_out,
                required=self._required,
            )  # fmt: skip
        elif url.kind == "tcp":
            self._tcp = MavlinkTcp(url, required=self._required)
        else:
            self._udp = MavlinkUdp(url, self._tick_s)
        self._thread.start()

    def send(self, message: bytes) -> bool:
        """Send or queue a message; False if it, or an older one in its place, is lost."""
        if self._udp is not None:
            return self._udp.send(message)
        if self._tcp is not None:
            return self._tcp.send(message)
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

    def take_messages(self) -> list[str]:
        """That the serial port is away or back, once each."""
        return [] if self._serial is None else self._serial.take_messages()

    def _next_out(self) -> bytes:
        return self._outbox.popleft() if self._outbox else b""

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._closed.is_set():
            with contextlib.suppress(OSError, ValueError):  # closed by another thread
                if self._udp is not None:
                    self._serve_udp(self._udp, due_s)
                elif self._tcp is not None:
                    self._serve_tcp(self._tcp)
                else:
                    self._closed.wait(self._tick_s)
            now_s = time.monotonic()
            if now_s >= due_s and not self._closed.is_set():
                due_s = now_s + self._tick_s
                self._call(self._on_tick)

    def _call(self, callback: Callable[..., None], *arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception:
            self.callback_errors += 1
            if self.callback_errors == 1:
                traceback.print_exc()

    def _serve_udp(self, udp: MavlinkUdp, due_s: float) -> None:
        """Take datagrams until the next tick. Little is done for each: 200 a second come, to cold caches."""
        while True:
            received = udp.receive()
            if self._closed.is_set():
                return
            if received is not None and received[0]:
                data, stranger = received
                self._call(self._on_data, data, True, None if stranger is None else partial(udp.adopt, stranger))
            if time.monotonic() >= due_s:
                return

    def _serve_tcp(self, tcp: MavlinkTcp) -> None:
        if tcp.wait(self._tick_s):
            self._call(self._on_data, b"", True, None)
        for _ in range(_MAX_READS):
            data = None if self._closed.is_set() else tcp.receive()
            if data is None:
                return
            self._call(self._on_data, data, False, None)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._closed.set()
        if self._serial is not None:
            self._serial.close()
        if self._thread.is_alive():
            self._thread.join(1.0)
        for end in (self._udp, self._tcp):
            if end is not None:
                end.close()
