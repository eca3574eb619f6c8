"""Rows by matched corners of both images, and why no map begins."""

import numpy as np
import pytest

from kiteline_agent.keyframes.pair_search import Fault, rows_of
from kiteline_agent.mapping.start_watch import StartWatch
from kiteline_core.arrays import F64

_N = 60
_LEFT = np.random.default_rng(2).uniform([60.0, 20.0], [700.0, 460.0], (_N, 2))
_NONE = np.zeros(_N)


def _right(lower_px: float | F64, disparity_px: float = 20.0) -> F64:
    return _LEFT + np.column_stack([np.full(_N, -disparity_px), np.broadcast_to(lower_px, _N)])


@pytest.mark.parametrize("lower_px", [0.0, 6.0, -20.0])
def test_matches_that_agree_tell_the_rows(lower_px: float) -> None:
    slope = 1.5 * (_LEFT[:, 0] - 376.0) / 376.0  # the camera is also twisted
    wrong = np.arange(_N) < 20
    right = np.where(wrong[:, None], _LEFT[::-1], _right(lower_px + slope))
    assert rows_of(_LEFT, right, _NONE, 24.0) == pytest.approx(lower_px, abs=0.5)
    assert rows_of(_LEFT, right, _NONE + lower_px, 24.0) == pytest.approx(0.0, abs=0.5)  # it is read there already


def test_matches_that_scatter_tell_nothing() -> None:
    scattered = np.random.default_rng(3).uniform(-24.0, 24.0, _N)
    assert rows_of(_LEFT, _right(scattered), _NONE, 24.0) is None
    assert rows_of(_LEFT, _right(40.0), _NONE, 24.0) is None  # beyond any mount
    half = np.where((np.arange(_N) < 0.45 * _N)[:, None], _right(9.0), _LEFT[::-1])
    assert rows_of(_LEFT, half, _NONE, 24.0) is None
    assert rows_of(_LEFT[:15], _right(9.0)[:15], _NONE[:15], 24.0) is None
    assert rows_of(_LEFT[:0], _LEFT[:0], _NONE[:0], 24.0) is None


def test_what_lies_behind_the_cameras_tells_nothing() -> None:
    assert rows_of(_LEFT, _right(9.0, -20.0), _NONE, 24.0) is None


def test_a_fault_is_said_once_it_has_lasted_and_once_alone() -> None:
    watch, s = StartWatch(), 1_000_000_000
    assert watch.note(0, Fault.CORNERS) == []
    assert watch.note(s // 2, None) == []  # a map began
    assert watch.note(s, Fault.CORNERS) == []
    assert watch.note(s * 3 // 2, Fault.PAIR) == []
    assert watch.note(2 * s, Fault.PAIR) == [Fault.PAIR.value]
    assert watch.note(3 * s, Fault.PAIR) == []
    assert watch.note(4 * s, Fault.CORNERS) == [Fault.CORNERS.value]
