"""`kiteline doctor --camera SOURCE`: watch cameras for some seconds, as an agent would."""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from kiteline_core.arrays import F32, U8
from kiteline_core.frame import Frame
from kiteline_hw.ports import FrameSource, is_live
from kiteline_hw.sources.open import open_source
from kiteline_lab.tools.checks.check import DoctorCheck, Severity

WATCH_S = 6.0  # s of images
_PATIENCE_S = 15.0  # s until the first image
_LOOK_NS = 250_000_000  # ns from one image that is looked at to the next
_GOOD_SKEW_MS, _BAD_SKEW_MS = 1.0, 5.0  # at 1 m/s and 2 m, 1 ms is a quarter of a pixel
_GOOD_JITTER_MS, _LATE_MS = 2.0, 60.0
_GOOD_RATE, _BAD_RATE = 0.05, 0.25  # relative
_BAD_DROPPED = 0.02  # of the frames; each costs tracking its prediction
_DARK, _BRIGHT = 35.0, 215.0  # mean grey value
_CLIPPED = 0.05  # of the pixels
_UNEQUAL = 0.2  # relative; alignment compares left and right images pixel by pixel
_SHARP, _BLURRED = 0.75, 0.64  # edge ratio: sharp recordings have .83 to .93, blurred by 1 px .67, by 1.5 px .60
_NO_STAMPS = "tells no capture times"  # of what a camera says
_TRIED = "it is tried again and again"  # the end of what is said of a camera that cannot be opened
_OPENED = re.compile(r"(picamera \d+|\S+): (?!images again)")  # what a camera took; of outages it says "NAME was …"
_CORNERS = 60  # tracking begins to fail below


@dataclass
class Watched:
    """Images of cameras that were watched. said: messages of the cameras.

    Images are looked at when all have come: on a small computer it takes longer than the next one waits.
    """

    views: list[tuple[U8, ...]] = field(default_factory=list)  # left, right: kept until `look`
    kept_ns: int = 0  # stamp of the last of them
    t_ns: list[int] = field(default_factory=list)
    age_ms: list[float] = field(default_factory=list)
    grey: list[tuple[float, ...]] = field(default_factory=list)  # mean of each view
    clipped: list[float] = field(default_factory=list)
    sharp: list[tuple[float, ...]] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    dropped: int = 0
    skew_ns: tuple[int, int] | None = None
    skipped: dict[str, int] = field(default_factory=dict)

    def add(self, frame: Frame, now_ns: int | None) -> None:
        """Add a frame, and when it was there."""
        if not self.views or frame.t_ns - self.kept_ns >= _LOOK_NS:
            self.views.append((frame.left,) if frame.right is None else (frame.left, frame.right))
            self.kept_ns = frame.t_ns
        self.t_ns.append(frame.t_ns)
        if now_ns is not None:
            self.age_ms.append((now_ns - frame.t_ns) / 1e6)

    def look(self) -> None:
        """Look at the images that were kept, and drop them."""
        for views in self.views:
            self.grey.append(tuple(float(view.mean()) for view in views))
            self.clipped.append(float(max(((view < 4) | (view > 251)).mean() for view in views)))
            self.sharp.append(tuple(edge_ratio(view) for view in views))
            found: Any = cv2.goodFeaturesToTrack(views[0], 300, 0.02, 10.0)
            self.corners.append(0 if found is None else len(found))
        self.views.clear()


def check_cameras(spec: str, calibration: str = "", seconds: float = WATCH_S) -> list[DoctorCheck]:
    """Watch a camera, or the beginning of a recording. Raises SourceError for one that cannot be opened."""
    source = open_source(spec, imu=False, calibration=calibration)
    try:
        seen = watch(source, seconds)
    finally:
        source.close()
    return list(judge(seen, _asked_hz(spec) if is_live(source) else 0.0))


