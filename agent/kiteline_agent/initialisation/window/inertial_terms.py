"""The inertial part of a window: errors of the IMU's samples and of priors, and how large these errors turn out."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kiteline_agent.inertial.preintegration import BiasPrior, Preintegrated, Samples, TimeOffset, preintegrate
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.window.window_noise import NoiseEvidence, WindowNoise, vibration
from kiteline_agent.initialisation.window.window_state import WindowState, tangent
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

STATE = 12  # unknowns of a keyframe: rotation (right), position, velocity, accelerometer bias
SHARED = 6  # unknowns of the window: gyro bias, direction of gravity, time offset
OFFSET = 5  # the last of these
_PAIR = 2 * STATE  # unknowns of two keyframes
_FLOOR = np.diag(np.repeat([2e-5, 5e-4, 2e-5], 3) ** 2)  # of an interval's covariance: rad, m/s, m
NO_OFFSET = TimeOffset(0.0, 1e-6)  # for certain
_ENDS_S = 0.012  # s of samples at the ends of an interval that tell the rate and force there: vibration averages out
_FAR_S = 5e-4  # s; from a change of the time offset by so much samples are cut anew

CutSamples = Callable[[float], list[Samples] | None]  # K - 1 intervals at a time offset in s; None: samples are missing


class InertialTerms:
    """Preintegrated intervals between K keyframes. Call `integrate` first, and again when a state `moved_far`."""

    def __init__(
        self, cut: CutSamples, offset: TimeOffset, calibration: ImuCalibration, gravity_m_s2: float,
        prior: BiasPrior, config: InertialBundleConfig, noise: WindowNoise,
    ) -> None:  # fmt: skip
        """offset: time offset as known before the window; none of its samples is missing there."""
        self._cut, self._offset = cut, offset
        intervals = cut(self._offset.offset_s)
        assert intervals is not None
        self._intervals, self._cut_at_s = _without_measured_noise(intervals), self._offset.offset_s
        self._calibration = replace(
            calibration,
            gyro_noise=noise.gyro * config.imu_inflation * calibration.gyro_noise,
            accel_noise=noise.accel * config.imu_inflation * calibration.accel_noise,
        )
        told = config.imu_inflation * calibration.accel_noise  # no interval has less, unless the window shows it
        least = min(noise.accel, 1.0) * told
        self._calibrations = [
            replace(self._calibration, accel_noise=max(float(level) * self._calibration.accel_noise, least))
            for level in vibration(intervals).levels
        ]
        self._walk = noise.walk * float(np.hypot(calibration.accel_walk, config.accel_walk))
        self._gravity_m_s2 = gravity_m_s2
        self._prior = prior
        self.motions: list[Preintegrated] = []
        self._later: list[F64] = []  # (9,) of each interval: its change by the time offset
        self._integrated_at_s = self._cut_at_s  # time offset of a state; the cut stays where samples are missing
        self._info: list[F64] = []
        self._known: tuple[WindowState, F64, list[F64]] | None = None  # errors and motions of the last state

    def preintegrate(self, samples: Samples, bias: F64) -> Preintegrated:
        """One interval with a bias (6,)."""
        return preintegrate(samples, bias, self._calibration)

    def samples_at(self, offset_s: float) -> list[Samples]:
        """The samples between the keyframes at a time offset, or at the one before if some are missing there."""
        if abs(offset_s - self._cut_at_s) > _FAR_S:
            intervals = self._cut(offset_s)
            if intervals is not None:
                self._intervals, self._cut_at_s = _without_measured_noise(intervals), offset_s
        return self._intervals

    def has_samples_at(self, offset_s: float) -> bool:
        """True if the samples were cut near this time offset: none are missing there."""
        return abs(offset_s - self._cut_at_s) < 2.0 * _FAR_S

    def integrate(self, state: WindowState) -> None:
        """Integrate the samples with the state's biases, at its time offset."""
        self._known, self._integrated_at_s = None, state.offset_s
        self.motions, self._later = [], []
        for samples, bias, calibration in zip(
            self.samples_at(state.offset_s), state.accel_bias, self._calibrations, strict=False
        ):
            both = np.concatenate([state.gyro_bias, bias])
            self.motions.append(preintegrate(samples, both, calibration))
            self._later.append(_by_offset(samples, self.motions[-1]))
        self._info = [np.asarray(np.linalg.inv(m.cov + _FLOOR)) for m in self.motions]

    def moved_far(self, state: WindowState) -> bool:
        """True if the state's biases or offset are too far from the integrated ones for a linear correction."""
        if abs(state.offset_s - self._integrated_at_s) > _FAR_S:
            return True
        gyro = max(float(np.abs(m.bias[:3] - state.gyro_bias).max()) for m in self.motions)
        accel = max(
            float(np.abs(m.bias[3:] - bias).max()) for m, bias in zip(self.motions, state.accel_bias, strict=False)
        )
        return gyro > 0.01 or accel > 0.2

    def cost(self, state: WindowState, *, inertial: bool) -> float:
        """Half the squared errors. inertial: False counts rotations and priors alone."""
        used = self._used_info(inertial=inertial)
        cost = 0.5 * sum(float(e @ i @ e) for e, i in zip(self._errors(state), used, strict=True))
        return cost + self._prior_cost(state)

    def add(self, state: WindowState, h: F64, b: F64, *, inertial: bool) -> float:
        """Add the normal equations of the errors; returns their cost."""
        cost, begin = 0.0, STATE * len(state.R)
        shared = slice(begin, begin + SHARED)
        errors, infos, tilt = self._errors(state), self._used_info(inertial=inertial), self._tilt(state)
        for k, e in enumerate(errors):
            j = self._jacobian(state, e, k, tilt)
            weighted = j.T @ infos[k]
            both, system = slice(STATE * k, STATE * (k + 2)), weighted @ j
            h[both, both] += system[:_PAIR, :_PAIR]
            h[both, shared] += system[:_PAIR, _PAIR:]
            h[shared, both] += system[_PAIR:, :_PAIR]
            h[shared, shared] += system[_PAIR:, _PAIR:]
            change = weighted @ e
            b[both] += change[:_PAIR]
            b[shared] += change[_PAIR:]
            cost += 0.5 * float(e @ infos[k] @ e)
        return cost + self._add_priors(state, h, b)

    def mean_chi2(self, state: WindowState) -> float:
        """Mean squared error in deviations."""
        errors = self._errors(state)
        return float(np.mean([e @ i @ e for e, i in zip(errors, self._info, strict=True)])) / 9.0

    def evidence(self, state: WindowState, cov: F64) -> NoiseEvidence:
        """How large the errors are, and would be by the error model. cov: of all unknowns but landmarks.

        What the unknowns take up of an error is not expected (W. Förstner, variance components).
        """
        chi2, expected, tilt = np.zeros(3), np.zeros(3), self._tilt(state)
        shared = np.arange(STATE * len(state.R), STATE * len(state.R) + SHARED)
        for k, (e, motion) in enumerate(zip(self._errors(state), self.motions, strict=True)):
            j = self._jacobian(state, e, k, tilt)
            columns = np.concatenate([np.arange(STATE * k, STATE * (k + 2)), shared])
            taken = j @ cov[np.ix_(columns, columns)] @ j.T
            for part, rows in enumerate((slice(0, 3), slice(3, 9))):
                info = np.linalg.inv(motion.cov[rows, rows] + _FLOOR[rows, rows])
                chi2[part] += e[rows] @ info @ e[rows]
                expected[part] += len(info) - np.trace(info @ taken[rows, rows])
            rows_a = STATE * k + 9 + np.arange(3)
            d = cov[rows_a, rows_a] + cov[rows_a + STATE, rows_a + STATE] - 2.0 * cov[rows_a, rows_a + STATE]
            variance = self._walk**2 * motion.dt_s
            chi2[2] += float(((state.accel_bias[k + 1] - state.accel_bias[k]) ** 2).sum()) / variance
            expected[2] += 3.0 - float(d.sum()) / variance
        return NoiseEvidence(chi2, np.maximum(expected, 0.0))

    def _errors(self, state: WindowState) -> F64:
        """(K-1,9) errors of rotation, velocity and position."""
        return self._errors_and_motions(state)[0]

    def _errors_and_motions(self, state: WindowState) -> tuple[F64, list[F64]]:
        """`_errors`, and the change of velocity and position (6,) of each interval with the state's biases."""
        if self._known is not None and self._known[0] is state:
            return self._known[1:]
        rows, moved, later_s = [], [], state.offset_s - self._cut_at_s
        for k, (motion, later) in enumerate(zip(self.motions, self._later, strict=True)):
            turn, vp = motion.corrected(np.concatenate([state.gyro_bias, state.accel_bias[k]]))
            turn, vp = turn @ se3.so3_exp(later_s * later[:3]), vp + later_s * later[3:]
            back, dt = state.R[k].T, motion.dt_s
            dv = state.v[k + 1] - state.v[k] - state.gravity * dt
            dp = state.p[k + 1] - state.p[k] - state.v[k] * dt - 0.5 * dt * dt * state.gravity
            rows.append(
                np.concatenate([se3.so3_log(turn.T @ back @ state.R[k + 1]), back @ dv - vp[:3], back @ dp - vp[3:]])
            )
            moved.append(vp)
        errors = np.array(rows)
        self._known = state, errors, moved
        return errors, moved

    def _tilt(self, state: WindowState) -> F64:
        """(3,2) by which the direction of gravity moves it."""
        return np.asarray(self._gravity_m_s2 * tangent(state.gravity))

    def _jacobian(self, state: WindowState, e: F64, k: int, tilt: F64) -> F64:
        """(9,30) of interval k by its two keyframes and the shared unknowns. tilt: see `_tilt`."""
        motion, back, dt = self.motions[k], state.R[k].T, self.motions[k].dt_s
        vp = self._errors_and_motions(state)[1][k]
        j = np.zeros((9, 2 * STATE + SHARED))
        j[:3, :3], j[:3, 12:15] = -state.R[k + 1].T @ state.R[k], np.eye(3)
        j[3:6, :3], j[3:6, 6:9], j[3:6, 18:21] = se3.skew(e[3:6] + vp[:3]), -back, back
        j[6:, :3], j[6:, 3:6], j[6:, 15:18] = se3.skew(e[6:] + vp[3:]), -back, back
        j[6:, 6:9] = -dt * back
        j[3:, 9:12] = -motion.jac[3:, 3:]
        j[:, 24:27] = -motion.jac[:, :3]
        j[3:6, 27:29], j[6:, 27:29] = -dt * back @ tilt, -0.5 * dt * dt * back @ tilt
        j[:, 29] = -self._later[k]
        return j

    def _used_info(self, *, inertial: bool) -> list[F64]:
        if inertial:
            return self._info
        used = [np.zeros((9, 9)) for _ in self._info]
        for out, info in zip(used, self._info, strict=True):
            out[:3, :3] = info[:3, :3]
        return used

    def _prior_cost(self, state: WindowState) -> float:
        steps = np.diff(state.accel_bias, axis=0) / self._walk_sigma()[:, None]
        off = (np.concatenate([state.gyro_bias, state.accel_bias[0]]) - self._prior.bias) / self._prior.sigma
        late = (state.offset_s - self._offset.offset_s) / self._offset.sigma_s
        return 0.5 * float((steps**2).sum() + off @ off + late * late)

    def _walk_sigma(self) -> F64:
        return np.array([self._walk * np.sqrt(m.dt_s) for m in self.motions])

    def _add_priors(self, state: WindowState, h: F64, b: F64) -> float:
        """Random walk of the accelerometer bias, and priors of the first biases and of the time offset."""
        for k, sigma in enumerate(self._walk_sigma()):
            rows = STATE * k + 9 + np.arange(3)
            change = (state.accel_bias[k + 1] - state.accel_bias[k]) / sigma**2
            for r, g in zip(rows, change, strict=True):
                h[r, r] += sigma**-2.0
                h[r + STATE, r + STATE] += sigma**-2.0
                h[r, r + STATE] -= sigma**-2.0
                h[r + STATE, r] -= sigma**-2.0
                b[r] -= g
                b[r + STATE] += g
        info = self._prior.sigma**-2.0
        rows = np.concatenate([STATE * len(state.R) + np.arange(3), 9 + np.arange(3)])
        h[rows, rows] += info
        b[rows] += info * (np.concatenate([state.gyro_bias, state.accel_bias[0]]) - self._prior.bias)
        offset, known = STATE * len(state.R) + OFFSET, self._offset.sigma_s**-2.0
        h[offset, offset] += known
        b[offset] += known * (state.offset_s - self._offset.offset_s)
        return self._prior_cost(state)


