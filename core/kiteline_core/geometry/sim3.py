"""Similarities as 4x4 float64 arrays: `S_a_b` maps points of frame b into a, which may have another unit of length.

The upper left part is a scale times a rotation; the scale converts lengths of b to lengths of a. A rigid motion is a
similarity of scale 1, with results bit-identical to `se3`.
"""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_ONE = 1e-9  # a scale closer to 1 is 1, given the accuracy of orthonormal rotations


def scale_of(S: F64) -> float:
    """Scale of S_a_b: units of a per unit of b."""
    (a, b, c, _), (d, e, f, _), (g, h, k, _), _ = S.tolist()
    scale = float(np.cbrt(a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g)))
    return 1.0 if abs(scale - 1.0) < _ONE else scale


def of(scale: float, T: F64) -> F64:
    """The similarity (4,4) with the rotation and the translation of a rigid motion, and a scale."""
    S = np.array(T, np.float64)
    S[:3, :3] *= scale
    return S


def rigid(S: F64) -> F64:
    """The rigid motion (4,4) with the rotation and the translation of a similarity."""
    scale = scale_of(S)
    return se3.orthonormalise(S if scale == 1.0 else se3.from_rt(S[:3, :3] / scale, S[:3, 3]))


def inverse(S: F64) -> F64:
    """S_b_a of S_a_b."""
    scale = scale_of(S)
    if scale == 1.0:
        return se3.inverse(S)
    back = S[:3, :3].T / scale**2
    return se3.from_rt(back, -(back @ S[:3, 3]))


def normalise(S: F64) -> F64:
    """The similarity nearest to S, since products of many lose orthonormality."""
    scale = scale_of(S)
    return se3.orthonormalise(S) if scale == 1.0 else of(scale, rigid(S))


def scaled_about(S_a_b: F64, factor: float, T_b_k: F64) -> F64:
    """Multiply the scale by `factor`, keeping the pose in a of a body at T_b_k (4,4)."""
    kept = of(scale_of(S_a_b) * factor, rigid(place(S_a_b, T_b_k)))
    return normalise(kept @ se3.inverse(T_b_k))


def place(S_a_b: F64, T_b_k: F64) -> F64:
    """Poses in a, as rigid motions, of bodies at T_b_k (4,4) or (n,4,4)."""
    scale = scale_of(S_a_b)
    out = np.asarray(S_a_b @ T_b_k)
    if scale != 1.0:
        out[..., :3, :3] /= scale
    return out


def with_scaled_translation(T: F64, factor: float) -> F64:
    """A rigid motion (4,4) with its translation multiplied by `factor`."""
    return se3.from_rt(T[:3, :3], T[:3, 3] * factor)
