"""Configuration of the base station: one frozen section per stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from kiteline_core.ground.config import GroundConfig as ScanConfig
from kiteline_core.imaging.matching import MatchConfig
from kiteline_core.optimisation.bundle import BundleConfig
from kiteline_core.pose.pnp import RansacConfig


@dataclass(frozen=True, slots=True)
class IntakeConfig:
    """When a received keyframe is used."""

    patience_s: float = 2.0  # s; after this long a keyframe is used without its missing sections
    missing_root_s: float = 10.0  # s; after this long a submap without its first keyframe begins at its oldest one
    odometry_gap_s: float = 1.5  # s; a submap that begins within this time of the last one is placed by odometry
    tie_m: float = 0.2  # m; deviation of the motion over a loss up to which it places a submap: half a metre at worst
    tie_rad: float = 0.03  # rad; the same of the rotation
    max_per_step: int = 4  # keyframes; used in one step, so that a backlog does not delay the rest
    confirmed_px: float = 5.0  # px; from the projection of an older landmark to where a keyframe observes it, at most
    min_confirmed: int = (
        10  # such landmarks; with them a keyframe is of use, and its agent may claim memory for another
    )
    max_pending: int = 20_000  # sections kept without their header: only a faulty agent has more


@dataclass(frozen=True, slots=True)
class MeasurementConfig:
    """Standard deviations of the agents' measurements."""

    sigma_px: float = 0.25  # px at octave 0; of an aligned keypoint
    sigma_growth: float = 1.4  # factor per octave; less than 2, as alignment is finer than the octave's pixels
    sigma_disparity_px: float = (
        0.4  # px at octave 0; of a disparity: observations of a landmark share its template's error
    )
    sigma_calibrated_px: float = 0.2  # px at octave 0; of a disparity once the agent's disparity offset is known
    sigma_fused_px: float = 0.6  # px at octave 0; of a new landmark that was fused: two detections of one corner
    sigma_fused_growth: float = 2.0  # factor per octave; corners are detected to a fraction of the octave's pixels


@dataclass(frozen=True, slots=True)
class BundleWindowConfig:
    """Which keyframes a local bundle adjusts."""

    max_free: int = 10  # keyframes whose poses are free: more cost time and change little
    max_fixed: int = 15  # keyframes held fixed: those that observe most of the same landmarks
    min_shared: int = 12  # landmarks that two covisible keyframes share
    min_landmarks: int = 20  # landmarks of a bundle: fewer do not constrain the poses


@dataclass(frozen=True, slots=True)
class OdometryFactorConfig:
    """Weight of the relative pose that an agent measured between a keyframe and its parent."""

    enough_observations: int = 80  # observations of a keyframe above which only the rotation is constrained
    rotation_sigma_px: float = 0.1  # px; of each of 6 far synthetic points: together they hold rotation to 0.15 mrad
    worn_px: float = (
        0.5  # px per sqrt(s) between them, for both: of a worn rig, whose disparity offset is counted apart
    )
    run: int = 20  # keyframes; consecutive rotations whose common error is estimated together
    sigma_px: float = 0.15  # px; of each of 12 synthetic points if the keyframe has no observations
    scale_sigma_px: float = 2.0  # px; of each of 12 more in monocular submaps in metres, whose images tell no scale


@dataclass(frozen=True, slots=True)
class LandmarkMatchingConfig:
    """Matching of known landmarks with an agent's new ones."""

    max_covisible: int = 12  # covisible keyframes searched
    max_nearby: int = 8  # other keyframes searched that view the same place: revisits
    near_ratio: float = 0.5  # distance of such a keyframe over the median depth
    near_cosine: float = 0.7  # cosine of the angle between the optical axes: 45 degrees
    radius_px: float = 8.0  # px at octave 0; search radius: drift within a room; doubles with each octave
    max_hamming: int = 60  # of 256 bits; unrelated ORB descriptors differ by 128 +- 20
    ratio: float = 0.8  # best over second-best distance: below it, a match is distinct
    octave_gap: float = 1.2  # octaves between the predicted and the detected scale
    angle_gap: int = 24  # 1/256 turns; between the predicted and the detected orientation: 34 degrees
    disparity_px: float = 3.0  # px at octave 0; between the predicted and the measured disparity


