"""Metres per unit of a monocular map, by a window in metres that was solved while that map was tracked."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId

_FRAMES = 128  # more than a window has keyframes
_LEAST_FRAMES = 8  # two seconds of keyframes, whose positions are compared
_MOST_ERROR = 0.05  # distance between two paths of one flight, over the spread of their positions


@dataclass(frozen=True, slots=True)
class MapUnit:
    """metres: per unit of the map. sigma: relative deviation of that, beside the window's own. R_m_w: (3,3)."""

    metres: float
    sigma: float
    R_m_w: F64


class UnscaledPath:
    """Frames relative to keyframes of the map, which the base may move."""

    def __init__(self, local_map: LocalMap) -> None:
        self._map = local_map
        self._frames: deque[tuple[int, KeyframeId, F64]] = deque(maxlen=_FRAMES)

    def clear(self) -> None:
        """Forget all."""
        self._frames.clear()

    def add(self, t_ns: int, keyframe: KeyframeId, T_k_c: F64) -> None:
        """Note a frame whose camera lies at T_k_c (4,4) in a keyframe."""
        self._frames.append((t_ns, keyframe, T_k_c.copy()))

    def unit(self, t_ns: tuple[int, ...], window: WindowState, T_b_c: F64) -> MapUnit | None:
        """The unit in which the path is as long as in a window with these stamps; None if too little tells it.

        Of the newest half, as the unit drifts. The rotation is that of the cameras.
        """
        rows = {t: k for k, t in enumerate(t_ns)}
        slots = {keyframe: self._map.slot_of(keyframe) for _, keyframe, _ in self._frames}
        known = [(rows[t], slots[k], T_k_c) for t, k, T_k_c in self._frames if t in rows and slots[k] >= 0]
        known = known[-max(len(known) // 2, _LEAST_FRAMES) :]
        if len(known) < _LEAST_FRAMES:
            return None
        row = [k for k, _, _ in known]
        T_m_c = np.array([self._map.T_m_k[slot] @ T_k_c for _, slot, T_k_c in known])
        R_w_c = window.R[row] @ T_b_c[:3, :3]
        p_w_c = window.p[row] + window.R[row] @ T_b_c[:3, 3]
        R_m_w = (T_m_c[:, :3, :3] @ R_w_c.transpose(0, 2, 1)).mean(axis=0)
        R_m_w = se3.orthonormalise(se3.from_rt(R_m_w, np.zeros(3)))[:3, :3]
        by_map = T_m_c[:, :3, 3] - T_m_c[:, :3, 3].mean(axis=0)
        by_window = (p_w_c - p_w_c.mean(axis=0)) @ R_m_w.T
        moved, moved_m = float(np.linalg.norm(by_map)), float(np.linalg.norm(by_window))
        if min(moved, moved_m) <= 0.0:
            return None
        metres = moved_m / moved
        error = float(np.linalg.norm(metres * by_map - by_window)) / moved_m
        return MapUnit(metres, error / float(np.sqrt(len(known) - 1)), R_m_w) if error < _MOST_ERROR else None
