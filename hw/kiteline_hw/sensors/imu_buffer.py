"""Buffers inertial samples until the next frame; drops and counts non-finite and out-of-order ones."""

from typing import Protocol

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.frame import ImuBatch
from kiteline_hw.ports import SourceReport

_NONE_NS = -(2**63)  # ns; before any sample
_LEAP_NS = 1_000_000_000  # ns; no IMU pauses that long and then goes back in time


class ImuSamples(Protocol):
    """The samples of a source that were not taken yet."""

    def take_until(self, t_ns: int) -> ImuBatch | None:
        """All samples not yet taken with a time <= t_ns, or None if there are none."""
        ...


class NoImu:
    """The samples of a source without an IMU."""

    def take_until(self, t_ns: int) -> ImuBatch | None:
        return None


class ImuTable:
    """Samples of a whole recording. t_ns: (n,). gyro: (n,3) rad/s. accel: (n,3) m/s^2."""

    def __init__(self, t_ns: I64, gyro: F64, accel: F64, report: SourceReport) -> None:
        keep = _usable(t_ns, gyro, accel, _NONE_NS, report)
        self._t_ns, self._gyro, self._accel = t_ns[keep], gyro[keep], accel[keep]
        self._next = 0

    def take_until(self, t_ns: int) -> ImuBatch | None:
        begin, end = self._next, int(np.searchsorted(self._t_ns, t_ns, side="right"))
        if end <= begin:
            return None
        self._next = end
        return ImuBatch(self._t_ns[begin:end], self._gyro[begin:end], self._accel[begin:end])


class ImuStream:
    """Samples as they arrive; bounded by the number that arrive between two frames."""

    def __init__(self, report: SourceReport) -> None:
        self._report = report
        self._t_ns: list[int] = []
        self._rows: list[tuple[float, ...]] = []
        self._last_ns = _NONE_NS

    def __len__(self) -> int:
        """The number of buffered samples."""
        return len(self._t_ns)

    def add(self, t_ns: int, row: tuple[float, ...]) -> None:
        """Add a sample: gyro x y z rad/s, accel x y z m/s^2."""
        self._t_ns.append(t_ns)
        self._rows.append(row)

    def take_until(self, t_ns: int) -> ImuBatch | None:
        n = len(self._t_ns)
        while n > 0 and self._t_ns[n - 1] > t_ns:
            n -= 1
        if n == 0:
            return None
        times = np.array(self._t_ns[:n], np.int64)
        rows = np.array(self._rows[:n], np.float64)
        del self._t_ns[:n], self._rows[:n]
        keep = _usable(times, rows[:, :3], rows[:, 3:], self._last_ns, self._report)
        times, rows = times[keep], rows[keep]
        if len(times) == 0:
            return None
        self._last_ns = int(times[-1])
        return ImuBatch(times, rows[:, :3].copy(), rows[:, 3:].copy())


def _usable(t_ns: I64, gyro: F64, accel: F64, last_ns: int, report: SourceReport) -> Bool:
    """Mask (n,) of finite samples whose stamps increase, also over `last_ns`; counts the others in the report."""
    if np.isfinite(gyro).all() and np.isfinite(accel).all() and len(t_ns) and t_ns[0] > last_ns:
        if (t_ns[1:] > t_ns[:-1]).all():
            return np.ones(len(t_ns), np.bool_)
    finite = np.asarray(np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1))
    for t in t_ns[~finite]:
        report.skip("imu sample not finite", f"at {t} ns")
    if len(t_ns) > 2:
        # A single stamp far ahead of both neighbours is wrong itself; otherwise all later samples would be dropped. So
        # is the first of all, which has but one neighbour.
        ahead = np.zeros(len(t_ns), np.bool_)
        ahead[0] = last_ns == _NONE_NS and int(t_ns[0]) - int(t_ns[1]) > _LEAP_NS
        ahead[1:-1] = (t_ns[1:-1] - t_ns[:-2] > _LEAP_NS) & (t_ns[1:-1] > t_ns[2:])
        for t in t_ns[ahead & finite]:
            report.skip("imu stamp not increasing", f"at {t} ns, far ahead of its neighbours")
        finite &= ~ahead
    newest = np.maximum.accumulate(np.concatenate([[last_ns], np.where(finite, t_ns, last_ns)]))[:-1]
    late = finite & (t_ns <= newest)
    for t in t_ns[late]:
        report.skip("imu stamp not increasing", f"at {t} ns")
    return np.asarray(finite & ~late)
