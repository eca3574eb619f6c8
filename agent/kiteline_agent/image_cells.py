"""Sizes of image cells, which spread corners and landmarks over the image, for images that are small."""

from __future__ import annotations

import math
from dataclasses import replace

from kiteline_agent.config import AgentConfig

_REFERENCE_PX = 752 * 480  # image for which the options give cells: 350 of them for the corners of a keyframe
_LEAST_PX = 12  # two templates of neighbours overlap by less than half


def with_cells_for(config: AgentConfig, width: int, height: int) -> AgentConfig:
    """The configuration with cells for images of this size: a smaller image has as many cells, not larger ones.

    At 320x240 cells of 32 px would leave 75 corners, fewer than `keyframe.min_inliers`, and a depth camera or a single
    camera has depth for a part of these only. Larger images have more cells. Those of the start from two views stay:
    it needs strong corners.
    """
    shrink = math.sqrt(width * height / _REFERENCE_PX)
    if shrink >= 1.0:
        return config

    def cell(px: int) -> int:
        return min(px, max(round(px * shrink), _LEAST_PX))

    tracks = config.inertial_start.corner_tracks
    return replace(
        config,
        detector=replace(config.detector, cell_px=cell(config.detector.cell_px)),
        align=replace(config.align, cell_px=cell(config.align.cell_px)),
        relocalisation=replace(config.relocalisation, cell_px=cell(config.relocalisation.cell_px)),
        inertial_start=replace(config.inertial_start, corner_tracks=replace(tracks, cell_px=cell(tracks.cell_px))),
    )
