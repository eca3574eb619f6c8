"""Landmarks of a rolling shutter at the stamp of their keyframe, which depends on depths that are known later."""

import numpy as np

from kiteline_core.arrays import F64, I64


class RowParallax:
    """By how much the bearings of landmarks in their keyframes change with their inverse depths."""

    def __init__(self, keyframes: int, landmarks: int) -> None:
        self.any = False  # keyframe of a rolling shutter so far
        self._change_m = np.zeros((keyframes, landmarks, 2))  # of a bearing, by inverse depth
        self._rho = np.zeros((keyframes, landmarks))  # 1/m for which the bearings are right

    def clear(self, slot: int) -> None:
        """A new keyframe, of which no bearing changes."""
        self._change_m[slot] = 0.0

    def set(self, slot: int, change_m: F64, rho: F64) -> None:
        """Note it for a new keyframe: change_m (n,2) m. rho: (n,) 1/m of the bearings now."""
        self.clear(slot)
        n = min(len(rho), self._rho.shape[1])
        self.add(slot, change_m[:n], rho[:n])

    def add(self, slot: int, change_m: F64, rho: F64) -> None:
        """Bearings were moved, as is right for inverse depths rho (n,) 1/m: they change by change_m (n,2) m more."""
        n = len(rho)
        self.any = True
        self._change_m[slot, :n] += change_m
        self._rho[slot, :n] = rho

    def refer(self, slot: int, index: I64, rho: F64) -> None:
        """The bearings of a keyframe's landmarks (n,) have become right for these inverse depths (n,) 1/m."""
        self._rho[slot, index] = rho

    def change(self, rows: I64, rho: F64) -> F64:
        """Change (n,2) of the bearings of landmarks whose inverse depths (n,) have become known better."""
        change = self._change_m.reshape(-1, 2)[rows] * (rho - self._rho.reshape(-1)[rows])[:, None]
        self._rho.reshape(-1)[rows] = rho
        return np.asarray(change)