def _by_offset(samples: Samples, motion: Preintegrated) -> F64:
    """(9,) derivative of [rotation, on the right, velocity, position] by the time offset, per s: both ends move."""
    first, last = samples.t_s <= _ENDS_S, samples.t_s >= samples.t_s[-1] - _ENDS_S
    rate = [samples.gyro[rows].mean(axis=0) - motion.bias[:3] for rows in (first, last)]
    force = [samples.accel[rows].mean(axis=0) - motion.bias[3:] for rows in (first, last)]
    dv, dp = motion.vp[:3], motion.vp[3:]
    turn = rate[1] - motion.turn.T @ rate[0]
    velocity = motion.turn @ force[1] - force[0] - np.cross(rate[0], dv)
    position = dv - motion.dt_s * force[0] - np.cross(rate[0], dp)
    return np.concatenate([turn, velocity, position])


def _without_measured_noise(intervals: list[Samples]) -> list[Samples]:
    """Samples with the calibrated noise, and more only in steps that miss samples or are clipped.

    Much of the measured noise is fast motion, which averages out over an interval.
    """
    measured = [s.density for s in intervals if s.density is not None]
    if len(measured) < len(intervals):
        return [replace(s, density=None) for s in intervals]
    usual = np.concatenate(measured).min(axis=0)
    return [replace(s, density=np.where(d > usual, d, 0.0)) for s, d in zip(intervals, measured, strict=True)]