@dataclass(frozen=True, slots=True)
class TriangulationConfig:
    """Triangulation of landmarks for which the agent has no depth."""

    max_covisible: int = 6  # covisible keyframes searched
    epipolar_px: float = 1.5  # px at octave 0; between a keypoint and its epipolar line
    max_hamming: int = 50  # of 256 bits; stricter than landmark matching, as a line is longer than a circle
    ratio: float = 0.75  # best over second-best distance
    max_cosine: float = 0.9998  # parallax of at least 1.1 degrees: below it depth is noise
    reprojection_px: float = 2.0  # px at octave 0; in every view
    min_baseline_ratio: float = 0.01  # baseline over median depth: below it two keyframes have one viewpoint


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Detection of loop closures and map merges. A wrong closure does more harm than a missed one."""

    share: str = "all"  # agents whose maps may be merged: "all", "none", or groups such as "0 1, 1 2"
    enabled: bool = True  # False: no loops are closed and no maps merged
    candidates: int = 8  # most similar keyframes of other maps that are verified: a room's map has as many views
    candidates_same_map: int = 3  # most similar keyframes of the same map that are verified
    min_gap: int = 12  # keyframes of one submap between two that are matched
    loop_gap: int = 30  # keyframes; landmarks observed again after so many count as a loop
    max_shared: int = 15  # landmarks that a candidate may share with the keyframe already
    min_likeness: float = 0.002  # similarity of places, 0..1: unrelated images 0.01, one from 0.5 m beside no more
    min_neighbour_ratio: float = 0.03  # in one map, of the similarity to the previous keyframe: drift leaves near views
    match: MatchConfig = field(default_factory=MatchConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
    sigma_disparity_px: float = 0.4  # px; standard deviation of the disparities behind the landmarks' depths
    max_neighbours: int = 8  # covisible keyframes whose landmarks are matched too
    radius_px: float = 10.0  # px at octave 0; search radius around predicted projections, halved in the second round
    octave_gap: float = 1.5  # octaves between the predicted and the detected scale
    min_inliers: int = 20  # landmarks that are enough to judge a keyframe, a plane or a merge by
    min_inliers_local: int = 13  # between two maps, landmarks that agree before guided matching: by chance up to 10
    min_inliers_all: int = 35  # landmarks that agree, with those of the neighbours, to merge maps
    min_inliers_loop: int = 40  # landmarks that agree, with those of the neighbours, to close a loop in one map
    min_matched_share: float = 0.25  # of the landmarks expected in view: less is an object that stands in two places
    min_scale_points: int = 20  # landmarks with depth in both maps, from which a scale is estimated
    scale_spread: float = 0.2  # of the logarithm of depth ratios; ratios within it agree
    scale_share: float = 0.7  # of the depth ratios that must agree: two different objects fix no scale
    scale_sigma: float = 0.02  # standard error of the scale's logarithm: the bundle corrects a few percent
    columns: int = 6  # cells across the image: a poster that hangs twice fills few of them
    rows: int = 4  # cells down the image
    cell_inliers: int = 2  # inliers that fill a cell
    min_cells: int = 8  # filled cells, of 24
    min_keyframes: int = 3  # keyframes that agree on a correction
    recent_keyframes: int = 24  # keyframes of a submap within which matches are counted together
    predecessors: int = 4  # keyframes before a matched one that are verified too: their views still overlap
    against: int = 3  # agreeing keyframes needed more for each one that contradicts
    agree_m: float = 0.10  # m; between two corrections that agree
    agree_depth: float = 0.04  # added share of the median depth
    agree_path: float = 0.02  # added share of the path between the two keyframes
    agree_rad: float = 0.05  # rad; between two corrections that agree
    agree_scale: float = 0.05  # difference of the logarithms of two scales that agree
    drift_m: float = 0.3  # m; correction of a loop that drift explains
    drift_path: float = 0.02  # added share of the path between the two keyframes
    drift_rad: float = 0.1  # rad; correction of a loop that drift explains
    drift_votes: int = 12  # keyframes in a row, none against them, that outvote this expectation in one submap
    drift_votes_apart: float = 1.0  # of the median depth; from the first to the farthest one: they see other things
    most_drift: float = 5.0  # times the expected drift; no votes suffice beyond: two storeys that look alike
    tilt_rad: float = 0.05  # rad; by which gravity of two maps may differ that are merged: cameras on worn mounts
    tilt_deviations: float = 4.0  # added, of what their agents know gravity to
    drift_rad_m: float = 0.002  # rad/m; added for each metre of the path
    monocular_drift_path: float = 0.05  # share of the path instead of drift_path if the scale drifts too
    max_scale_drift: float = 0.4  # logarithm of the scale drift along a loop
    fuse_m: float = 0.02  # m; smaller corrections need no pose graph: landmarks are fused at once
    fuse_rad: float = 0.005  # rad; the same of rotations
    fuse_scale: float = 0.005  # the same of the logarithm of a scale
    off_plane: float = 0.03  # of the median depth; landmarks farther from the common plane lie off it
    min_off_plane: float = 0.15  # share of landmarks off the plane to merge maps: a wallpaper has copies
    ambiguous_m: float = 1.0  # m; similar places of one map that lie farther apart make it ambiguous


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """Corrections of whole maps: pose graphs and full bundles."""

    min_shared: int = 100  # landmarks of two covisible keyframes joined by an edge
    sigma_m: float = 0.005  # m; standard deviation of an edge between neighbours
    sigma_path: float = 0.01  # added share of the edge's length
    sigma_rad: float = 0.003  # rad; of an edge between neighbours
    sigma_scale: float = 0.003  # of the logarithm of the scale between neighbours in a monocular submap
    loop_sigma_scale: float = 0.01  # of the logarithm of the scale of a loop edge
    loop_sigma_depth: float = 0.005  # of a loop edge: added share of the median depth
    loop_sigma_rad: float = 0.003  # rad; of a loop edge
    level_inflation: float = 4.5  # of deviations of gravity, whose errors are the same over some 20 keyframes
    huber: float = 3.0  # standard deviations; loop edges with larger residuals weigh less
    stop: float = 1e-4  # relative decrease of the error below which the solver stops
    first_full: int = 3  # keyframes of a map at its first full bundle: a worn rig is seen in it
    full_share: float = 0.03  # of the worker's time for scheduled full bundles: one of 100 keyframes every 3 s
    max_full: int = 800  # keyframes of a full bundle, which takes 0.4 s; of a larger map, those around the loop
    robust_trials: int = 6  # trial steps of a full bundle before the outlier test
    final_trials: int = 6  # trial steps of a full bundle after the outlier test
    requeries: int = 2  # keyframes of merged maps that are matched to the other map in one step
    min_kept: float = 0.5  # share of inliers among observations that a merge fused: below it the merge is undone


@dataclass(frozen=True, slots=True)
class DisparityConfig:
    """Calibration of each agent's disparity offset by bundles of a whole map."""

    retry_growth: float = 1.1  # growth of the map after which an insignificant offset is estimated again
    prior_px: float = 0.1  # px; standard deviation of a constant offset: the accuracy of calibrations
    prior_rad: float = 3e-4  # rad; of the right camera's rotation (times the focal length: px where x or y is 1)
    tail: float = 6.0  # standard deviations, inflated: beyond two of the prior's own it yields to the data
    determined: float = 0.7  # share of the prior's deviation; a term yields that data alone determine better
    worn: float = 15.0  # factor on both deviations for a rig that has changed since its calibration: one or two pixels
    contradicts: float = (
        6.0  # squared distance of the data from a good calibration, inflated; of true rigs it is below 1
    )
    min_sideways: float = 0.2  # share of the motion across the optical axis below which errors of a lens pass for such
    known_from: float = 2.0  # prior deviations, rms; from which the offset of earlier flights is that of a worn rig
    usual_rows_px: float = 0.25  # px; by which rows are off in good calibrations: more, and the motion does not matter
    inflation: float = (
        3.0  # factor on the estimated standard deviations: lens distortion biases depths from motion, too
    )
    min_significance: float = 0.5  # standard deviations; from which an offset is accepted: by chance 1 in 20
    calibrated_px: float = 0.03  # px; standard deviation of the offset below which it counts as known


