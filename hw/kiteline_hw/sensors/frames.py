"""Turns encoded images and inertial samples into Frames and ImuBatches: pairs them by time, decodes, checks sizes."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import I64
from kiteline_core.frame import EncodedImage, Frame, ImuBatch
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.calibration.checks import doubts
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.images import ImageRef, decode_depth
from kiteline_hw.sensors.imu_buffer import ImuSamples
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sensors.sensor_bits import SensorBits

PAIR_TOLERANCE_NS = 5_000_000  # ns; left and right image of a moving vehicle must not be further apart
DEPTH_TOLERANCE_NS = 20_000_000  # ns; what the TUM tools use: free-running depth cameras lag by up to half a period

_END_NS = 2**63 - 1  # ns; no sample is later
_SKEWS = 100  # pairs over which the skew is measured
_LEAST_APART_NS, _MOST_APART_NS = 200_000, 10_000_000_000  # ns; images of no camera are nearer or farther apart
_GOOD_SKEW_NS = 500_000  # ns; at a turn of 1 rad/s an image of 450 px focal length is a quarter of a pixel off

T = TypeVar("T")
P = TypeVar("P", bound=np.generic)


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """The images of one instant, not yet decoded."""

    t_ns: int
    left: ImageRef
    right: ImageRef | None = None
    depth: ImageRef | None = None


def pair_tolerance_ns(stamps_ns: I64) -> int:
    """Largest time difference of a pair: half the frame period at most, so that an image never fits two frames."""
    if len(stamps_ns) < 2:
        return PAIR_TOLERANCE_NS
    return min(PAIR_TOLERANCE_NS, int(np.median(np.diff(stamps_ns))) // 2)


class SkewNote:
    """Notes how far apart the stamps of pairs are, where that makes depths wrong in motion."""

    def __init__(self, report: SourceReport) -> None:
        self._report = report
        self._skews: list[int] = []

    def add(self, skew_ns: int) -> None:
        """Take the difference of a pair's stamps."""
        if len(self._skews) == _SKEWS:
            return
        self._skews.append(skew_ns)
        if len(self._skews) == _SKEWS and (middle := float(np.median(self._skews))) > _GOOD_SKEW_NS:
            self._report.notes.append(
                f"right and left images are {middle / 1e6:.1f} ms apart: while the cameras turn, stereo depths are "
                "wrong by it; trigger both by one signal"
            )


def pair_by_time(
    items: Iterable[tuple[int, int, T]], tolerance_ns: int, names: tuple[str, str], report: SourceReport
) -> Iterator[tuple[int, T, T | None]]:
    """Pair items (t_ns, side 0 or 1, item), given in order of time; yields (t_ns of side 0, item 0, item 1 or None).

    Each item is paired with the nearest of the other side within the tolerance; one without a partner is counted as
    "missing <name>", and yielded alone if it is of side 0. Buffers the items of one tolerance at most.
    """
    waiting: tuple[deque[tuple[int, T]], deque[tuple[int, T]]] = (deque(), deque())
    skew = SkewNote(report if names[1].startswith("right") else SourceReport())

    def pair_waiting(now_ns: int | None) -> Iterator[tuple[int, T, T | None]]:
        # An item can be paired once no nearer one can follow: after its own time plus the tolerance.
        while waiting[0] or waiting[1]:
            side = 0 if waiting[0] and (not waiting[1] or waiting[0][0][0] <= waiting[1][0][0]) else 1
            mine, other = waiting[side], waiting[1 - side]
            t, item = mine[0]
            if other and other[0][0] == t:
                mine.popleft()
                _, partner = other.popleft()
                skew.add(0)
                yield (t, item, partner) if side == 0 else (t, partner, item)
                continue
            gap = other[0][0] - t if other else None
            if gap is None or gap > tolerance_ns:
                if now_ns is not None and now_ns <= t + tolerance_ns:
                    return
                mine.popleft()
                report.skip(f"missing {names[1 - side]}", f"{names[side]} at {t} ns has no partner")
                if side == 0:
                    yield t, item, None
                continue
            # The candidate is later than this item: a later item of the same side may be nearer to it.
            t_other = other[0][0]
            rival = mine[1][0] if len(mine) > 1 else None
            if rival is not None and abs(rival - t_other) < t_other - t:
                mine.popleft()
                report.skip(f"missing {names[1 - side]}", f"{names[side]} at {t} ns has no partner")
                if side == 0:
                    yield t, item, None
                continue
            if rival is None and now_ns is not None and now_ns <= t_other + (t_other - t):
                return
            mine.popleft()
            _, partner = other.popleft()
            skew.add(t_other - t)
            yield (t, item, partner) if side == 0 else (t_other, partner, item)

    for t_ns, side, item in items:
        waiting[side].append((t_ns, item))
        yield from pair_waiting(t_ns)
    yield from pair_waiting(None)


