"""What an odometer adds to tracking: where the vehicle went between two frames, how far that is believed, and how long
the unit of one eye's map is.

Nothing that it says is taken for granted. While images place the vehicle, what it says is compared with what they see,
over windows long enough for both: that gives its scale (one number, as with wheels whose tyres wear), its noise as it
really is, and whether it may be used at all. A slip, a dead sensor, stale stamps or axes that were mixed up show as
noise; noise beyond what is tolerable ends its use until it agrees again. So a bad odometer costs nothing where images
place the vehicle, and where they do not it was checked a moment ago.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial.fixed_lag import BodyVelocity
from kiteline_agent.motion.odometer_samples import Driven, OdometerSamples, measured
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]

_WELL = 0.09  # (m/s)^2 or (rad/s)^2; directions measured worse than this count less and less


@dataclass(frozen=True, slots=True)
class OdometerConfig:
    """How far an odometer is believed."""

    use: bool = True  # False: what a source says is logged and not looked at
    keep_s: float = 3.0  # of samples that are remembered
    max_gap_s: float = 0.25  # a longer hole makes an interval unknown: wheels are read at 10 Hz at least
    floor_m_s: float = 0.02  # error of a velocity that no device states: its own axes, its place, its stamps
    floor_rad_s: float = 0.005  # the same of a turn rate
    correlation_s: float = 0.5  # over which its errors stay alike: a patch of slippery floor, a gust
    compare_s: float = 0.2  # window of a comparison, in which images measure a velocity to a centimetre a second
    least_moved_m: float = 0.02  # moved in a window: less tells nothing of axes and scale
    aligned: float = 0.9  # cosine between what it and what the images measured, from which on lengths are compared
    scale_start: float = 0.1  # relative deviation of its scale before it was compared
    scale_most: float = 0.25  # relative; a larger error is no matter of scale
    scale_floor: float = 0.01  # relative deviation below which its scale is never said to be known
    scale_walk: float = 0.003  # relative, per sqrt(s): load and temperature change
    scale_sigma_m_s: float = 0.05  # noise of a window that is expected when its scale is measured
    start_m_s: float = 0.08  # noise that is expected before it was compared; it counts as one window
    start_rad_s: float = 0.03  # likewise
    memory_s: float = 3.0  # over which errors are averaged to the noise that is expected
    unusual: float = 5.0  # times the expected square: beyond it something has happened
    rise: float = 0.5  # share by which such an error counts at once: trust is lost within 0.2 s
    tolerance_m_s: float = 0.12  # expected noise above which it is not used; that of a good one is 0.05
    tolerance_share: float = 0.10  # of the speed, likewise
    proofs: int = 3  # windows in motion in which it agreed, before it is used
    surprise: float = 4.0  # deviations from what was expected, beyond which it counts nothing: 8 m/s^2
    settled: float = 0.4  # share of such a jump below which it has to fall again before it is used in the dark
    accel_m_s2: float = 2.0  # that a vehicle may have which only its odometer sees: leaning by twelve degrees
    turn_rad_s2: float = 4.0  # likewise: a small multicopter that tilts
    seen_m_s: float = 0.05  # error of a velocity between two frames
    seen_rad_s: float = 0.02  # likewise
    unit_window_s: float = 0.4  # window of a comparison while the unit of one eye's map is sought
    unit_windows: int = 40  # most of them that are kept
    unit_least: int = 8  # fewer cannot tell the unit
    unit_moved_m: float = 0.05  # by the odometer, within a window that counts
    unit_share: float = 0.7  # of the windows that have to agree


class Odometer:
    """Once a frame: `predict`, then `seen` with the measured pose or `coasted` without one. Pure; no clocks."""

    def __init__(self, T_b_c: F64, config: OdometerConfig, *, metric: bool) -> None:
        """T_b_c: (4,4) camera in the body. metric: whether the map's lengths are metres."""
        self._T_b_c, self._T_c_b = T_b_c, se3.inverse(T_b_c)
        self._config = config
        self.metric = metric
        self._samples = OdometerSamples(config.keep_s, config.max_gap_s)
        self.scale, self._scale_var = 1.0, config.scale_start**2  # true velocity = scale * measured
        self._noise, self._turn_noise = config.start_m_s**2, config.start_rad_s**2  # variances
        self._proofs = 0
        self._speed = 0.0  # m/s, as last seen
        self._anchor: tuple[int, F64] | None = None  # T_m_c at the begin of the window
        self._last: tuple[int, F64] | None = None  # T_m_c of the last frame, however it was come by
        self._velocity, self._rate = np.zeros(3), np.zeros(3)  # in b
        self._velocity_cov, self._rate_cov = np.eye(3), np.eye(3)
        self._velocity_slow, self._rate_slow = np.eye(3), np.eye(3)  # what of them lasts over frames
        self._jump = 0.0  # m/s, of what it said in the dark and no vehicle does; 0: it may be believed
        self._alone_s = 0.0  # since it was last believed
        self._carried = False  # the last prediction rests on the odometer
        self._gain = np.zeros((3, 3))  # of that prediction, in b
        self.blind_s = 0.0
        self._way, self._way_cov, self._way_cross = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))  # in m
        self._turn_cov, self._turn_cross = np.zeros((3, 3)), np.zeros((3, 3))  # about the body's axes
        self._units: list[tuple[float, bool]] = []  # metres in a unit, whether the directions agreed
        self._trusted = self._told = False
        self._unmatched = 0  # windows without a sample although it was heard
        self._compared = 0

    # what is known

    @property
    def heard(self) -> bool:
        """Whether there is an odometer at all."""
        return self._samples.any

    @property
    def trusted(self) -> bool:
        """Whether it has agreed with the images of late."""
        return self._trusted

    @property
    def sure(self) -> bool:
        """Whether it was believed in the last prediction."""
        return self._carried and self._alone_s == 0.0

    @property
    def carries(self) -> bool:
        """Whether the last prediction rests on it."""
        return self._carried

    def report(self) -> dict[str, float | bool] | None:
        """What it is worth; None without one."""
        if not self.heard:
            return None
        return {
            "trusted": self._trusted,
            "scale": round(self.scale, 4),
            "scale_sigma": round(float(np.sqrt(self._scale_var)), 4),
            "noise_m_s": round(float(np.sqrt(self._noise)), 4),
            "compared": self._compared,
        }

    def news(self) -> list[str]:
        """What is worth an event since the last call."""
        if self._unmatched == 10:
            self._unmatched += 1
            return ["odometer: none of its stamps lies between those of frames, not used"]
        if self._trusted == self._told:
            return []
        self._told = self._trusted
        if self._trusted:
            return [f"odometer: agrees with what is seen, its scale is {self.scale:.3f}"]
        return [f"odometer: off by {np.sqrt(self._noise):.2f} m/s from what is seen, not used"]

    # once a frame

    def hear(self, batch: OdometryBatch | None) -> None:
        """Take in samples."""
        if self._config.use:
            self._samples.hear(batch)

    def predict(self, T_m_c: F64, t_ns: int) -> F64 | None:
        """T_m_c (4,4) at t_ns from the pose (4,4) of the last frame; None where the odometer cannot tell."""
        self._carried = False
        if not self.heard or not self._trusted or not self.metric or self._last is None:
            return None
        before_ns = self._last[0]
        driven = self._samples.between(before_ns, t_ns)
        if driven is None and self.blind_s == 0.0:
            return None
        c, dt = self._config, (t_ns - before_ns) * 1e-9
        grown = dt * (dt + 2.0 * self._alone_s) * np.eye(3)  # what nobody measures changes for longer and longer
        prior, rate_prior = self._velocity_cov + c.accel_m_s2**2 * grown, self._rate_cov + c.turn_rad_s2**2 * grown
        if driven is None or not self._take(driven, prior, rate_prior):
            self._alone_s += dt
            self._velocity_cov = self._velocity_slow = prior
            self._rate_cov = self._rate_slow = rate_prior
            self._gain = np.zeros((3, 3))
        self._carried = True
        T_b0_b1 = se3.exp(dt * np.concatenate([self._velocity, self._rate]))
        return se3.orthonormalise(T_m_c @ self._T_c_b @ T_b0_b1 @ self._T_b_c)

    def _take(self, driven: Driven, prior: F64, rate_prior: F64) -> bool:
        """Let what was measured change the velocity; False where no vehicle moves like that: it slips, or is dead."""
        c = self._config
        z = self.scale * driven.velocity
        slow = (self._noise + c.floor_m_s**2) * np.eye(3) + self._scale_var * np.outer(z, z)
        told = _blend(self._velocity, prior, z, driven.velocity_cov, slow, c.surprise)
        jump = float(np.linalg.norm(z - self._velocity))
        if not told.expected or jump > c.settled * self._jump > 0.0:
            self._jump = max(self._jump, jump) if self.blind_s > 0.0 else 0.0
            return False
        self._jump = self._alone_s = 0.0
        self._velocity, self._velocity_cov, self._velocity_slow, self._gain = told.value, told.cov, told.slow, told.gain
        slow = (self._turn_noise + c.floor_rad_s**2) * np.eye(3)
        told = _blend(self._rate, rate_prior, driven.rate, driven.rate_cov, slow, np.inf)  # a gust turns at once
        self._rate, self._rate_cov, self._rate_slow = told.value, told.cov, told.slow
        return True

    def seen(self, T_m_c: F64, t_ns: int) -> None:
        """The images (and an IMU) placed the camera at T_m_c (4,4)."""
        if self.heard:
            self._compare(T_m_c, t_ns)
            if self._last is not None and t_ns > self._last[0] and self.blind_s == 0.0 and self.metric:
                self._note_motion(self._last[1], T_m_c, (t_ns - self._last[0]) * 1e-9)
        self._last = (t_ns, T_m_c)
        if self.blind_s > 0.0:
            self._begin_sight()

    def coasted(self, T_m_c: F64, t_ns: int) -> F64 | None:
        """No image placed the camera; it is taken to be at T_m_c (4,4). The covariance (6,6) of the body's pose since
        images were lost, [translation in m, rotation about the body's axes]; None where the odometer did not carry it.
        """
        self._anchor = None
        before, self._last = self._last, (t_ns, T_m_c)
        if before is None:
            return None
        dt = (t_ns - before[0]) * 1e-9
        self.blind_s += dt
        if not self._carried:
            return None
        r = T_m_c[:3, :3] @ self._T_c_b[:3, :3]
        ended = min(dt / self._config.correlation_s, 1.0)  # share of errors that gave way to others
        relax = ended * (r @ self._gain @ r.T)
        self._way = self._way + (T_m_c[:3, 3] - before[1][:3, 3])
        self._way_cross = self._way_cross + dt * (r @ self._velocity_slow @ r.T) - relax @ self._way_cross
        self._way_cov = self._way_cov + dt * (self._way_cross + self._way_cross.T)
        turn_cross = self._turn_cross if self._alone_s > 0.0 else (1.0 - ended) * self._turn_cross
        self._turn_cross = turn_cross + dt * self._rate_slow
        self._turn_cov = self._turn_cov + dt * (self._turn_cross + self._turn_cross.T)
        arm = se3.skew(self._way)
        cov = np.zeros((6, 6))
        cov[:3, :3] = self._way_cov + self._scale_var * np.outer(self._way, self._way)
        cov[:3, :3] += arm @ r @ self._turn_cov @ r.T @ arm.T / 3.0  # turned wrongly on the way, more and more
        cov[3:, 3:] = self._turn_cov
        return 0.5 * (cov + cov.T)

    def velocity(self, t_ns: int) -> BodyVelocity | None:
        """What it says for the inertial smoother of the frame at t_ns; None where it is not to be believed."""
        c = self._config
        if not self.heard or not self._trusted or not self.metric or self._last is None:
            return None
        before_ns = self._last[0]
        told = self._samples.within(before_ns, t_ns)
        if told is None:
            return None
        value, cov, age_s = self.scale * told[0], told[1], told[2]
        dt = (t_ns - before_ns) * 1e-9
        # errors last longer than a frame: so many frames count as one
        slow = (self._noise + c.floor_m_s**2) * np.eye(3) + self._scale_var * np.outer(value, value)
        counted = cov + max(1.0, 2.0 * c.correlation_s / dt) * slow
        return BodyVelocity(value, cov + slow, counted, age_s)

    # the map changes

    def restart(self, T_m_c: F64, t_ns: int) -> None:
        """The pose was found again at T_m_c (4,4), or a new map began there."""
        self._anchor, self._last = (t_ns, T_m_c), (t_ns, T_m_c)
        self._begin_sight()

    def shift(self, T_new_old: F64) -> None:
        """The submap frame moved by (4,4)."""
        self._anchor = None if self._anchor is None else (self._anchor[0], T_new_old @ self._anchor[1])
        self._last = None if self._last is None else (self._last[0], T_new_old @ self._last[1])
        r = T_new_old[:3, :3]
        self._way = r @ self._way
        self._way_cov, self._way_cross = r @ self._way_cov @ r.T, r @ self._way_cross @ r.T

    def change_unit(self, *, metric: bool) -> None:
        """The map's unit changed: to metres, or to one of its own."""
        self.metric = metric
        self._anchor = self._last = None
        self._units = []
        self._begin_sight()

    @property
    def measures_unit(self) -> bool:
        """Whether it is about to tell the unit of one eye's map: most of what it says so far agrees with the images."""
        return 0 < len(self._units) <= 2 * sum(agrees for _, agrees in self._units)

    def unit_m(self) -> tuple[float, float] | None:
        """Metres in a unit of the map, and one deviation; None while that is not known."""
        c = self._config
        agreed = [metres for metres, agrees in self._units if agrees]
        if len(agreed) < max(c.unit_least, c.unit_share * len(self._units)):
            return None
        metres = float(np.median(agreed))
        spread = 1.4826 * float(np.median(np.abs(np.array(agreed) - metres)))
        return metres, 1.25 * spread / float(np.sqrt(len(agreed)))

    # parts

    def _begin_sight(self) -> None:
        self.blind_s = self._jump = self._alone_s = 0.0
        self._way, self._way_cov, self._way_cross = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        self._turn_cov, self._turn_cross = np.zeros((3, 3)), np.zeros((3, 3))

    def _note_motion(self, before: F64, after: F64, dt_s: float) -> None:
        """Constant velocity goes on from what was seen."""
        c = self._config
        twist = se3.log(self._T_b_c @ se3.inverse(before) @ after @ self._T_c_b) / dt_s
        self._velocity, self._rate = twist[:3], twist[3:]
        self._velocity_cov, self._rate_cov = c.seen_m_s**2 * np.eye(3), c.seen_rad_s**2 * np.eye(3)

    def _compare(self, T_m_c: F64, t_ns: int) -> None:
        """Look at a window once it is long enough."""
        c = self._config
        if self._anchor is None or t_ns <= self._anchor[0]:
            self._anchor = (t_ns, T_m_c)
            return
        before_ns, before = self._anchor
        dt = (t_ns - before_ns) * 1e-9
        if dt < (c.compare_s if self.metric else c.unit_window_s) - 1e-3:
            return
        self._anchor = (t_ns, T_m_c)
        driven = self._samples.between(before_ns, t_ns)
        if driven is None:
            self._unmatched += self._compared == 0
            return
        self._compared += 1
        T_c0_c1 = se3.inverse(before) @ T_m_c
        # How the body turned is what the images say; of the odometer's velocity remains what moves the camera.
        r_c_b = self._T_c_b[:3, :3]
        turn = self._T_b_c[:3, :3] @ se3.so3_log(T_c0_c1[:3, :3])
        swung = (self._T_c_b @ se3.exp(np.concatenate([np.zeros(3), turn])) @ self._T_b_c)[:3, 3]
        moved = r_c_b @ se3.exp(np.concatenate([dt * driven.velocity, turn]))[:3, 3]
        known = measured(r_c_b @ driven.velocity_cov @ r_c_b.T, _WELL)
        if not self.metric:
            self._note_unit(known @ (moved + swung), known @ T_c0_c1[:3, 3])
            return
        self._judge(known @ moved, known @ (T_c0_c1[:3, 3] - swung), float(np.trace(known)), dt)
        known = measured(driven.rate_cov, _WELL)
        error = known @ (driven.rate - turn / dt)
        square = float(error @ error) / max(float(np.trace(known)), 0.5)
        self._turn_noise = self._expected(self._turn_noise, square, dt)

    def _judge(self, driven: F64, seen: F64, axes: float, dt: float) -> None:
        """Displacements (3,) in m by the odometer and by the images, in the directions that are measured."""
        c = self._config
        distance = float(np.sqrt(seen @ seen))
        self._speed = distance / dt
        square = float(driven @ driven)
        self._scale_var += c.scale_walk**2 * dt
        if square > c.least_moved_m**2:
            found = float(driven @ seen) / square
            var = (c.scale_sigma_m_s * dt) ** 2 / square
            off = found - self.scale
            aligned = float(driven @ seen) > c.aligned * distance * float(np.sqrt(square))
            if aligned and off * off < 9.0 * (self._scale_var + var):
                gain = self._scale_var / (self._scale_var + var)
                self.scale = float(np.clip(self.scale + gain * off, 1.0 - c.scale_most, 1.0 + c.scale_most))
                self._scale_var = max((1.0 - gain) * self._scale_var, c.scale_floor**2)
        error = (seen - self.scale * driven) / dt
        worst = c.tolerance_m_s + c.tolerance_share * self._speed
        square_error = float(error @ error) / max(axes, 0.5)
        if max(distance, float(np.sqrt(square))) > c.least_moved_m:
            self._proofs = min(self._proofs + 1, c.proofs) if square_error < worst**2 else 0
        self._noise = self._expected(self._noise, square_error, dt)
        self._trusted = self._proofs >= c.proofs and self._noise < worst**2

    def _expected(self, before: float, square: float, dt: float) -> float:
        c = self._config
        usual = max(1.0 - float(np.exp(-dt / c.memory_s)), 1.0 / (self._compared + 1.0))
        share = max(usual, c.rise) if square > c.unusual * before else usual
        return before + share * (square - before)

    def _note_unit(self, driven: F64, seen: F64) -> None:
        """Displacements (3,) of one window: in m by the odometer, in the map's unit by the images."""
        a, b = float(np.sqrt(driven @ driven)), float(np.sqrt(seen @ seen))
        if a < self._config.unit_moved_m or b <= 0.0:
            return
        along = float(driven @ seen)
        self._units.append((along / (b * b), along > self._config.aligned * a * b))
        del self._units[: -self._config.unit_windows]


@dataclass(slots=True)
class _Blended:
    """A vector (3,), its covariance (3,3), what of that lasts over frames, the gain (3,3); whether it was expected."""

    value: F64
    cov: F64
    slow: F64
    gain: F64
    expected: bool


def _blend(value: F64, cov: F64, measured: F64, fast: F64, slow: F64, surprise: float) -> _Blended:
    """The Kalman update of a vector (3,) with a measurement of all of it, unless that surprises.

    fast, slow: (3,3) of its noise, from sample to sample and lasting.
    """
    off = measured - value
    if float(off @ np.linalg.solve(cov + fast + slow, off)) > surprise * surprise:
        return _Blended(value, cov, cov, np.zeros((3, 3)), False)
    gain = cov @ np.linalg.inv(cov + fast + slow)
    left = np.eye(3) - gain
    lasting = left @ cov @ left.T + gain @ slow @ gain.T
    return _Blended(value + gain @ off, lasting + gain @ fast @ gain.T, lasting, gain, True)
