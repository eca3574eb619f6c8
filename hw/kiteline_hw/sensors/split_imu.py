"""Joins gyroscope and accelerometer where each sends samples of its own: accelerations at the stamps of the rates.

RealSense's driver publishes both apart unless it is told otherwise, at 200 to 400 Hz and at 63 to 250 Hz.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.ports import SourceReport

GAP_NS = 50_000_000  # ns between two accelerations above which none is interpolated: slower than any such sensor
Row = tuple[float, ...]


class ImuJoiner:
    """Interpolates accelerations linearly at the stamps of the gyroscope; its memory is bounded by `wait_ns`.

    R_g_a: (3,3) axes of the accelerometer in those of the gyroscope; None: they are parallel. wait_ns: how long a rate
    waits for the acceleration after it, by stamps.
    """

    def __init__(self, report: SourceReport, R_g_a: F64 | None = None, wait_ns: int = 2 * GAP_NS) -> None:
        self._report, self._wait_ns = report, wait_ns
        self._R_g_a = None if R_g_a is None or np.allclose(R_g_a, np.eye(3), atol=1e-9) else R_g_a
        self._rates: deque[tuple[int, Row]] = deque()
        self._last: tuple[int, Row] | None = None  # the newest acceleration

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest rate that waits for an acceleration; None if none does."""
        return self._rates[0][0] if self._rates else None

    def add_gyro(self, t_ns: int, rate: Row) -> None:
        """Add a rate (3) in rad/s."""
        self.expire(t_ns)
        self._rates.append((t_ns, rate))

    def add_accel(self, t_ns: int, accel: Row) -> list[tuple[int, Row]]:
        """Add an acceleration (3) in m/s^2; the samples (t_ns, gyro x y z, accel x y z) that are complete with it."""
        last = self._last
        if last is not None and t_ns <= last[0]:
            self._report.skip("imu stamp not increasing", f"acceleration at {t_ns} ns")
            return []
        if self._R_g_a is not None:
            accel = tuple((self._R_g_a @ np.array(accel)).tolist())
        self._last = (t_ns, accel)
        out: list[tuple[int, Row]] = []
        while self._rates and self._rates[0][0] <= t_ns:
            t, rate = self._rates.popleft()
            if t == t_ns:
                out.append((t, rate + accel))
            elif last is None or t < last[0]:  # before the first one, or late
                continue
            elif t_ns - last[0] > GAP_NS:
                self._skip(t)
            else:
                share = (t - last[0]) / (t_ns - last[0])
                out.append((t, rate + tuple(a + (b - a) * share for a, b in zip(last[1], accel, strict=True))))
        return out

    def expire(self, now_ns: int) -> None:
        """Leave out the rates that no acceleration follows in time."""
        while self._rates and now_ns - self._rates[0][0] > self._wait_ns:
            self._skip(self._rates.popleft()[0])

    def _skip(self, t_ns: int) -> None:
        self._report.skip("imu sample without acceleration", f"at {t_ns} ns")


def join_imu(
    items: Iterable[tuple[int, int, Any]], gyro: int, accel: int, joiner: ImuJoiner
) -> Iterator[tuple[int, int, Any]]:
    """Items (t_ns, channel, item) in order of time, with whole samples in place of those of two channels.

    Items of `gyro` and `accel` are rows (6), of which each measures a half. Other items wait until the samples before
    them are complete.
    """
    ready: deque[tuple[int, Row]] = deque()
    others: deque[tuple[int, int, Any]] = deque()
    for t_ns, channel, item in items:
        joiner.expire(t_ns)
        if channel == gyro:
            joiner.add_gyro(t_ns, item[:3])
        elif channel == accel:
            ready.extend(joiner.add_accel(t_ns, item[3:]))
        else:
            others.append((t_ns, channel, item))
        oldest_ns = joiner.oldest_ns
        while ready or (others and (oldest_ns is None or others[0][0] < oldest_ns)):
            if ready and (not others or ready[0][0] <= others[0][0]):
                t, row = ready.popleft()
                yield t, gyro, row
            else:
                yield others.popleft()
    yield from others
