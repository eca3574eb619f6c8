"""A modelled V4L2 camera behind the system calls that drive a real one, with faults to be injected.

It keeps the driver's rules: a queue of mapped buffers, sequence numbers that count lost images too, monotonic stamps,
errors by number. `device.unplug()`, `plug()`, `silence()`, `garbage()`, `lose(n)` do what happens in the field.
"""

import ctypes
import errno
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from kiteline_hw.cameras import v4l2_api as api

_SLOT_BYTES = 1 << 24  # between the mapping offsets of two buffers


class _Mapped(bytearray):
    """A buffer's memory."""

    def close(self) -> None:
        """Memory of a model needs no unmapping."""


@dataclass
class ModelDevice:
    """One camera node. image(k) gives the bytes of the k-th image in the chosen pixel format.

    formats: pixel formats with the sizes offered in each. fps: Hz. delay_s: from the stamp to the driver's delivery.
    offset_s: of the stamps against another device of the same clock. controls: (least, most, value) by number.
    """

    image: Callable[[int], bytes]
    formats: dict[str, list[tuple[int, int]]]
    fps: float = 20.0
    delay_s: float = 0.004
    offset_s: float = 0.0
    monotonic: bool = True
    capabilities: int = api.CAP_VIDEO_CAPTURE | api.CAP_STREAMING
    row_padding: int = 0
    most_buffers: int = 32
    controls: dict[int, list[int]] = field(default_factory=dict)
    open_error: int = 0  # errno of open; 0: none
    openings: int = 0
    plugged: bool = True
    silent: bool = False
    bad: bool = False
    losing: int = 0
    damaged: int = 0
    layout: api.PixFormat = field(default_factory=api.PixFormat)
    streaming: bool = False
    maps: list[_Mapped] = field(default_factory=list)
    queued: deque[int] = field(default_factory=deque)
    begin_ns: int = 0
    next_image: int = 0
    sequence: int = 0
    lost: int = 0  # images for which no buffer was free
    delivered: int = 0
    in_use: bool = False

    def unplug(self) -> None:
        """Pull the cable: every call fails until `plug`."""
        self.plugged = False

    def plug(self) -> None:
        """Plug it in again; streaming has to begin anew."""
        self.streaming, self.in_use, self.plugged = False, False, True

    def silence(self, on: bool = True) -> None:
        """Send no images, as a camera whose trigger stands still."""
        self.silent = on

    def garbage(self, on: bool = True) -> None:
        """Send bytes that are no image."""
        self.bad = on

    def lose(self, images: int) -> None:
        """Lose images in the driver: their numbers are missing."""
        self.losing += images

    def due_ns(self) -> int:
        """When the next image is delivered."""
        return self.begin_ns + round((self.next_image / self.fps + self.delay_s + self.offset_s) * 1e9)


