"""Buffers an odometer's velocities until the next frame; drops and counts non-finite and out-of-order ones."""

from collections.abc import Iterable, Iterator

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import UNMEASURED, Frame, ImuBatch, OdometryBatch
from kiteline_hw.ports import SourceReport

VELOCITY_SIGMA_M_S = 0.1  # m/s; of a device that reports no variance
RATE_SIGMA_RAD_S = 0.05  # rad/s; likewise
_UNMEASURED_FROM = 1e3  # a reported variance from here on means "not measured": ROS drivers write 1e3 to 1e9


class OdometerStream:
    """Samples as they arrive; bounded by the number that arrive between two frames."""

    def __init__(self, report: SourceReport | None = None) -> None:
        self._report = report
        self._waiting: list[OdometryBatch] = []
        self._last_ns = -(2**63)

    def __len__(self) -> int:
        """The number of buffered samples."""
        return sum(len(batch.t_ns) for batch in self._waiting)

    def add(self, batch: OdometryBatch) -> None:
        """Add samples in the body frame."""
        self._waiting.append(batch)

    def take_until(self, t_ns: int) -> OdometryBatch | None:
        """All samples not yet taken with a time <= t_ns, or None if there are none."""
        batch = odometry.joined(self._waiting)
        if batch is None:
            return None
        due = batch.t_ns <= t_ns
        self._waiting = [] if due.all() else [odometry.chosen(batch, ~due)]
        sound = odometry.usable(batch)
        newest = np.maximum.accumulate(np.concatenate([[self._last_ns], np.where(due & sound, batch.t_ns, -(2**63))]))
        late = batch.t_ns <= newest[:-1]
        self._note("odometer sample not plausible", batch.t_ns[due & ~sound])
        self._note("odometer stamp not increasing", batch.t_ns[due & sound & late])
        keep = due & sound & ~late
        if not keep.any():
            return None
        self._last_ns = int(batch.t_ns[keep][-1])
        return odometry.chosen(batch, keep)

    def _note(self, reason: str, t_ns: I64) -> None:
        if self._report is not None:
            for t in t_ns:
                self._report.skip(reason, f"at {t} ns")


def insert_before_frames(
    items: Iterable[Frame | ImuBatch], samples: OdometerStream
) -> Iterator[Frame | ImuBatch | OdometryBatch]:
    """The same items, with each Frame after the OdometryBatch of the samples up to its time."""
    for item in items:
        batch = samples.take_until(item.t_ns) if isinstance(item, Frame) else None
        if batch is not None:
            yield batch
        yield item


def reported_covariance(diagonal: F64, sigma: float) -> F64:
    """Covariance (3,3) of three variances as a device reports them.

    One that it does not know (0 or below, not finite) becomes sigma^2, and a huge one UNMEASURED.
    """
    unknown = ~np.isfinite(diagonal) | (diagonal <= 0.0)
    out = np.where(unknown, sigma * sigma, diagonal)
    return np.diag(np.where(out >= _UNMEASURED_FROM, UNMEASURED, out))
