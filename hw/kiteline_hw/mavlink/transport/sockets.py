"""UDP and TCP sockets of a flight controller. Sending never blocks; receiving waits for a while at most."""

import contextlib
import errno
import select
import socket
import struct
import threading
import time
from typing import Any

from kiteline_hw.mavlink.transport.url import MavlinkUrl
from kiteline_hw.ports import LinkError

_DATAGRAM_BYTES = 2048  # larger than any MAVLink message
_READ_BYTES = 4096
_SILENT_S = 5.0  # s of silence after which the peer's host may speak from another port: a program was restarted
_UNSENT_BYTES = 4096  # bytes that may wait for a slow TCP peer; a later pose is worth more than an old one
_CONNECT_S = 2.0  # s that a first connection may take
_FIRST_RETRY_S, _MAX_RETRY_S = 0.1, 2.0  # s between attempts to connect


class MavlinkUdp:
    """A UDP socket. It exchanges datagrams with one peer: the configured address or, listening, the one adopted.

    wait_s: how long `receive` waits. The kernel waits, in the call that reads: at 200 datagrams a second a second call
    for each would cost as much again.
    """

    def __init__(self, url: MavlinkUrl, wait_s: float) -> None:
        try:
            info = socket.getaddrinfo(url.address, url.port, type=socket.SOCK_DGRAM)[0]
            self.socket = socket.socket(info[0], socket.SOCK_DGRAM)
        except OSError as error:
            raise LinkError(f"flight controller at {url.address}:{url.port}: {error}") from error
        wait_us = max(1, round(wait_s * 1e6))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", *divmod(wait_us, 1_000_000)))
        self._listens = url.kind == "udpin"
        self._peer: Any = None if self._listens else info[4]
        self._heard_s = 0.0
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
            self.socket.sendto(message, socket.MSG_DONTWAIT, self._peer)
        except OSError:  # no route, no listener or a full buffer: loss, not an error
            return False
        return True

    def receive(self) -> tuple[bytes, Any] | None:
        """A datagram with None, or with the address of a sender that may be adopted; None if none came in time.

        A datagram of any other sender is returned empty.
        """
        try:
            data, sender = self.socket.recvfrom(_DATAGRAM_BYTES)
        except BlockingIOError:
            return None
        except OSError:  # an earlier datagram reached no listener
            return b"", None
        now_s = time.monotonic()
        peer = self._peer
        if sender == peer or (peer is not None and sender[:2] == peer[:2]):
            self._heard_s = now_s
            return data, None
        moved = peer is not None and sender[0] == peer[0] and now_s - self._heard_s > _SILENT_S
        return (data, sender) if self._listens and (peer is None or moved) else (b"", None)

    def adopt(self, sender: Any) -> None:
        """Serve this address from now on."""
        self._peer, self._heard_s = sender, time.monotonic()

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


class MavlinkTcp:
    """A TCP client that connects again with back-off. `wait` and `receive` are called from one thread."""

    def __init__(self, url: MavlinkUrl, *, required: bool) -> None:
        self._url = url
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._connected = False
        self._unsent = b""
        self._retry_s, self._next_s = _FIRST_RETRY_S, 0.0
        self._deadline_s = 0.0
        if required:
            try:
                sock = socket.create_connection((url.address, url.port), _CONNECT_S)
            except OSError as error:
                raise LinkError(
                    f"cannot connect to TCP {url.address}:{url.port}: {error}. Does the flight controller listen there?"
                ) from error
            self._take(sock, connected=True)

    def _take(self, sock: socket.socket, *, connected: bool) -> None:
        sock.setblocking(False)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._connected = sock, connected
        self._deadline_s = time.monotonic() + _CONNECT_S

    def wait(self, seconds: float) -> bool:
        """Wait until there is something to read, at most so long; True if a connection was made meanwhile."""
        if self._socket is None:
            self._dial(seconds)
            return False
        writes = not self._connected or bool(self._unsent)
        fd = [self._socket]
        _, writable, _ = select.select(fd if self._connected else [], fd if writes else [], [], seconds)
        if self._connected:
            with self._lock:
                self._flush()
            return False
        if writable:
            if self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0:
                self._connected, self._retry_s = True, _FIRST_RETRY_S
                return True
            self._hang_up()
        elif time.monotonic() > self._deadline_s:
            self._hang_up()
        return False

    def _dial(self, seconds: float) -> None:
        now_s = time.monotonic()
        if now_s < self._next_s:
            time.sleep(min(seconds, self._next_s - now_s))
            return
        self._next_s = now_s + self._retry_s
        self._retry_s = min(2.0 * self._retry_s, _MAX_RETRY_S)
        try:
            info = socket.getaddrinfo(self._url.address, self._url.port, type=socket.SOCK_STREAM)[0]
            sock = socket.socket(info[0], socket.SOCK_STREAM)
            self._take(sock, connected=False)
            if sock.connect_ex(info[4]) not in (0, errno.EINPROGRESS):
                self._hang_up()
        except OSError:
            self._hang_up()

    def send(self, message: bytes) -> bool:
        """Send a message; False if there is no connection, or too much waits for it."""
        with self._lock:
            if not self._connected or len(self._unsent) > _UNSENT_BYTES:
                return False
            self._unsent += message
            self._flush()
        return True

    def _flush(self) -> None:
        if self._unsent and self._socket is not None:
            with contextlib.suppress(OSError):  # a full buffer; a broken connection is noticed by the reader
                self._unsent = self._unsent[self._socket.send(self._unsent) :]

    def receive(self) -> bytes | None:
        """Bytes of the stream; None if there are none."""
        if self._socket is None or not self._connected:
            return None
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self._hang_up()
            return None
        return data

    def _hang_up(self) -> None:
        with self._lock:
            if self._socket is not None:
                self._socket.close()
            self._socket, self._connected, self._unsent = None, False, b""
            self._next_s = time.monotonic() + self._retry_s

    def close(self) -> None:
        """Close the connection."""
        self._hang_up()