class ModelKernel:
    """The system calls on modelled devices, by path."""

    def __init__(self, devices: dict[str, ModelDevice]) -> None:
        self.devices = devices
        self._open: dict[int, ModelDevice] = {}
        self._next_fd = 1000
        self._lock = threading.RLock()

    def open(self, path: str) -> int:
        with self._lock:
            device = self.devices.get(path)
            if device is None or not device.plugged:
                raise OSError(errno.ENOENT, "No such file or directory")
            if device.open_error:
                raise OSError(device.open_error, "modelled")
            if device.in_use:
                raise OSError(errno.EBUSY, "Device or resource busy")
            device.in_use = True
            device.openings += 1
            self._next_fd += 1
            self._open[self._next_fd] = device
            return self._next_fd

    def close(self, fd: int) -> None:
        with self._lock:
            device = self._open.pop(fd)
            device.streaming = device.in_use = False

    def map(self, fd: int, length: int, offset: int) -> Any:
        device = self._device(fd)
        assert length == len(device.maps[offset // _SLOT_BYTES])
        return device.maps[offset // _SLOT_BYTES]

    def wait(self, fd: int, seconds: float) -> bool:
        end_ns = time.monotonic_ns() + round(seconds * 1e9)
        while True:
            with self._lock:
                device = self._open[fd]
                if not device.plugged:
                    return True
                now_ns = time.monotonic_ns()
                self._fill(device, now_ns)
                ready = device.streaming and not device.silent and device.due_ns() <= now_ns and bool(device.queued)
                due_ns = device.due_ns() if device.streaming and not device.silent else end_ns
            if ready:
                return True
            if now_ns >= end_ns:
                return False
            time.sleep(max(1e-4, (min(due_ns, end_ns, now_ns + 10_000_000) - now_ns) / 1e9))

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        with self._lock:
            handler = _HANDLERS.get(request)
            if handler is None:
                raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
            handler(self, self._device(fd), argument)

    def _device(self, fd: int) -> ModelDevice:
        device = self._open[fd]
        if not device.plugged:
            raise OSError(errno.ENODEV, "No such device")
        return device

    def _fill(self, d: ModelDevice, now_ns: int) -> None:
        """Let pass what a driver would have lost: images that found all buffers full, or that a fault took."""
        period_ns = round(1e9 / d.fps)
        if not d.streaming:
            return
        while d.silent and d.due_ns() <= now_ns:  # a trigger that stands still numbers nothing
            d.next_image += 1
        while d.losing and d.due_ns() <= now_ns:
            d.next_image += 1
            d.sequence += 1
            d.losing -= 1
        while d.due_ns() + period_ns * max(1, len(d.queued)) <= now_ns:
            d.next_image += 1
            d.sequence += 1
            d.lost += 1

    # One method for each call

    def _capability(self, d: ModelDevice, a: api.Capability) -> None:
        a.driver, a.card = b"model", b"modelled camera"
        a.capabilities, a.device_caps = d.capabilities | api.CAP_DEVICE_CAPS, d.capabilities

    def _describe(self, d: ModelDevice, a: api.FormatDescription) -> None:
        a.pixelformat = api.fourcc(list(d.formats)[_index(a.index, d.formats)])

    def _size(self, d: ModelDevice, a: api.FrameSize) -> None:
        sizes = d.formats.get(api.fourcc_text(a.pixel_format), [])
        a.type = api.DISCRETE
        a.values[0], a.values[1] = sizes[_index(a.index, sizes)]

    def _interval(self, d: ModelDevice, a: api.FrameInterval) -> None:
        _index(a.index, (0,))
        a.type, a.values[0], a.values[1] = api.DISCRETE, 1000, round(1000 * d.fps)

    def _format(self, d: ModelDevice, a: api.Format) -> None:
        pix = a.fmt.pix
        name = api.fourcc_text(pix.pixelformat)
        name = name if name in d.formats else next(iter(d.formats))
        sizes = d.formats[name]
        asked = (pix.width, pix.height)
        pix.width, pix.height = asked if asked in sizes else sizes[0]
        pix.pixelformat = api.fourcc(name)
        pix.bytesperline = pix.width * (2 if name in ("YUYV", "UYVY") else 1) + d.row_padding
        pix.sizeimage = pix.bytesperline * pix.height * 2
        d.layout = api.PixFormat.from_buffer_copy(pix)

    def _rate(self, d: ModelDevice, a: api.StreamParameters) -> None:
        a.numerator, a.denominator = 1000, round(1000 * d.fps)

    def _query(self, d: ModelDevice, a: api.ControlQuery) -> None:
        if a.id not in d.controls:
            raise OSError(errno.EINVAL, "Invalid argument")
        a.minimum, a.maximum = d.controls[a.id][:2]

    def _set(self, d: ModelDevice, a: api.Control) -> None:
        least, most, _ = d.controls[a.id]
        if not least <= a.value <= most:
            raise OSError(errno.ERANGE, "Numerical result out of range")
        d.controls[a.id][2] = a.value

    def _get(self, d: ModelDevice, a: api.Control) -> None:
        a.value = d.controls[a.id][2]

    def _request(self, d: ModelDevice, a: api.RequestBuffers) -> None:
        a.count = min(a.count, d.most_buffers)
        d.maps = [_Mapped(d.layout.sizeimage) for _ in range(a.count)]
        d.queued = deque()

    def _buffer(self, d: ModelDevice, a: api.Buffer) -> None:
        a.length, a.m.offset = d.layout.sizeimage, a.index * _SLOT_BYTES

    def _queue(self, d: ModelDevice, a: api.Buffer) -> None:
        if a.index in d.queued or a.index >= len(d.maps):
            raise OSError(errno.EINVAL, "Invalid argument")
        d.queued.append(a.index)

    def _dequeue(self, d: ModelDevice, a: api.Buffer) -> None:
        now_ns = time.monotonic_ns()
        self._fill(d, now_ns)
        if d.silent or not d.streaming or d.due_ns() > now_ns or not d.queued:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        data = b"\x00garbage" if d.bad else d.image(d.next_image)
        a.index = d.queued.popleft()
        d.maps[a.index][: len(data)] = data
        a.bytesused, a.sequence = len(data), d.sequence
        a.flags = (api.FLAG_STAMP_MONOTONIC if d.monotonic else 0) | (api.FLAG_ERROR if d.damaged else 0)
        d.damaged = max(0, d.damaged - 1)
        stamp_ns = d.due_ns() - round(d.delay_s * 1e9)
        a.timestamp.seconds, a.timestamp.microseconds = divmod(stamp_ns // 1000, 1_000_000)
        d.next_image += 1
        d.sequence += 1
        d.delivered += 1

    def _on(self, d: ModelDevice, a: ctypes.c_int) -> None:
        d.streaming, d.sequence, d.next_image = True, 0, d.next_image + 1
        # Images keep their rhythm and their order through a replug.
        if not d.begin_ns:
            d.begin_ns, d.next_image = time.monotonic_ns(), 0
        else:
            passed = (time.monotonic_ns() - d.begin_ns) / 1e9 * d.fps
            d.next_image = max(d.next_image, int(passed) + 1)

    def _off(self, d: ModelDevice, a: ctypes.c_int) -> None:
        d.streaming = False
        d.queued.clear()


def _index(index: int, items: Any) -> int:
    if index >= len(items):
        raise OSError(errno.EINVAL, "Invalid argument")
    return index


_HANDLERS: dict[int, Callable[[ModelKernel, ModelDevice, Any], None]] = {
    api.QUERYCAP: ModelKernel._capability, api.ENUM_FMT: ModelKernel._describe,
    api.ENUM_FRAMESIZES: ModelKernel._size, api.ENUM_FRAMEINTERVALS: ModelKernel._interval,
    api.S_FMT: ModelKernel._format, api.S_PARM: ModelKernel._rate, api.QUERYCTRL: ModelKernel._query,
    api.S_CTRL: ModelKernel._set, api.G_CTRL: ModelKernel._get, api.REQBUFS: ModelKernel._request,
    api.QUERYBUF: ModelKernel._buffer, api.QBUF: ModelKernel._queue, api.DQBUF: ModelKernel._dequeue,
    api.STREAMON: ModelKernel._on, api.STREAMOFF: ModelKernel._off,
}  # fmt: skip