def watch(source: FrameSource, seconds: float) -> Watched:
    """Look at the frames of some seconds."""
    seen = Watched()
    if not is_live(source):
        first: int | None = None
        for frame in (item for item in source if isinstance(item, Frame)):
            first = frame.t_ns if first is None else first
            if frame.t_ns - first > seconds * 1e9:
                break
            seen.add(frame, None)
    else:
        end_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end_s:
            item = source.poll(time.monotonic_ns() + 100_000_000)
            seen.said += source.take_messages()
            if not isinstance(item, Frame):
                continue
            if not seen.t_ns:
                end_s = time.monotonic() + seconds
                source.take_dropped()  # while the first one was awaited
            seen.add(item, time.monotonic_ns())
        seen.dropped = source.take_dropped()
        seen.skew_ns = source.skew_ns
    seen.skipped = dict(source.report.skipped)
    seen.look()
    return seen


def judge(seen: Watched, fps: float) -> Iterator[DoctorCheck]:
    """The verdicts. fps: asked for; 0: of a recording, whose stamps and drops are history."""
    told = [line.removeprefix("camera ") for line in seen.said if line.startswith("camera ") or line.endswith(_TRIED)]
    if not seen.t_ns:
        mend = "" if told and told[-1].endswith(_TRIED) else "check its cable, and its trigger if it has one"
        yield DoctorCheck(Severity.FAIL, "cameras", told[-1] if told else "no image came", mend)
        return
    outages = [line for line in told if not _OPENED.match(line) and _NO_STAMPS not in line]
    if outages:
        yield DoctorCheck(Severity.FAIL, "cameras", "; ".join(outages), "another cable, plug or supply")
    else:
        opened = "; ".join(line for line in told if _OPENED.match(line))
        yield DoctorCheck(Severity.OK, "cameras", opened or f"{len(seen.t_ns)} images")
    if fps > 0.0:
        yield from _timing(seen, fps)
    yield _exposure(seen)
    yield _sharpness(seen)


def _timing(seen: Watched, fps: float) -> Iterator[DoctorCheck]:
    gaps_ms = np.diff(seen.t_ns) / 1e6
    if len(gaps_ms) == 0:
        yield DoctorCheck(Severity.FAIL, "camera rate", "one image only", "check its trigger")
        return
    period_ms = float(np.median(gaps_ms))
    off = abs(1000.0 / period_ms / fps - 1.0)
    grade = Severity.OK if off <= _GOOD_RATE else Severity.NOTE if off <= _BAD_RATE else Severity.FAIL
    mend = "a shorter exposure (exposure_ms=), a smaller size, MJPG or another USB port; or fps= as it gives"
    text = f"{1000.0 / period_ms:.1f} Hz, asked for {fps:g}"
    yield DoctorCheck(grade, "camera rate", text, "" if off <= _GOOD_RATE else mend)
    jitter_ms = float(np.percentile(np.abs(gaps_ms - period_ms * np.round(gaps_ms / period_ms)), 95))
    age_ms = float(np.median(seen.age_ms))
    untold = any(_NO_STAMPS in line for line in seen.said)
    text = f"jitter {jitter_ms:.1f} ms (95 %), {age_ms:.0f} ms from stamp to image"
    mend = ""
    if untold:
        text += "; the camera tells none: images count from their arrival"
        mend = "fly a camera whose driver stamps images, or expect a delay; an IMU lets the agent estimate it"
    elif jitter_ms > _GOOD_JITTER_MS or age_ms > _LATE_MS:
        mend = "end other programs; prefer GREY or YUYV to MJPG, and a port of its own"
    yield DoctorCheck(Severity.NOTE if mend else Severity.OK, "camera stamps", text, mend)
    lost = {reason: n for reason, n in seen.skipped.items() if n}
    gone = sum(lost.values()) + seen.dropped
    share = gone / (gone + len(seen.t_ns))
    grade = Severity.OK if gone == 0 else Severity.NOTE if share <= _BAD_DROPPED else Severity.FAIL
    why = ", ".join(f"{n} {reason}" for reason, n in {**lost, "not taken in time": seen.dropped}.items() if n)
    text = f"{gone} of {gone + len(seen.t_ns)}" + (f": {why}" if why else "")
    mend = "another cable or USB port for each camera, a lower rate, or fewer programs beside"
    yield DoctorCheck(grade, "camera drops", text, mend if gone else "")
    if seen.skew_ns is not None:
        middle_ms, spread_ms = (value / 1e6 for value in seen.skew_ns)
        worst_ms = abs(middle_ms) + spread_ms
        grade = (
            Severity.OK if worst_ms <= _GOOD_SKEW_MS else Severity.NOTE if worst_ms <= _BAD_SKEW_MS else Severity.FAIL
        )
        text = f"right image {middle_ms:+.2f} ms after the left one, give or take {spread_ms:.2f} ms"
        mend = "trigger both cameras by one signal: in motion stereo depths are wrong by it"
        yield DoctorCheck(grade, "camera skew", text, "" if grade is Severity.OK else mend)
    elif len(seen.grey[0]) < 2 and any("apart" in line for line in seen.said):
        text = next(line for line in seen.said if "apart" in line)
        yield DoctorCheck(Severity.FAIL, "camera skew", text.partition(";")[0], "trigger both cameras by one signal")


