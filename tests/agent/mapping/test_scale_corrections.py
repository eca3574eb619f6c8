"""A map whose lengths are found to be wrong is continued in right ones once images have led for a while."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.mapping import submap_stage
from kiteline_agent.mapping.submap_stage import SubmapStage

PERIOD_NS = 50_000_000


LOST = range(3, 8)  # frames that are not tracked


def corrected_at(stage: Any) -> int:
    """The frame in which a correction that is due from the tenth frame on is applied."""
    motion = stage._camera.motion
    for number in (n for n in range(60) if n not in LOST):
        ctx: Any = SimpleNamespace(number=number, t_ns=number * PERIOD_NS, config=AgentConfig())
        motion.scale_correction = lambda due=number >= 10: (1.05, 0.01) if due else None
        if SubmapStage.restart_in_metres(stage, ctx, stage):
            return number
    return -1


@pytest.mark.parametrize("settled_s", [1.0, 0.0])
def test_a_correction_waits_for_the_map_after_frames_that_were_not_tracked(
    monkeypatch: pytest.MonkeyPatch, settled_s: float
) -> None:
    monkeypatch.setattr(submap_stage, "metric_points", lambda *_: SimpleNamespace(sigma_rho=np.ones(100)))
    monkeypatch.setattr(submap_stage, "_SETTLED_S", settled_s)
    motion = SimpleNamespace(metres_per_unit=lambda _sigma: None)
    stage: Any = SimpleNamespace(
        _camera=SimpleNamespace(submaps=SimpleNamespace(room=True), motion=motion), _two_view_start=object(),
        _map=None, _tracked_number=-1, _tracked_since_ns=0, _restart=lambda *_: None,
    )  # fmt: skip
    due = max(10, LOST.stop + round(settled_s * 1e9 / PERIOD_NS))
    assert due <= corrected_at(stage) < due + AgentConfig().two_view_start.scale_every
