"""Configuration of the base station: one frozen section per stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from kiteline_core.imaging.matching import MatchConfig
from kiteline_core.optimisation.bundle import BundleConfig
from kiteline_core.pose.pnp import RansacConfig


@dataclass(frozen=True, slots=True)
class IntakeConfig:
    """When a keyframe is taken up."""

    patience_s: float = 2.0  # a keyframe whose sections are still under way is used as it is after this long
    orphan_s: float = 10.0  # a submap whose first keyframes never come is begun at the oldest known one after this long
    carry_s: float = 1.5  # a submap that begins so soon after the last one was left begins there: odometry carried on
    per_step: int = 4  # keyframes taken up in one step, so that a backlog does not hold up the rest
    max_pending: int = 20_000  # sections kept without their header; more are a broken peer


@dataclass(frozen=True, slots=True)
class MeasurementConfig:
    """How well an agent measures."""

    sigma_px: float = 0.25  # one standard deviation of an aligned pixel coordinate at octave 0
    sigma_growth: float = 1.4  # by which it grows with each octave: alignment is finer than its pixels
    sigma_disparity_px: float = 0.4  # the same of a disparity; sightings of a point share its template's error
    sigma_settled_px: float = 0.2  # the same once the offset of the agent's disparities is known
    fused_px: float = 0.6  # the same of a birth that shows an older point: two detections of one corner
    fused_growth: float = 2.0  # corners are found to a share of their level's pixels


@dataclass(frozen=True, slots=True)
class BundleWindowConfig:
    """Which keyframes a local bundle adjusts."""

    free: int = 10  # keyframes whose poses move: more cost time and change little
    fixed: int = 15  # keyframes that only hold: those that see most of the same points
    min_shared: int = 12  # points that two covisible keyframes share at least
    min_points: int = 20  # fewer points hold no pose


@dataclass(frozen=True, slots=True)
class OdometryFactorConfig:
    """The agent's own pose of a keyframe in its parent."""

    enough: int = 80  # observations of a keyframe above which its points hold it: every keyframe of a wide link
    enough_px: float = 0.1  # of each of 6 far made-up points there: together they say the turn to 0.15 mrad
    run: int = 20  # links one after the other, over which an agent's turns may all be off the same way
    sigma_px: float = 0.15  # of each of 12 made-up points where there is nothing else; it grows with what there is


@dataclass(frozen=True, slots=True)
class LandmarkMatchingConfig:
    """Known points recognised where the agent bore new ones."""

    keyframes: int = 12  # covisible keyframes searched
    near_keyframes: int = 8  # keyframes that merely look at the same place: revisits
    near_ratio: float = 0.5  # distance of such a keyframe over the median depth
    near_cosine: float = 0.7  # cosine of the angle between the two optical axes: 45 degrees
    radius_px: float = 8.0  # px at octave 0: drift within a room; doubles with each octave
    max_hamming: int = 60  # of 256 bits: unrelated ORB descriptors differ by 128 +- 20
    ratio: float = 0.8  # best over second-best distance: below it, a match is distinct
    octave_gap: float = 1.2  # octaves between the size foreseen and the size found
    angle_gap: int = 24  # 1/256 turns between the orientation foreseen and found: 34 degrees
    disparity_px: float = 3.0  # px at octave 0 between the disparity foreseen and measured
    min_gap: int = 1  # keyframes between two that are matched


