"""Options of the start of a monocular map in metres, from corners and IMU."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class CornerTracksConfig:
    """How corners are found and followed."""

    corners: int = 200  # followed at once; a bundle of 100 long tracks is as accurate as one of 300
    cell_px: int = 32  # px: one corner a cell
    replenish: float = 0.85  # share of the corners below which a keyframe adds new ones
    window_px: int = 15  # px: window of the optical flow; the smallest that keeps hold of corners
    backward_px: float = 0.5  # px between a corner and its image followed back
    drift_px: float = 2.0  # px between flow over frames and flow from the last keyframe
    keyframe_s: float = 0.24  # time between two keyframes: short enough for flow, long enough for parallax
    keyframes: int = 45  # of a window, whose cost grows with their square; of more, every second old one is left out
    thinned_s: float = 0.6  # longest time between two keyframes after one was left out


@dataclass(frozen=True, slots=True)
class InertialBundleConfig:
    """Error models of the window, and effort of the solver."""

    sigma_px: float = 1.0  # px of an observation; the drift of a corner is alike in all keyframes
    huber: float = 0.5  # deviations beyond which an observation counts linearly: many corners drift
    max_rms: float = 3.0  # deviations, and times the median, beyond which a corner moves and is left out; most have 0.6
    imu_inflation: float = 3.0  # of the calibration's noise densities: vibration
    accel_walk: float = 0.015  # m/s^2 per sqrt(s), beside the calibration's: errors of scale and axes, vibration
    gyro_bias_rad_s: float = 0.1  # deviation of an unknown gyro bias
    accel_bias_m_s2: float = 0.2  # the same of the accelerometer
    lens_focal: float = 0.004  # relative deviation of the calibrated focal length
    lens_centre_px: float = 1.0  # px; the same of the centre
    lens_radial: float = 0.005  # of pixels over focal length where r is 1: half a pixel in between
    camera_turn_rad: float = 0.003  # rad about an axis; the same of the camera's rotation in the body
    first_depth_m: float = 3.0  # at which all landmarks start; only the sign matters
    structure_iterations: int = 25  # steps of the first stage: none of it is known
    iterations: int = 20  # steps of the last stage
    structure_settled: float = 1e-3  # relative fall of the cost below which the first stage ends
    settled: float = 0.1  # fall of the cost below which the last one ends: a deviation of the scale is worth 0.5


@dataclass(frozen=True, slots=True)
class ContradictionConfig:
    """When images and IMU contradict each other: by a wrong calibration, place of the camera, time offset or unit."""

    lens_chi2: float = 26.0  # squared deviations of the eight errors of a lens: 99.9 % of calibrations have less
    gyro_noise: float = 5.0  # times that of single samples, as rotations by images show it: 20 ms of delay have 2.8
    both_lens_chi2: float = 12.0  # of both together: a focal length that is off by a tenth has 13, 20 ms of delay 2
    both_gyro_noise: float = 1.7  # likewise: a focal length that is off by a tenth has 1.9, worn rigs 1.2
    accel_bias: float = 5.0  # deviations of the accelerometer's bias: that of missing gravity is 40
    structure_px: float = 1.2  # median error of corners with the gyro's rotations: 0.3 if these are right, else 2
    lasts_s: float = 5.0  # time over which all windows contradict before it is said: people in view are gone by then
    unsure_s: float = 24.0  # before the IMU is given up where not every window accuses it: none gets longer


@dataclass(frozen=True, slots=True)
class InertialStartConfig:
    """When a monocular camera with an IMU knows its scale, and begins a map in metres."""

    min_span_s: float = 2.4  # before which a window tells no scale
    max_span_s: float = 24.0  # longest window; older keyframes are dropped
    rest_s: float = (
        4.0  # of a rest before the flight that a window holds: enough for the biases, long ones are solved rarely
    )
    attempt_s: float = 0.45  # time between two solutions: each costs as much as some frames
    attempt_share: float = 0.09  # the same over the window's length: long windows cost more
    landmarks: int = 220  # of the window, with the longest tracks: errors of few add up to a wrong turn and motion
    landmarks_each: int = 70  # in each keyframe: in fast turns no track is long
    min_flow: float = 0.02  # of the focal length, median: with less the camera has not moved
    scale_sigma: float = 0.02  # relative deviation of the scale below which it is metric

    agreement: float = 0.04  # relative difference of the scale to that of the solution before, on its keyframes
    max_reprojection_px: float = 0.9  # rms of a solution's inliers
    noise_prior: float = 6.0  # degrees of freedom of the calibrated noise beside those of a window
    least_accel_noise: float = 0.5  # times the noise of single samples: vibration averages out to half of it
    max_imu_chi2: float = 1.5  # mean squared error of its inertial factors, in deviations
    state_inflation: float = 2.0  # of the deviations of the state with which tracking begins
    depth_sigma: float = 0.25  # relative deviation above which a landmark has no depth yet
    contradiction: ContradictionConfig = field(default_factory=ContradictionConfig)
    corner_tracks: CornerTracksConfig = field(default_factory=CornerTracksConfig)
    bundle: InertialBundleConfig = field(default_factory=InertialBundleConfig)
