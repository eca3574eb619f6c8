"""Configuration of the base station: one frozen section per stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from kiteline_basestation.grid import GridConfig
from kiteline_core.bundle import BundleConfig


@dataclass(frozen=True, slots=True)
class IntakeConfig:
    """When a keyframe is taken up."""

    patience_s: float = 2.0  # a keyframe whose sections are still under way is used as it is after this long
    orphan_s: float = 10.0  # a submap whose first keyframes never come is begun at the oldest known one after this long
    per_step: int = 4  # keyframes taken up in one step, so that a backlog does not hold up the rest
    max_pending: int = 20_000  # sections kept without their header; more are a broken peer


@dataclass(frozen=True, slots=True)
class MeasurementConfig:
    """How well an agent measures."""

    sigma_px: float = 0.25  # one standard deviation of an aligned pixel coordinate at octave 0
    sigma_growth: float = 1.4  # by which it grows with each octave: alignment is finer than its pixels
    sigma_disparity_px: float = 0.4  # the same of a disparity; sightings of a point share its template's error
    fused_px: float = 0.6  # the same of a birth that shows an older point: two detections of one corner
    fused_growth: float = 2.0  # corners are found to a share of their level's pixels


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Which keyframes a local bundle adjusts."""

    free: int = 10  # keyframes whose poses move: more cost time and change little
    fixed: int = 15  # keyframes that only hold: those that see most of the same points
    min_shared: int = 12  # points that two covisible keyframes share at least
    min_points: int = 20  # fewer points hold no pose


@dataclass(frozen=True, slots=True)
class RefindConfig:
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
class NewPointConfig:
    """Points made from two views, where stereo saw no depth."""

    keyframes: int = 6  # covisible keyframes searched
    epipolar_px: float = 1.5  # px at octave 0 between a keypoint and the other's line
    max_hamming: int = 50  # of 256 bits; stricter than refind, for a line is longer than a circle
    ratio: float = 0.75  # best over second-best distance
    max_cosine: float = 0.9998  # parallax of at least 1.1 degrees: below it depth is noise
    reprojection_px: float = 2.0  # px at octave 0 in every view
    min_baseline_ratio: float = 0.01  # baseline over median depth: below it two keyframes are one view


@dataclass(frozen=True, slots=True)
class CullConfig:
    """Points and observations that are dropped."""

    age: int = 4  # keyframes after its birth at which a point is judged
    min_found: float = 0.25  # share of the keyframes that should see a point and do
    min_visible: int = 4  # keyframes that should have seen it before it is judged
    min_observations: int = 2  # observations that must remain after the outlier test
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
class BaseConfig:
    """All sections."""

    intake: IntakeConfig = field(default_factory=IntakeConfig)
    measurement: MeasurementConfig = field(default_factory=MeasurementConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    bundle: BundleConfig = field(default_factory=BundleConfig)
    refind: RefindConfig = field(default_factory=RefindConfig)
    new_points: NewPointConfig = field(default_factory=NewPointConfig)
    cull: CullConfig = field(default_factory=CullConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    grid: GridConfig = field(default_factory=GridConfig)
