"""Configuration of the onboard half: one frozen section per stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.inertial.controller_imu import ControllerImuConfig
from kiteline_agent.inertial.inertial_config import InertialConfig
from kiteline_agent.initialisation.two_view import TwoViewConfig
from kiteline_agent.motion.odometer import OdometerConfig
from kiteline_core.imaging.matching import MatchConfig
from kiteline_core.pose.pnp import RansacConfig


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    """Image pyramids."""

    levels: int = 4  # each halves the size; three detected octaves and one above for convergence
    first: int = 0  # finest level that is made; 1: a third of the work, twice the error


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Depth along the row."""

    min_depth_m: float = 0.25  # nearest surface; bounds the search along the row
    uniqueness: float = 1.15  # second-best cost over best: below it, the row repeats itself
    min_ncc: float = 0.85  # correlation of the two patches; lower ones are occlusions and edges of depth
    search_px: float = 3.0  # px of the level: how far stereo may lie from the predicted disparity
    iterations: int = 6  # Gauss-Newton steps; it converges in 3
    points: int = 240  # of a frame, spread over those that were found
    sigma_px: float = 0.25  # one standard deviation of a disparity at octave 0


@dataclass(frozen=True, slots=True)
class AlignConfig:
    """Template alignment."""

    coarse_points: int = 80  # points of the first, coarse pass that mends the motion model
    points: int = 240  # points of the fine pass; more cost time and gain little
    cell_px: int = 32  # one candidate at a time is taken from each cell
    iterations: int = 8  # Gauss-Newton steps a level
    fine_from: int = 1  # template level at which the fine pass begins; 0 is cheaper and forgives less
    coarse_step_px: float = 7.0  # px of the coarse level: half a template
    fine_step_px: float = 3.0  # px of the fine level: what the coarse pass leaves
    min_ncc: float = 0.80  # correlation of template and patch
    sigma_px: float = 0.30  # one standard deviation of an aligned pixel coordinate at octave 0
    max_scale: float = 2.5  # how much nearer or farther than its template a point may be


@dataclass(frozen=True, slots=True)
class PoseConfig:
    """Motion-only optimisation."""

    rounds: int = 3  # each ends with a new verdict on outliers
    iterations: int = 4  # Gauss-Newton steps a round
    chi2: float = 9.21  # 99 % of a chi-square with 2 degrees of freedom
    min_inliers: int = 15  # below it a pose is not to be trusted
    min_share: float = 0.3  # of the points looked for: good tracks find half, ones that began elsewhere a tenth


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """When a frame becomes a keyframe; see keyframes.RULES."""

    min_gap_frames: int = 2  # leaves the tracker time to spread a keyframe's work
    max_gap_s: float = 3.0  # a standing vehicle still proves that it is alive
    min_share: float = 0.65  # inliers relative to those of the reference keyframe
    min_inliers: int = 90  # absolute number of inliers that a comfortable track has
    min_cover: float = 0.45  # share of 96 px image cells that hold a tracked point
    baseline_ratio: float = 0.12  # translation over median depth: new views of the same scene
    rotation_rad: float = 0.30  # a turn that has replaced a quarter of the view
    thin: float = 3.0  # times the fewest inliers of a pose: below it a keyframe cannot wait for CPU time


@dataclass(frozen=True, slots=True)
class LocalMapConfig:
    """What the agent remembers."""

    keyframes: int = 48  # slots; older and farther keyframes are forgotten (the base has them)
    births: int = 200  # points a keyframe can bear
    searched: int = 48  # keyframes whose points are looked for: those seen last
    max_far_ratio: float = 400.0  # depth over baseline beyond which stereo says nothing
    first_points: int = 40  # with depth, that a first keyframe must have


@dataclass(frozen=True, slots=True)
class DepthFilterConfig:
    """How new sightings sharpen a point's depth until the base sends a better one."""

    refined_sigma_px: float = 0.08  # virtual disparity error of a depth that the base refined
    floor_px: float = 0.06  # virtual disparity error that the filter never claims to beat
    inflation: float = 6.0  # successive sightings share the template's error: so many count as one


@dataclass(frozen=True, slots=True)
class TwoViewStartConfig:
    """How one eye begins a map."""

    median_depth_m: float = 4.0  # of the first points: the convention that sets the scale; that of a room
    corners: int = 400  # followed from the first frame; half of them are lost or have no parallax
    cell_px: int = 22  # one corner a cell
    window_px: int = 15  # px of the flow's window: the cheapest that holds on to corners
    min_flow: float = 0.02  # of the focal length, median: below it two views are hardly two
    min_share: float = 0.4  # of the first corners; with fewer left a new first frame is taken
    max_frames: int = 40  # after which a new first frame is taken: the view has changed too much
    scale_every: int = 10  # frames between two looks at the scale that an IMU gives
    scale_sigma: float = 0.02  # relative deviation at which that scale is believed
    two_view: TwoViewConfig = field(default_factory=TwoViewConfig)


