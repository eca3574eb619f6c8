"""How uncertain the agent's own map is: errors add up from keyframe to keyframe, whatever the local pose claims."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core import se3
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class MapDrift:
    """Covariance of each keyframe relative to the submap's origin, as a perturbation on the left of T_m_k.

    A keyframe's pose errs as the keyframes at whose points it was measured, and on top as that measurement, whose noise
    is not independent from point to point (templates, stereo of one pair), hence an inflation. A vehicle that comes
    back to old points is as certain as they are. Bounded: the keyframes that were added first are forgotten first,
    and a forgotten one counts as the oldest known.
    """

    def __init__(self, inflation: float, keep: int) -> None:
        """inflation: of variance of a keyframe's measurement. keep: how many keyframes are remembered."""
        self._inflation = inflation
        self._keep = keep
        self._cov: dict[KeyframeId, F64] = {}

    def begin(self, keyframe: KeyframeId) -> None:
        """A submap begins: its first keyframe is its origin."""
        self._cov = {keyframe: np.zeros((6, 6))}

    def add(self, keyframe: KeyframeId, seen: I64, T_m_k: F64, information: F64) -> None:
        """seen: (n,) keyframes that bore the inliers of the frame that became this keyframe. information: (6,6) of its
        T_k_m as perturbed on the left, from the images.
        """
        adjoint = _adjoint(T_m_k)
        own = np.linalg.inv(information + 1e-6 * np.eye(6)) * self._inflation
        self._cov[keyframe] = self._of(seen) + adjoint @ own @ adjoint.T
        while len(self._cov) > self._keep:
            del self._cov[next(iter(self._cov))]

    def refine(self, keyframe: KeyframeId, share: float) -> None:
        """The base has optimised a keyframe: its covariance shrinks to a share of what it was."""
        if keyframe in self._cov:
            self._cov[keyframe] = self._cov[keyframe] * share

    def pose_cov(self, seen: I64, T_m_b: F64, local: F64) -> F64:
        """(6,6) of a body pose in the submap, [translation in m, rotation about the body's axes].

        seen: (n,) keyframes that bore the points of which the pose is measured. local: (6,6) of the pose relative to
        the map.
        """
        r, t = T_m_b[:3, :3], T_m_b[:3, 3]
        j = np.zeros(
            (6, 6)
        )  # of [translation, body rotation] by a perturbation [translation, rotation] of the whole map
        j[:3, :3], j[:3, 3:], j[3:, 3:] = np.eye(3), -se3.skew(t), r.T
        return np.asarray(local + j @ self._of(seen) @ j.T)

    def _of(self, seen: I64) -> F64:
        """Mean of the covariances of the keyframes; those forgotten count as the oldest known."""
        total = np.zeros((6, 6))
        if not self._cov:
            return total
        oldest = next(iter(self._cov.values()))
        names, counts = np.unique(seen, return_counts=True)
        for name, count in zip(names.tolist(), counts.tolist()):
            total += count / len(seen) * self._cov.get(KeyframeId(name), oldest)
        return total


def _adjoint(T: F64) -> F64:
    """(6,6): Exp(adjoint @ x) T = T Exp(x) for x [translation, rotation]."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = T[:3, :3]
    out[:3, 3:] = se3.skew(T[:3, 3]) @ T[:3, :3]
    return out
