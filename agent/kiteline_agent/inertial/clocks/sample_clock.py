"""When samples of an IMU were taken, from stamps of their arrival.

An IMU takes samples at a constant rate. Over a serial line or a bus they arrive late by chance, often several at once,
and many drivers stamp them then. The samples are counted, and a robust line through their stamps over that count tells
when each was taken, apart from a constant delay, which the time offset holds. Even stamps are left as they are. Where
the rate changes, as of a flight controller that is asked for more, the count begins again.
"""

import numpy as np

from kiteline_agent.inertial.clocks.stamp_line import stamp_line
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuBatch, chosen, joined
from kiteline_core.order_statistics import median

_SAMPLES = 400  # that a line is fitted to: one or two seconds
_FEWEST = 80  # from which it tells more than a stamp
_JUDGED = 40  # samples after which stamps are judged again
_EVEN = 0.1  # of a step, by which it may differ from a multiple of the usual one
_FILLED = 2.0  # times the usual step: the mean one, where half of the samples are missing
_UNEVEN = 0.05  # share of steps that differ by more, from which a line is used
_MOST_S = 0.03  # s; scatter beyond which nothing is counted on
_SILENT_S = 0.5  # s without a sample: it begins again
_MISSED = 3.0, 4.0  # deviations of the scatter, and periods: a sample that is later follows missing ones
_EARLY = 4  # samples in a row that come as much too early: the rate has risen
_FEWER = 1.25  # periods a sample in both halves of the newest _FEWEST: the rate has fallen
_ALIKE = 12  # newest steps that are even by themselves, where the rate has changed
_CHANGED = 0.15  # relative change of the usual step, at least, to count as another rate
_TOLD_S = 1e-3  # s; scatter that the user should know of


