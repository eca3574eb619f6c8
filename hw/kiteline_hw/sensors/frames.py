"""Turns encoded images and inertial samples into Frames and ImuBatches: pairs them by time, decodes, checks sizes."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import EncodedImage, Frame, ImuBatch
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.images import ImageRef, decode_depth, decode_grey
from kiteline_hw.sensors.imu_buffer import ImuSamples
from kiteline_hw.sensors.raw_pixels import BadImage

PAIR_TOLERANCE_NS = 5_000_000  # ns; left and right image of a moving vehicle must not be further apart
DEPTH_TOLERANCE_NS = 20_000_000  # ns; what the TUM tools use: free-running depth cameras lag by up to half a period

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """The images of one instant, not yet decoded."""

    t_ns: int
    left: ImageRef
    right: ImageRef | None = None
    depth: ImageRef | None = None


def pair_tolerance_ns(stamps_ns: NDArray[np.int64], most_ns: int = PAIR_TOLERANCE_NS) -> int:
    """Largest time difference of a pair: half the frame period at most, so that an image never fits two frames."""
    if len(stamps_ns) < 2:
        return most_ns
    return min(most_ns, int(np.median(np.diff(stamps_ns))) // 2)


def pair_by_time(
    items: Iterable[tuple[int, int, T]], tolerance_ns: int, names: tuple[str, str], report: SourceReport
) -> Iterator[tuple[int, T, T | None]]:
    """Pair items (t_ns, side 0 or 1, item), given in order of time; yields (t_ns of side 0, item 0, item 1 or None).

    Each item is paired with the nearest of the other side within the tolerance; one without a partner is counted as
    "missing <name>", and yielded alone if it is of side 0. Buffers the items of one tolerance at most.
    """
    waiting: tuple[deque[tuple[int, T]], deque[tuple[int, T]]] = (deque(), deque())

    def pair_waiting(now_ns: int | None) -> Iterator[tuple[int, T, T | None]]:
        # An item can be paired once no nearer one can follow: after its own time plus the tolerance.
        while waiting[0] or waiting[1]:
            side = 0 if waiting[0] and (not waiting[1] or waiting[0][0][0] <= waiting[1][0][0]) else 1
            mine, other = waiting[side], waiting[1 - side]
            t, item = mine[0]
            if other and other[0][0] == t:
                mine.popleft()
                _, partner = other.popleft()
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
            yield (t, item, partner) if side == 0 else (t_other, partner, item)

    for t_ns, side, item in items:
        waiting[side].append((t_ns, item))
        yield from pair_waiting(t_ns)
    yield from pair_waiting(None)


def decode_frames(
    frames: Iterable[EncodedFrame], imu: ImuSamples, rig: CameraRig, report: SourceReport, name: str
) -> Iterator[Frame | ImuBatch]:
    """Decode images into Frames; each Frame comes after the ImuBatch of the samples up to its time.

    Unreadable images, images of another size and stamps that do not increase are skipped and counted; a left image is
    delivered without its right one where that is missing. Raises SourceError if no frame, or of a stereo rig none with
    both images, is usable.
    """
    last_ns = -(2**63)
    delivered = paired = 0
    for encoded in frames:
        if encoded.t_ns <= last_ns:
            report.skip("frame stamp not increasing", f"{encoded.t_ns} ns after {last_ns} ns")
            continue
        try:
            frame = _decode(encoded, rig, report)
        except BadImage as error:
            report.skip("unreadable image", f"at {encoded.t_ns} ns: {error}")
            continue
        except _WrongSize as error:
            report.skip("image of another size", f"at {encoded.t_ns} ns: {error}")
            continue
        last_ns = encoded.t_ns
        batch = imu.take_until(encoded.t_ns)
        if batch is not None:
            yield batch
        delivered += 1
        paired += frame.right is not None
        yield frame
    if delivered == 0 or (rig.right is not None and paired == 0):
        why = "; ".join(report.notes) or "it holds no images"
        raise SourceError(f"{name}: not one usable {'frame' if delivered == 0 else 'pair of images'} ({why})")


class _WrongSize(Exception):
    pass


def _decode(encoded: EncodedFrame, rig: CameraRig, report: SourceReport) -> Frame:
    left, left_bytes = decode_grey(encoded.left)
    _check_size("left", left.shape, rig.left.height, rig.left.width)
    kept = [left_bytes]
    right = depth = None
    if encoded.right is not None and rig.right is not None:
        try:
            decoded, right_bytes = decode_grey(encoded.right)
            _check_size("right", decoded.shape, rig.right.height, rig.right.width)
        except BadImage as error:
            report.skip("unreadable image", f"right at {encoded.t_ns} ns: {error}")
        except _WrongSize as error:
            report.skip("image of another size", f"at {encoded.t_ns} ns: {error}")
        else:
            right = decoded
            kept.append(right_bytes)
    if encoded.depth is not None and rig.has_depth:
        depth, depth_bytes = decode_depth(encoded.depth)
        _check_size("depth", depth.shape, rig.left.height, rig.left.width)
        kept.append(depth_bytes)
    images: tuple[EncodedImage, ...] = tuple(image for image in kept if image is not None)
    return Frame(encoded.t_ns, left, right, depth, images if len(images) == len(kept) else ())


def _check_size(what: str, shape: tuple[int, ...], height: int, width: int) -> None:
    if shape != (height, width):
        raise _WrongSize(f"{what} image is {shape[1]}x{shape[0]} px, calibration says {width}x{height}")
