"""Leaves out samples that no motion explains: single peaks, values that a stuck bus repeats, zeros of a dead one.

A peak is far from the three samples before it and from the next one, which agree among themselves. Vibration is not
taken for peaks: its samples disagree with each other, and are as large as those before. Where the last of new samples
may be a peak, it waits for the next one.
"""

import numpy as np

from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import ImuBatch, joined

_BEFORE = 3  # samples before a peak that agree with the next one
_LEAST = np.repeat([0.5, 5.0], 3)  # rad/s, m/s^2; of a peak: smaller ones do little harm
_LEVELS = 6.0  # times the usual second difference; of noise one in a million is as large
_APART = 3.0  # times what its neighbours differ by
_MEMORY = 128  # samples that tell the usual second difference
_AT_ONCE = 32  # samples after which it is measured again
_REPEATS_MEMORY = 512  # samples that tell how often one repeats the last
_OFTEN = 0.2  # share of repeats from which on they are usual
_TOLD, _TOLD_OF = 20, 1000  # samples left out, and samples, from which on the user should know


class SampleCheck:
    """Call `checked` with each batch."""

    def __init__(self) -> None:
        self._kept = np.zeros((0, 6))  # the last samples that were kept
        self._last = np.zeros((0, 6))  # the last two samples
        self._differences = np.zeros((0, 6))  # magnitudes of the newest second differences
        self._repeats: Bool = np.zeros(0, np.bool_)  # which of the newest samples are the same as the one before
        self._usual: F64 | None = None  # (6,), median of these
        self._unmeasured = 0  # second differences since that was measured
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
        self._seen += len(imu.t_ns)
        if self._waiting is not None:
            imu, self._waiting = joined([self._waiting, imu]), None
            assert imu is not None
        values = np.concatenate([imu.gyro, imu.accel], axis=1)
        keep, waits = self._explained(values)
        self._note_left_out(int(np.count_nonzero(~keep)))
        if waits:
            keep[-1], self._waiting = False, _chosen(imu, slice(len(keep) - 1, None))
        self._kept = np.concatenate([self._kept, values[keep]])[-_BEFORE:]
        self._measure(values[:-1] if waits else values)
        return imu if keep.all() else _chosen(imu, keep) if keep.any() else None

    def _explained(self, values: F64) -> tuple[Bool, bool]:
        """Which of new samples (n,6) a motion explains, (n,), and whether the last one may be a peak."""
        keep: Bool = np.asarray(values.any(axis=1))
        if self._usual is None:
            return keep, False
        before = np.concatenate([self._last[-1:], values[:-1]])
        if self._repeats.mean() < _OFTEN:  # else the sensor is coarse, at rest, or read more often than it measures
            keep &= ~(values == before).all(axis=1)
        least = np.maximum(_LEAST, _LEVELS * self._usual)
        for k in np.flatnonzero(keep & (np.abs(values - before) > 0.5 * least).any(axis=1)).tolist():
            earlier = np.concatenate([self._kept, values[:k][keep[:k]]])[-_BEFORE:]
            if k + 1 == len(values):
                return keep, _is_peak(values[k], earlier, least)
            keep[k] = not _is_peak(values[k], np.concatenate([earlier, values[k + 1 : k + 2]]), least)
        return keep, False

    def _measure(self, values: F64) -> None:
        """Measure with new samples (n,6) how they usually differ."""
        x = np.concatenate([self._last, values])
        repeats = (x[1:] == x[:-1]).all(axis=1)[-len(values) :]
        self._repeats = np.concatenate([self._repeats, repeats])[-_REPEATS_MEMORY:]
        found = np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))
        self._differences, self._last = np.concatenate([self._differences, found])[-_MEMORY:], x[-2:]
        self._unmeasured += len(found)
        if self._unmeasured >= _AT_ONCE:
            self._usual, self._unmeasured = np.sort(self._differences, axis=0)[len(self._differences) // 2], 0

    def _note_left_out(self, count: int) -> None:
        self._left_out += count
        if self._told or self._left_out < _TOLD or self._seen < _TOLD_OF:
            return
        self._told = True
        share = 100.0 * self._left_out / self._seen
        self._events.append(
            f"imu: {share:.1f} % of its samples are peaks, repeats or zeros that no motion explains, and are left "
            "out: check its bus and its supply"
        )


def _is_peak(value: F64, around: F64, least: F64) -> bool:
    """True if a sample (6,) is far from its neighbours (n,6), which agree."""
    off = np.abs(value - np.median(around, axis=0))
    return bool(((off > least) & (off > _APART * (around.max(axis=0) - around.min(axis=0)))).any())


def _chosen(imu: ImuBatch, which: Bool | slice) -> ImuBatch:
    return ImuBatch(imu.t_ns[which], imu.gyro[which], imu.accel[which])
