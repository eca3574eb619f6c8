"""The newest IMU samples, and the noise that they show."""

from copy import copy
from dataclasses import replace

import numpy as np

from kiteline_agent.inertial import imu_kernels
from kiteline_agent.inertial.preintegration import Samples
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.frame import ImuBatch
from kiteline_core.order_statistics import median

_NOISE_MEMORY_S = 0.5  # over which the noise is averaged: rotors change speed faster than biases do
_AT_ONCE = 20  # samples whose noise is measured together
_ATTACK = 4.0  # factor of variance above which new noise replaces the average at once: motors start
_BEFORE = 5  # samples before new ones, for their differences
_STEP_GAIN = 0.1  # with which the usual time between samples follows
_RECENT = 10  # samples whose mean is without vibration
EVEN = 1.5  # longest over shortest step of three samples whose second difference is used
GAP = 2.5  # of the usual step: a longer one misses samples
_GAP_GYRO_RAD_S, _GAP_ACCEL_M_S2 = 0.3, 2.0  # error of interpolation over missing samples
_HELD_NS = 25_000_000  # for which the newest sample may stand in for those that have not come yet
_FEW = 2.5  # usual steps for which it may where accelerations tell lengths
_HELD = 2.0, 20.0  # rad/s and m/s^2, error of samples that have not come yet: next to nothing beside images
_CLIPPED_GYRO_RAD_S, _CLIPPED_ACCEL_M_S2 = 1.0, 10.0  # error of a sample at the end of the range
_RANGE_GYRO_RAD_S, _RANGE_ACCEL_M_S2 = 2.0, 15.0  # no IMU has a smaller range


