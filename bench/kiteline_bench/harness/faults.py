"""What may befall a camera, done to a clip: faults of single frames, losses of sight, another place all of a sudden."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_bench.harness.clip import Clip
from kiteline_core.frame import Frame, ImuBatch, Trajectory

U8 = NDArray[np.uint8]

_GREY, _NOISE = 120.0, 1.2  # grey values of a blank wall, as a camera sees it
_DARK = 8

SECONDS = {
    "black": 0.15, "half a pair": 0.5, "no depth": 0.5, "exposure jump": 0.5, "covered lens, 2 s": 2.0,
    "no texture, 10 s": 10.0,
}  # fmt: skip
_OF_PAIRS = ("half a pair",)
_OF_DEPTH = ("no depth",)
FAULTS = ("dropped", "duplicated", "out of order", "frozen", *SECONDS)


def fitting(clip: Clip) -> tuple[str, ...]:
    """The faults that a clip's cameras can have."""
    return tuple(
        fault
        for fault in FAULTS
        if (fault not in _OF_PAIRS or clip.rig.right is not None) and (fault not in _OF_DEPTH or clip.rig.has_depth)
    )


def faulty(clip: Clip, fault: str) -> Clip:
    """A clip with one fault that begins after its first quarter; stamps stay in order unless that is the fault."""
    items, n = list(clip.items), len(clip.items) // 4
    if fault in SECONDS:
        for k in range(n, min(n + round(SECONDS[fault] * 1e9 / clip.period_ns), len(items) - 1)):
            items[k] = (_CHANGES[fault](items[k][0]), items[k][1])
    elif fault == "dropped":
        del items[n : n + 5]
    elif fault == "frozen":
        for k in range(n, n + 5):
            items[k] = (replace(items[n - 1][0], t_ns=items[k][0].t_ns), items[k][1])
    elif fault == "duplicated":
        items.insert(n, (items[n - 1][0], None))
    elif fault == "out of order":
        items[n], items[n + 1] = items[n + 1], items[n]
    else:
        raise ValueError(f"no fault {fault!r}; there are: {', '.join(FAULTS)}")
    return replace(clip, items=tuple(items))


def blind(clip: Clip, begin: int, end: int, *, black: bool = False) -> Clip:
    """A clip whose frames begin..end show a blank wall, or nothing at all."""
    items = list(clip.items)
    for k in range(begin, end):
        items[k] = (_dark(items[k][0]) if black else _wall(items[k][0]), items[k][1])
    return replace(clip, items=tuple(items))


def rearranged(clip: Clip, order: Sequence[int | None]) -> Clip:
    """Frames of a clip in another order, at its own pace; None: a blank wall. No inertial samples: nobody flew that.

    The true poses go along; while the wall is seen the camera is where it was before.
    """
    assert clip.truth is not None
    items: list[tuple[Frame, ImuBatch | None]] = []
    stamps, poses, last = [], [], 0
    for k, source in enumerate(order):
        last = last if source is None else source
        frame = clip.items[last][0]
        t_ns = clip.items[0][0].t_ns + k * clip.period_ns
        items.append((replace(frame if source is not None else _wall(frame), t_ns=t_ns), None))
        stamps.append(t_ns)
        poses.append(clip.truth.T_w_b[int(np.argmin(np.abs(clip.truth.t_ns - frame.t_ns)))])
    truth = Trajectory(np.array(stamps, np.int64), np.array(poses))
    return replace(clip, imu=None, items=tuple(items), truth=truth)


def _both(frame: Frame, change: Callable[[U8], U8]) -> Frame:
    right = None if frame.right is None else change(frame.right)
    return replace(frame, left=change(frame.left), right=right, encoded=())


def _dark(frame: Frame) -> Frame:
    return _both(frame, lambda image: np.full_like(image, _DARK))


def _wall(frame: Frame) -> Frame:
    rng = np.random.default_rng(frame.t_ns % (1 << 32))
    return _both(frame, lambda image: np.clip(rng.normal(_GREY, _NOISE, image.shape), 0, 255).astype(np.uint8))


def _bright(frame: Frame) -> Frame:
    return _both(frame, lambda image: np.clip(image * 1.5, 0, 255).astype(np.uint8))


_CHANGES: dict[str, Callable[[Frame], Frame]] = {
    "black": _dark,
    "covered lens, 2 s": _dark,
    "half a pair": lambda frame: replace(frame, right=None),
    "no depth": lambda frame: replace(frame, depth_m=None if frame.depth_m is None else np.zeros_like(frame.depth_m)),
    "exposure jump": _bright,
    "no texture, 10 s": _wall,
}
