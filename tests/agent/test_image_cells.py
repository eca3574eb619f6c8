"""Small images have as many cells for corners and landmarks as large ones."""

from __future__ import annotations

import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.image_cells import with_cells_for


@pytest.mark.parametrize("size", [(320, 240), (424, 240), (640, 480)])
def test_a_small_image_has_as_many_cells(size: tuple[int, int]) -> None:
    config = with_cells_for(AgentConfig(), *size)
    for cell_px in (config.detector.cell_px, config.align.cell_px, config.inertial_start.corner_tracks.cell_px):
        cells = -(-size[0] // cell_px) * -(-size[1] // cell_px)
        assert 300 < cells < 420, "about as many as 752x480 px have"
    assert config.keyframe.min_inliers < 300, "a frame can have more landmarks than a keyframe needs"


def test_cells_stay_at_752x480_and_above_and_never_vanish() -> None:
    assert with_cells_for(AgentConfig(), 752, 480) == AgentConfig()
    assert with_cells_for(AgentConfig(), 1280, 720) == AgentConfig()
    assert with_cells_for(AgentConfig(), 64, 48).detector.cell_px >= 12
