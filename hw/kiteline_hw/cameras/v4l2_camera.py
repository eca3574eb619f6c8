"""A V4L2 device: size, pixel format, rate, exposure and gain; images with the driver's stamps and sequence numbers."""

import contextlib
import ctypes
import errno
from dataclasses import dataclass
from typing import Any

from kiteline_core.frame import EncodedImage
from kiteline_hw.cameras import v4l2_api as api
from kiteline_hw.cameras.camera import CameraError, Capture
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels

_BUFFERS = 4  # two are filled while one is read; one more for a late thread
_UNCHANGED = -1.0

# Pixel formats in the order of preference, with the names of RawPixels; "jpeg" is decoded. NV12 and YU12 begin with
# the grey plane.
FORMATS = {
    "GREY": "mono8", "NV12": "mono8", "YU12": "mono8", "YUYV": "yuyv", "UYVY": "uyvy", "MJPG": "jpeg", "JPEG": "jpeg",
}  # fmt: skip

_REASONS = {
    errno.ENOENT: ("is not there: plug it in, or name another one (`ls /dev/v4l/by-id` shows them)", True),
    errno.ENODEV: ("was unplugged: plug it in again", True),
    errno.ENXIO: ("was unplugged: plug it in again", True),
    errno.EIO: ("does not answer: check its cable, plug it in again", True),
    errno.EPROTO: ("does not answer: check its cable, plug it in again", True),
    errno.EBUSY: ("is used by another program: end it (`fuser -v /dev/video*` shows it)", True),
    errno.EACCES: ("is closed to this user: add the user to the group video and log in again", False),
    errno.EPERM: ("is closed to this user: add the user to the group video and log in again", False),
    errno.ENOSPC: ("gets no share of the USB bus: use another port, MJPG, a smaller size or a lower rate", True),
}


@dataclass(frozen=True, slots=True)
class V4l2Settings:
    """What is asked of a device.

    width, height: px. fps: Hz. format: a pixel format's four letters, "" to choose one. exposure_ms: -1 leaves the
    camera's own control of exposure on. gain: in the driver's unit; -1 leaves it.
    """

    width: int
    height: int
    fps: float = 20.0
    format: str = ""
    exposure_ms: float = _UNCHANGED
    gain: float = _UNCHANGED


