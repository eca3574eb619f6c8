"""When frames were taken. A camera takes them at a constant rate, and a busy computer stamps them late, by chance.

Stamps of the last seconds lie about a straight line over the number of the frame. Where they scatter about it as by
chance, the line tells when a frame was taken far better than its stamp. Stamps that hardly scatter, as those of a
trigger or a driver, are left as they are, and so are frames without a constant rate. Rotations by images and gyro
refute the line where frames are taken as irregularly as they are stamped.
"""

from collections import deque

import numpy as np

from kiteline_agent.inertial.clocks.stamp_line import TAIL, stamp_line
from kiteline_agent.inertial.preintegration import Samples, preintegrate
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.order_statistics import median

_FRAMES = 60  # that a line is fitted to: two or three seconds
_FEWEST = 12  # from which it tells more than a stamp
_KEPT_S = 60.0  # s for which times are known: longer than frames wait for a monocular map and stay in its window
_LEAST_S = 2e-4  # s; error below which a stamp is as good
_GOOD_S = 1e-4  # s; scatter below which only single late stamps are corrected
_MOST = 0.25  # of the period; with more scatter frames cannot be counted
_TOLD_S = 1e-3  # s; scatter that the user should know of
_EARLY, _MOST_EARLY = 4.0, 0.45  # deviations, and periods at most, by which no stamp comes before its frame
_MOST_LATE = 0.1  # share of stamps that are late by half a period or more
_NEWEST, _CHANGED = 6, 4  # newest stamps, and how many of them are beyond that where the rate has changed
_WAIT = 8  # frames to the next line after one that did not fit
_PERIODS = np.linspace(0.88, 1.12, 241)  # that are tried, over the median of the steps
_CHANCE = 7.0  # squared sum of unit vectors over their number, which random ones exceed once in a thousand draws
_RELATED = 0.6  # correlation of neighbours' errors: with more the rate itself has changed
_TURN_VARIANCE = 2.0 * 4e-4**2  # rad^2; of a rotation by two images
_REFUTED = 40.0  # squared errors of rotations, in deviations, by which the line must be worse to be given up
_SHARE = 0.25  # of that, at most, from one frame
_UNTOLD = 25.0  # squared deviations of both, from which something else is wrong


