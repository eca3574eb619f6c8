"""A serial port in a thread of its own: exclusive, never blocking, reopened with back-off after a hang-up."""

import contextlib
import errno
import os
import select
import termios
import threading
from collections.abc import Callable

import serial

from kiteline_hw.ports import LinkError

_READ_BYTES = 4096  # bytes per read at most: a whole tty buffer
_FIRST_RETRY_S = 0.05  # s until the first attempt to reopen the port
_MAX_RETRY_S = 2.0  # s between attempts at most: a replugged adapter is found soon, a missing one costs no CPU
_IDLE_S = 0.5  # s that the thread sleeps at most

# pyserial raises TypeError and ValueError if its port vanishes during a call.
_ERRORS = (serial.SerialException, OSError, termios.error, ValueError, TypeError)

_UNPLUGGED = "the device is gone: unplugged, or without power"
_REASONS = {
    errno.ENOENT: "the device is missing",
    errno.ENODEV: _UNPLUGGED,
    errno.EACCES: "this user may not open the device",
    errno.EAGAIN: "another program uses the device",
    errno.EBUSY: "another program uses the device",
}


def _reason(error: BaseException) -> str:
    """Why a port could not be opened."""
    return _REASONS.get(getattr(error, "errno", None) or 0, f"the device cannot be opened ({error})")


def parse_serial(spec: str) -> tuple[str, int]:
    """Device and baud rate of DEVICE:BAUD. Raises LinkError."""
    device, colon, baud = spec.rpartition(":")
    if not colon or not device or not baud.isdecimal() or int(baud) == 0:
        raise LinkError(f"serial port {spec!r}: expected DEVICE:BAUD, for instance /dev/ttyUSB0:57600")
    return device, int(baud)


class SerialPort:
    """A thread that owns the port and calls `on_data` with received bytes and `next_out` for bytes to write (or b"").

    Call `wake` when there is something new to write. required: raise LinkError if the port cannot be opened now; else
    it is tried again in the background.
    """

    def __init__(
        self,
        device: str, baud: int, on_data: Callable[[bytes], None], next_out: Callable[[], bytes], *,
        required: bool = True,
    ) -> None:  # fmt: skip
        self._device = device
        self._baud = baud
        self._on_data = on_data
        self._next_out = next_out
        self._closed = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._unwritten = b""  # rest of the frame that is being written
        self.opened = 0
        self.callback_errors = 0
        self.connected = False
        self.fault = ""  # why the port is not open
        self._told_away = False
        port: serial.Serial | None = None
        try:
            port = self._open()
        except _ERRORS as error:
            self.fault = _reason(error)
            if required:
                self._close_pipe()
                raise LinkError(
                    f"cannot open serial port {device} at {baud} baud: {error}. Is it plugged in, used by another "
                    "program, or closed to this user (group dialout)?"
                ) from error
        self._thread = threading.Thread(target=self._run, args=(port,), name="serial", daemon=True)
        self._thread.start()

    def _open(self) -> serial.Serial:
        port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0, exclusive=True)
        self.opened += 1
        self.connected = True
        self.fault = ""
        return port

    def take_messages(self) -> list[str]:
        """That the port is away, with the reason, or back, once each; from one thread."""
        fault = "" if self.connected else self.fault
        if bool(fault) == self._told_away:
            return []
        self._told_away = bool(fault)
        return [
            f"serial port {self._device}: {fault}; it is tried again"
            if fault
            else f"serial port {self._device} is back"
        ]

    def wake(self) -> None:
        """Make the thread call `next_out`. Never blocks; from any thread."""
        with contextlib.suppress(OSError):  # a full pipe wakes the thread anyway; a closed one has no thread
            os.write(self._wake_write, b"\0")

    def _run(self, port: serial.Serial | None) -> None:
        retry_s = _FIRST_RETRY_S
        while not self._closed.is_set():
            if port is None:
                try:
                    port = self._open()
                    retry_s = _FIRST_RETRY_S
                except _ERRORS as error:
                    self.fault = _reason(error)
                    self._closed.wait(retry_s)
                    retry_s = min(2.0 * retry_s, _MAX_RETRY_S)
                    continue
            try:
                self._exchange(port)
            except _ERRORS:
                self.fault = _UNPLUGGED
                self._hang_up(port)
                port = None
                self._closed.wait(retry_s)
        if port is not None:
            self._hang_up(port)

    def _exchange(self, port: serial.Serial) -> None:
        """Wait until the port can be read or written, and do so. A hang-up raises SerialException or OSError."""
        if not self._unwritten:
            self._unwritten = self._get_next()
        fd = port.fileno()
        readable, writable, _ = select.select([fd, self._wake_read], [fd] if self._unwritten else [], [], _IDLE_S)
        if self._wake_read in readable:
            os.read(self._wake_read, _READ_BYTES)
        if fd in readable:
            with contextlib.suppress(BlockingIOError):
                data = os.read(fd, _READ_BYTES)  # pyserial's own read waits for the port once more
                if not data:
                    raise OSError(errno.ENODEV, _UNPLUGGED)
                self._hand_over(data)
        if fd in writable:
            try:
                written = port.write(self._unwritten)
            except serial.SerialTimeoutException:
                written = 0
            self._unwritten = self._unwritten[written or 0 :]

    def _get_next(self) -> bytes:
        try:
            return self._next_out()
        except Exception:
            self.callback_errors += 1
            return b""

    def _hand_over(self, data: bytes) -> None:
        try:
            self._on_data(data)
        except Exception:
            self.callback_errors += 1

    def _hang_up(self, port: serial.Serial) -> None:
        self.connected = False
        self._unwritten = b""
        with contextlib.suppress(*_ERRORS):
            port.close()

    def close(self) -> None:
        """Close the port, within a second. May be called twice."""
        if self._closed.is_set():
            return
        self._closed.set()
        self.wake()
        self._thread.join(1.0)
        if not self._thread.is_alive():
            self._close_pipe()

    def _close_pipe(self) -> None:
        os.close(self._wake_read)
        os.close(self._wake_write)