def _exposure(seen: Watched) -> DoctorCheck:
    grey = np.array([views[:1] + views[-1:] for views in seen.grey])
    left, right = (float(value) for value in np.median(grey, axis=0))
    clipped = float(np.median(seen.clipped))
    text = f"mean grey {left:.0f}" + (f" and {right:.0f}" if len(seen.grey[0]) > 1 else "")
    text += f", {100.0 * clipped:.0f} % black or white"
    if min(left, right) < _DARK:
        return DoctorCheck(Severity.FAIL, "camera exposure", f"{text}: too dark", "more light, gain= or exposure_ms=")
    if max(left, right) > _BRIGHT:
        return DoctorCheck(Severity.FAIL, "camera exposure", f"{text}: too bright", "a smaller exposure_ms= or gain=")
    if abs(left - right) > _UNEQUAL * max(left, right):
        mend = "the same exposure_ms= and gain= for both, and clean lenses"
        return DoctorCheck(Severity.NOTE, "camera exposure", f"{text}: the two differ", mend)
    if clipped > _CLIPPED:
        return DoctorCheck(Severity.NOTE, "camera exposure", text, "a smaller exposure_ms=, or no lamp in view")
    return DoctorCheck(Severity.OK, "camera exposure", text)


def _sharpness(seen: Watched) -> DoctorCheck:
    sides = np.median(np.array([views[:1] + views[-1:] for views in seen.sharp]), axis=0)
    ratio, corners = float(sides.min()), round(float(np.median(seen.corners)))
    text = f"edges {ratio:.2f} of sharp ones, {corners} corners"
    if corners < _CORNERS:
        mend = "point it at something with texture, in the light of a flight"
        return DoctorCheck(Severity.NOTE, "camera sharpness", f"{text}: too few to judge", mend)
    if ratio >= _SHARP:
        return DoctorCheck(Severity.OK, "camera sharpness", text)
    side = "" if len(seen.sharp[0]) < 2 else ", worst in the " + ("left" if sides[0] <= sides[1] else "right") + " one"
    mend = "hold it still for this; then focus the lens (and calibrate again), clean it; exposure_ms= for motion blur"
    return DoctorCheck(Severity.FAIL if ratio < _BLURRED else Severity.NOTE, "camera sharpness", text + side, mend)


def edge_ratio(view: U8) -> float:
    """Steepness of the strongest edges a pixel, over that in the image of half the size: about 1 for a sharp edge, 1/2
    for one that is blurred over several pixels. Contrast and scene matter little.
    """
    image = view.astype(np.float32)
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return _steepness(image) / max(_steepness(np.asarray(half, np.float32)), 1e-6)


def _steepness(image: F32) -> float:
    """Mean gradient of the steepest hundredth of the pixels."""
    gradient = np.hypot(cv2.Scharr(image, cv2.CV_32F, 1, 0), cv2.Scharr(image, cv2.CV_32F, 0, 1))
    n = max(1, gradient.size // 100)
    return float(np.partition(gradient.ravel(), -n)[-n:].mean())


def _asked_hz(spec: str) -> float:
    """The rate in the options of a live camera, else their default."""
    items = spec.rpartition("?")[2].split("&")
    return next((float(item[4:]) for item in items if item.startswith("fps=")), 20.0)
