"""Configuration of the onboard half: one frozen section per stage."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from kiteline_agent.controller_imu_config import ControllerImuConfig
from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.imaging.fixed_parts import FixedPartsConfig
from kiteline_agent.imaging.row_alignment import RowConfig
from kiteline_agent.inertial.inertial_config import InertialConfig
from kiteline_agent.inertial_start_config import InertialStartConfig
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.scan_config import LocalGridConfig as LocalGridConfig
from kiteline_agent.scan_config import ScanConfig as ScanConfig
from kiteline_core.ground.config import GroundConfig

_LEAST_LEVELS, _MOST_LEVELS = 2, 8  # of a pyramid: a coarse pass needs two, and the eighth of any image is a few pixels


@dataclass(frozen=True, slots=True)
class OdometerConfig:
    """When an odometer is used, and its error model."""

    use: bool = True  # False: odometer samples are logged only
    keep_s: float = 3.0  # s of samples in the buffer
    max_gap_s: float = 0.25  # a longer gap makes an interval unknown: wheels are read at 10 Hz at least
    floor_m_s: float = 0.02  # velocity error that no device states: its axes, its place, its stamps
    floor_rad_s: float = 0.005  # the same of a rotation rate
    tolerance_m_s: float = 0.12  # noise above which it is not used; that of a good one is 0.05
    accel_m_s2: float = 2.0  # acceleration of the constant-velocity model: leaning by twelve degrees
    turn_rad_s2: float = 4.0  # the same about the body's axes: a small multicopter that tilts
    unit_wait_s: float = 20.0  # s for which poses wait for the metre; then they are given in a unit of their own


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    """Image pyramids."""

    levels: int = 4  # each halves the size; three detected octaves and one above for convergence
    first: int = 0  # finest level that is computed; 1: a third of the work, twice the error

    def __post_init__(self) -> None:
        if not _LEAST_LEVELS <= self.levels <= _MOST_LEVELS:
            raise ValueError(f"levels: expected {_LEAST_LEVELS} to {_MOST_LEVELS}")


@dataclass(frozen=True, slots=True)
class ReadoutConfig:
    """Read-out of a rolling shutter of which the calibration says nothing, found in flight."""

    on: bool = True  # false: a camera without a calibrated read-out has a global shutter


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Depth from disparities along the image row."""

    MAY_BE_ZERO: ClassVar = ("points",)

    min_depth_m: float = 0.25  # m: nearest surface; bounds the search along the row
    search_px: float = 3.0  # px of the level: range around the predicted disparity
    points: int = 240  # disparities measured in a frame, spread over the landmarks found; 0: none
    sigma_px: float = 0.25  # px at octave 0: standard deviation of a disparity


@dataclass(frozen=True, slots=True)
class AlignConfig:
    """Template alignment."""

    MAY_BE_ZERO: ClassVar = ("fine_from",)

    points: int = 240  # landmarks of the fine pass; more cost time and gain little
    cell_px: int = 32  # px: candidates are spread over cells of this size
    fine_from: int = 1  # template level at which the fine pass begins; 0: cheaper, and converges from less far
    sigma_px: float = 0.30  # px at octave 0: standard deviation of an aligned coordinate


@dataclass(frozen=True, slots=True)
class PoseConfig:
    """Motion-only optimisation."""

    iterations: int = 4  # Gauss-Newton steps a round
    chi2: float = 9.21  # 99 % of a chi-square with 2 degrees of freedom
    min_inliers: int = 15  # with fewer a pose is not trusted
    min_share: float = 0.3  # inliers of the landmarks searched for; good tracks have half, wrong ones a tenth
    dragged_px: float = 2.0  # px from a prediction by the IMU above which landmarks near it are tried; usually 1
    near_px: float = 4.0  # px; these: the errors of alignment, and of a prediction where the pose was dragged before


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """When a frame becomes a keyframe; see keyframes.policy.RULES."""

    max_gap_s: float = 3.0  # s: longest time between two keyframes, at rest too
    min_share: float = 0.65  # inliers relative to those of the reference keyframe
    min_inliers: int = 90  # inliers of a comfortable track
    min_cover: float = 0.45  # share of coarse image cells that hold a tracked landmark
    baseline_ratio: float = 0.12  # translation over median depth: new views of the same scene
    rotation_rad: float = 0.30  # rad: a rotation that has replaced a quarter of the view
    earlier: bool = False  # True: what one camera saw before its map began is shared, for other drones to be recognised


