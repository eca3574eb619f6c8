"""Whose covariance quality tells: that of the pose in its submap, or that of the whole way."""

from types import SimpleNamespace
from typing import Any

import pytest

from kiteline_agent.mapping.pose_report import PoseReport


@pytest.mark.parametrize(
    ("had_metres", "in_first", "recognised", "knows"),
    [
        (False, False, False, True),  # each map has a unit of its own, and nothing joins them
        (True, True, False, True),
        (True, False, True, True),
        (True, False, False, False),  # also of a map without metres, after one that had them
    ],
)
def test_a_place_is_known_by_the_first_submap_or_by_a_merge(
    had_metres: bool, in_first: bool, recognised: bool, knows: bool
) -> None:
    camera = SimpleNamespace(
        had_metres=had_metres,
        submaps=SimpleNamespace(in_first=in_first, active=1),
        motion=SimpleNamespace(metric=False),
    )
    corrections = SimpleNamespace(is_recognised=lambda _submap: recognised)
    report: Any = SimpleNamespace(_camera=camera, _corrections=corrections)
    assert PoseReport._knows_place(report) is knows
