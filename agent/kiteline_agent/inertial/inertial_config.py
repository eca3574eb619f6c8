"""Options of the inertial stage."""

from dataclasses import dataclass, field

import numpy as np

from kiteline_core.arrays import F64


@dataclass(frozen=True, slots=True)
class FixedLagConfig:
    """Length of the window, and error models of the measurements."""

    states: int = 3  # frames in the window; with fixed points, 2 to 6 are equally accurate and more cost time
    fresh: int = 1  # newest frames whose points are relinearised; older ones are condensed to 6x6
    iterations: int = 3  # Gauss-Newton steps; the prediction is close
    points: int = 320  # most points of a frame
    chi2: float = 9.21  # 99 % of a chi-square with 2 degrees of freedom; Huber's knee is at half of it
    velocity_gate: float = 16.27  # 99.9 %: beyond it a velocity is rejected: wheels slip
    visual_inflation: float = 16.0  # of variance: errors of templates and points are correlated over frames
    imu_inflation: float = 3.0  # of noise densities: vibration, uncalibrated scale and axes, a bent map
    length_inflation: float = 5.0  # of the deviation of lengths in the map: it lasts over an acceleration
    turn_floor_rad: float = 2e-5  # error of a preintegrated rotation that no noise density explains
    velocity_floor_m_s: float = 5e-4  # the same of velocity: interpolated ends of the interval
    position_floor_m: float = 2e-5  # the same of position
    tilt_walk_rad: float = 2e-4  # per sqrt(s): the map itself bends while it grows


@dataclass(frozen=True, slots=True)
class SelfCalibrationConfig:
    """Errors of the calibration before the flight, errors of poses by images, and when an estimate is applied."""

    position_rad: float = 2.3e-4  # error of a position by images, over the depth that they see: a tenth of a pixel
    sensor_scale_sigma: float = 0.01  # of the scales of gyro and accelerometer; data sheets give 1 to 3 %
    misalignment_sigma: float = 0.007  # rad; by which a sensing axis leans to another; data sheets give 0.5 to 1 degree
    significance: float = 25.0  # squared deviations of 9 axes from a true rig, above which they are applied
    offset_s: float = 0.0  # camera stamp + offset = IMU time, if a calibration gives it
    offset_sigma_s: float = 0.02  # cameras without a trigger line
    kept_axes_sigma: float = 1e-3  # of axes between two flights: temperature, and what images are off by in both
    apply_axes: bool = True  # False: axes are only estimated
    apply_offset: bool = True  # False: only the configured offset is used

    @property
    def axes_sigma(self) -> F64:
        """(9,) deviations of the elements of a sensor's matrix, row-major, before a flight."""
        scale, misalignment = self.sensor_scale_sigma, self.misalignment_sigma
        return np.where(np.eye(3, dtype=np.bool_), scale, misalignment).ravel()


@dataclass(frozen=True, slots=True)
class StartDeviations:
    """Standard deviations of the initial state."""

    turn_rad: float = 0.02
    position_m: float = 0.02
    velocity_m_s: float = 0.1
    gyro_bias_rad_s: float = 0.01
    accel_bias_m_s2: float = 0.1
    tilt_rad: float = 0.03


@dataclass(frozen=True, slots=True)
class InertialConfig:
    """How the inertial state is initialised, and how long dead reckoning is trusted."""

    smoother: FixedLagConfig = field(default_factory=FixedLagConfig)
    calibration: SelfCalibrationConfig = field(default_factory=SelfCalibrationConfig)
    gravity_m_s2: float = 9.81  # differs by 0.3 % over the earth, which the accelerometer bias absorbs
    max_gap_s: float = 0.2  # a longer gap in the samples makes an interval unknown: a bus was blocked
    rest_gyro_rad_s: float = 0.02  # standard deviation of the gyro below which the vehicle stands still
    rest_accel_m_s2: float = 0.15  # the same of the accelerometer: motors may idle
    motion_frames: int = 7  # least frames that tell gravity in motion: with five, noise could pass for acceleration
    max_dead_reckoning_s: float = 20.0  # longest dead reckoning: a small IMU is useless after it
