"""A recording as frames with the sensor data since the frame before: decoded once, flown often, cut and changed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kiteline_core import odometry as odometer
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory, chosen, joined
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, LogWriter
from kiteline_hw.ports import FrameSource
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics
from kiteline_lab.flights.simulate import encode


@dataclass(frozen=True, slots=True)
class Item:
    """A frame, the sensor data since the frame before, and the true pose T_w_b (4,4), None where it is unknown."""

    frame: Frame
    imu: ImuBatch | None = None
    odometry: OdometryBatch | None = None
    T_w_b: F64 | None = None


@dataclass(frozen=True, slots=True)
class Recording:
    """Items in order of time. imu: calibration; None: the inertial samples are not used."""

    rig: CameraRig
    imu: ImuCalibration | None
    items: tuple[Item, ...]

    @property
    def period_ns(self) -> int:
        """Time between the first two frames."""
        return self.items[1].frame.t_ns - self.items[0].frame.t_ns

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the frames that have one; None without any."""
        known = [(item.frame.t_ns, item.T_w_b) for item in self.items if item.T_w_b is not None]
        if not known:
            return None
        return Trajectory(np.array([t for t, _ in known], np.int64), np.array([pose for _, pose in known]))

    def part(self, begin: int, end: int | None = None) -> "Recording":
        """The recording of frames begin..end alone."""
        return replace(self, items=self.items[begin:end])

    def seconds(self, begin_s: float, end_s: float) -> "Recording":
        """The recording from begin_s to end_s after its first frame."""
        first_ns = self.items[0].frame.t_ns
        inside = (item for item in self.items if begin_s <= (item.frame.t_ns - first_ns) * 1e-9 < end_s)
        return replace(self, items=tuple(inside))

    def without_imu(self) -> "Recording":
        """The recording without inertial samples."""
        return replace(self, imu=None, items=tuple(replace(item, imu=None) for item in self.items))

    def left_only(self) -> "Recording":
        """The recording of the left camera and the IMU alone."""
        rig = replace(self.rig, right=None, T_c_r=None, has_depth=False)
        items = (replace(item, frame=replace(item.frame, right=None, depth_m=None)) for item in self.items)
        return replace(self, rig=rig, items=tuple(items))

    def with_odometry(self, batch: OdometryBatch | None) -> "Recording":
        """The recording with these velocities in place of its own, each given to the first frame after it."""
        items, first = [], 0
        for item in self.items:
            part = None
            if batch is not None:
                last = int(np.searchsorted(batch.t_ns, item.frame.t_ns, side="right"))
                part = odometer.chosen(batch, slice(first, last)) if last > first else None
                first = last
            items.append(replace(item, odometry=part))
        return replace(self, items=tuple(items))

    def with_imu(self, samples: ImuBatch) -> "Recording":
        """The recording with these inertial samples in place of its own; those before its first frame go with it."""
        items, first = [], 0
        for item in self.items:
            last = int(np.searchsorted(samples.t_ns, item.frame.t_ns, side="right"))
            items.append(replace(item, imu=chosen(samples, slice(first, last)) if last > first else None))
            first = last
        return replace(self, items=tuple(items))

    def between_rests(self) -> "Recording":
        """The longest part between two moments at which the vehicle hardly moves: it can be flown to and fro."""
        truth = self.truth
        if truth is None:
            return self
        n = len(self.items)
        stamps = np.array([item.frame.t_ns for item in self.items], np.float64)
        position = np.stack([np.interp(stamps, truth.t_ns, truth.T_w_b[:, i, 3]) for i in range(3)], axis=1)
        speed = np.linalg.norm(np.gradient(position, axis=0), axis=1)
        begin, end = int(np.argmin(speed[: n // 4])), n - n // 4 + int(np.argmin(speed[n - n // 4 :]))
        return self.part(begin, end + 1)

    def backward(self) -> "Recording":
        """The recording played backward: another flight with the same sensors, stamps from the same time on.

        A vehicle that flies the same way back has the same specific force, and rotates the other way. A sensor that
        lags, lags behind in the recording and is ahead in this one.
        """
        sum_ns = self.items[0].frame.t_ns + self.items[-1].frame.t_ns
        samples = joined([item.imu for item in self.items if item.imu is not None])
        items = list[Item]()
        if samples is not None:
            samples = ImuBatch(
                np.ascontiguousarray(sum_ns - samples.t_ns[::-1]), np.ascontiguousarray(-samples.gyro[::-1]),
                np.ascontiguousarray(samples.accel[::-1]),
            )  # fmt: skip
        for item in reversed(self.items):
            items.append(Item(replace(item.frame, t_ns=sum_ns - item.frame.t_ns), T_w_b=item.T_w_b))
        turned = replace(self, items=tuple(items))
        return turned if samples is None else turned.with_imu(samples)

    def to_and_fro(self, frames: int) -> Iterator[Item]:
        """So many items, played forward and backward in turn, with stamps that go on.

        Played backward, inertial samples keep their specific force, and rotate the other way.
        """
        n = len(self.items)
        for k in range(frames):
            cycle, at = divmod(k, 2 * n - 2)
            t_ns = self.items[0].frame.t_ns + k * self.period_ns
            if at >= n or (at == 0 and cycle):
                to = 2 * n - 2 - at if at else 0
                imu = _reversed(self.items[to].imu, self.items[to + 1].imu, t_ns)
            else:
                to, imu = at, _moved(self.items[at].imu, t_ns)
            yield Item(replace(self.items[to].frame, t_ns=t_ns), imu)

    def save(self, path: Path) -> Path:
        """Write the recording as a log that flies like any other."""
        with LogWriter(path, {"role": "recording", "source": path.stem}) as log:
            log.rig(self.items[0].frame.t_ns, self.rig, self.imu)
            for item in self.items:
                if item.imu is not None and self.imu is not None:
                    log.imu(IMU, int(item.imu.t_ns[-1]), item.imu)
                if item.T_w_b is not None:
                    log.pose(GROUND_TRUTH, item.frame.t_ns, "world", item.T_w_b)
                log.frame(replace(item.frame, encoded=encode(item.frame, False)))
        return path


def load(source: str, *, imu: bool = True, mono: bool = False, frames: int | None = None) -> Recording:
    """Decode a source, or its first frames. Raises SourceError."""
    opened = open_source(source, mono=mono, imu=imu)
    items = []
    for item in items_of(opened):
        items.append(item)
        if len(items) == frames:
            break
    opened.close()
    return Recording(opened.rig, opened.imu if imu else None, tuple(items))


def items_of(source: FrameSource) -> Iterator[Item]:
    """The frames of a source, each with the sensor data since the frame before."""
    inertial: list[ImuBatch] = []
    driven: list[OdometryBatch] = []
    for item in source:
        if isinstance(item, OdometryBatch):
            driven.append(item)
        elif isinstance(item, ImuBatch):
            inertial.append(item)
        else:
            T_w_b = None
            if source.ground_truth is not None:
                found, poses = metrics.truth_at(np.array([item.t_ns], np.int64), source.ground_truth)
                T_w_b = poses[0] if len(found) else None
            yield Item(replace(item, encoded=()), joined(inertial), odometer.joined(driven), T_w_b)
            inertial, driven = [], []


def _moved(batch: ImuBatch | None, end_ns: int) -> ImuBatch | None:
    """The samples, moved in time so that the last one is at `end_ns`."""
    if batch is None or not len(batch.t_ns):
        return None
    return replace(batch, t_ns=batch.t_ns + (end_ns - int(batch.t_ns[-1])))


def _reversed(before: ImuBatch | None, batch: ImuBatch | None, end_ns: int) -> ImuBatch | None:
    """The samples of `batch`, played backward; the last sample of `before` comes last, at `end_ns`."""
    if batch is None or not len(batch.t_ns):
        return None
    parts = (
        [batch]
        if before is None or not len(before.t_ns)
        else [chosen(before, slice(-1, None)), chosen(batch, slice(0, -1))]
    )
    t_ns, gyro, accel = (np.concatenate([getattr(p, name) for p in parts])[::-1] for name in ("t_ns", "gyro", "accel"))
    return ImuBatch(np.asarray(end_ns - (t_ns - int(t_ns[-1]))), -gyro, np.ascontiguousarray(accel))
