"""Configuration of the onboard half: one frozen section per stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from kiteline_core.features import DetectorConfig


@dataclass(frozen=True, slots=True)
class PyramidConfig:
    """Image pyramids."""

    levels: int = 4  # each halves the size; three detected octaves and one above for convergence


@dataclass(frozen=True, slots=True)
class StereoConfig:
    """Depth along the row."""

    min_depth_m: float = 0.25  # nearest surface; bounds the search along the row
    uniqueness: float = 1.15  # second-best cost over best: below it, the row repeats itself
    min_ncc: float = 0.85  # correlation of the two patches; lower ones are occlusions and edges of depth
    search_px: float = 3.0  # px of the level: how far stereo may lie from the predicted disparity
    iterations: int = 6  # Gauss-Newton steps; it converges in 3
    sigma_px: float = 0.25  # one standard deviation of a disparity at octave 0


@dataclass(frozen=True, slots=True)
class AlignConfig:
    """Template alignment."""

    coarse_points: int = 80  # points of the first, coarse pass that mends the motion model
    points: int = 240  # points of the fine pass; more cost time and gain little
    cell_px: int = 32  # one candidate at a time is taken from each cell
    iterations: int = 8  # Gauss-Newton steps a level
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


@dataclass(frozen=True, slots=True)
class LocalMapConfig:
    """What the agent remembers."""

    keyframes: int = 48  # slots; older and farther keyframes are forgotten (the base has them)
    births: int = 200  # points a keyframe can bear
    max_far_ratio: float = 400.0  # depth over baseline beyond which stereo says nothing


@dataclass(frozen=True, slots=True)
class DepthFilterConfig:
    """How new sightings sharpen a point's depth until the base sends a better one."""

    refined_sigma_px: float = 0.08  # virtual disparity error of a depth that the base refined
    floor_px: float = 0.06  # virtual disparity error that the filter never claims to beat


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
