"""Configuration of the base station: one frozen section per stage."""

from dataclasses import dataclass, field
from typing import ClassVar

from kiteline_core.ground.config import GroundConfig
from kiteline_core.optimisation.bundle import BundleConfig


@dataclass(frozen=True, slots=True)
class IntakeConfig:
    """Bounds on what agents may send."""

    max_pending: int = 20_000  # sections kept without their header: only a faulty agent has more


@dataclass(frozen=True, slots=True)
class MeasurementConfig:
    """Standard deviations of the agents' measurements."""

    sigma_px: float = 0.25  # px at octave 0; of an aligned keypoint
    sigma_disparity_px: float = (
        0.2  # px at octave 0; of a disparity: with an offset of a good calibration, which is not known
    )


@dataclass(frozen=True, slots=True)
class BundleWindowConfig:
    """Which keyframes a local bundle adjusts."""

    max_free: int = 10  # keyframes whose poses are free: more cost time and change little
    max_fixed: int = 15  # keyframes held fixed: those that observe most of the same landmarks


@dataclass(frozen=True, slots=True)
class OdometryFactorConfig:
    """Weight of the relative pose that an agent measured between a keyframe and its parent."""

    enough_observations: int = 80  # observations of a keyframe above which only the rotation is constrained
    worn_px: float = (
        0.5  # px per sqrt(s) between them, for both: of a worn rig, whose disparity offset is counted apart
    )
    sigma_px: float = 0.07  # px; of each of 12 synthetic points of 0.5 s without observations: 150 were tracked


@dataclass(frozen=True, slots=True)
class LandmarkMatchingConfig:
    """Matching of known landmarks with an agent's new ones."""

    radius_px: float = 8.0  # px at octave 0; search radius: drift within a room; doubles with each octave
    max_hamming: int = 60  # of 256 bits; unrelated ORB descriptors differ by 128 +- 20
    disparity_px: float = 3.0  # px at octave 0; between the predicted and the measured disparity


@dataclass(frozen=True, slots=True)
class TriangulationConfig:
    """Triangulation of landmarks for which the agent has no depth."""

    epipolar_px: float = 1.5  # px at octave 0; between a keypoint and its epipolar line
    max_hamming: int = 50  # of 256 bits; stricter than landmark matching, as a line is longer than a circle
    max_cosine: float = 0.9998  # parallax of at least 1.1 degrees: below it depth is noise


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Detection of loop closures and map merges. A wrong closure does more harm than a missed one."""

    share: str = "all"  # agents whose maps may be merged: "all", "none", or groups such as "0 1, 1 2"
    enabled: bool = True  # False: no loops are closed and no maps merged
    candidates: int = 8  # most similar keyframes of other maps that are verified: a room's map has as many views
    min_likeness: float = 0.002  # similarity of places, 0..1: unrelated images 0.01, one from 0.5 m beside no more
    radius_px: float = 10.0  # px at octave 0; search radius around predicted projections, halved in the second round
    min_inliers: int = 20  # landmarks that are enough to judge a keyframe, a plane or a merge by
    min_inliers_all: int = 35  # landmarks that agree, with those of the neighbours, to merge maps
    min_inliers_loop: int = 40  # landmarks that agree, with those of the neighbours, to close a loop in one map
    min_matched_share: float = 0.25  # of the landmarks expected in view: less is an object that stands in two places
    columns: int = 6  # cells across the image: a poster that hangs twice fills few of them
    rows: int = 4  # cells down the image
    predecessors: int = 4  # keyframes beside matched ones that are verified too: their views still overlap
    drift_m: float = 0.3  # m; correction of a loop that drift explains
    drift_path: float = 0.02  # added share of the path between the two keyframes
    drift_matches: int = 12  # matches that agree, none against them, after which drift may be larger in one submap
    most_drift: float = 5.0  # times the expected drift; beyond, no number of them does: two storeys that look alike


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """Corrections of whole maps: pose graphs and full bundles."""

    huber: float = 3.0  # standard deviations; loop edges with larger residuals weigh less
    stop: float = 1e-4  # relative decrease of the error below which the solver stops
    full_share: float = 0.03  # of the worker's time for scheduled full bundles: one of 100 keyframes every 3 s
    max_full: int = 800  # keyframes of a full bundle, which takes 0.4 s; of a larger map, those around the loop


@dataclass(frozen=True, slots=True)
class DisparityCalibrationConfig:
    """Calibration of each agent's disparity offset by bundles of a whole map."""

    contradicts: float = (
        6.0  # squared distance of the data from a good calibration, inflated; of true rigs it is below 1
    )
    min_sideways: float = 0.2  # share of the motion across the optical axis below which errors of a lens pass for such
    inflation: float = (
        3.0  # factor on the estimated standard deviations: lens distortion biases depths from motion, too
    )


