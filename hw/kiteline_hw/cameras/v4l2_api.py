"""The part of Linux's video capture interface (linux/videodev2.h) that a camera needs: structures, numbers, calls.

64-bit machines only. Source: the kernel's documentation, "Video for Linux API".
"""

import ctypes
import fcntl
import mmap
import os
import select
from typing import Any, Protocol

U32 = ctypes.c_uint32
CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP = 1  # V4L2_MEMORY_MMAP
ANY_FIELD = 0

CAP_VIDEO_CAPTURE, CAP_STREAMING, CAP_DEVICE_CAPS = 0x1, 0x04000000, 0x80000000
FLAG_ERROR = 0x40
FLAG_STAMP_MASK, FLAG_STAMP_MONOTONIC = 0xE000, 0x2000
DISCRETE = 1  # kind of an enumerated frame size or interval

AUTO_GAIN, GAIN, ANALOGUE_GAIN = 0x00980912, 0x00980913, 0x009E0903
EXPOSURE_AUTO, EXPOSURE_100US, EXPOSURE_CHANGES_RATE = 0x009A0901, 0x009A0902, 0x009A0903
EXPOSURE_MANUAL = 1  # value of EXPOSURE_AUTO


class Capability(ctypes.Structure):
    _fields_ = (
        ("driver", ctypes.c_char * 16), ("card", ctypes.c_char * 32), ("bus_info", ctypes.c_char * 32),
        ("version", U32), ("capabilities", U32), ("device_caps", U32), ("reserved", U32 * 3),
    )  # fmt: skip


class PixFormat(ctypes.Structure):
    _fields_ = (
        ("width", U32), ("height", U32), ("pixelformat", U32), ("field", U32), ("bytesperline", U32),
        ("sizeimage", U32), ("colorspace", U32), ("priv", U32), ("flags", U32), ("ycbcr_enc", U32),
        ("quantization", U32), ("xfer_func", U32),
    )  # fmt: skip


class _FormatUnion(ctypes.Union):
    _fields_ = (("pix", PixFormat), ("raw", ctypes.c_uint8 * 200), ("pointer", ctypes.c_void_p))


class Format(ctypes.Structure):
    _fields_ = (("type", U32), ("fmt", _FormatUnion))


class RequestBuffers(ctypes.Structure):
    _fields_ = (("count", U32), ("type", U32), ("memory", U32), ("capabilities", U32), ("reserved", U32))


class _TimeVal(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


class _Memory(ctypes.Union):
    _fields_ = (("offset", U32), ("pointer", ctypes.c_ulong))


class Buffer(ctypes.Structure):
    _fields_ = (
        ("index", U32), ("type", U32), ("bytesused", U32), ("flags", U32), ("field", U32), ("timestamp", _TimeVal),
        ("timecode", U32 * 4), ("sequence", U32), ("memory", U32), ("m", _Memory), ("length", U32),
        ("reserved2", U32), ("request_fd", ctypes.c_int32),
    )  # fmt: skip


class StreamParameters(ctypes.Structure):
    _fields_ = (
        ("type", U32), ("capability", U32), ("capturemode", U32), ("numerator", U32), ("denominator", U32),
        ("rest", ctypes.c_uint8 * 184),
    )  # fmt: skip


class FormatDescription(ctypes.Structure):
    _fields_ = (
        ("index", U32), ("type", U32), ("flags", U32), ("description", ctypes.c_char * 32), ("pixelformat", U32),
        ("reserved", U32 * 4),
    )  # fmt: skip


class FrameSize(ctypes.Structure):
    """values: width and height if DISCRETE, else least, most and step of each."""

    _fields_ = (
        ("index", U32), ("pixel_format", U32), ("type", U32), ("values", U32 * 6), ("reserved", U32 * 2),
    )  # fmt: skip


class FrameInterval(ctypes.Structure):
    """values: seconds as numerator, denominator if DISCRETE, else least, most and step of them."""

    _fields_ = (
        ("index", U32), ("pixel_format", U32), ("width", U32), ("height", U32), ("type", U32), ("values", U32 * 6),
        ("reserved", U32 * 2),
    )  # fmt: skip


class Control(ctypes.Structure):
    _fields_ = (("id", U32), ("value", ctypes.c_int32))


class ControlQuery(ctypes.Structure):
    _fields_ = (
        ("id", U32), ("type", U32), ("name", ctypes.c_char * 32), ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32), ("step", ctypes.c_int32), ("default_value", ctypes.c_int32), ("flags", U32),
        ("reserved", U32 * 2),
    )  # fmt: skip


_READ, _WRITE = 2, 1


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, ctypes.sizeof(Capability))
ENUM_FMT = _request(_READ | _WRITE, 2, ctypes.sizeof(FormatDescription))
S_FMT = _request(_READ | _WRITE, 5, ctypes.sizeof(Format))
REQBUFS = _request(_READ | _WRITE, 8, ctypes.sizeof(RequestBuffers))
QUERYBUF = _request(_READ | _WRITE, 9, ctypes.sizeof(Buffer))
QBUF = _request(_READ | _WRITE, 15, ctypes.sizeof(Buffer))
DQBUF = _request(_READ | _WRITE, 17, ctypes.sizeof(Buffer))
STREAMON = _request(_WRITE, 18, 4)
STREAMOFF = _request(_WRITE, 19, 4)
S_PARM = _request(_READ | _WRITE, 22, ctypes.sizeof(StreamParameters))
G_CTRL = _request(_READ | _WRITE, 27, ctypes.sizeof(Control))
S_CTRL = _request(_READ | _WRITE, 28, ctypes.sizeof(Control))
QUERYCTRL = _request(_READ | _WRITE, 36, ctypes.sizeof(ControlQuery))
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, ctypes.sizeof(FrameSize))
ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, ctypes.sizeof(FrameInterval))


def fourcc(text: str) -> int:
    """The number of a pixel format such as "YUYV"."""
    return int.from_bytes(text.ljust(4).encode("ascii")[:4], "little")


def fourcc_text(number: int) -> str:
    """The four characters of a pixel format."""
    return number.to_bytes(4, "little").decode("ascii", "replace").rstrip()


class Kernel(Protocol):
    """The system calls on a video device. Each raises OSError as the kernel says."""

    def open(self, path: str) -> int: ...
    def close(self, fd: int) -> None: ...
    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """One call; `argument` is read and filled."""
        ...

    def map(self, fd: int, length: int, offset: int) -> Any:
        """A buffer of the driver's memory that has `close`."""
        ...

    def wait(self, fd: int, seconds: float) -> bool:
        """Wait for an image; False if none came. An unplugged device counts as one: the next call raises."""
        ...


class LinuxKernel:
    """The real system calls."""

    def open(self, path: str) -> int:
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        fcntl.ioctl(fd, request, argument, True)

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, fd: int, seconds: float) -> bool:
        poller = select.poll()
        poller.register(fd, select.POLLIN | select.POLLPRI)
        return bool(poller.poll(max(0.0, seconds) * 1e3))