@dataclass(frozen=True, slots=True)
class TriangulationConfig:
    """Points made from two views, where stereo saw no depth."""

    keyframes: int = 6  # covisible keyframes searched
    epipolar_px: float = 1.5  # px at octave 0 between a keypoint and the other's line
    max_hamming: int = 50  # of 256 bits; stricter than refind, for a line is longer than a circle
    ratio: float = 0.75  # best over second-best distance
    max_cosine: float = 0.9998  # parallax of at least 1.1 degrees: below it depth is noise
    reprojection_px: float = 2.0  # px at octave 0 in every view
    min_baseline_ratio: float = 0.01  # baseline over median depth: below it two keyframes are one view


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """What proves that a place was seen before. A wrong proof is worse than a missed one."""

    share: str = "all"  # agents whose maps may become one: "all", "none", or groups such as "0 1, 1 2"
    enabled: bool = True
    candidates: int = 4  # most alike keyframes of other maps that are looked at
    candidates_here: int = 3  # of the same map
    min_gap: int = 12  # keyframes of the same submap between two that may close a loop
    loop_gap: int = 30  # keyframes back that points have to be seen again for it to count as a loop
    max_shared: int = 15  # points that two keyframes share already: more are no news
    min_likeness: float = 0.02  # of the bags of words: below it two places have little in common
    min_of_neighbours: float = 0.1  # share of the likeness that a keyframe has to the one before it
    match: MatchConfig = field(default_factory=MatchConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
    sigma_disparity_px: float = 0.4  # one deviation of the disparities from which points hang on their rays
    neighbours: int = 8  # covisible keyframes whose points are looked for as well
    radius_px: float = 10.0  # px at octave 0 around where a point is foreseen, halved at the second look
    octave_gap: float = 1.5  # octaves between the size foreseen and the size found
    min_inliers: int = 20  # points that agree between the two keyframes alone
    min_inliers_all: int = 35  # the same with the neighbours' points: to join maps
    min_inliers_loop: int = 40  # the same, within one map
    min_share: float = 0.25  # of what both maps should see here: less is a thing that stands in two places
    scale_points: int = 20  # with depth in both maps, that tell the scale between maps of which one has its own unit
    scale_spread: float = 0.2  # of the logarithm of a ratio of depths, within which
    scale_share: float = 0.7  # of them have to say the same: two things that lie unlike each other say no scale
    scale_sigma: float = 0.02  # deviation of what they say together: the bundle after it is good to a few percent
    columns: int = 6  # parts of the image: a poster that hangs twice fills few of them
    rows: int = 4
    cell_points: int = 2  # inliers that fill a part
    min_cells: int = 8  # of the 24 parts
    votes: int = 3  # keyframes that say the same
    memory: int = 24  # keyframes of a submap among which votes are counted
    ask_before: int = 4  # keyframes before one that was proved, asked of the same place: their views still overlap
    against: int = 3  # votes for, for each vote against
    agree_m: float = 0.10  # between two votes, and
    agree_depth: float = 0.04  # of the median depth, and
    agree_path: float = 0.02  # of the way between the two keyframes
    agree_rad: float = 0.05  # between two votes
    agree_scale: float = 0.05  # of the logarithms of the scales of two votes
    drift_m: float = 0.3  # correction of a loop that drift explains: this, and
    drift_path: float = 0.02  # this share of the way flown since
    drift_rad: float = 0.1  # this turn, and
    drift_rad_m: float = 0.002  # this turn for each metre
    own_drift_path: float = 0.05  # the same share where the unit of length drifts as well, by one eye, and beside it
    own_drift_scale: float = 0.4  # logarithm by which that unit may drift along a loop; it says how far the way is off
    small_m: float = 0.02  # correction that needs no pose graph: fusing points is enough
    small_rad: float = 0.005
    small_scale: float = 0.005  # of its logarithm
    off_plane: float = 0.03  # of the median depth: so far from a plane lies what is no part of it
    min_off_plane: float = 0.15  # share of the points that join maps and lie off their plane: a wallpaper has copies
    twin_m: float = 1.0  # places of one map that look the same and lie further apart than this are twins


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """Corrections of whole maps: the pose graph and the bundle after it."""

    min_shared: int = 100  # points that make two covisible keyframes an edge
    sigma_m: float = 0.005  # of an edge between neighbours, and
    sigma_path: float = 0.01  # this share of its length
    sigma_rad: float = 0.003
    sigma_scale: float = 0.003  # of an edge between neighbours whose unit of length may drift
    loop_sigma_scale: float = 0.01
    loop_sigma_depth: float = 0.005  # of a loop's edge: this share of the median depth
    loop_sigma_rad: float = 0.003
    huber: float = 3.0  # deviations beyond which an edge counts less
    iterations: int = 8
    scaled_iterations: int = 30  # with scales, in which the graph is bent farther
    stop: float = 1e-4  # relative gain below which more iterations change nothing
    first_full: int = 12  # keyframes after which a whole map is first bundled
    full_share: float = 0.03  # of the worker's time that bundles of whole maps may take: for 100 keyframes every 3 s
    max_full: int = 800  # keyframes that a full bundle moves, in 0.4 s; of a larger map, those around the loop
    robust_trials: int = 6  # of the full bundle before the outlier test
    final_trials: int = 6  # after it
    revisits: int = 2  # keyframes a step that look again for what joined maps know
    min_kept: float = 0.5  # share of the points fused by a merge that the bundle must keep, else it was wrong


@dataclass(frozen=True, slots=True)
class DisparityConfig:
    """What an agent's disparities are off by, found by bundles of a whole map."""

    again: float = 1.1  # growth of the map after which an offset that was not believed is looked for again
    prior_px: float = 0.1  # one deviation of a constant offset: what calibrations are good to
    prior_rad: float = 3e-4  # of the turn of a right camera (times the focal length: px where x or y is 1)
    inflation: float = 3.0  # of deviations of what is found: the lens bends what motion tells of depths, too
    stands_out: float = 0.5  # of such deviations a number, from which on an offset is believed: by chance 1 in 20
    settled_px: float = 0.03  # deviation of the offset below which it is known


@dataclass(frozen=True, slots=True)
class CullConfig:
    """Points and observations that are dropped."""

    age: int = 4  # keyframes after its birth at which a point is judged
    min_found: float = 0.25  # share of the keyframes that should see a point and do
    min_visible: int = 4  # keyframes that should have seen it before it is judged
    min_observations: int = 2  # observations that must remain after the outlier test
    keyframe_age: int = 10  # keyframes of its submap after it before a keyframe may be found to tell nothing new
    keyframe_share: float = 0.9  # of its points that others see as well
    keyframe_others: int = 3  # how many others have to see them, at no coarser a scale
    max_offset_px: float = 8.0  # px that a point's bearing may leave its birth; more is another point


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """Corrections smaller than these are not worth their bytes, nor kept."""

    pose_m: float = 0.0005
    pose_rad: float = 0.0002  # a tenth of a pixel at 500 px of focal length
    depth_px: float = 0.1  # px of bearing or disparity, the largest of a keyframe's points
    grid_every: int = 3  # keyframes between two grids
    grid_share: int = 40  # of the map's keyframes at least this share, one in so many: a grid reads the whole map


@dataclass(frozen=True, slots=True)
class MapCacheConfig:
    """The window of the map that each agent is kept supplied with."""

    copies: int = 24  # keyframes an agent holds copies of; 0: none. They cover two views of a room and its way there
    every_s: float = 1.0  # between two looks at what an agent needs
    horizon_s: float = 2.0  # how far ahead along its motion: what a thin link takes to bring two keyframes
    remembered: int = 48  # newest keyframes of its own that an agent remembers by itself
    reach: float = 1.5  # distance of a keyframe over the depth in view: farther ones see little of the same
    min_cosine: float = 0.3  # of the angle between the optical axes: descriptors do not bear more than 70 degrees
    looked_at: int = 60  # keyframes whose points are projected
    min_points: int = 8  # of a keyframe that are about to be in view: fewer are not worth their bytes
    keep: float = 1.5  # how much more a copy that is there counts than one that would have to be sent
    pose_m: float = 0.002  # a copy that moved less stays where it is: half a pixel at 2 m
    pose_rad: float = 0.0005  # a quarter of a pixel at 500 px of focal length
    length: float = 0.01  # relative change of the reader's unit of length from which on copies are lent anew


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """How the ground is found."""

    camera_above_m: float = 0.1  # m; ground points lie at least this far below every camera that sees them
    patch_m: float = 2.0  # m; side of the neighbourhoods; three by three of them share their points
    height_bin_m: float = 0.05  # m; a floor's points, with stereo noise, fill two or three bins
    slope: float = 0.25  # m/m; how steep the ground may be: a ramp, or a map whose z is 10 degrees off the vertical
    peak_share: float = 0.25  # of the highest peak: a lower peak with this share is the ground, below it is noise
    peak_points: float = 4.0  # points; fewer make no peak
    bands_m: tuple[float, ...] = (0.3, 0.2, 0.12, 0.1)  # m; half-widths around the plane, from a bin's error to noise
    plane_points: float = 12.0  # points that a neighbourhood's plane needs; with fewer it stays as it is
    level_m: float = 0.3  # m; a patch of points with less spread than this says nothing of the slope


@dataclass(frozen=True, slots=True)
class GridConfig:
    """The grid's numbers. Heights are relative to the local ground."""

    cell_m: float = 0.1  # m; finer cells fall between the rays to sparse points; 0.2 suits streets
    max_ray_m: float = 20.0  # m; beyond, a stereo point is wrong by more than a cell
    obstacle_low_m: float = 0.1  # m; lower than this is ground: a vehicle rolls, and noise reaches this far
    vehicle_height_m: float = 2.0  # m; what hangs higher is passed below
    noise_per_m: float = 0.01  # m of height per m of distance from the nearest view: stereo noise grows with distance
    free_below_m: float = 0.7  # m; a ray to the ground that is still higher says nothing about the floor below it
    clear_below_m: float = 0.5  # m; the same of a ray to an obstacle: higher up it passes over boxes and chairs
    log_hit: float = 0.6  # log-odds of one view of an obstacle point (p = 0.65): two views make 0.77
    log_through: float = -0.3  # log-odds of one ray through an obstacle's heights (p = 0.43)
    log_free: float = -0.7  # log-odds of one ray over a cell without obstacle (p = 0.33)
    log_limit: float = 3.5  # log-odds; p within 0.03..0.97, so that the grid can still change its mind
    quartile: float = 0.675  # standard deviations from the mean to a quartile of a normal distribution
    fence: float = 1.5  # interquartile ranges above the upper quartile: longer rays are outliers (Segfloor eq. 5.3)
    floor: GroundConfig = field(default_factory=GroundConfig)


@dataclass(frozen=True, slots=True)
class BaseConfig:
    """All sections."""

    intake: IntakeConfig = field(default_factory=IntakeConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    window: BundleWindowConfig = field(default_factory=BundleWindowConfig)
    links: OdometryFactorConfig = field(default_factory=OdometryFactorConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)
    refind: LandmarkMatchingConfig = field(default_factory=LandmarkMatchingConfig)
    new_points: TriangulationConfig = field(default_factory=TriangulationConfig)
    cull: CullConfig = field(default_factory=CullConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    disparity: DisparityConfig = field(default_factory=DisparityConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    supply: MapCacheConfig = field(default_factory=MapCacheConfig)
    grid: GridConfig = field(default_factory=GridConfig)
