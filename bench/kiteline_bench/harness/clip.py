"""A recording held in memory, for flights whose cost must be the agent's alone: decoded once, flown often."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kiteline_agent.runtime.frame_reader import joined
from kiteline_core import odometry as odometer
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, LogWriter
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.simulate import encode


@dataclass(frozen=True, slots=True)
class Clip:
    """Frames in order of time, each with the inertial samples since the one before. odometry: of the whole clip."""

    rig: CameraRig
    imu: ImuCalibration | None
    items: tuple[tuple[Frame, ImuBatch | None], ...]
    truth: Trajectory | None
    odometry: OdometryBatch | None = None

    @property
    def period_ns(self) -> int:
        """Between the first two frames."""
        return self.items[1][0].t_ns - self.items[0][0].t_ns

    def part(self, begin: int, end: int) -> Clip:
        """Frames begin..end alone."""
        return replace(self, items=self.items[begin:end])

    def calm(self) -> Clip:
        """The longest part between two moments at which the vehicle hardly moves: it can be flown to and fro."""
        if self.truth is None:
            return self
        n = len(self.items)
        stamps = np.array([frame.t_ns for frame, _ in self.items], np.float64)
        place = np.stack([np.interp(stamps, self.truth.t_ns, self.truth.T_w_b[:, i, 3]) for i in range(3)], axis=1)
        pace = np.linalg.norm(np.gradient(place, axis=0), axis=1)
        begin, end = int(np.argmin(pace[: n // 4])), n - n // 4 + int(np.argmin(pace[n - n // 4 :]))
        return self.part(begin, end + 1)

    def to_and_fro(self, frames: int) -> Iterator[tuple[Frame, ImuBatch | None]]:
        """So many frames, played forward and backward without end, with stamps that go on.

        Played backward, inertial samples keep their specific force, and turn the other way.
        """
        n = len(self.items)
        for k in range(frames):
            turn, at = divmod(k, 2 * n - 2)
            t_ns = self.items[0][0].t_ns + k * self.period_ns
            if at >= n or (at == 0 and turn):
                to = 2 * n - 2 - at if at else 0
                imu = _reversed(self.items[to][1], self.items[to + 1][1], t_ns)
            else:
                to, imu = at, _moved(self.items[at][1], t_ns)
            yield replace(self.items[to][0], t_ns=t_ns), imu

    def save(self, path: Path) -> Path:
        """Write it as a recording that flies like any other."""
        with LogWriter(path, {"role": "recording", "source": path.stem}) as log:
            log.rig(self.items[0][0].t_ns, self.rig, self.imu)
            for frame, imu in self.items:
                if imu is not None and self.imu is not None:
                    log.imu(IMU, int(imu.t_ns[-1]), imu)
                if self.truth is not None:
                    at = int(np.argmin(np.abs(self.truth.t_ns - frame.t_ns)))
                    log.pose(GROUND_TRUTH, frame.t_ns, "world", self.truth.T_w_b[at])
                log.frame(replace(frame, encoded=encode(frame, False)))
        return path


def _moved(batch: ImuBatch | None, end_ns: int) -> ImuBatch | None:
    if batch is None or not len(batch.t_ns):
        return None
    return replace(batch, t_ns=batch.t_ns + (end_ns - int(batch.t_ns[-1])))


def _reversed(before: ImuBatch | None, batch: ImuBatch | None, end_ns: int) -> ImuBatch | None:
    """The samples of `batch`, played backward, the last of those before it at the end, which is at `end_ns`."""
    if batch is None or not len(batch.t_ns):
        return None
    parts = [batch] if before is None or not len(before.t_ns) else [_last(before), _all_but_last(batch)]
    t_ns, gyro, accel = (np.concatenate([getattr(p, name) for p in parts])[::-1] for name in ("t_ns", "gyro", "accel"))
    return ImuBatch(np.asarray(end_ns - (t_ns - int(t_ns[-1]))), -gyro, np.ascontiguousarray(accel))


def _last(batch: ImuBatch) -> ImuBatch:
    return ImuBatch(batch.t_ns[-1:], batch.gyro[-1:], batch.accel[-1:])


def _all_but_last(batch: ImuBatch) -> ImuBatch:
    return ImuBatch(batch.t_ns[:-1], batch.gyro[:-1], batch.accel[:-1])


def load(source: str, *, imu: bool = True, mono: bool = False, frames: int = 0) -> Clip:
    """Decode a source, or its first so many frames. Raises SourceError."""
    opened = open_source(source, mono=mono, imu=imu)
    items: list[tuple[Frame, ImuBatch | None]] = []
    pending: list[ImuBatch] = []
    driven: list[OdometryBatch] = []
    for item in opened:
        if isinstance(item, OdometryBatch):
            driven.append(item)
            continue
        if isinstance(item, ImuBatch):
            pending.append(item)
            continue
        items.append((replace(item, encoded=()), joined(pending)))
        pending = []
        if len(items) == frames:
            break
    truth = opened.ground_truth
    clip = Clip(opened.rig, opened.imu if imu else None, tuple(items), truth, odometer.joined(driven))
    opened.close()
    return clip