@dataclass(frozen=True, slots=True)
class DepthFromMotionConfig:
    """How bearings get their depth from motion."""

    per_frame: int = 150  # bearings looked for in a frame; each costs about 10 us
    per_frame_stereo: int = 24  # the same beside stereo, which leaves only far and doubtful points
    nearer: float = 2.0  # how much nearer than the nearest twentieth of the points a bearing may be
    reach: float = 2.5  # deviations of inverse depth that are searched
    step_px: float = 0.7  # px of the level between two tries: half of what correlation bears
    max_steps: int = 40  # tries on a segment; longer ones are searched on a smaller image
    min_search_ncc: float = 0.7  # correlation at a try, up to half a step from the peak
    distinct: float = 0.93  # share of the best correlation that nothing else on the segment may reach
    off_line_px: float = 1.5  # px at octave 0 that alignment may leave the segment's line
    gate: float = 3.0  # deviations between what is measured and what is held
    sigma_px: float = 0.5  # one deviation of an aligned pixel, with the pose's own error
    inflation: float = 2.0  # successive frames share the template's error: so many count as one
    known: float = 0.12  # deviation over inverse depth at which a bearing becomes a point
    far_share: float = 0.4  # of the typical inverse depth: a farther point needs only be known as well as one there
    min_hits: int = 3  # frames that agree
    max_misses: int = 6  # frames in which nothing alike is there: it moved, or was the edge of something
    max_tries: int = 60  # frames in view without a depth: there is none to be had


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    """Finding the old map again."""

    cell_px: int = 16  # one corner a cell; four times as many as a keyframe bears, so that its own are among them
    max_corners: int = 600  # 0.5 ms of descriptors
    min_corners: int = 60  # fewer: there is no texture in view, and a try would prove nothing
    candidates: int = 3  # places tried in a frame; each costs about 1 ms
    beyond_px: float = 150.0  # px beyond a keyframe's border of which points are matched too: a fifth of the image
    min_pnp_inliers: int = 12  # of P3P; chance matches reach 8
    min_inliers: int = 30  # of the tracker from that pose
    min_share: float = 0.4  # of the points that the tracker looked for: a place that only resembles has fewer
    carried_m: float = 0.08  # deviation of a pose by the IMU alone up to which the map goes on: well below what is good
    carried_rad: float = 0.02  # likewise: a degree
    failures: int = 2  # tries, with texture in view, to find the old map before a new one opens
    beside_frames: int = 20  # how long the search goes on beside a young submap: 1 s
    agree_ratio: float = 0.05  # of the depth: two results beside a young submap may differ by so much
    agree_rad: float = 0.035  # 2 degrees, the same for the turn
    twins: int = 2  # further places of the same submap that are tried when one was found; each costs about 1 ms
    twin_share: float = 0.6  # of its matches, with which another place is as likely
    twin_ratio: float = 0.2  # of the depth, that two results of one place may differ: P3P by points of one side only
    twin_rad: float = 0.15  # the same for the turn


@dataclass(frozen=True, slots=True)
class CovarianceConfig:
    """What is not known of the sensors, and when a pose counts as good."""

    calibration_px: float = 0.05  # px at the image's edge that a good calibration of one camera is off by
    extrinsic_rad: float = 3e-4  # of the camera in the body: a hundredth of a degree or two
    extrinsic_m: float = 1e-3  # likewise
    least_rms: float = 0.3  # whitened residual of a frame below which its noise is not believed to be smaller
    inflation: float = 1.0  # of the variance of a measured pose
    dispute_frames: float = 10.0  # frames over which what an IMU pulls poses off the images is averaged
    pull_share: float = 1.0  # of its mean, one deviation, that is wrong
    refined_share: float = 0.25  # of a keyframe's variance that is left when the base has optimised it
    blind_accel_m_s2: float = 2.0  # that an unseen vehicle may have: a multicopter that leans by twelve degrees
    blind_turn_rad_s2: float = 2.0  # likewise
    blind_velocity_m_s: float = 0.03  # error of the velocity between two frames
    blind_rate_rad_s: float = 0.02  # likewise
    blind_speed_m_s: float = 5.0  # error of the velocity of a vehicle that was not seen to move: it just began
    blind_speed_rad_s: float = 1.0  # likewise
    good_m: float = 0.2  # a pose counts as good within so much
    good_rad: float = 0.1745  # and so much: 10 degrees
    few_inliers: int = 10  # from which on points speak for a pose: so many agree by chance
    many_inliers: int = 30  # with which nothing speaks against it
    flagged_below: int = 50  # quality below which a pose is not to be relied on: it is as likely wrong as good
    surprise: float = 7.0  # deviations by which a place found again may differ from where the IMU says the vehicle is
    surprise_blind: float = 10.0  # the same where nothing measured the way: two g, all the time
    strange: float = 4.0  # the same, from which on a place is doubted at first: nearly one g
    doubt_frames: int = 20  # for which it is: one second, in which a place that only resembles falls apart
    surprise_m: float = 0.1  # deviation of that beside the covariances: maps are corrected meanwhile
    surprise_rad: float = 0.05  # likewise


