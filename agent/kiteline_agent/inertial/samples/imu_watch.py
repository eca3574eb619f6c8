"""Watch for missing IMU samples, stamps of another clock, and accelerations that are not in m/s^2 with gravity."""

import numpy as np

from kiteline_core.frame import ImuBatch

_GRAVITY_S = 3.0  # over which accelerations are averaged: longer than a fall or a jolt of a small vehicle
_LEAST, _MOST = 0.5, 4.0  # times gravity: no flight averages less or more, other units and missing gravity do
_EXPECTED = "expected what an accelerometer measures, in m/s^2 and with gravity: not in g, not linear acceleration"
_OTHER_CLOCK = "and are not used, the images alone carry the pose: expected stamps of one clock for both"
SILENT_S = 3.0  # s without a sample, after which an event is logged


def has_recent(imu: ImuBatch | None, t_ns: int, within_ns: int = round(SILENT_S * 1e9)) -> bool:
    """True if there are samples, and the newest one is stamped less than `within_ns` before the frame at t_ns."""
    return imu is not None and len(imu.t_ns) > 0 and t_ns - int(imu.t_ns[-1]) < within_ns


class ImuWatch:
    """Reports when IMU samples stop, when they resume, and once that they do not measure gravity.

    Samples that are stamped long before their frame, by another clock, are as good as none.
    """

    def __init__(self, silent_s: float, gravity_m_s2: float) -> None:
        """silent_s: time without a sample after which silence is reported."""
        self._silent_ns = round(silent_s * 1e9)
        self._gravity_m_s2 = gravity_m_s2
        self._last_ns: int | None = None  # of the last frame with samples, or of the first frame before any
        self._silent = False
        self._newest_ns: int | None = None  # stamp of the newest sample, also of one that is no use
        self._first_ns: int | None = None  # of the first sample
        self._sum_m_s2, self._count = 0.0, 0  # of the lengths of accelerations
        self._weighed = False

    def frame(self, t_ns: int, imu: ImuBatch | None) -> list[str]:
        """Process a frame; returns the events for the log."""
        if imu is not None and len(imu.t_ns):
            self._newest_ns = int(imu.t_ns[-1])
        if imu is not None and has_recent(imu, t_ns, self._silent_ns):
            was_silent, self._silent, self._last_ns = self._silent, False, t_ns
            return [*(["imu: samples again"] if was_silent else []), *self._weigh(imu)]
        if self._last_ns is None:
            self._last_ns = t_ns
        if self._silent or t_ns - self._last_ns < self._silent_ns:
            return []
        self._silent = True
        if self._newest_ns is not None and self._newest_ns < self._last_ns - self._silent_ns:
            behind_s = (t_ns - self._newest_ns) * 1e-9
            return [f"imu: its samples are stamped {behind_s:.1f} s before the images {_OTHER_CLOCK}"]
        return [f"imu: silent for {(t_ns - self._last_ns) * 1e-9:.1f} s, the images alone carry the pose"]

    def _weigh(self, imu: ImuBatch) -> list[str]:
        """Compare the accelerations of the first seconds with gravity."""
        if self._weighed:
            return []
        if self._first_ns is None:
            self._first_ns = int(imu.t_ns[0])
        self._sum_m_s2 += float(np.linalg.norm(imu.accel, axis=1).sum())
        self._count += len(imu.t_ns)
        if (imu.t_ns[-1] - self._first_ns) * 1e-9 < _GRAVITY_S:
            return []
        self._weighed = True
        mean = self._sum_m_s2 / self._count
        if _LEAST * self._gravity_m_s2 < mean < _MOST * self._gravity_m_s2:
            return []
        told = f"{mean:.3g} m/s^2 in the mean, gravity alone is {self._gravity_m_s2:.3g}"
        return [f"imu: accelerations are {told}: {_EXPECTED}"]
