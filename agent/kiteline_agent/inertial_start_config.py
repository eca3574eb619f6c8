"""Options of the start of a monocular map in metres, from corners and IMU."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class CornerTracksConfig:
    """How corners are found and followed."""

    cell_px: int = 32  # px: one corner a cell
    keyframes: int = 45  # of a window, whose cost grows with their square; of more, every second old one is left out


@dataclass(frozen=True, slots=True)
class InertialBundleConfig:
    """Error models of the window, and effort of the solver."""

    sigma_px: float = 1.0  # px of an observation; the drift of a corner is alike in all keyframes
    huber: float = 0.5  # deviations beyond which an observation counts linearly: many corners drift
    imu_inflation: float = 3.0  # of the calibration's noise densities: vibration
    accel_walk: float = 0.015  # m/s^2 per sqrt(s), beside the calibration's: errors of scale and axes, vibration
    gyro_bias_rad_s: float = 0.1  # deviation of an unknown gyro bias
    accel_bias_m_s2: float = 0.2  # the same of the accelerometer
    lens_focal: float = 0.004  # relative deviation of the calibrated focal length
    lens_centre_px: float = 1.0  # px; the same of the centre
    lens_radial: float = 0.005  # of pixels over focal length where r is 1: half a pixel in between
    camera_turn_rad: float = 0.003  # rad about an axis; the same of the camera's rotation in the body


@dataclass(frozen=True, slots=True)
class ContradictionConfig:
    """When images and IMU contradict each other: by a wrong calibration, place of the camera, time offset or unit."""

    lasts_s: float = 5.0  # time over which all windows contradict before it is said: people in view are gone by then
    unsure_s: float = 24.0  # before the IMU is given up where not every window accuses it: none gets longer


@dataclass(frozen=True, slots=True)
class InertialStartConfig:
    """When a monocular camera with an IMU knows its scale, and begins a map in metres."""

    min_flow: float = 0.02  # of the focal length, median: with less the camera has not moved

    contradiction: ContradictionConfig = field(default_factory=ContradictionConfig)
    corner_tracks: CornerTracksConfig = field(default_factory=CornerTracksConfig)
    bundle: InertialBundleConfig = field(default_factory=InertialBundleConfig)