@dataclass(frozen=True, slots=True)
class InertialScaleConfig:
    """Scale of a monocular map in metres by the agents' inertial steps."""

    least_s: float = 8.0  # time of all steps below which the agent's scale stands: it rests on as much
    iterations: int = 5  # of Gauss-Newton
    gravity_m_s2: float = 9.81  # differs by 0.3 % over the earth, which the accelerometer bias absorbs
    noise_inflation: float = 3.0  # of the accelerometer's noise: vibration
    floor_m_s: float = 2e-4  # m/s; of a step by the IMU: the code's quanta
    floor_m: float = 3e-5  # m; the same
    image_rad: float = 5e-4  # error of a step by images, over the distance of what they see
    image_m: float = 5e-4  # m; the same of near scenes
    huber: float = 2.5  # deviations; steps by images with larger errors weigh less
    bias_sigma: float = 0.3  # m/s^2; of the accelerometer's bias where a chain begins
    bias_walk: float = 0.03  # m/s^2 per sqrt(s); its slow errors: axes, vibration, temperature, as true poses show them
    agent_sigma: float = 0.03  # of the agent's scale
    drift: float = 0.015  # of the scale by images per root of a view: 1 rad, or a motion as far as what is seen
    most_drift: float = 3.0  # deviations of that from one knot to the next; 1.7 at most in whole maps, 5 in torn ones
    knot_views: float = 1.0  # between the values of a scale that drifts
    most_knots: int = 16  # such values of a map
    hold: float = 0.5  # deviations; a smaller change would only move the world under the vehicle


