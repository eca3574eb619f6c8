"""A recording held in memory, for flights whose cost must be the agent's alone: decoded once, flown often."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from kiteline_core.cameras import CameraRig
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_hw.sources import open_source


@dataclass(frozen=True, slots=True)
class Clip:
    """Frames in order of time, each with the inertial samples since the one before."""

    rig: CameraRig
    imu: ImuCalibration | None
    items: tuple[tuple[Frame, ImuBatch | None], ...]
    truth: Trajectory | None

    @property
    def period_ns(self) -> int:
        """Between the first two frames."""
        return self.items[1][0].t_ns - self.items[0][0].t_ns

    def to_and_fro(self, frames: int) -> Iterator[Frame]:
        """So many frames, played forward and backward without end, with stamps that go on; no inertial samples."""
        n = len(self.items)
        for k in range(frames):
            at = k % (2 * n - 2)
            frame = self.items[at if at < n else 2 * n - 2 - at][0]
            yield replace(frame, t_ns=self.items[0][0].t_ns + k * self.period_ns)


def load(source: str, *, imu: bool = True, mono: bool = False, frames: int = 0) -> Clip:
    """Decode a source, or its first so many frames. Raises SourceError."""
    opened = open_source(source, mono=mono, imu=imu)
    items: list[tuple[Frame, ImuBatch | None]] = []
    pending: ImuBatch | None = None
    for item in opened:
        if isinstance(item, ImuBatch):
            pending = item
            continue
        items.append((replace(item, encoded=()), pending))
        pending = None
        if len(items) == frames:
            break
    clip = Clip(opened.rig, opened.imu if imu else None, tuple(items), opened.ground_truth)
    opened.close()
    return clip
