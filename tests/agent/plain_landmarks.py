"""New landmarks of a keyframe in tests that look at places alone."""

import numpy as np

from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_core.arrays import F64


def plain_landmarks(uv: F64, rho: F64 | float, sigma_rho: float = 1e-3) -> KeyframeLandmarks:
    """Landmarks at uv (n,2) px with inverse depths rho, (n,) or of all, without descriptors and templates."""
    n = len(uv)
    octave, angle = np.zeros((2, n), np.uint8)
    return KeyframeLandmarks(
        uv, np.broadcast_to(np.asarray(rho, np.float64), n), np.full(n, sigma_rho), octave, angle,
        np.zeros((n, 32), np.uint8), np.zeros((n, 3, 21, 21), np.uint8),
    )  # fmt: skip
