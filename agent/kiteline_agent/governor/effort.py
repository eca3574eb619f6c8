"""Efforts that the governor chooses from, and the configuration at each."""

from dataclasses import dataclass, replace

from kiteline_agent.config import AgentConfig


@dataclass(frozen=True, slots=True)
class Effort:
    """Work allowed for a frame: factors on the configured numbers, except for levels and `every`."""

    points: float  # of the fine and the coarse pass, and of the required inliers
    corners: float  # new landmarks of a keyframe
    stereo: float  # landmarks whose disparity is measured
    fine_from: int  # template level at which the fine pass starts
    first: int  # finest pyramid level that is built
    keyframes: float  # motion until the next keyframe
    slots: float  # keyframes whose landmarks are searched
    every: int  # 1: every frame is tracked, 2: every other one
    frame_cost: float  # of a tracked frame relative to the first row, measured
    keyframe_cost: float  # the same of the extra cost of a keyframe


FULL = Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 1, 1.00, 1.00)
CARRIED = (
    FULL,
    Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 16, 1.00, 1.00),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.0, 0.5, 8, 0.81, 0.60),
)  # with an IMU, which bridges skipped frames: skipping costs little accuracy
ALONE = (
    FULL,
    Effort(1.00, 1.00, 1.0, 1, 0, 1.0, 1.0, 2, 1.00, 1.00),
    Effort(1.00, 1.00, 0.5, 1, 1, 1.2, 1.0, 2, 0.89, 0.66),
    Effort(0.80, 0.80, 0.5, 0, 1, 1.2, 1.0, 2, 0.74, 0.68),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 2, 0.68, 0.65),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 3, 0.68, 0.65),
    Effort(0.65, 0.65, 0.5, 0, 1, 1.2, 1.0, 4, 0.68, 0.65),
    Effort(0.45, 0.45, 0.3, 0, 1, 1.4, 0.5, 4, 0.56, 0.56),
)  # images alone: rotation between frames must stay small, so resolution is reduced before frames are skipped


def governed(config: AgentConfig, effort: Effort) -> AgentConfig:
    """The configuration at an effort: with fewer points, cells are larger and fewer inliers are required.

    Below full effort there are no scans, no slants are measured, and disparities are those of surfaces that face the
    camera.
    """
    align, keyframe = config.align, config.keyframe
    points = max(round(align.points * effort.points), 2 * config.pose.min_inliers)
    return replace(
        config,
        pyramid=replace(config.pyramid, first=max(config.pyramid.first, effort.first)),
        align=replace(
            align,
            points=points,
            cell_px=round(align.cell_px / effort.points**0.5),
            fine_from=min(align.fine_from, effort.fine_from),
        ),
        stereo=replace(config.stereo, points=round(config.stereo.points * effort.stereo)),
        detector=replace(
            config.detector,
            max_corners=round(config.detector.max_corners * effort.corners),
            first=max(config.detector.first, effort.first),
        ),
        keyframe=replace(
            keyframe,
            min_inliers=max(round(keyframe.min_inliers * effort.points), config.pose.min_inliers + 10),
            min_cover=keyframe.min_cover * (0.5 + 0.5 * effort.points),
            baseline_ratio=keyframe.baseline_ratio * effort.keyframes,
            rotation_rad=keyframe.rotation_rad * min(effort.keyframes, 1.4),
        ),
        local_map=replace(config.local_map, searched=max(round(config.local_map.searched * effort.slots), 8)),
        slant=replace(config.slant, points=config.slant.points if effort == FULL else 0),
        scan=replace(config.scan, on=config.scan.on and effort == FULL),
    )