@dataclass(frozen=True, slots=True)
class MapCacheConfig:
    """Copies of keyframes that the base lends, and what is made of them."""

    copies: int = 32  # slots; the base lends fewer, an earlier base's may still be here
    points: int = 128  # of a copy
    sigma_px: float = 0.15  # virtual disparity error of a lent point: many views made it
    max_scale: float = 2.5  # how much nearer or farther than in its keyframe a point may be
    octave_gap: float = 1.2  # octaves between the size foreseen and the size found
    corner_px: float = 1.0  # one standard deviation of a corner's place at octave 0, found twice
    radius_px: float = 6.0  # px at octave 0 around where a lost frame's points are foreseen: what P3P leaves
    min_met: int = 12  # lent points that agree with one pose; chance matches reach 8
    min_found: int = 30  # of them that find a lost frame
    min_share: float = 0.15  # of those that should be in view; not every point is a corner again
    candidates: int = 3  # copies tried in a lost frame
    beyond_px: float = 150.0  # px beyond a copy's border of which points are matched too


@dataclass(frozen=True, slots=True)
class SmoothingConfig:
    """How corrections reach the live pose in the world. They never touch the odometry frame."""

    max_m_s: float = 0.2  # m/s at which the odometry frame moves in w: no jump, and told within a second; 0: at once
    max_rad_s: float = 0.0  # rad/s at which it turns; 0: at once
    snap_m: float = 0.3  # farther than this two maps were joined: taken at once


@dataclass(frozen=True, slots=True)
class GovernorConfig:
    """How CPU time is held under a budget."""

    cpu_percent: float = 0.0  # of one core, over any window; 0: no budget
    window_s: float = 1.0  # s in which the budget has to hold
    margin: float = 0.97  # share of the budget that is planned with: the rest is for what was not foreseen
    tight: float = 1.0  # share of the budget above which effort falls
    fill: float = 1.05  # share up to which frames are let through between two rows: keyframes are not always due
    comfort: float = 0.86  # share below which the next better effort would have to stay, so that effort rises
    grace_s: float = 2.0  # s at the start that are not booked: a map has to be begun
    down_s: float = 0.25  # s between two falls: the expectations need time to show the first one
    up_s: float = 1.5  # s of comfort before a rise
    max_gap_s: float = 0.35  # s between tracked frames; after more, a track is hard to find again
    carried_gap_s: float = 0.8  # the same with an IMU, whose prediction counts as tracking for 1 s
    blind_s: float = 1.0  # s without a tracked frame, after which one is tracked whatever it costs
    doubt: float = 0.1  # how much dearer than expected a frame may be, at least
    learning: float = 0.15  # gain of the expectations of frames
    keyframe_learning: float = 0.4  # gain of how often keyframes are asked for
    first_keyframes: float = 2.0  # in a second, before it was seen
    first_frame_ms: float = 3.5  # of a tracked frame at full effort, before it was seen: 752x480 on a laptop
    first_period_s: float = 0.05  # between frames, before it was seen
    settling_s: float = 1.0  # s at the start in which effort follows the load without hysteresis


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """All sections."""

    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)
    depth_filter: DepthFilterConfig = field(default_factory=DepthFilterConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    controller_imu: ControllerImuConfig = field(default_factory=ControllerImuConfig)
    odometer: OdometerConfig = field(default_factory=OdometerConfig)
    certainty: CovarianceConfig = field(default_factory=CovarianceConfig)
    governor: GovernorConfig = field(default_factory=GovernorConfig)
    motion: DepthFromMotionConfig = field(default_factory=DepthFromMotionConfig)
    mono_start: TwoViewStartConfig = field(default_factory=TwoViewStartConfig)
    recovery: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    window: MapCacheConfig = field(default_factory=MapCacheConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