class SampleBuffer:
    """The newest IMU samples in order of time.

    The white part of the noise is measured by second differences, to which motion hardly contributes: vibration is
    often far above the noise density of a data sheet. Tones near half the rate of the samples average out over a frame,
    so differences of pairs of samples count where they are smaller. Steps across missing or clipped samples have more
    noise.
    """

    def __init__(self, keep_s: float, max_gap_s: float) -> None:
        """keep_s: length of the buffer. max_gap_s: a longer gap makes an interval unknown."""
        self._keep_ns = int(keep_s * 1e9)
        self._gap_ns = int(max_gap_s * 1e9)
        self._t: I64 = np.zeros(0, np.int64)
        self._values = np.zeros((0, 6))
        self._clipped: Bool = np.zeros((0, 2), np.bool_)
        self._largest = np.array([_RANGE_GYRO_RAD_S, _RANGE_ACCEL_M_S2])  # magnitudes so far
        self._unmeasured = 0  # new samples whose noise was not measured yet
        self._step_ns: float | None = None  # usual time between two samples
        self._variance = np.zeros((2, 2))  # of the noise of one sample, by samples and by pairs: gyro, accel

    def push(self, imu: ImuBatch | None) -> None:
        """Append samples that are finite and newer than the newest one."""
        if imu is None or len(imu.t_ns) == 0:
            return
        values = np.concatenate([imu.gyro, imu.accel], axis=1)
        newest = int(self._t[-1]) if len(self._t) else -(1 << 62)
        stamps, new = imu.t_ns, len(imu.t_ns)
        if int(stamps.min()) <= newest or not np.isfinite(values).all():
            good = (stamps > newest) & np.isfinite(values).all(axis=1)
            stamps, values, new = stamps[good], values[good], int(np.count_nonzero(good))
        if new:
            t = np.concatenate([self._t, stamps])
            first = int(t.searchsorted(t[-1] - self._keep_ns))
            self._t, self._values = t[first:], np.concatenate([self._values, values])[first:]
            self._clipped = np.concatenate([self._clipped, np.zeros((new, 2), np.bool_)])[first:]
            self._find_clipped(new)
            self._unmeasured += new
            if self._unmeasured >= _AT_ONCE:
                self._measure_noise(min(self._unmeasured, len(self._t)))
                self._unmeasured = 0

    def extended(self, imu: ImuBatch | None) -> "SampleBuffer":
        """A copy with more samples; this buffer stays as it is."""
        other = copy(self)
        other._largest, other._variance = self._largest.copy(), self._variance.copy()  # `push` replaces the others
        other.push(imu)
        return other

    @property
    def newest_t_ns(self) -> int | None:
        """Time of the newest sample."""
        return int(self._t[-1]) if len(self._t) else None

    @property
    def last_accel(self) -> F64:
        """Mean specific force (3,) of the newest samples, m/s^2; zero without any."""
        return np.asarray(self._values[-_RECENT:, 3:].mean(axis=0)) if len(self._t) else np.zeros(3)

    @property
    def density(self) -> F64:
        """Measured noise density (2,) of gyro (rad/s/sqrt(Hz)) and accelerometer (m/s^2/sqrt(Hz))."""
        return np.asarray(np.sqrt(self._variance.min(axis=0) * (self._step_ns or 0.0) * 1e-9))

    def lacks(self, to_ns: int) -> bool:
        """True if samples before an instant have not come yet; what `between` gives in their place is a guess."""
        return len(self._t) == 0 or to_ns - int(self._t[-1]) > _HELD_NS

    def lacks_some(self, to_ns: int) -> bool:
        """True if more than a sample or two have not come yet: a held one is no acceleration that tells lengths."""
        return len(self._t) == 0 or to_ns - int(self._t[-1]) > _FEW * (self._step_ns or 0.0)

    def between(self, from_ns: int, to_ns: int) -> Samples | None:
        """Samples from one instant to another, ends interpolated (held beyond the newest); None with a gap."""
        t = self._t
        if len(t) < 2 or to_ns <= from_ns:
            return None
        lo, hi = int(t.searchsorted(from_ns, "right")), int(t.searchsorted(to_ns, "left"))
        stamps = np.empty(hi - lo + 2, np.int64)
        stamps[0], stamps[1:-1], stamps[-1] = from_ns, t[lo:hi], to_ns
        steps = stamps[1:] - stamps[:-1]
        if from_ns < t[0] - self._gap_ns or to_ns > t[-1] + self._gap_ns or steps.max() > self._gap_ns:
            return None
        values = np.empty((hi - lo + 2, 6))
        values[1:-1] = self._values[lo:hi]
        values[0] = self._at(from_ns)
        values[-1] = self._at(to_ns)
        return Samples(
            (stamps - from_ns).astype(np.float64) * 1e-9,
            np.ascontiguousarray(values[:, :3]),
            np.ascontiguousarray(values[:, 3:]),
            self._densities(steps, lo, hi),
        )

    def ahead(self, from_ns: int, to_ns: int) -> Samples | None:
        """`between`, but that forces which have not come yet are the mean of the newest ones: one alone vibrates."""
        samples = self.between(from_ns, to_ns)
        if samples is not None and to_ns > self._t[-1]:
            samples.accel[-1] = 2.0 * self.last_accel - samples.accel[-2]  # with the sample before, the mean
        return samples

    def within(self, from_ns: int, to_ns: int) -> F64:
        """The samples (n,6) between two instants."""
        first, last = self._t.searchsorted(from_ns, "left"), self._t.searchsorted(to_ns, "right")
        return self._values[first:last]

    def samples(self) -> tuple[I64, F64]:
        """Stamps (n,) of all samples, and the samples (n,6)."""
        return self._t, self._values

    def _at(self, t_ns: int) -> F64:
        t = self._t
        k = int(t.searchsorted(t_ns))
        if k == 0 or k == len(t):
            return np.asarray(self._values[min(k, len(t) - 1)])
        share = (t_ns - int(t[k - 1])) / (int(t[k]) - int(t[k - 1]))
        return np.asarray((1.0 - share) * self._values[k - 1] + share * self._values[k])

    def _densities(self, steps: I64, lo: int, hi: int) -> F64:
        """Noise density (n,2) of the steps (n,) in ns, between samples lo - 1 and hi."""
        out = np.empty((len(steps), 2))
        out[:] = self.density
        missed = steps > GAP * self._step_ns if self._step_ns else np.zeros(len(steps), np.bool_)
        if missed.any():
            dt_s = steps[missed] * 1e-9
            out[missed] = np.sqrt(out[missed] ** 2 + np.outer(dt_s, [_GAP_GYRO_RAD_S**2, _GAP_ACCEL_M_S2**2]))
        if self._clipped[max(lo - 1, 0) : hi + 1].any():
            ends = self._clipped[np.clip(np.arange(lo - 1, hi + 1), 0, len(self._t) - 1)]
            clipped = ends[:-1] | ends[1:]
            extra = np.array([_CLIPPED_GYRO_RAD_S, _CLIPPED_ACCEL_M_S2]) * clipped
            out = np.sqrt(out**2 + steps[:, None] * 1e-9 * extra**2)
        return out

    def _find_clipped(self, new: int) -> None:
        """Mark new samples that repeat the largest magnitude of the flight: the end of the range."""
        size = np.abs(self._values[-new - 1 :])
        most = size.max(axis=0).tolist()
        for sensor, largest in enumerate((max(most[:3]), max(most[3:]))):
            if largest < self._largest[sensor]:
                continue
            self._largest[sensor] = largest
            at_end = (size[:, 3 * sensor : 3 * sensor + 3] == largest).any(axis=1)
            if np.count_nonzero(at_end) > 1:
                self._clipped[-len(size) :, sensor] |= at_end

    def _measure_noise(self, new: int) -> None:
        """Update the usual step and the variances of the noise by the newest samples."""
        t, values = self._t[-new - _BEFORE :], self._values[-new - _BEFORE :]
        if len(t) < 3:
            return
        usual = median((t[1:] - t[:-1]).astype(np.float64))
        self._step_ns = usual if self._step_ns is None else self._step_ns + _STEP_GAIN * (usual - self._step_ns)
        sums = np.empty((2, 2))
        count, pairs = imu_kernels.second_differences(t, values, self._step_ns, EVEN, GAP, sums)
        if count == 0:
            return
        share = 1.0 - float(np.exp(-count * self._step_ns * 1e-9 / _NOISE_MEMORY_S))
        self._follow_noise(0, sums[0] / count, share)
        if pairs > 0:
            self._follow_noise(1, sums[1] / pairs, share)

    def _follow_noise(self, scale: int, found: F64, share: float) -> None:
        """Average a variance (2,) of gyro and accelerometer."""
        before = self._variance[scale]
        self._variance[scale] = np.where(found > _ATTACK * before, found, before + share * (found - before))


def without_held(samples: Samples) -> Samples:
    """Samples of which the last step, held as they had not come yet, counts next to nothing."""
    assert samples.density is not None
    density = samples.density.copy()
    density[-1] = np.maximum(density[-1], np.sqrt(samples.t_s[-1] - samples.t_s[-2]) * np.array(_HELD))
    return replace(samples, density=density)
