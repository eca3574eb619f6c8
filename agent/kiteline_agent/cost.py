"""The virtual CPU: what a frame costs in counted operations, and when a limited core is free again. Pure."""

from __future__ import annotations

from kiteline_agent.agent import StepOutput
from kiteline_core.frame import Frame

# Operations, at one a nanosecond on the modelled core; measured on x86 and rounded up.
_PER_PIXEL = 4  # rectification and pyramids
_PER_INLIER = 15_000  # alignment and pose, for a point that was used
_KEYFRAME_PER_PIXEL = 8  # detection over the whole left image
_KEYFRAME = 3_000_000  # descriptors, row stereo, coding
_STEP = 300_000  # endpoint and log


def frame_ops(frame: Frame, output: StepOutput) -> int:
    """Operations that a frame cost."""
    pixels = frame.left.size * (1 if frame.right is None else 2)
    ops = _STEP + _PER_PIXEL * pixels
    if output.estimate is not None:
        ops += _PER_INLIER * output.estimate.inliers
    if any(event.startswith(("keyframe", "submap")) for event in output.events):
        ops += _KEYFRAME + _KEYFRAME_PER_PIXEL * frame.left.size
    return ops


class VirtualCpu:
    """A core of which `percent` are ours; 0: it is never busy. Work is done in order."""

    def __init__(self, percent: float) -> None:
        self._percent = percent
        self.free_ns = 0

    def spend(self, ops: int, now_ns: int) -> None:
        """Do work that was ready at `now_ns`."""
        if self._percent > 0.0:
            self.free_ns = max(now_ns, self.free_ns) + round(ops * 100.0 / self._percent)

    def newest_wins(self, frame_ns: int, period_ns: int) -> bool:
        """Whether a frame is passed over: before the core is free to take it up, the next one is there."""
        return period_ns > 0 and self.free_ns >= frame_ns + period_ns