class SampleClock:
    """Call `timed` with each batch."""

    def __init__(self) -> None:
        self._stamps_ns: I64 = np.zeros(0, np.int64)  # of the newest samples
        self._numbers: I64 = np.zeros(0, np.int64)
        self._begin_ns, self._period_ns, self._scatter_ns = 0.0, 0.0, 0.0  # the line, at number 0; period 0: none
        self._newest_ns: int | None = None  # the last time that was given
        self._last: ImuBatch | None = None  # the last sample, with its stamp
        self._even, self._unjudged = True, 0  # and samples since that was judged
        self._early = 0  # samples in a row that came before the line says that they were taken
        self._told = False
        self._events: list[str] = []

    @property
    def jitter_s(self) -> float:
        """Scatter of stamps that are corrected; 0 while none are."""
        return 1e-9 * self._scatter_ns

    def take_events(self) -> list[str]:
        """A line for the log once stamps are corrected by much."""
        events, self._events = self._events, []
        return events

    def timed(self, imu: ImuBatch | None) -> ImuBatch | None:
        """The samples with the times at which they were taken; without those that cannot be later than the last."""
        if imu is None or len(imu.t_ns) == 0:
            return imu
        imu = self._in_order(imu)
        if len(imu.t_ns) == 0:
            return None
        times_ns = self._taken_ns(imu.t_ns)
        newest_ns = int(times_ns[0]) - 1 if self._newest_ns is None else self._newest_ns
        later = times_ns > np.maximum.accumulate(np.append(newest_ns, times_ns[:-1]))
        last_ns = int(times_ns[-1])
        set_back = int(times_ns.max()) - last_ns > 1e9 * _SILENT_S
        self._newest_ns = last_ns if set_back else max(newest_ns, last_ns)
        if later.all():
            return imu if times_ns is imu.t_ns else ImuBatch(times_ns, imu.gyro, imu.accel)
        return ImuBatch(times_ns[later], imu.gyro[later], imu.accel[later]) if later.any() else None

    def _in_order(self, imu: ImuBatch) -> ImuBatch:
        """The samples without those that a link sends twice or late, and those stamped far ahead of the next one."""
        stamps_ns, last = imu.t_ns, self._last
        follows = last is None or bool(stamps_ns[0] > last.t_ns[0])
        if not (follows and (stamps_ns[1:] > stamps_ns[:-1]).all()):
            silent_ns = round(1e9 * _SILENT_S)
            whole = imu if last is None else joined([last, imu])
            assert whole is not None
            step_ns = np.diff(whole.t_ns)
            keep = np.append(step_ns > -silent_ns, True)
            newest_ns = np.maximum.accumulate(np.where(keep, whole.t_ns, whole.t_ns.min()))[:-1]
            late = (whole.t_ns[1:] < newest_ns) | ((whole.t_ns[1:] == newest_ns) & (step_ns != 0))
            keep[1:] &= ~(late & (newest_ns - whole.t_ns[1:] < silent_ns))
            copy = (step_ns == 0) & (whole.gyro[1:] == whole.gyro[:-1]).all(axis=1)
            keep[1:] &= ~(copy & (whole.accel[1:] == whole.accel[:-1]).all(axis=1))
            imu = chosen(imu, keep[len(keep) - len(imu.t_ns) :])
        if len(imu.t_ns):
            self._last = chosen(imu, slice(-1, None))
        return imu

    def _taken_ns(self, stamps_ns: I64) -> I64:
        """Times (n,) of new samples; the stamps (n,) themselves where they are even or tell no rate."""
        steps_ns = np.diff(stamps_ns)
        silences = 1 + np.flatnonzero((steps_ns < 0) | (steps_ns >= 1e9 * _SILENT_S))
        if len(silences):  # a recording that paused: frames did not come either
            return np.concatenate([self._taken_ns(part) for part in np.split(stamps_ns, silences)])
        old = self._stamps_ns
        if len(old) and not 0 <= int(stamps_ns[0]) - int(old[-1]) < 1e9 * _SILENT_S:
            self._begin_again()
            self._newest_ns = None
        new = self._number(stamps_ns)
        self._unjudged += len(stamps_ns)
        if self._has_another_rate():
            new = np.arange(-len(stamps_ns), 0) + len(self._numbers)
        if len(self._stamps_ns) >= _FEWEST and self._unjudged >= _JUDGED:
            self._even, self._unjudged = _is_even(np.diff(self._stamps_ns).astype(np.float64), _UNEVEN), 0
        if self._even:
            self._period_ns = self._scatter_ns = 0.0
            return stamps_ns
        first_ns, newest = int(self._stamps_ns[0]), int(self._numbers[-1])
        n = (self._numbers - newest).astype(np.float64)
        line = stamp_line(n, 1e-9 * (self._stamps_ns - first_ns).astype(np.float64))
        if not (line.scatter_s < _MOST_S and line.period_s > 0.0):
            self._period_ns = self._scatter_ns = 0.0
            return stamps_ns
        self._period_ns, self._scatter_ns = 1e9 * line.period_s, 1e9 * line.scatter_s
        self._begin_ns = first_ns + 1e9 * line.begin_s - self._period_ns * newest
        if line.scatter_s > _TOLD_S and not self._told:
            self._told = True
            self._events.append(f"imu: stamps scatter by {1e3 * line.scatter_s:.1f} ms: samples are counted instead")
        return np.round(self._begin_ns + self._period_ns * new).astype(np.int64)

    def _begin_again(self, kept: int = 0) -> None:
        """Count anew, from so many of the newest samples on."""
        self._stamps_ns = self._stamps_ns[len(self._stamps_ns) - kept :]
        self._numbers = np.arange(kept, dtype=np.int64)
        self._even, self._unjudged, self._early = True, kept, 0
        self._period_ns = self._scatter_ns = 0.0

    def _has_another_rate(self) -> bool:
        """True if the newest samples come at another rate than those before, which are forgotten then."""
        steps, n = np.diff(self._stamps_ns).astype(np.float64), self._numbers
        kept = 0
        if self._early >= _EARLY:
            kept = self._early
        elif self._period_ns > 0.0 and len(n) > _FEWEST:
            half = _FEWEST // 2
            if min(n[-1] - n[-1 - half], n[-1 - half] - n[-1 - 2 * half]) > _FEWER * half:
                kept = half  # the other one began before it fell
        if kept == 0 and len(steps) >= 2 * _ALIKE and _is_even(steps[-_ALIKE:]):
            kept = _ALIKE * (abs(median(steps[-_ALIKE:]) / median(steps[:_ALIKE]) - 1.0) > _CHANGED)
        if kept:
            self._begin_again(kept)
        return kept > 0

    def _number(self, stamps_ns: I64) -> I64:
        """Count new samples, and those that are missing before them. Returns their numbers (n,)."""
        last = int(self._numbers[-1]) if len(self._numbers) else -1
        if self._period_ns == 0.0:
            numbers = last + 1 + np.arange(len(stamps_ns), dtype=np.int64)
        else:
            found, most_ns = [], max(_MISSED[0] * self._scatter_ns, _MISSED[1] * self._period_ns)
            for stamp_ns in stamps_ns.tolist():
                late_ns = stamp_ns - self._begin_ns - self._period_ns * (last + 1)
                self._early = self._early + 1 if late_ns < -most_ns else 0
                last += 1 + (round(late_ns / self._period_ns) if late_ns > most_ns else 0)
                found.append(last)
            numbers = np.array(found, np.int64)
        self._stamps_ns = np.concatenate([self._stamps_ns, stamps_ns])[-_SAMPLES:]
        self._numbers = np.concatenate([self._numbers, numbers])[-_SAMPLES:]
        return numbers


def _is_even(steps: F64, uneven: float = 0.0) -> bool:
    """True if all steps, but for a share, are whole multiples of the usual one: samples may be missing."""
    usual = median(steps)
    if not 0.0 < float(steps.mean()) < _FILLED * usual:  # several come at once
        return False
    off = np.abs(steps / usual - np.maximum(np.round(steps / usual), 1.0))
    return int((off > _EVEN).sum()) <= uneven * len(off)