def decode_frames(
    frames: Iterable[EncodedFrame], imu: ImuSamples, rig: CameraRig, report: SourceReport, name: str,
    grey: SensorBits | None = None,
) -> Iterator[Frame | ImuBatch]:  # fmt: skip
    """Decode images into Frames; each Frame comes after the ImuBatch of the samples up to its time.

    Unreadable images, images of another size and stamps that do not increase are skipped and counted; a left image is
    delivered without its right one, or its depth, where that is missing. Raises SourceError if no frame, or none with
    both images of a stereo or depth camera, is usable. grey: the bits of images of 16, where they are known.
    """
    first_ns = last_ns = -(2**63)
    delivered = paired = sampled = 0
    report.notes += doubts(rig.left, "left") + ([] if rig.right is None else doubts(rig.right, "right"))
    grey = SensorBits() if grey is None else grey
    for encoded in frames:
        if encoded.t_ns <= last_ns:
            report.skip("frame stamp not increasing", f"{encoded.t_ns} ns after {last_ns} ns")
            continue
        try:
            frame = _decode(encoded, rig, grey, report)
        except BadImage as error:
            report.skip("unreadable image", f"at {encoded.t_ns} ns: {error}")
            continue
        except _WrongSize as error:
            report.skip("image of another size", f"at {encoded.t_ns} ns: {error}")
            continue
        if (note := grey.take_note()) is not None:
            report.notes.append(note)
        last_ns = encoded.t_ns
        first_ns = last_ns if delivered == 0 else first_ns
        batch = imu.take_until(encoded.t_ns)
        if batch is not None:
            sampled += 1
            yield batch
        delivered += 1
        paired += frame.depth_m is not None if rig.right is None else frame.right is not None
        yield frame
    if delivered == 0 or ((rig.right is not None or rig.has_depth) and paired == 0):
        why = "; ".join(_first_of_each(report)) or "it holds no images"
        pair = "pair of images" if rig.right is not None else "image with its depth"
        raise SourceError(f"{name}: not one usable {'frame' if delivered == 0 else pair} ({why})")
    apart_ns = (last_ns - first_ns) / max(delivered - 1, 1)
    if delivered > 1 and not _LEAST_APART_NS <= apart_ns <= _MOST_APART_NS:
        report.notes.append(
            f"images: {1e-6 * apart_ns:.6g} ms apart by their stamps: are these in the unit that the format expects?"
        )
    if sampled == 0 and (late := imu.take_until(_END_NS)) is not None:
        report.notes.append(
            f"imu: its samples begin {1e-9 * (int(late.t_ns[0]) - last_ns):.1f} s after the last image by their "
            "stamps, and none is used: expected stamps of one clock for both"
        )


def _first_of_each(report: SourceReport) -> list[str]:
    """The first note of each reason, with how many more items were skipped for it."""
    first: dict[str, str] = {}
    for note in report.notes:
        first.setdefault(note.partition(":")[0], note)
    more = {reason: report.skipped.get(reason, 1) - 1 for reason in first}
    return [f"{note}, and {more[reason]} more" if more[reason] else note for reason, note in first.items()]


class _WrongSize(Exception):
    pass


def _decode(encoded: EncodedFrame, rig: CameraRig, grey: SensorBits, report: SourceReport) -> Frame:
    left, left_bytes = grey.decode(encoded.left)
    _check_size("left", left.shape, rig.left.height, rig.left.width)
    kept = [left_bytes]
    right = depth = None
    if encoded.right is not None and rig.right is not None:
        found = _partner(grey.decode, encoded.right, "right", rig.right, encoded.t_ns, report)
        if found is not None:
            right = found[0]
            kept.append(found[1])
    if encoded.depth is not None and rig.has_depth:
        of_depth = _partner(decode_depth, encoded.depth, "depth", rig.left, encoded.t_ns, report)
        if of_depth is not None:
            depth = of_depth[0]
            kept.append(of_depth[1])
    images: tuple[EncodedImage, ...] = tuple(image for image in kept if image is not None)
    return Frame(encoded.t_ns, left, right, depth, images if len(images) == len(kept) else ())


def _partner(
    decode: Callable[[ImageRef], tuple[NDArray[P], EncodedImage | None]], image: ImageRef, what: str,
    camera: CameraModel, t_ns: int, report: SourceReport,
) -> tuple[NDArray[P], EncodedImage | None] | None:  # fmt: skip
    """The image beside the left one and its bytes; None, and counted, if it is unusable."""
    try:
        pixels, data = decode(image)
        _check_size(what, pixels.shape, camera.height, camera.width)
    except BadImage as error:
        report.skip("unreadable image", f"{what} at {t_ns} ns: {error}")
    except _WrongSize as error:
        report.skip("image of another size", f"at {t_ns} ns: {error}")
    else:
        return pixels, data
    return None


def _check_size(what: str, shape: tuple[int, ...], height: int, width: int) -> None:
    if shape != (height, width):
        raise _WrongSize(f"{what} image is {shape[1]}x{shape[0]} px, calibration says {width}x{height}")