@dataclass(frozen=True, slots=True)
class CullConfig:
    """Culling of landmarks, observations and keyframes."""

    landmark_age: int = 4  # keyframes after the first observation at which a landmark is tested
    min_found: float = 0.25  # share of the keyframes with a landmark in view that observe it
    min_visible: int = 4  # keyframes with the landmark in view before it is tested
    min_observations: int = 2  # observations that must remain after the outlier test
    keyframe_age: int = 10  # later keyframes of its submap before a keyframe may be culled as redundant
    keyframe_share: float = 0.9  # share of its landmarks that other keyframes observe as well
    keyframe_others: int = 3  # other keyframes that observe them, at a scale at most one octave coarser
    max_offset_px: float = 8.0  # px at octave 0; from the keypoint to the refined projection: more is another landmark


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """Smallest corrections that are sent and kept."""

    pose_m: float = 0.0005  # m; a tenth of a pixel at 2.5 m and 500 px of focal length
    pose_rad: float = 0.0002  # rad; a tenth of a pixel at 500 px of focal length
    depth_px: float = 0.1  # px; of projection or disparity, the largest of a keyframe's landmarks
    batch_s: float = 2.0  # s that a thin link takes to carry a batch of corrections, about; the next one waits so long
    batch_values: int = 1000  # values of a batch: a loop over a large map moves all its keyframes
    step_values: int = 100  # values of a batch, and as many others, coded in one step, in 15 ms; the next steps go on
    batch_wait_s: float = 10.0  # s after which nobody listens: no batch is waited for, nothing planned for the agent


@dataclass(frozen=True, slots=True)
class MapCacheConfig:
    """Keyframes that are sent to an agent for its map cache."""

    max_keyframes: int = 24  # keyframes in an agent's cache, 0 none; they cover two views of a room and the way there
    period_s: float = 1.0  # s between two plans
    horizon_s: float = 2.0  # s that the motion is predicted: what a thin link takes to carry two keyframes
    local_keyframes: int = 48  # newest keyframes of its own that an agent keeps in its local map
    max_distance_ratio: float = (
        1.5  # distance of a keyframe over the depth in view: farther ones share little of the view
    )
    min_cosine: float = 0.3  # of the angle between the optical axes: descriptors match up to 70 degrees
    max_candidates: int = 60  # keyframes whose landmarks are projected
    min_landmarks: int = 8  # landmarks of a keyframe that will be in view: fewer are not worth their bytes
    hysteresis: float = 1.5  # factor on the landmarks in view of a keyframe that is cached already
    pose_m: float = 0.002  # m; smaller corrections of a cached keyframe are not sent: half a pixel at 2 m
    pose_rad: float = 0.0005  # rad; a quarter of a pixel at 500 px of focal length
    max_scale_change: float = 0.01  # relative change of the agent's unit of length at which keyframes are sent again


