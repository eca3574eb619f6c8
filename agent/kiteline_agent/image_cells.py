"""Sizes of image cells, which spread corners and landmarks over the image, for images that are small."""

import math
from dataclasses import replace

from kiteline_agent.config import AgentConfig

_REFERENCE_PX = 752 * 480  # image for which the options give cells: 350 of them for the corners of a keyframe
_LEAST_PX = 12  # two templates of neighbours overlap by less than half


def with_cells_for(config: AgentConfig, width: int, height: int) -> AgentConfig:
    """The configuration with cells for images of this size: a smaller image has as many cells, not larger ones.

    At 320x240 cells of 32 px would leave 75 corners, fewer than `keyframe.min_inliers`. Larger images have more cells.
    Those of the start from two views stay: it needs strong corners. A `cell_px` that differs from its default stays,
    and all do if `shrink_cells` is false.
    """
    shrink = math.sqrt(width * height / _REFERENCE_PX)
    if shrink >= 1.0 or not config.shrink_cells:
        return config

    def cell(px: int, default: int) -> int:
        return px if px != default else min(px, max(round(px * shrink), _LEAST_PX))

    usual, start = AgentConfig(), config.inertial_start
    detector, align, relocalisation, tracks = config.detector, config.align, config.relocalisation, start.corner_tracks
    tracks = replace(tracks, cell_px=cell(tracks.cell_px, usual.inertial_start.corner_tracks.cell_px))
    return replace(
        config,
        detector=replace(detector, cell_px=cell(detector.cell_px, usual.detector.cell_px)),
        align=replace(align, cell_px=cell(align.cell_px, usual.align.cell_px)),
        relocalisation=replace(relocalisation, cell_px=cell(relocalisation.cell_px, usual.relocalisation.cell_px)),
        inertial_start=replace(start, corner_tracks=tracks),
    )
