"""The start in metres is searched beside a map in a unit of its own, which tracking does not wait for."""

from types import SimpleNamespace
from typing import Any

import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.initialisation.inertial_start import InertialStart
from tests.agent.initialisation.test_inertial_start import CAMERA, EXACT
from tests.agent.initialisation.window.test_window_bundle import CALIBRATION


def test_beside_a_map_a_solution_is_spread_over_frames_and_begins_no_map_after_a_loss(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = InertialStart(CAMERA, CALIBRATION, AgentConfig(), Work())
    monkeypatch.setattr(start._tracks, "follow", lambda _left: True)
    monkeypatch.setattr(start._tracks, "is_due", lambda _t_ns: True)
    monkeypatch.setattr(start._tracks, "add", lambda *_: True)
    monkeypatch.setattr(start, "_bound_window", lambda _t_ns: None)
    parts: list[int] = []

    def begin(ctx: Any, _imu: Any) -> Any:
        for part in range(3):
            parts.append(part)
            yield
        return ctx.number

    monkeypatch.setattr(start, "_begin", begin)

    def frame(number: int) -> Any:
        return SimpleNamespace(number=number, t_ns=50_000_000 * number, images=SimpleNamespace(left=None))

    found: Any
    for number in range(3):
        assert start.add_beside_map(frame(number), EXACT) is None and len(parts) == number + 1
    found = start.add_beside_map(frame(3), EXACT)
    assert found == 0 and parts == [0, 1, 2]  # of the frame in which it began
    assert start.add_beside_map(frame(4), EXACT) is None
    found = start.add(frame(5), EXACT)  # the map is lost: one begins at this frame or not at all
    assert found == 5
