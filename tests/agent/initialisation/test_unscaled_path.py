"""Metres per unit of a map, by a window in metres of the same flight."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from kiteline_agent.initialisation.unscaled_path import UnscaledPath
from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId

UNIT_M = 0.4
T_B_C = se3.exp(np.array([0.1, -0.05, 0.2, 0.3, 1.2, -0.4]))  # a lever that is no length of the map


def path(n: int = 30) -> F64:
    """Poses (n,4,4) of the body in w, in metres."""
    s = np.linspace(0.0, 6.0, n)
    at = np.column_stack([np.sin(s), 0.5 * np.cos(1.3 * s), 0.3 * s])
    return np.array(
        [se3.from_rt(se3.so3_exp(np.array([0.2 * x, 0.1, -0.3 * x])), p) for x, p in zip(s, at, strict=True)]
    )


class Map:
    """In place of LocalMap: keyframes in a map whose axes and unit are its own."""

    def __init__(self) -> None:
        self.T_m_k = np.array([se3.exp(np.array([1.0, 2.0, 3.0, 0.5, 0.0, 0.1])), np.eye(4)])
        self.slots = {5: 0, 6: 1}

    def slot_of(self, keyframe: int) -> int:
        return self.slots.get(keyframe, -1)


def window(T_w_b: F64) -> WindowState:
    return cast("WindowState", SimpleNamespace(R=T_w_b[:, :3, :3], p=T_w_b[:, :3, 3]))


def flown(local_map: Map, T_w_b: F64, noise: float = 0.0) -> tuple[UnscaledPath, tuple[int, ...], F64]:
    """The path in the map, the stamps of its frames, and R_m_w (3,3)."""
    rng, turn = np.random.default_rng(2), se3.exp(np.array([4.0, 1.0, -2.0, 0.3, -0.8, 1.1]))
    found = UnscaledPath(cast("Any", local_map))
    for k, T in enumerate(T_w_b):
        T_m_c = turn @ T @ T_B_C
        T_m_c[:3, 3] = T_m_c[:3, 3] / UNIT_M + noise * rng.normal(size=3)
        keyframe = KeyframeId(5 + (k > 12))
        T_k_c = se3.inverse(local_map.T_m_k[local_map.slots[keyframe]]) @ T_m_c
        found.add(100 * k, keyframe, T_k_c)
    return found, tuple(100 * k for k in range(len(T_w_b))), turn[:3, :3]


def test_the_unit_is_found_in_axes_of_any_direction() -> None:
    T_w_b = path()
    found, t_ns, R_m_w = flown(Map(), T_w_b)
    unit = found.unit(t_ns, window(T_w_b), T_B_C)
    assert unit is not None
    assert unit.metres == pytest.approx(UNIT_M, rel=1e-9) and unit.sigma < 1e-9
    np.testing.assert_allclose(unit.R_m_w, R_m_w, atol=1e-9)


def test_a_map_that_the_base_moved_and_keyframes_that_are_gone_do_no_harm() -> None:
    T_w_b, local_map = path(), Map()
    found, t_ns, R_m_w = flown(local_map, T_w_b)
    moved = se3.exp(np.array([0.5, 0.0, 1.0, 0.0, 0.7, 0.0]))
    local_map.T_m_k = moved @ local_map.T_m_k
    del local_map.slots[5]
    unit = found.unit(t_ns, window(T_w_b), T_B_C)
    assert unit is not None and unit.metres == pytest.approx(UNIT_M, rel=1e-9)
    np.testing.assert_allclose(unit.R_m_w, moved[:3, :3] @ R_m_w, atol=1e-9)


def test_noise_is_told_and_another_path_tells_nothing() -> None:
    T_w_b = path()
    found, t_ns, _ = flown(Map(), T_w_b, noise=0.02)
    unit = found.unit(t_ns, window(T_w_b), T_B_C)
    assert unit is not None and abs(unit.metres / UNIT_M - 1.0) < 3.0 * unit.sigma < 0.03
    assert found.unit(t_ns, window(T_w_b[::-1]), T_B_C) is None


def test_few_frames_or_none_that_moved_tell_nothing() -> None:
    T_w_b = path()
    found, t_ns, _ = flown(Map(), T_w_b)
    assert found.unit(t_ns[:7], window(T_w_b[:7]), T_B_C) is None
    still = np.tile(T_w_b[0], (30, 1, 1))
    found, t_ns, _ = flown(Map(), still)
    assert found.unit(t_ns, window(still), T_B_C) is None
    found.clear()
    assert found.unit(t_ns, window(T_w_b), T_B_C) is None
