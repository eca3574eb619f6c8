"""Small images have as many cells for corners and landmarks as large ones."""

from dataclasses import replace
from pathlib import Path

import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.image_cells import with_cells_for
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import FlyingAgent


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


def test_a_cell_that_was_set_stays() -> None:
    config = AgentConfig()
    config = replace(config, detector=replace(config.detector, cell_px=40), align=replace(config.align, cell_px=20))
    small = with_cells_for(config, 320, 240)
    assert (small.detector.cell_px, small.align.cell_px) == (40, 20)
    assert small.relocalisation.cell_px < config.relocalisation.cell_px
    written = replace(AgentConfig(), shrink_cells=False)
    assert with_cells_for(written, 320, 240) == written


def test_a_small_pair_has_landmarks_for_few_keyframes(recording: Path) -> None:
    small = load(str(recording))
    agent = FlyingAgent(small.rig, None, vocabulary=False)
    for item in small.items:
        agent.step(item)
    keyframes = [event for events in agent.run.events for event in events if event.startswith("keyframe")]
    assert 3 <= len(keyframes) <= 9  # with cells of 32 px every second frame had too few landmarks
    assert min(found.inliers for found in agent.run.found[1:]) > 90