@dataclass(frozen=True, slots=True)
class TileConfig:
    """Tiles of the grid that are sent to an agent."""

    max_tiles: int = 96  # tiles that an agent holds, 0 none: 4 kB each on board; a disc of 15 m radius at 0.05 m has 70
    period_s: float = 1.0  # s between two plans
    horizon_s: float = 3.0  # s that the motion is predicted: what lies ahead is of use before the agent is there
    reach_m: float = 14.0  # m; tiles whose centres are nearer are sent: distances are told up to 10 m
    kept_ratio: float = 1.5  # of reach_m; tiles farther away are removed
    keyframe_bytes: float = 100.0  # bytes that each of the agent's keyframes earns: two thirds of a scan upwards
    most_credit_bytes: float = 3000.0  # bytes at once: after a loop closure, or when an agent comes to a known place
    overhead_bytes: int = 14  # of a tile in a packet: its key, version and a share of headers
    min_changes: int = (
        96  # cells that differ before a tile is sent again: its newest edges are in the agent's own scans
    )
    solid_weight: int = 4  # added cells for each one that became an obstacle, or is none any more
    near_m: float = 4.0  # m; added to distances: among near tiles changes decide


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """Estimation of the ground height."""

    camera_above_m: float = 0.1  # m; ground points are at least this far below every camera that observes them
    patch_m: float = 2.0  # m; side of a patch; three by three patches share their points
    height_bin_m: float = 0.05  # m; the points of a floor, with stereo noise, fill two or three bins
    slope: float = 0.25  # m/m; steepest ground: a ramp, or a map whose z is 10 degrees off the vertical
    peak_share: float = 0.25  # of the highest peak; the lowest peak with this share is the ground, below it is noise
    min_peak_points: float = 4.0  # points of a peak
    bands_m: tuple[float, ...] = (0.3, 0.2, 0.12, 0.1)  # m; half-widths around the plane, from a bin's error to noise
    min_plane_points: float = 12.0  # points that a patch needs for a fit of its plane
    slope_prior_m: float = 0.3  # m; points with less horizontal spread than this leave the slope near zero


