"""Counts and CPU time of a flight, frame by frame, and its trajectory lines. The clock is handed in; no file."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from kiteline_agent.covariance.pose_quality import FLAGGED_BELOW
from kiteline_agent.runtime.frame_reader import SAMPLES
from kiteline_agent.step import Estimate, PredictedPose
from kiteline_core.arrays import F64
from kiteline_core.geometry import tum
from kiteline_core.ids import SubmapId, keyframe_id, submap_of_keyframe


@dataclass(slots=True)
class FrameCounts:
    """frames = tracked + lost + dropped.

    bridged: tracked, by dead reckoning. flagged: tracked, with a quality that is not to be relied on. initialising:
    lost, before a map of known scale. predicted: dropped, with a predicted pose.
    """

    tracked: int = 0
    bridged: int = 0
    flagged: int = 0
    lost: int = 0
    initialising: int = 0
    dropped: int = 0
    predicted: int = 0
    bytes_up: int = 0
    bytes_down: int = 0
    keyframes: int = 0
    submaps: set[SubmapId] = field(default_factory=set)
    _newest: dict[SubmapId, int] = field(default_factory=dict)  # keyframe of each submap

    @property
    def frames(self) -> int:
        """Number of frames that the source gave."""
        return self.tracked + self.lost + self.dropped

    def count(self, estimate: Estimate | None, predicted: PredictedPose | None = None) -> None:
        """Count one frame that was given to the agent. estimate: None if the governor skipped it."""
        if estimate is None:
            self.dropped += 1
            self.predicted += predicted is not None
        elif live_pose(estimate) is None:
            self.lost += 1
            self.initialising += estimate.initialising
        else:
            self.tracked += 1
            self.bridged += estimate.bridged
            self.flagged += estimate.quality < FLAGGED_BELOW
        if estimate is not None and estimate.keyframe >= 0:
            submap = submap_of_keyframe(estimate.keyframe)
            newest = self._newest.get(submap, keyframe_id(submap, 0) - 1)
            if estimate.keyframe > newest:  # several, where a map begins with what the camera saw before
                self._newest[submap] = estimate.keyframe
                self.keyframes += estimate.keyframe - newest
            self.submaps.add(estimate.submap)

    def as_report(self) -> dict[str, int | float]:
        """The counts as report.json holds them."""
        keyframes = self.keyframes
        return {
            "frames": self.frames,
            "tracked": self.tracked,
            "bridged": self.bridged,
            "flagged": self.flagged,
            "lost": self.lost,
            "initialising": self.initialising,
            "dropped": self.dropped,
            "predicted": self.predicted,
            "submaps": len(self.submaps),
            "keyframes": keyframes,
            "bytes_up": self.bytes_up,
            "bytes_down": self.bytes_down,
            "bytes_per_keyframe": round(self.bytes_up / keyframes, 1) if keyframes else 0.0,
        }


def live_pose(estimate: Estimate) -> F64 | None:
    """The body in w if the base has placed the submap, else in m; None if the frame was not tracked."""
    if not estimate.tracked:
        return None
    return estimate.T_m_b if estimate.T_w_b is None else estimate.T_w_b


def live_line(estimate: Estimate | None) -> str:
    """The frame's line in live.tum; empty if it was skipped or has no pose."""
    pose = None if estimate is None else live_pose(estimate)
    return "" if estimate is None or pose is None else tum.line(estimate.t_ns, pose)


def odometry_line(pose: Estimate | PredictedPose | None) -> str:
    """The frame's line in odometry.tum; empty before there is a map."""
    if pose is None or (isinstance(pose, Estimate) and pose.initialising):
        return ""
    return tum.line(pose.t_ns, pose.T_o_b)


class Decoder(Protocol):
    """What reads frames."""

    @property
    def decode_ns(self) -> int:
        """Process CPU spent on reading and decoding so far."""
        ...


class CpuAccount:
    """Measures the CPU time of each frame.

    clock: process CPU time in ns. whole: the agent is alone in its process, so that all CPU time between two frames
    counts; otherwise only that inside its steps. ms: of the newest frames. frames: all that were counted. last_ns: of
    the last one.
    """

    def __init__(self, clock: Callable[[], int], camera: Decoder, whole: bool) -> None:
        self._clock = clock
        self._camera = camera
        self._whole = whole
        self._mark_ns = clock()
        self._decode_mark_ns = camera.decode_ns
        self._spent_ns = 0
        self.ms: deque[float] = deque(maxlen=SAMPLES)
        self.frames = 0
        self.last_ns = 0

    def begin(self) -> None:
        """Start of a step."""
        if not self._whole:
            self._mark_ns = self._clock()

    def end(self, with_frame: bool) -> None:
        """End of a step; with_frame: a frame was processed."""
        end_ns = self._clock()
        self._spent_ns += end_ns - self._mark_ns
        if self._whole:
            self._spent_ns -= self._camera.decode_ns - self._decode_mark_ns
        self._mark_ns, self._decode_mark_ns = end_ns, self._camera.decode_ns
        if with_frame:
            self.ms.append(self._spent_ns / 1e6)
            self.frames += 1
            self.last_ns, self._spent_ns = self._spent_ns, 0