@dataclass(frozen=True, slots=True)
class LocalMapConfig:
    """Size of the local map."""

    keyframes: int = 48  # slots; older and farther keyframes are evicted (the base keeps them)
    landmarks: int = 200  # new landmarks a keyframe, at most
    searched: int = 48  # keyframes whose landmarks are searched for: those seen last
    max_far_ratio: float = 400.0  # depth over baseline beyond which stereo gives no depth
    moved_px: float = 1.0  # px by which a keyframe's new pose moves landmarks at its typical depth, to be taken over
    camera_px: float = 1.0  # px by which corrections move the camera in its own image, to be taken over
    inertial_px: float = 2.0  # the same of an agent whose IMU runs: its poses err half as much, the base's do not
    first_points: int = 40  # landmarks with depth that the first keyframe of a submap needs


@dataclass(frozen=True, slots=True)
class TwoViewStartConfig:
    """How a monocular camera begins a map."""

    median_depth_m: float = 4.0  # m: convention that sets the scale of the first landmarks; that of a room
    cell_px: int = 22  # px: one corner a cell
    min_flow: float = 0.02  # of the focal length, median: with less flow two views have no parallax
    scale_every: int = 10  # frames between two tests of the metric scale: each may correct it needlessly


@dataclass(frozen=True, slots=True)
class DepthFromMotionConfig:
    """How landmarks without depth (seeds) get one from motion."""

    per_frame: int = 150  # seeds searched in a frame; each costs about 10 us
    off_line_px: float = 1.5  # px at octave 0 between the aligned pixel and the epipolar line
    gate: float = 3.0  # standard deviations between measured and held inverse depth
    sigma_px: float = 0.5  # px: standard deviation of an aligned pixel, with the pose's own error
    min_hits: int = 3  # frames that agree
    max_misses: int = 6  # frames without a match: it moved, or was an occlusion edge


@dataclass(frozen=True, slots=True)
class SlantConfig:
    """How slanted the surfaces around landmarks are, which says how their templates are warped."""

    MAY_BE_ZERO: ClassVar = ("points",)

    points: int = 240  # landmarks whose slant is measured in a frame, 1 us each; 0: all surfaces face the camera
    sigma: float = 1.0  # deviation of a slant before it is measured: a wall seen at 45 degrees, in the middle of a view
    memory: float = 0.9  # share of what is known that a frame leaves if it tells as much: frames share errors


@dataclass(frozen=True, slots=True)
class DisparityAlignmentConfig:
    """Estimation of a worn stereo rig's disparity offset on board."""

    on: bool = True  # False: only the base estimates it
    every: int = 4  # frames between two pairs, at most: each costs 0.3 ms
    points: int = 120  # most of them that are used
    sigma_px: float = 0.3  # px at octave 0; of aligned coordinates and disparities


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    """Relocalisation in the local map, and how the map goes on without it."""

    cell_px: int = 16  # px: one corner a cell; four times as many as in a keyframe, so that its own are among them
    max_corners: int = 600  # 0.5 ms of descriptors
    indexed_per_frame: int = 16  # keyframes a frame's search adds to the place index, the newest first; 0.65 ms each
    candidates: int = 3  # places tried in a frame; each costs about 1 ms
    margin: float = 0.2  # of the image width: landmarks so far beyond a keyframe's border are matched, too
    min_inliers: int = 30  # of the tracker from that pose
    dead_reckoning_m: float = 0.08  # m: standard deviation up to which dead reckoning extends the map; below good_m


@dataclass(frozen=True, slots=True)
class CovarianceConfig:
    """Errors of sensors and calibration, and when a pose counts as good."""

    calibration_px: float = 0.05  # px at the image's edge: error of a good calibration of one camera
    extrinsic_rad: float = 3e-4  # rad: error of the camera's rotation in the body, a hundredth of a degree or two
    extrinsic_m: float = 1e-3  # m: error of the camera's position in the body
    least_rms: float = 0.3  # whitened residual of a frame: its noise is never assumed to be smaller

    imu_offset_frames: float = 10.0  # frames over which the difference between fused and image poses is averaged
    unmeasured_accel_m_s2: float = 2.0  # m/s^2 of an unobserved vehicle: a multicopter tilted by twelve degrees
    unmeasured_turn_rad_s2: float = 2.0  # rad/s^2: the same for the rotation
    unknown_velocity_m_s: float = 5.0  # m/s: error of the velocity of a vehicle whose motion was not observed yet
    unknown_rate_rad_s: float = 1.0  # rad/s: the same for the rotation
    good_m: float = 0.2  # m: error up to which a pose counts as good
    good_rad: float = 0.1745  # rad: the same for the rotation, 10 degrees