class V4l2Camera:
    """One device, opened again after it was away with the same settings."""

    start_s = 2.0  # slow webcams take one

    def __init__(self, device: str, settings: V4l2Settings, kernel: api.Kernel) -> None:
        self.name = device
        self._settings = settings
        self._kernel = kernel
        self._fd = -1
        self._maps: list[Any] = []
        self._layout = api.PixFormat()

    def open(self) -> str:
        """Open the device and begin; what was chosen, for the user. Raises CameraError."""
        try:
            self._fd = self._kernel.open(self.name)
            self._check_capabilities()
            chosen = self._set_format()
            rate_hz = self._set_rate()
            controls = self._set_controls()
            self._begin()
        except OSError as error:
            self.close()
            raise self._error(error) from error
        except CameraError:
            self.close()
            raise
        return f"{self.name}: {chosen} at {rate_hz:g} Hz{controls}"

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises CameraError if the device is gone, BadImage."""
        try:
            if not self._kernel.wait(self._fd, timeout_s):
                return None
            buffer = self._buffer(0)
            self._call(api.DQBUF, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._error(error) from error
        data = bytes(memoryview(self._maps[buffer.index])[: buffer.bytesused])
        flags, sequence = int(buffer.flags), int(buffer.sequence)
        stamp = buffer.timestamp
        t_ns = int(stamp.seconds) * 1_000_000_000 + int(stamp.microseconds) * 1000
        try:
            self._call(api.QBUF, buffer)
        except OSError as error:
            raise self._error(error) from error
        if flags & api.FLAG_ERROR or not data:
            raise BadImage(f"the driver marks image {sequence} as damaged")
        monotonic = flags & api.FLAG_STAMP_MASK == api.FLAG_STAMP_MONOTONIC
        return Capture(t_ns if monotonic else None, sequence, self._image(data))

    def close(self) -> None:
        """Release the device; it may be opened again."""
        fd, self._fd = self._fd, -1
        if fd < 0:
            return
        with contextlib.suppress(OSError):
            self._kernel.ioctl(fd, api.STREAMOFF, ctypes.c_int(api.CAPTURE))
        for mapped in self._maps:
            mapped.close()
        self._maps = []
        with contextlib.suppress(OSError):
            self._kernel.close(fd)

    def _call(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        self._kernel.ioctl(self._fd, request, argument)

    def _error(self, error: OSError) -> CameraError:
        text, passing = _REASONS.get(error.errno or 0, (f"failed: {error.strerror}; plug it in again", True))
        return CameraError(f"camera {self.name} {text}", passing)

    def _check_capabilities(self) -> None:
        found = api.Capability()
        try:
            self._call(api.QUERYCAP, found)
        except OSError as error:
            if error.errno == errno.ENOTTY:
                raise CameraError(f"{self.name} is no video device: expected one such as /dev/video0", False) from error
            raise
        of_node = found.device_caps if found.capabilities & api.CAP_DEVICE_CAPS else found.capabilities
        if not of_node & api.CAP_VIDEO_CAPTURE or not of_node & api.CAP_STREAMING:
            raise CameraError(
                f"{self.name} ({found.card.decode(errors='replace')}) gives no images: expected a capture node; a "
                "camera has several nodes, try the one before",
                False,
            )

    def _enumerate(self, request: int, item: Any) -> list[Any]:
        """All items of a list of the driver's, copied."""
        out: list[Any] = []
        kind = type(item)
        for index in range(256):  # a driver that never ends its list does not end the program
            item.index = index
            try:
                self._call(request, item)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    break
                raise
            out.append(kind.from_buffer_copy(item))
        return out

    def _offers(self, pixelformat: int) -> bool:
        """True if the wanted size is offered in a pixel format at the wanted rate."""
        s = self._settings
        sizes = self._enumerate(api.ENUM_FRAMESIZES, api.FrameSize(pixel_format=pixelformat))
        if sizes and not any(_fits(size, s.width, s.height) for size in sizes):
            return False
        asked = api.FrameInterval(pixel_format=pixelformat, width=s.width, height=s.height)
        intervals = [i for i in self._enumerate(api.ENUM_FRAMEINTERVALS, asked) if i.type == api.DISCRETE]
        return not intervals or any(i.values[1] >= 0.99 * s.fps * i.values[0] for i in intervals)

    def _set_format(self) -> str:
        """Choose the pixel format and set the size; what the device took."""
        s = self._settings
        offered = [
            api.fourcc_text(d.pixelformat)
            for d in self._enumerate(api.ENUM_FMT, api.FormatDescription(type=api.CAPTURE))
        ]
        known = [name for name in FORMATS if name in offered]
        if s.format:
            if s.format not in FORMATS or (offered and s.format not in offered):
                both = ", ".join(known) or "none of these"
                raise CameraError(
                    f"camera {self.name} gives no format {s.format}: it offers {both}, of {', '.join(FORMATS)}", False
                )
            known = [s.format]
        if not known:
            raise CameraError(
                f"camera {self.name} offers {', '.join(offered) or 'no format'}: expected one of {', '.join(FORMATS)}",
                False,
            )
        best = next((name for name in known if self._offers(api.fourcc(name))), known[0])
        wanted = api.Format(type=api.CAPTURE)
        wanted.fmt.pix = api.PixFormat(
            width=s.width, height=s.height, pixelformat=api.fourcc(best), field=api.ANY_FIELD
        )
        self._call(api.S_FMT, wanted)
        layout = self._layout = api.PixFormat.from_buffer_copy(wanted.fmt.pix)
        given = api.fourcc_text(layout.pixelformat)
        if (layout.width, layout.height) != (s.width, s.height) or given not in FORMATS:
            sizes = self._enumerate(api.ENUM_FRAMESIZES, api.FrameSize(pixel_format=api.fourcc(best)))
            shown = ", ".join(f"{z.values[0]}x{z.values[1]}" for z in sizes if z.type == api.DISCRETE)
            raise CameraError(
                f"camera {self.name} gives {layout.width}x{layout.height} px in {given}, the calibration says "
                f"{s.width}x{s.height}: calibrate at a size that it offers" + (f" ({shown})" if shown else ""),
                False,
            )
        return f"{layout.width}x{layout.height} {given}"

    def _set_rate(self) -> float:
        """Set the rate; the one that the device took, in Hz."""
        asked = api.StreamParameters(type=api.CAPTURE, numerator=1000, denominator=round(1000 * self._settings.fps))
        try:
            self._call(api.S_PARM, asked)
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise
            return self._settings.fps  # fixed by the sensor's mode
        return asked.denominator / asked.numerator if asked.numerator and asked.denominator else self._settings.fps

    def _set_controls(self) -> str:
        """Set exposure and gain, where they are asked for; what was set, for the user."""
        s, said = self._settings, ""
        # Without this a camera lowers its rate in the dark.
        self._set_control(api.EXPOSURE_CHANGES_RATE, 0)
        if s.exposure_ms >= 0.0:
            self._set_control(api.EXPOSURE_AUTO, api.EXPOSURE_MANUAL)
            value = self._set_control(api.EXPOSURE_100US, max(1, round(10.0 * s.exposure_ms)))
            said += ", no exposure control" if value is None else f", exposure {value / 10.0:g} ms"
        if s.gain >= 0.0:
            self._set_control(api.AUTO_GAIN, 0)
            value = self._set_control(api.GAIN, round(s.gain))
            value = self._set_control(api.ANALOGUE_GAIN, round(s.gain)) if value is None else value
            said += ", no gain control" if value is None else f", gain {value}"
        return said

    def _set_control(self, number: int, value: int) -> int | None:
        """Set a control, within its limits; the value that the device took, None if it has no such control."""
        limits = api.ControlQuery(id=number)
        try:
            self._call(api.QUERYCTRL, limits)
            control = api.Control(number, min(max(value, limits.minimum), limits.maximum))
            self._call(api.S_CTRL, control)
            self._call(api.G_CTRL, control)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.ENXIO):
                raise
            return None
        return int(control.value)

    def _begin(self) -> None:
        asked = api.RequestBuffers(count=_BUFFERS, type=api.CAPTURE, memory=api.MMAP)
        self._call(api.REQBUFS, asked)
        if asked.count < 2:
            raise CameraError(f"camera {self.name} has memory for {asked.count} images: expected 2 at least")
        for index in range(asked.count):
            buffer = self._buffer(index)
            self._call(api.QUERYBUF, buffer)
            self._maps.append(self._kernel.map(self._fd, buffer.length, buffer.m.offset))
            self._call(api.QBUF, buffer)
        self._call(api.STREAMON, ctypes.c_int(api.CAPTURE))

    def _buffer(self, index: int) -> api.Buffer:
        return api.Buffer(index=index, type=api.CAPTURE, memory=api.MMAP)

    def _image(self, data: bytes) -> EncodedImage | RawPixels:
        p = self._layout
        name = FORMATS[api.fourcc_text(p.pixelformat)]
        if name == "jpeg":
            return EncodedImage(data, "jpeg")
        return RawPixels(p.width, p.height, name, p.bytesperline, data)


def _fits(size: api.FrameSize, width: int, height: int) -> bool:
    v: list[int] = list(size.values)
    if size.type == api.DISCRETE:
        return (v[0], v[1]) == (width, height)
    return v[0] <= width <= v[1] and v[3] <= height <= v[4]
