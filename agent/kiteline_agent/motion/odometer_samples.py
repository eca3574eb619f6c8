"""Buffer of odometer samples and their means over an interval."""

from dataclasses import dataclass

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import OdometryBatch

_ANY = 100.0  # (m/s)^2 or (rad/s)^2; any measured direction is far more precise


@dataclass(slots=True)
class MeanVelocity:
    """Means over an interval, in b: velocity (3,) m/s, rate (3,) rad/s, covariances (3,3) of one sample."""

    velocity: F64
    rate: F64
    velocity_cov: F64
    rate_cov: F64


class OdometerSamples:
    """The newest samples in order of time."""

    def __init__(self, keep_s: float, max_gap_s: float) -> None:
        """keep_s: length of the buffer. max_gap_s: a longer gap makes an interval unknown."""
        self._keep_ns, self._gap_ns = int(keep_s * 1e9), int(max_gap_s * 1e9)
        self._samples: OdometryBatch | None = None

    @property
    def any(self) -> bool:
        """True once a sample has arrived."""
        return self._samples is not None

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample; None before one has come."""
        return int(self._samples.t_ns[-1]) if self._samples is not None and len(self._samples.t_ns) else None

    def add(self, batch: OdometryBatch | None) -> None:
        """Append samples that are finite and newer than the newest one."""
        if batch is None or len(batch.t_ns) == 0:
            return
        good = odometry.usable(batch)
        if self._samples is not None and len(self._samples.t_ns):
            if batch.t_ns[-1] < self._samples.t_ns[-1] - self._keep_ns:  # an earlier stamp was far ahead: start again
                self._samples = None
            else:
                good &= batch.t_ns > self._samples.t_ns[-1]
        joined = odometry.joined([b for b in (self._samples, odometry.chosen(batch, good)) if b is not None])
        assert joined is not None
        if len(joined.t_ns):
            first = int(np.searchsorted(joined.t_ns, joined.t_ns[-1] - self._keep_ns))
            joined = odometry.chosen(joined, slice(first, len(joined.t_ns)))
        self._samples = joined

    def between(self, from_ns: int, to_ns: int) -> MeanVelocity | None:
        """Means over an interval, its ends interpolated (held beyond the newest sample); None with a gap."""
        samples, gap_ns = self._samples, self._gap_ns
        if samples is None or len(samples.t_ns) == 0 or to_ns <= from_ns:
            return None
        t = samples.t_ns
        lo, hi = int(np.searchsorted(t, from_ns, "right")), int(np.searchsorted(t, to_ns, "left"))
        inside = t[max(lo - 1, 0) : hi + 1]
        ends = np.concatenate([[max(from_ns, int(inside[0]))], inside[(inside > from_ns) & (inside < to_ns)], [to_ns]])
        if t[0] > from_ns + gap_ns or t[-1] < to_ns - gap_ns or np.diff(inside).max(initial=0) > gap_ns:
            return None
        at = np.concatenate([[from_ns], ends[1:-1], [to_ns]])
        weight = np.zeros(len(at))
        steps = np.diff(at) / (to_ns - from_ns)
        weight[:-1] += 0.5 * steps
        weight[1:] += 0.5 * steps
        seconds, now = (t - from_ns) * 1e-9, (at - from_ns) * 1e-9
        values = np.concatenate([samples.velocity, samples.rate], axis=1)
        mean = np.array([weight @ np.interp(now, seconds, values[:, i]) for i in range(6)])
        some = slice(max(min(lo, hi - 1), 0), max(hi, 1))
        cov, rate_cov = samples.velocity_cov[some].mean(axis=0), samples.rate_cov[some].mean(axis=0)
        return MeanVelocity(
            measured_part(cov, _ANY) @ mean[:3], measured_part(rate_cov, _ANY) @ mean[3:], cov, rate_cov
        )

    def within(self, from_ns: int, to_ns: int) -> tuple[F64, F64, float] | None:
        """Mean velocity (3,), its covariance (3,3) and age in s of the samples in (from_ns, to_ns], if any."""
        samples = self._samples
        if samples is None:
            return None
        inside = (samples.t_ns > from_ns) & (samples.t_ns <= to_ns)
        if not inside.any():
            return None
        cov = samples.velocity_cov[inside].mean(axis=0)
        value = measured_part(cov, _ANY) @ samples.velocity[inside].mean(axis=0)
        return value, cov, float(np.mean(to_ns - samples.t_ns[inside])) * 1e-9


def measured_part(cov: F64, limit: float) -> F64:
    """Projection (3,3) onto the measured directions: 1 for variances far below `limit`, 0 far above."""
    return np.asarray(limit * np.linalg.inv(cov + limit * np.eye(3)))