@dataclass(frozen=True, slots=True)
class MapCacheConfig:
    """Cached keyframes sent by the base, and how they are matched."""

    keyframes: int = 32  # slots; the base sends fewer, but those of an earlier base may still be there
    sigma_px: float = 0.15  # px: virtual disparity error of a cached landmark, which rests on many views
    radius_px: float = 6.0  # px at octave 0: search radius around a projection, the error that P3P leaves
    candidates: int = 3  # cached keyframes tried in a lost frame
    margin: float = 0.2  # of the image width: landmarks so far beyond a keyframe's border are matched, too


@dataclass(frozen=True, slots=True)
class SmoothingConfig:
    """How corrections reach the live pose in the world. They never move the odometry frame."""

    MAY_BE_ZERO: ClassVar = (
        "max_m_s",
        "whole_rad",
    )

    max_m_s: float = 0.03  # m/s at which the odometry frame moves in w: 3 mm a frame at 10 Hz; 0: at once
    onboard_m: float = 0.0026  # m a frame by which live poses follow what the agent itself finds of its map
    time_s: float = 10.0  # s for all but an e-th of a correction that is larger, or whose lengths accelerations told
    max_rad_s: float = 0.0  # rad/s at which it rotates about the vehicle; 0: at once, which moves nothing
    snap_m: float = 1.0  # m: a correction that moves the vehicle farther at once is a map merge, and not smoothed
    scale_sigma: float = 0.03  # relative deviation of a monocular map's scale before the base tells one
    whole_rad: float = 0.005  # rad by which the base may turn the whole map unnoticed; 0: live poses follow all of it
    whole_m: float = 0.02  # m, the same of its shift at the vehicle; twice that while no correction comes


@dataclass(frozen=True, slots=True)
class PredictionConfig:
    """Poses of frames that the governor skips, and between frames."""

    MAY_BE_ZERO: ClassVar = ("rate_hz",)

    rate_hz: float = 30.0  # 1/s: poses to a flight controller, predicted to the time of sending; 0: frames only


@dataclass(frozen=True, slots=True)
class GovernorConfig:
    """How CPU time is kept within a budget."""

    cpu_percent: float = 0.0  # percent of one core, over any window; 0: no budget
    fill: float = 0.9  # share that frames and keyframes may take between two rows; what is left is for early keyframes
    carried_fill: float = 0.95  # the same with an IMU: a keyframe may wait for room, since frames are bridged meanwhile
    grace_s: float = 2.0  # s at the start that do not count: a map has to be begun
    up_s: float = 1.5  # s of low load before a rise
    max_gap_s: float = 0.35  # s between tracked frames; after more, tracking often fails
    min_cost_error: float = 0.15  # relative error of a frame's expected cost, at least: a pair for the disparity offset
    first_frame_ms: float = 3.5  # ms: expected cost of a tracked frame at full effort at the start: 752x480 on a laptop


@dataclass(frozen=True, slots=True)
class LogConfig:
    """Images in the log. Images that the source delivers encoded are logged as they come."""

    MAY_BE_ZERO: ClassVar = ("every",)

    every: int = 1  # frames; of so many, the images of one are logged, 0: none. Only a log with all can be replayed
    compressed: bool = True  # PNG of half an image's size for some 2.7 ms of a fast core, else stored for 0.25 ms
    apart: bool = True  # live flights encode in another process: 0.2 ms of the agent's CPU time for a pair, not 5


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """All sections."""

    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    fixed_parts: FixedPartsConfig = field(default_factory=FixedPartsConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    rows: RowConfig = field(default_factory=RowConfig)
    disparities: DisparityAlignmentConfig = field(default_factory=DisparityAlignmentConfig)
    readout: ReadoutConfig = field(default_factory=ReadoutConfig)
    known_rig: KnownRigConfig = field(default_factory=KnownRigConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    controller_imu: ControllerImuConfig = field(default_factory=ControllerImuConfig)
    odometer: OdometerConfig = field(default_factory=OdometerConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    governor: GovernorConfig = field(default_factory=GovernorConfig)
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    depth_from_motion: DepthFromMotionConfig = field(default_factory=DepthFromMotionConfig)
    slant: SlantConfig = field(default_factory=SlantConfig)
    two_view_start: TwoViewStartConfig = field(default_factory=TwoViewStartConfig)
    inertial_start: InertialStartConfig = field(default_factory=InertialStartConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    map_cache: MapCacheConfig = field(default_factory=MapCacheConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    scan: ScanConfig = field(default_factory=ScanConfig)
    local_grid: LocalGridConfig = field(default_factory=LocalGridConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    log: LogConfig = field(default_factory=LogConfig)
    shrink_cells: bool = True  # every cell_px that has its default, in images below 752x480; else they have few corners
    tracker: Literal["map", "ekf"] = "map"  # ekf: the Kalman filter, for one camera with odometry and little CPU
    ekf: EkfConfig = field(default_factory=EkfConfig)
