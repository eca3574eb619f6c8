"""Leaves out samples that no motion explains: single peaks, values that a stuck bus repeats, zeros of a dead one.

A peak is far from the three samples before it and from the next one, which agree among themselves. Vibration is not
taken for peaks: its samples disagree with each other, and are as large as those before. Where the last of new samples
may be a peak, it waits for the next one.
"""

import numpy as np

from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import ImuBatch, chosen, joined

_BEFORE = 3  # samples before a peak that agree with the next one
_LEAST = np.repeat([0.5, 5.0], 3)  # rad/s, m/s^2; of a peak: smaller ones do little harm
_LEVELS = 6.0  # times the usual second difference; of noise one in a million is as large
_APART = 3.0  # times what its neighbours differ by
_MEMORY = 128  # samples that tell the usual second difference
_AT_ONCE = 32  # samples after which the usual second difference is measured again
_REPEATS_MEMORY = 512  # samples that tell how often one repeats the last
_OFTEN = 0.2  # share of repeats from which on they are usual: the sensor is read more often than it measures
_LONG_RUN = 16  # repeats in a row that are not usual of any sensor
_STILL_RAD_S, _STILL_M_S2 = 0.1, (9.3, 10.3)  # turn rate and specific force with which a vehicle may stand still
_TOLD, _TOLD_OF, _TOLD_SHARE = 20, 1000, 0.002  # samples left out, of how many, and what share the user should know of


class SampleCheck:
    """Call `checked` with each batch."""

    def __init__(self) -> None:
        self._before: F64 | None = None  # (6,), the last sample
        self._run = 0  # of repeats that ends there
        self._repeats: Bool = np.zeros(0, np.bool_)  # which of the newest samples are the same as the one before
        self._kept = np.zeros((0, 6))  # the last samples that were kept
        self._last = np.zeros((0, 6))  # the last two that were neither repeats nor zeros
        self._differences = np.zeros((0, 6))  # magnitudes of the newest second differences
        self._usual: F64 | None = None  # (6,), the median of the second differences
        self._unmeasured = 0  # second differences since it was measured
        self._waiting: ImuBatch | None = None  # one sample that may be a peak
        self._seen, self._left_out, self._told = 0, 0, False
        self._events: list[str] = []

    def take_events(self) -> list[str]:
        """A line for the log once some samples were left out."""
        events, self._events = self._events, []
        return events

    def checked(self, imu: ImuBatch | None) -> ImuBatch | None:
        """New samples without those that no motion explains; None if none is left."""
        if imu is None or len(imu.t_ns) == 0:
            return imu
        keep = self._measured(np.concatenate([imu.gyro, imu.accel], axis=1))
        self._seen += len(keep)
        if self._waiting is not None:
            imu, keep, self._waiting = joined([self._waiting, imu]), np.append(True, keep), None
            assert imu is not None
        at = np.flatnonzero(keep)
        peak, waits = self._peaks(np.concatenate([imu.gyro[at], imu.accel[at]], axis=1))
        keep[at[peak]] = False
        self._note_left_out(int(np.count_nonzero(~keep)))
        if waits:
            keep[at[-1]], self._waiting = False, chosen(imu, at[-1:])
        return imu if keep.all() else chosen(imu, keep) if keep.any() else None

    def _measured(self, values: F64) -> Bool:
        """Which of new samples (n,6) a sensor measured: no zeros, nothing that is not finite, no repeats; (n,)."""
        before = values[:1] if self._before is None else self._before[None]
        same = (values == np.concatenate([before, values[:-1]])).all(axis=1)
        same[0] &= self._before is not None
        self._before = values[-1]
        keep: Bool = np.asarray(values.any(axis=1) & np.isfinite(values).all(axis=1))
        if not same.any():
            self._run = 0
            self._repeats = np.concatenate([self._repeats, same])[-_REPEATS_MEMORY:]
            return keep
        for k, is_same in enumerate(same.tolist()):
            self._run = self._run + 1 if is_same and not _may_stand_still(values[k]) else 0
            if self._run < _LONG_RUN:
                self._repeats = np.append(self._repeats, self._run > 0)[-_REPEATS_MEMORY:]
            if self._run >= _LONG_RUN or (self._run and self._repeats.mean() < _OFTEN):
                keep[k] = False
        return keep

    def _peaks(self, values: F64) -> tuple[Bool, bool]:
        """Which of new samples (n,6) are peaks, (n,), and whether the last one may be one."""
        peak, waits, n = np.zeros(len(values), np.bool_), False, len(values)
        for begin in range(0, n, _AT_ONCE):
            end = min(begin + _AT_ONCE, n)
            if self._usual is not None:
                least = np.maximum(_LEAST, _LEVELS * self._usual)
                steps = np.diff(np.concatenate([self._last[-1:], values[begin:end]]), axis=0)
                for k in (begin + np.flatnonzero((np.abs(steps) > 0.5 * least).any(axis=1))).tolist():
                    earlier = np.concatenate([self._kept, values[begin:k][~peak[begin:k]]])[-_BEFORE:]
                    around = np.concatenate([earlier, values[k + 1 : k + 2]])
                    found = len(earlier) == _BEFORE and _is_peak(values[k], around, least)
                    peak[k], waits = found and k + 1 < n, found and k + 1 == n
            end -= int(waits)
            self._kept = np.concatenate([self._kept, values[begin:end][~peak[begin:end]]])[-_BEFORE:]
            self._note_differences(values[begin:end])
        return peak, waits

    def _note_differences(self, values: F64) -> None:
        """Measure the usual second difference with samples (n,6)."""
        x = np.concatenate([self._last, values])
        found = np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))
        self._differences, self._last = np.concatenate([self._differences, found])[-_MEMORY:], x[-2:]
        self._unmeasured += len(found)
        if self._unmeasured >= _AT_ONCE:
            self._usual, self._unmeasured = np.sort(self._differences, axis=0)[len(self._differences) // 2], 0

    def _note_left_out(self, count: int) -> None:
        self._left_out += count
        if self._told or self._seen < _TOLD_OF or self._left_out < max(_TOLD, _TOLD_SHARE * self._seen):
            return
        self._told = True
        share = 100.0 * self._left_out / self._seen
        self._events.append(
            f"imu: {share:.1f} % of its samples are peaks, repeats or zeros that no motion explains, and are left "
            "out: check its bus and its supply"
        )


def _may_stand_still(value: F64) -> bool:
    """True if a sample (6,) is that of a vehicle at rest: one without noise, or a coarse one, repeats itself there."""
    turns, force = np.linalg.norm(value[:3]), np.linalg.norm(value[3:])
    return bool(turns < _STILL_RAD_S and _STILL_M_S2[0] < force < _STILL_M_S2[1])


def _is_peak(value: F64, around: F64, least: F64) -> bool:
    """True if a sample (6,) is far from its neighbours (n,6), which agree."""
    off = np.abs(value - np.median(around, axis=0))
    return bool(((off > least) & (off > _APART * (around.max(axis=0) - around.min(axis=0)))).any())