@dataclass(frozen=True, slots=True)
class InertialScaleConfig:
    """Scale of a monocular map in metres by the agents' inertial steps."""

    huber: float = 2.5  # deviations; steps by images with larger errors weigh less
    drift: float = 0.015  # of the scale by images per root of a view: 1 rad, or a motion as far as what is seen
    most_drift: float = 3.0  # deviations of that from one knot to the next; 1.7 at most in whole maps, 5 in torn ones
    hold: float = 0.5  # deviations; a smaller change would only move the world under the vehicle


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """Smallest corrections that are sent and kept."""

    pose_m: float = 0.0005  # m; a tenth of a pixel at 2.5 m and 500 px of focal length
    pose_rad: float = 0.0002  # rad; a tenth of a pixel at 500 px of focal length
    depth_px: float = 0.1  # px; of projection or disparity, the largest of a keyframe's landmarks
    batch_s: float = 2.0  # s that a thin link takes to carry a batch of corrections, about; the next one waits so long
    batch_gap_s: float = 0.6  # s between two batches at least, for cameras that measure depth: more often gains nothing
    batch_values: int = 1000  # values of a batch: a loop over a large map moves all its keyframes
    step_values: int = 100  # values of a batch, and as many others, coded in one step, in 15 ms; the next steps go on
    batch_wait_s: float = 10.0  # s after which nobody listens: no batch is waited for, nothing planned for the agent


@dataclass(frozen=True, slots=True)
class MapCachePlannerConfig:
    """Keyframes that are sent to an agent for its map cache."""

    MAY_BE_ZERO: ClassVar = ("max_keyframes",)

    max_keyframes: int = 24  # keyframes in an agent's cache, 0: none; they cover two views of a room and the way there
    horizon_s: float = 2.0  # s that the motion is predicted: what a thin link takes to carry two keyframes
    local_keyframes: int = 48  # newest keyframes of its own that an agent keeps in its local map
    max_distance_ratio: float = (
        1.5  # distance of a keyframe over the depth in view: farther ones share little of the view
    )
    min_cosine: float = 0.3  # of the angle between the optical axes: descriptors match up to 70 degrees


@dataclass(frozen=True, slots=True)
class TileConfig:
    """Tiles of the grid that are sent to an agent."""

    MAY_BE_ZERO: ClassVar = ("max_tiles",)

    max_tiles: int = 96  # tiles that an agent holds, 0: none; 4 kB each on board; a disc of 15 m radius has 70
    horizon_s: float = 3.0  # s that the motion is predicted: what lies ahead is of use before the agent is there
    reach_m: float = 14.0  # m; tiles whose centres are nearer are sent: distances are told up to 10 m
    keyframe_bytes: float = 100.0  # bytes that each of the agent's keyframes earns: two thirds of a scan upwards
    most_credit_bytes: float = 3000.0  # bytes at once: after a loop closure, or when an agent comes to a known place
    min_changes: int = (
        96  # cells that differ before a tile is sent again: its newest edges are in the agent's own scans
    )


@dataclass(frozen=True, slots=True)
class GridConfig:
    """The occupancy grid. Heights are relative to the local ground; log-odds are in 1/32."""

    cell_m: float = 0.05  # m; a quarter of the gap that a small vehicle passes; 0.01 possible, 0.2 suits wide streets
    max_range_m: float = 20.0  # m; beyond, the columns of a scan are wider than half a metre
    sigma_px: float = 0.3  # px; standard deviation of a disparity: with the baseline, how ranges err
    max_sigma_m: float = (
        0.25  # m; ranges with a larger deviation are not used: a wall would be as thick as a door is wide
    )
    bands_m: tuple[float, ...] = (0.1, 0.5, 1.2, 2.0)  # m; limits of the height bands, as the agents' scans have them
    side_columns: int = (
        2  # of a scan at either side of its view that count as far ones: what stands there is not seen whole
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
    views: int = 8  # scans of one view that are drawn, the newest: log-odds of 16 bits hold some thousand near views
    drawn_per_step: int = 16  # scans that one step draws, half a ms each: a loop's corrections wait for later steps
    scanless_keyframes: int = 8  # of a stereo agent without a scan, after which its landmarks are drawn: they tell less
    made_per_step: int = 2  # scans that one step makes from landmarks, 6 ms each
    band_files: bool = False  # True: a file for each height band, too
    binary_files: bool = False  # True: a file in which one view occupies a cell for good, too (Segfloor)
    resident_tiles: int = 512  # tiles that stay inflated, 24 kB each: what a dozen drones draw on at a time


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
    loops: LoopConfig = field(default_factory=LoopConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    disparity: DisparityCalibrationConfig = field(default_factory=DisparityCalibrationConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    map_cache: MapCachePlannerConfig = field(default_factory=MapCachePlannerConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    scan: GroundConfig = field(default_factory=GroundConfig)
    tiles: TileConfig = field(default_factory=TileConfig)
