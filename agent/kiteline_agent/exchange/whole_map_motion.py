"""The part of the base's corrections that turns and shifts the whole map alike: the live pose leaves it out.

The base holds the first keyframe of a map still. What it learns later of that keyframe's own attitude then turns all
others by milliradians. The shape of the flown path, and all that is left to fly, are the same with or without such a
turn; poses from before and after it do not fit each other. Changes of shape are not touched.
"""

import numpy as np

from kiteline_agent.config import SmoothingConfig
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3

_LEAST_KEYFRAMES = 3  # two have hardly a shape
_SLACK = 2.0  # as a factor of the limit: so far the shift grows while the vehicle flies on, before it is limited again
# m: a keyframe counts with its centre and the ends of its axes, so that keyframes on a line tell their roll about it
_PROBES = np.concatenate([np.zeros((1, 3)), np.eye(3)])


class WholeMapMotion:
    """The frame of live poses: w as the base has it, but for what corrections moved the whole map by."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config
        self._T_v_w = np.eye(4)  # v: the frame of live poses

    def clear(self) -> None:
        """Live poses are in w again."""
        self._T_v_w = np.eye(4)

    def change_world(self, S_n_w: F64) -> None:
        """Live poses are in frame n from now on, where w lies at S_n_w (4,4)."""
        self._T_v_w = S_n_w @ self._T_v_w @ sim3.inverse(S_n_w)

    def add(self, before: F64, after: F64, S_w_m: F64) -> None:
        """Corrections moved keyframes in m from `before` to `after`, (k,4,4) each, the one near the vehicle last.

        Beyond the limits, measured there, the motion is a correction like others.
        """
        if len(before) < _LEAST_KEYFRAMES or self._config.whole_rad <= 0.0:
            return
        here_w = se3.transform(S_w_m, after[-1:, :3, 3])[0]
        T_old_new = _rigid_motion(_probes(after), _probes(before))
        self._T_v_w = self._T_v_w @ S_w_m @ T_old_new @ sim3.inverse(S_w_m)
        self._limit(here_w)

    def leave_out(self, T_w_x: F64, here_x: F64) -> F64:
        """The pose or similarity (4,4) of any frame x for live poses. here_x: (3,) m, vehicle in x.

        The turn shifts a vehicle that flew far since the last correction, or whose map was placed elsewhere, by more.
        """
        here_w = se3.transform(T_w_x, here_x[None])[0]
        if float(np.linalg.norm(self._shift(here_w))) > _SLACK * self._config.whole_m:
            self._limit(here_w)
        return self._T_v_w @ T_w_x

    def _shift(self, here_w: F64) -> F64:
        """What is left out at a place (3,)."""
        return np.asarray(se3.transform(self._T_v_w, here_w[None])[0] - here_w)

    def _limit(self, here_w: F64) -> None:
        """Shorten turn and shift at a place (3,) to the limits."""
        turn, shift = se3.so3_log(se3.orthonormalise(self._T_v_w)[:3, :3]), self._shift(here_w)
        R = se3.so3_exp(turn * _share(turn, self._config.whole_rad))
        shift = shift * _share(shift, self._config.whole_m)
        self._T_v_w = se3.from_rt(R, here_w + shift - R @ here_w)


def _share(of: F64, most: float) -> float:
    """What share of a vector (3,) is as long as allowed."""
    return min(1.0, most / max(float(np.linalg.norm(of)), 1e-12))


def _probes(poses: F64) -> F64:
    """Points (4k,3) of poses (k,4,4)."""
    return np.asarray(np.einsum("kij,pj->kpi", poses[:, :3, :3], _PROBES) + poses[:, None, :3, 3]).reshape(-1, 3)


def _rigid_motion(source: F64, target: F64) -> F64:
    """T (4,4) that moves points (n,3) to others (n,3) with the least squares (Kabsch, 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - b).T @ (source - a))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.from_rt(R, b - R @ a)