class FrameClock:
    """Call `add` with the stamp of each frame, also of those that are not tracked."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_FRAMES)
        # a frame of the newest line, its period, 0 if there is none, and the scatter about it
        self._begin_ns, self._period_s, self._scatter_s = 0, 0.0, 0.0
        self._events: list[str] = []
        self._told = False
        self._wait = 0  # frames until a line is tried again
        self._off: deque[bool] = deque(maxlen=_NEWEST)  # the newest stamps are off the line
        self._newest_ns: int | None = None
        self._taken_ns: dict[int, int] = {}  # by stamp, of the last _KEPT_S
        self._evidence = 0.0  # by which rotations speak against the line
        self._judged: tuple[int, F64] | None = None  # stamp and R_m_b (3,3) of the last frame
        self.jitter_s = 0.0  # scatter of stamps that are corrected; 0 while none are

    def add(self, stamp_ns: int) -> None:
        """A frame has come."""
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            self._begin_again(0)
            self._taken_ns.clear()
        self._newest_ns = stamp_ns
        taken_ns, self.jitter_s = stamp_ns, 0.0
        strange = self._is_strange(stamp_ns)
        self._off.append(strange)
        if not strange:
            self._stamps_ns.append(stamp_ns)
            if len(self._stamps_ns) >= _FEWEST and not self.refuted:
                taken_ns, self.jitter_s = self._line() or (stamp_ns, 0.0)
        if sum(self._off) >= _CHANGED:
            self._begin_again(_CHANGED)
        if self.jitter_s > _TOLD_S and not self._told:
            self._told = True
            self._events.append(
                f"camera stamps scatter by {1e3 * self.jitter_s:.1f} ms about a constant rate: it is used"
            )
        if self._taken_ns:
            taken_ns = max(taken_ns, next(reversed(self._taken_ns.values())) + 1)
        self._taken_ns[stamp_ns] = taken_ns
        while next(iter(self._taken_ns)) < stamp_ns - 1e9 * _KEPT_S:
            del self._taken_ns[next(iter(self._taken_ns))]

    def take_events(self) -> list[str]:
        """A line for the log once stamps are corrected by much, and once that turned out to be wrong."""
        events, self._events = self._events, []
        return events

    def taken_ns(self, stamp_ns: int) -> int:
        """When the frame of a stamp was taken; another instant is as it is."""
        return self._taken_ns.get(stamp_ns, stamp_ns)

    @property
    def refuted(self) -> bool:
        """True if rotations by images and gyro have shown that frames are taken when their stamps say."""
        return self._evidence > _REFUTED

    def judge(self, stamp_ns: int, R_m_b: F64, samples: Samples | None, bias: F64, calibration: ImuCalibration) -> None:
        """Compare the rotation since the frame before with the gyro's, by line and by stamps.

        R_m_b: (3,3) by images. samples: between the times by the line; None if they tell nothing. bias: (6,).
        """
        before, self._judged = self._judged, (stamp_ns, R_m_b)
        if before is None or samples is None or self.jitter_s == 0.0:
            return
        first_s, last_s = (1e-9 * (t_ns - self.taken_ns(t_ns)) for t_ns in (before[0], stamp_ns))
        turn = preintegrate(samples, bias, calibration).turn
        by_line = se3.so3_log(turn.T @ before[1].T @ R_m_b)
        rates = samples.gyro[[0, -1]] - bias[:3]
        by_stamps = by_line - (last_s * rates[1] - first_s * turn.T @ rates[0])
        squares = float(by_line @ by_line) / _TURN_VARIANCE, float(by_stamps @ by_stamps) / _TURN_VARIANCE
        if min(squares) > _UNTOLD:
            return
        worse, most = squares[0] - squares[1], _SHARE * _REFUTED
        self._evidence = max(self._evidence + min(max(worse, -most), most), -_REFUTED)
        if self.refuted:
            self.refute()

    def refute(self) -> None:
        """Let stamps count for the rest of the flight: images and IMU have shown that they are right."""
        if self.jitter_s > 0.0:
            self.jitter_s, self._evidence = 0.0, np.inf
            self._events.append("camera stamps are right, though they scatter about a constant rate: used again")

    def forget(self) -> None:
        """The next rotation is not relative to the last one: a loss, or a map that moved."""
        self._judged = None

    def _is_strange(self, stamp_ns: int) -> bool:
        """True if a stamp lies before a frame of the line: it is that of the frame before, by half a period late."""
        if self._period_s == 0.0:
            return False
        periods = 1e-9 * (stamp_ns - self._begin_ns) / self._period_s
        early = min(max(_MOST, _EARLY * self._scatter_s / self._period_s), _MOST_EARLY)
        return periods - round(periods) < -early

    def _begin_again(self, keep: int) -> None:
        """Forget all but the newest frames."""
        while len(self._stamps_ns) > keep:
            self._stamps_ns.popleft()
        self._period_s, self._wait = 0.0, 0
        self._off.clear()

    def _line(self) -> tuple[int, float] | None:
        """When the newest frame was taken, and the scatter of stamps, s; None if its stamp is as good."""
        steps_ns = np.diff(np.array(self._stamps_ns, np.int64))
        if int(steps_ns.max()) - int(steps_ns.min()) < 1e9 * _LEAST_S:
            return None
        n = self._numbers(1e-9 * steps_ns.astype(np.float64))
        if n is None or len(n) < _FEWEST:
            return None
        first_ns = self._stamps_ns[0]
        line = stamp_line(n, 1e-9 * (np.array(self._stamps_ns, np.int64) - first_ns).astype(np.float64))
        off, most = line.off_s, TAIL * line.scatter_s
        self._off[-1] = abs(off[-1]) > most
        if min(abs(off[-1]), abs(off[-2])) > 2.0 * most and abs(off[-1] - off[-2]) < 2.0 * line.scatter_s:
            self._begin_again(2)  # another phase: late ones are not late by the same
            return None
        near = np.clip(off, -most, most)
        related = float(near[1:] @ near[:-1]) > _RELATED * float(near @ near)
        if related or not line.scatter_s < _MOST * line.period_s:
            self._fail()
            return None
        self._begin_ns, self._period_s = first_ns + round(1e9 * line.begin_s), line.period_s
        self._scatter_s = line.scatter_s
        early = off[-1] < -2.0 * most  # none is stamped before it was taken
        as_good = line.scatter_s < _GOOD_S and abs(off[-1]) < _LEAST_S
        return None if early or as_good else (self._begin_ns, line.scatter_s)

    def _numbers(self, steps_s: F64) -> F64 | None:
        """Numbers (k,) of the frames, 0 for the newest, by the line before or the rhythm of the stamps; None: unknown.

        Of two stamps with one number the first came late, by half a period or more: it is forgotten. steps_s: between
        the stamps.
        """
        t_s = np.append(0.0, np.cumsum(steps_s))
        begin_s, period_s = 1e-9 * (self._begin_ns - self._stamps_ns[0]), self._period_s
        if period_s == 0.0:
            self._wait -= 1
            found = _rhythm(t_s, median(steps_s)) if self._wait < 0 else None
            if found is None:
                if self._wait < 0:
                    self._fail()
                return None
            begin_s, period_s = found
        n = np.round((t_s - begin_s) / period_s)
        once = np.append(n[1:] != n[:-1], True)
        if int((~once).sum()) > _MOST_LATE * len(once):
            self._fail()
            return None
        if not once.all():
            self._stamps_ns = deque(np.array(self._stamps_ns)[once].tolist(), maxlen=_FRAMES)
        return np.asarray(n[once] - n[-1])

    def _fail(self) -> None:
        """No line fits: try again later, with newer stamps."""
        self._begin_again(_FRAMES // 2)
        self._wait = _WAIT


def _rhythm(t_s: F64, about_s: float) -> tuple[float, float] | None:
    """Phase and period, about_s or near it, to which times t_s (n,) fit best, whatever frames are missing.

    None if random times would fit as well.
    """
    periods_s = about_s * _PERIODS
    waves = np.exp(2j * np.pi * t_s / periods_s[:, None]).mean(axis=1)
    best = int(np.argmax(np.abs(waves)))
    if len(t_s) * float(np.abs(waves[best])) ** 2 < _CHANCE:
        return None
    return float(np.angle(waves[best]) / (2.0 * np.pi) * periods_s[best]), float(periods_s[best])
