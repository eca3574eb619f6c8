"""Calibration of an IMU in flight: time offset, scale and axes of gyro and accelerometer.

Filters beside the smoother, at a few updates a second: these values change slowly. A rig is taken as calibrated until
the filters contradict that significantly; then their estimates correct the samples.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from kiteline_agent.inertial.calibration import mounting_search
from kiteline_agent.inertial.calibration.accel_calibration import AccelCalibration, Move
from kiteline_agent.inertial.calibration.axes_report import axes_report, correction_event, measured_rotation, turned_rad
from kiteline_agent.inertial.calibration.disagreement import Disagreement
from kiteline_agent.inertial.calibration.gyro_calibration import GyroCalibration
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig, is_plausible, known_axes
from kiteline_agent.inertial.calibration.lengths_check import LengthsCheck
from kiteline_agent.inertial.calibration.lever_search import LeverSearch
from kiteline_agent.inertial.calibration.mounting_search import Mounting, MountingSearch
from kiteline_agent.inertial.calibration.pose_chain import PoseChain, SampledMotion
from kiteline_agent.inertial.calibration.turn_scatter import added_variance
from kiteline_agent.inertial.calibration.window import Window
from kiteline_agent.inertial.inertial_config import SelfCalibrationConfig
from kiteline_agent.inertial.preintegration import Samples, TimeOffset
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

# Of gyro and accelerometer: time constant in s; squared motion of a few windows, in rad^2 and (m/s)^2; squared errors
# over squared motion that no calibrated IMU has; bias in rad/s and m/s^2 that none has. Errors of real and of worn IMUs
# reach 0.001 and 0.08; a camera turned by 20 degrees 0.04, a dead accelerometer 0.3.
_TURNS_COMPARED = 1.5, 0.03, 0.03, 0.4
_FORCES_COMPARED = 3.0, 0.3, 0.25, 1.0
_CORRECT = "used from now on, correct the calibration (T_BS, time offset)"
_KEPT = 0.25  # share of a window's added variance that the next has at least: the map that was dragged is still seen
_TURN_WINDOW_S = 0.25  # s over which rotations are compared
_MOVE_WINDOW_S = 0.6  # s of two windows over which velocities are compared: vibration averages out
_TURN_SIGMA_RAD = 4e-4  # rad; error of a rotation by images over a window
_POSITION_SIGMA_M = 7e-4  # m; error of a position by images, as it changes over windows, at least
_SCALE_SIGMA = 0.015  # relative; of lengths by the images
_SIGNIFICANT_WINDOWS = 2  # of turns, in a row, before axes are applied or dropped: people who walk by turn one window
_APPLY_S = 0.5  # s; time constant with which applied axes follow
_OFFSET_SIGNIFICANCE = 3.0  # deviations from the configured offset below which it stays: most rigs have none
_OFFSET_RATE = 0.05  # s/s; how fast the applied offset follows
_KEPT_OFFSET_SIGMA_S = 3e-4  # s; of the time offset between two flights: another exposure
_REFUTED = 5.0  # log likelihood of an unknown IMU over that of earlier flights, from which those are dropped
_EXACTLY_S = 1e-6  # s; deviation of a time offset that is used as configured
_OFFSET_TRUSTED_S = 3e-3  # s; deviation below which the offset is applied


class SelfCalibration:
    """Call `add` with each pose by images, then `update`."""

    def __init__(
        self, calibration: ImuCalibration, config: SelfCalibrationConfig, p_b_c: F64, gravity_m_s2: float, *,
        metric: bool = True,
    ) -> None:  # fmt: skip
        """p_b_c: (3,) m, camera in the body. metric: images alone measure in metres."""
        self._metric = metric
        self._searches = metric and config.apply_axes and config.apply_offset
        self._calibration, self._config, self._p_b_c = calibration, config, p_b_c
        self._gravity_m_s2 = gravity_m_s2
        self.gyro, self.accel = self._unknown_gyro(), self._unknown_accel()
        self._unprimed_gyro: GyroCalibration | None = None  # a second estimate, without what earlier flights found
        self._earlier = self._told = KnownImuConfig()  # what earlier flights found; before this one refuted it
        self._turns = PoseChain(_TURN_WINDOW_S)
        self._moves = PoseChain(_MOVE_WINDOW_S)
        self._mounting, self._lever = MountingSearch(), LeverSearch()
        self._lengths = LengthsCheck(_SCALE_SIGMA)
        self._given_axes, self._given_offset_s = np.eye(3), config.offset_s  # with which the filters began
        self._lever_m = np.zeros(3)  # origin of the body, as the calibration places it, in the IMU
        self.restarted = False  # True after an `update` that found a calibration: what was integrated before is void
        self.turned = False  # True after one that found a rotation: so is the vertical
        self._before: Move | None = None  # last window of moves
        self._added = 0.0  # rad^2, of the rotation by images in the last window of turns, beside turn_sigma_rad
        self._unsteady = 1.0  # factor on the variance of poses by images, since the last window of moves
        self._depth_m = 0.0  # that the images saw, largest since the last window of moves
        self.offset_s = config.offset_s  # applied: camera stamp + offset = IMU time
        self.gyro_matrix, self.accel_matrix = np.eye(3), np.eye(3)  # applied to samples
        self._gyro_windows = 0  # in a row after which the gyro's axes differed significantly
        self._refuting_windows = 0  # in a row that refuted what earlier flights found
        self._has_found_mounting = False
        self._corrects_offset = self._corrects_gyro = self._corrects_accel = False
        self.is_proved = False  # both sensors have agreed with the images, over turns
        self.camera_rotation_rad = 0.0  # against the gyro, rms as expected
        self._events: list[str] = []

    def _unknown_gyro(self) -> GyroCalibration:
        c = self._config
        return GyroCalibration(
            c.axes_sigma, c.offset_sigma_s, c.offset_s, self._calibration.gyro_walk, Disagreement(*_TURNS_COMPARED)
        )  # fmt: skip

    def _unknown_accel(self) -> AccelCalibration:
        c = self._config
        return AccelCalibration(
            c.axes_sigma, _SCALE_SIGMA, self._calibration.accel_walk, self._gravity_m_s2,
            Disagreement(*_FORCES_COMPARED),
        )  # fmt: skip

    def begin_with(self, known: KnownImuConfig) -> None:
        """Begin with what earlier flights found, as a prior; it is dropped if the flight refutes it: after repairs."""
        self._earlier = self._told = known
        if known.gyro and known.offset_s:
            self._begin_gyro()
            self._follow_offset(np.inf)
        self._begin_accel()
        self.gyro_matrix = self.gyro.matrix if self._corrects_gyro else np.eye(3)
        self.accel_matrix = self.accel.matrix if self._corrects_accel else np.eye(3)

    def _begin_gyro(self) -> None:
        """Begin the gyro's filter with what earlier flights found, and one without it beside."""
        known, (offset_s, offset_sigma_s) = self._earlier, self._earlier.offset_s
        self.gyro, self._unprimed_gyro = self._unknown_gyro(), self._unknown_gyro()
        sigma = np.hypot(known.gyro_sigma, self._config.kept_axes_sigma)
        offset_sigma_s = float(np.hypot(offset_sigma_s, _KEPT_OFFSET_SIGMA_S))
        self.gyro.begin_with(np.reshape(known.gyro, (3, 3)), sigma, offset_s, offset_sigma_s)
        self._given_axes, self._given_offset_s = self.gyro.matrix, offset_s
        self._gyro_windows, self._refuting_windows = _SIGNIFICANT_WINDOWS, 0  # they were significant, in flight
        self._test_gyro()

    def _begin_accel(self) -> None:
        known = self._earlier
        if known.accel:
            sigma = np.hypot(known.accel_sigma, self._config.kept_axes_sigma)
            self.accel.begin_with(np.reshape(known.accel, (3, 3)), sigma)
            self._test_accel()

    @property
    def applied_offset(self) -> TimeOffset:
        """The time offset that is applied, and by how much it may be off; exact where it may not be changed."""
        if not self._config.apply_offset:
            return TimeOffset(self.offset_s, _EXACTLY_S)
        off_s = float(np.hypot(self.gyro.offset_sigma_s, self.gyro.offset_s - self.offset_s))
        if self._unprimed_gyro is not None:  # what earlier flights found may be of another IMU
            off_s = max(off_s, self._config.offset_sigma_s)
        return TimeOffset(self.offset_s, max(off_s, _EXACTLY_S))

    def begin_with_offset(self, found: TimeOffset) -> None:
        """Begin a map whose start found the time offset. One that may not be changed was not found."""
        if not self._config.apply_offset:
            return
        self.gyro.begin_with_offset(found.offset_s, float(np.hypot(found.sigma_s, _KEPT_OFFSET_SIGMA_S)))
        self._given_offset_s = found.offset_s
        self._follow_offset(np.inf)

    def known(self) -> KnownImuConfig | None:
        """What is known now, for the next flight; None before a rotation was measured, and if no IMU is like that."""
        gyro, accel = self.gyro, self.accel
        if gyro.log_likelihood == 0.0 or not is_plausible(gyro.matrix, gyro.offset_s):
            return None
        offset = (round(gyro.offset_s, 6), max(round(gyro.offset_sigma_s, 6), 1e-6))
        out = KnownImuConfig(offset, *known_axes(gyro.matrix, gyro.axes_cov * max(gyro.excess, 1.0)))
        if not self._metric or not is_plausible(accel.matrix):
            return replace(out, accel=self._earlier.accel, accel_sigma=self._earlier.accel_sigma)
        axes, sigma = known_axes(accel.matrix, accel.axes_cov * max(accel.excess, 1.0))
        return replace(out, accel=axes, accel_sigma=sigma)

    def correct(self, samples: Samples) -> Samples:
        """Samples with the applied scales and axes, as the body's origin feels them."""
        gyro = samples.gyro @ self.gyro_matrix.T if self._corrects_gyro else samples.gyro
        accel = samples.accel @ self.accel_matrix.T if self._corrects_accel else samples.accel
        if self._lever_m.any():
            rate = gyro - self.gyro.bias
            speed = np.cross(rate, self._lever_m)
            accel = accel + np.gradient(speed, samples.t_s, axis=0) + np.cross(rate, speed)
        return Samples(samples.t_s, gyro, accel, samples.density)

    def report(self) -> dict[str, Any]:
        """What was found of gyro and accelerometer: measured = matrix @ true, in the body's axes by the camera.

        camera_rotation_deg: (3,) rotation vector of the gyro's axes against those of the body, degrees.
        """
        return {
            "gyro": axes_report(self.gyro.matrix, self.gyro.axes_cov, applied=self._corrects_gyro),
            "accel": axes_report(self.accel.matrix, self.accel.axes_cov, applied=self._corrects_accel),
            "camera_rotation_deg": np.degrees(measured_rotation(self.gyro.matrix)[1]).round(3).tolist(),
            "image_scale": [round(value, 5) for value in self.accel.scale],
        }

    @property
    def contradicts(self) -> bool:
        """True if images and IMU measure other motions: no error of a calibrated IMU explains that."""
        turns, forces = self.gyro.disagreement.contradicts, self.accel.disagreement.contradicts
        return (turns or forces) and not self.awaits_search

    @property
    def awaits_search(self) -> bool:
        """True if turns contradict the calibration so early that another one could not be searched yet."""
        return self._searches and self.gyro.disagreement.contradicts and not self._mounting.has_searched

    def take_events(self) -> list[str]:
        """A line for the log for each sensor whose correction began."""
        events, self._events = self._events, []
        return events

    def add(self, t_ns: int, T_m_b: F64, depth_m: float) -> None:
        """Append the pose T_m_b (4,4) of a frame, by images alone. depth_m: median distance of what they saw."""
        self._depth_m = max(self._depth_m, depth_m)
        self._turns.add(t_ns, T_m_b)
        self._moves.add(t_ns, se3.from_rt(T_m_b[:3, :3], T_m_b[:3, 3] - T_m_b[:3, :3] @ self._lever_m))
        self._mounting.add(t_ns, T_m_b[:3, :3])

    def clear(self) -> None:
        """Begin new windows after an image loss."""
        for windows in (self._turns, self._moves, self._mounting):
            windows.clear()
        self._before = None

    def forget_turns(self) -> None:
        """Poses by images were wrong until now: begin again with what earlier flights found; without those, go on."""
        self.clear()
        self._lever.clear()
        if self._has_found_mounting or not (self._told.gyro and self._told.offset_s):
            return  # vertical and velocity rest on a mounting
        if self._earlier is not self._told:  # they had refuted it
            self._earlier = self._told
            self._begin_accel()
        self._begin_gyro()

    def begin_map(self) -> None:
        """Begin new windows in a new map, whose vertical is unknown."""
        self.clear()
        self._lever.clear()
        self.accel.set_vertical(None)

    def move_map(self, T_new_old: F64) -> None:
        """Transform poses and gravity after the map moved: p_new = T_new_old p_old."""
        self._turns.move_map(T_new_old)
        self._moves.move_map(T_new_old)
        self._before = None
        for rotated in (self.accel, self._mounting, self._lever):
            rotated.rotate_map(T_new_old[:3, :3])

    def update(self, buffer: SampleBuffer, gravity: F64 | None, dt_s: float) -> F64:
        """Add windows that are complete, and let the applied values follow the estimates.

        gravity: (3,) in m as the smoother knows it; None: unknown. dt_s: since the last call. Returns the change (3,)
        of the corrected accelerometer bias, m/s^2, that the change of its axes entails.
        """
        self.restarted = self.turned = False
        turn = self._turns.take(buffer, self.gyro.offset_s)
        if isinstance(turn, SampledMotion):
            offset_s, density = self.gyro.offset_s, float(turn.density(self._calibration)[0])
            added = added_variance(
                turn, buffer, self.gyro.matrix, self.gyro.bias, _TURN_SIGMA_RAD, density
            )  # fmt: skip
            self._added = added = max(added, _KEPT * self._added)
            self._unsteady = max(self._unsteady, 1.0 + added / _TURN_SIGMA_RAD**2)
            for gyro in (self.gyro, self._unprimed_gyro):
                if gyro is not None:
                    window = self._integrate(turn, gyro)
                    variance = _TURN_SIGMA_RAD**2 + added + density**2 * window.duration_s
                    gyro.add(window, turn.T_m_b0[:3, :3].T @ turn.T_m_b1[:3, :3], variance, offset_s)
            self._drop_refuted_prior()
            self._test_gyro()
            self._search_mounting(buffer)
            if self.restarted:
                return np.zeros(3)
        if gravity is not None:
            if not self.accel.has_vertical:
                self.accel.set_vertical(gravity)
            move = self._moves.take(buffer, self.gyro.offset_s)
            if isinstance(move, SampledMotion):
                self._add_move(move)
                self._test_accel()
                self._search_lever()
            elif move:
                self._before = None
        turns, forces = self.gyro.disagreement, self.accel.disagreement
        self.is_proved |= turns.agrees and turns.moves and forces.agrees
        self._follow_offset(dt_s)
        return self._follow_axes(buffer, dt_s)

    def _drop_refuted_prior(self) -> None:
        """Drop what earlier flights found if rotations are likelier without it. Applied axes follow the new ones."""
        unprimed = self._unprimed_gyro
        if unprimed is None:
            return
        refuted = unprimed.log_likelihood - self.gyro.log_likelihood > _REFUTED
        self._refuting_windows = self._refuting_windows + 1 if refuted else 0
        if self._refuting_windows >= _SIGNIFICANT_WINDOWS:
            self.gyro, self._unprimed_gyro, self._earlier = unprimed, None, KnownImuConfig()
            self._given_axes, self._given_offset_s = np.eye(3), self._config.offset_s
            accel, self.accel = self.accel, self._unknown_accel()
            self.accel.continue_map(accel)
            self._events.append("the IMU is not the one of the rig file: calibrated anew")

    def _test_gyro(self) -> None:
        """Correct the gyro's samples from now on if its axes differ significantly from those of a true rig."""
        config = self._config
        self.camera_rotation_rad = turned_rad(self.gyro.matrix, self.gyro.axes_cov, config.misalignment_sigma)
        self._gyro_windows = self._gyro_windows + 1 if self.gyro.significance() > config.significance else 0
        if config.apply_axes and not self._corrects_gyro and self._gyro_windows >= _SIGNIFICANT_WINDOWS:
            self._corrects_gyro = True
            self._events.append(correction_event("gyro", self.gyro.matrix))

    def _test_accel(self) -> None:
        """The same of the accelerometer; not by a monocular map, whose lengths come from the accelerometer itself."""
        config = self._config
        may = config.apply_axes and self._metric and not self._corrects_accel
        if may and self.accel.significance() > config.significance:
            self._corrects_accel = True
            self._events.append(correction_event("accelerometer", self.accel.matrix))
        if self._metric:
            self._events += self._lengths.note(*self.accel.scale)

    def _search_mounting(self, buffer: SampleBuffer) -> None:
        """Begin anew with another mounting and time offset where these explain turns that the present ones do not."""
        gyro = self.gyro
        axes_off = float(np.abs(gyro.matrix - self._given_axes).max())
        doubted = self._gyro_windows > 0 and axes_off > 0.5 * mounting_search.LEAST_ROTATION_RAD
        doubted |= abs(gyro.offset_s - self._given_offset_s) > mounting_search.LEAST_CHANGE_S
        doubted |= gyro.disagreement.share > mounting_search.SUSPICION
        if not (doubted and self._searches):
            return
        found = self._mounting.find(buffer, self._given_axes, self._given_offset_s)
        if found is None:
            return
        self._begin_with_mounting(found)
        self._events.append(f"imu: {found}: {_CORRECT}")

    def _begin_with_mounting(self, found: Mounting) -> None:
        """Begin the gyro's filter anew; after more than a small change of the time offset all that is inertial, too."""
        self._has_found_mounting = True
        change_rad = float(np.linalg.norm(se3.so3_log(found.rotation @ self.accel_matrix.T)))
        self.turned = change_rad > mounting_search.LEAST_ROTATION_RAD
        jumps = abs(found.offset_s - self.offset_s) > mounting_search.RESTART_S
        jumps |= not np.array_equal(found.axes, self._given_axes)
        self.gyro, self._unprimed_gyro = self._unknown_gyro(), None
        self.gyro.begin_with(found.axes, self._config.axes_sigma.reshape(3, 3), found.offset_s, found.sigma_s)
        self.gyro.set_bias(found.bias)
        self._given_axes, self._given_offset_s = found.axes, found.offset_s
        self.offset_s, self._corrects_offset = found.offset_s, True
        self.gyro_matrix, self._corrects_gyro = found.axes, True
        if self.turned:
            self.accel_matrix, self._corrects_accel = found.rotation, True
        if jumps:
            self._restart()

    def _search_lever(self) -> None:
        """Begin anew with another lever arm where it explains accelerations that the present one does not."""
        if not (self._searches and self.gyro.disagreement.agrees):
            return
        change = self._lever.find()
        if change is not None:
            self._lever_m, self._p_b_c = self._lever_m + change, self._p_b_c + change
            self._restart()
            at = self._p_b_c.round(2).tolist()
            self._events.append(f"imu: the camera is at {at} m in its axes: {_CORRECT}")

    def _restart(self) -> None:
        """Begin the accelerometer's calibration anew, with the axes that are applied."""
        self.accel = self._unknown_accel()
        self.accel.begin_with(self.accel_matrix, self._config.axes_sigma.reshape(3, 3))
        self._moves.clear()
        self._lever.clear()
        self._before, self.restarted = None, True

    def _follow_offset(self, dt_s: float) -> None:
        """Move the applied time offset towards the estimate, once that is significant."""
        config = self._config
        if not config.apply_offset or self.gyro.offset_sigma_s >= _OFFSET_TRUSTED_S:
            return
        step = self.gyro.offset_s - self.offset_s
        sigma = self.gyro.offset_sigma_s * max(self.gyro.excess, 1.0) ** 0.5
        self._corrects_offset |= abs(step) > _OFFSET_SIGNIFICANCE * sigma
        if self._corrects_offset:
            self.offset_s += float(np.clip(step, -_OFFSET_RATE * dt_s, _OFFSET_RATE * dt_s))

    def _follow_axes(self, buffer: SampleBuffer, dt_s: float) -> F64:
        """Move the applied axes towards the estimates. Returns the change (3,) of the accelerometer bias, m/s^2."""
        change = np.zeros(3)
        share = 1.0 - float(np.exp(-dt_s / _APPLY_S))
        if self._corrects_gyro:
            self.gyro_matrix = self.gyro_matrix + share * (self.gyro.matrix - self.gyro_matrix)
        if self._corrects_accel:
            step = share * (self.accel.matrix - self.accel_matrix)
            self.accel_matrix = self.accel_matrix + step
            change = step @ buffer.last_accel
        return change

    def _add_move(self, link: SampledMotion) -> None:
        position_m = max(_POSITION_SIGMA_M, self._config.position_rad * self._depth_m)
        density = float(link.density(self._calibration)[1])
        now = Move(self._integrate(link, self.gyro), link, density, position_m, self._unsteady)
        before, self._before, self._unsteady, self._depth_m = self._before, now, 1.0, 0.0
        if before is not None:
            poses = before.link.T_m_b0, link.T_m_b0, link.T_m_b1
            variance = before.variance_with(now, self._gravity_m_s2 * _TURN_SIGMA_RAD)
            self.accel.add((before.window, now.window), poses, self._p_b_c, variance, self._lever)

    def _integrate(self, link: SampledMotion, gyro: GyroCalibration) -> Window:
        matrix, bias = gyro.matrix, gyro.bias
        rates = link.rates @ matrix.T - bias
        return Window.of(link.samples, matrix, bias, rates[0], rates[1])