@dataclass(frozen=True, slots=True)
class GridConfig:
    """The occupancy grid. Heights are relative to the local ground; log-odds are in 1/16."""

    cell_m: float = 0.05  # m; a quarter of the gap that a small vehicle passes; 0.01 possible, 0.2 suits wide streets
    max_range_m: float = 20.0  # m; beyond, the columns of a scan are wider than half a metre
    sigma_px: float = 0.3  # px; standard deviation of a disparity: with the baseline, how ranges err
    max_sigma_m: float = (
        0.25  # m; ranges with a larger deviation are not used: a wall would be as thick as a door is wide
    )
    fence: float = (
        1.5  # interquartile ranges above the upper quartile: longer rays to the ground are cut (Segfloor eq. 5.3)
    )
    bands_m: tuple[float, ...] = (0.1, 0.5, 1.2, 2.0)  # m; limits of the height bands, as the agents' scans have them
    accurate_sigma_m: float = 0.05  # m; up to this deviation of a range a view counts in full: a cell by default
    gap_sigmas: float = 3.0  # standard deviations before an obstacle within which ground is not freed
    log_hit: int = 6  # 1/16; log-odds of one near view of an obstacle (p = 0.59); in inverse proportion to the range
    log_free: int = 3  # 1/16; of one near view of free space (p = 0.45): half, as an edge is seen beside itself
    log_free_sure: int = 2  # 1/16; the same of a far view well before what it sees
    log_free_far: int = 1  # 1/16; of a far view elsewhere (box and wall may be one surface), and before seen ground
    sure_sigmas: float = (
        2.0  # standard deviations beyond gap_sigmas from which on a far view is well before what it sees
    )
    side_columns: int = (
        2  # of a scan at either side of its view that count as far ones: what stands there is not seen whole
    )
    occupied_from: int = 5  # 1/16; log-odds from which a band is occupied: one near view, two far ones
    free_from: int = 2  # 1/16; a cell is free if all bands lie at or below minus this: one near view, two far ones
    free_beside: int = (
        5  # 1/16; the same beside an occupied cell: a near view and a sure one, as one may lie a cell off
    )
    hole_neighbours: int = (
        5  # of 8 that are free, none occupied: a cell that no view spoke against is free too (a gap between two rays)
    )
    opening: bool = True  # what is free is opened by three by three cells: gaps between two rays are no ways
    ground_m: float = (
        -1.2
    )  # m; height in w of the middle storey: the camera that begins w flies 0.4 to 2 m above ground
    storey_m: float = 2.5  # m; between two storeys: less than those of houses
    storey_overlap_m: float = 0.4  # m; beyond its half a storey also holds what lies so near: ramps, drift of heights
    max_position_m: float = 100_000.0  # m; scans farther from the origin are not drawn: only a faulty map has them
    max_reach_m: float = 100.0  # m; scans that reach farther are not drawn: only a faulty scale makes them
    view_m: float = 0.5  # m; scans of an agent whose cameras lie in a square of this side ...
    view_rad: float = 0.39  # rad; ... and head the same way within this, a quarter of the field of view, are one view
    views: int = 8  # scans of one view that are drawn, the newest: log-odds of 16 bits hold some thousand near views
    drawn_per_step: int = 16  # scans that one step draws, half a ms each: a loop's corrections wait for later steps
    scanless_keyframes: int = 8  # of a stereo agent without a scan, after which its landmarks are drawn: they tell less
    sparse_lag: int = (
        5  # keyframes after which the landmarks of one without a scan are drawn again: they are refined by then
    )
    sparse_window: int = 4  # keyframes before and after it whose landmarks tell where its ground lies
    made_per_step: int = 2  # scans that one step makes from landmarks, 3 ms each
    sparse_columns: int = 36  # of a scan from landmarks: more would leave gaps between rays
    sparse_floor_points: int = 20  # nearest landmarks on the ground, whose median is the camera's height
    sparse_depth_m: float = 0.3  # m; landmarks so far behind the nearest obstacle of a column belong to it
    free_below_m: float = (
        0.7  # m; a ray to a landmark frees cells only where it is lower: it passes over boxes and chairs
    )
    noise_per_m: float = 0.01  # m/m; height noise of landmarks per distance
    ground_keyframes: int = 20  # newest keyframes among which one must know the height of the ground: 20 s
    band_files: bool = False  # True: a file for each height band, too
    binary_files: bool = False  # True: a file in which one view occupies a cell for good, too (Segfloor)
    resident_tiles: int = 512  # tiles that stay inflated, 24 kB each: what a dozen drones draw on at a time
    ground: GroundConfig = field(default_factory=GroundConfig)


@dataclass(frozen=True, slots=True)
class BaseConfig:
    """All sections."""

    intake: IntakeConfig = field(default_factory=IntakeConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    bundle_window: BundleWindowConfig = field(default_factory=BundleWindowConfig)
    odometry_factors: OdometryFactorConfig = field(default_factory=OdometryFactorConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)
    landmark_matching: LandmarkMatchingConfig = field(default_factory=LandmarkMatchingConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
    inertial_scale: InertialScaleConfig = field(default_factory=InertialScaleConfig)
    cull: CullConfig = field(default_factory=CullConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    disparity: DisparityConfig = field(default_factory=DisparityConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    map_cache: MapCacheConfig = field(default_factory=MapCacheConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    scan: ScanConfig = field(default_factory=ScanConfig)
    tiles: TileConfig = field(default_factory=TileConfig)
