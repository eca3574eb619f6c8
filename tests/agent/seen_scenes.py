"""Landmarks as a camera sees them whose calibration is off."""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance import calibration_error_kernels as certainty_kernels
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.track import Track
from kiteline_codec.schema import KeyframeHeader
from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId
from kiteline_core.pose import pose_kernels
from tests.agent.plain_landmarks import plain_landmarks
from tests.core.helpers_from_python import from_python

CAMERA = RectifiedCamera(752, 480, 450.0, 450.0, 370.0, 240.0, 0.11, True, np.eye(4))
SHAPES = certainty_kernels.SHAPES


def seen_with(error: F64, X: F64, T_c_m: F64) -> F64:
    """Observations (n,3) of points X (n,3) by cameras whose calibration errs as `error` (10,) says, in px."""
    p = X @ T_c_m[:3, :3].T + T_c_m[:3, 3]
    uvd = np.column_stack([CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx, CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy,
                           CAMERA.bf / p[:, 2]])  # fmt: skip
    out = uvd.copy()
    for i, (u, v, d) in enumerate(uvd):
        bias = np.empty((3, SHAPES))
        from_python(certainty_kernels.bias_error)(
            u, v, d, np.array([450.0, 450.0, 370.0, 240.0, CAMERA.bf]), 376.0, bias
        )
        out[i] += bias @ error
    return out


def scene(n: int = 120) -> F64:
    rng = np.random.default_rng(3)
    z = rng.uniform(2.0, 8.0, n)
    return np.column_stack([z * rng.uniform(-0.6, 0.6, n), z * rng.uniform(-0.4, 0.4, n), z])


def map_of(observed: F64, T_m_k: F64 | None = None) -> LocalMap:
    config = AgentConfig()
    local_map = LocalMap(CAMERA, config.local_map)
    n = len(observed)
    local_map.add(
        KeyframeHeader(KeyframeId(0), 0, NO_KEYFRAME, np.eye(4), n), np.eye(4) if T_m_k is None else T_m_k,
        plain_landmarks(observed[:, :2], observed[:, 2] / CAMERA.bf, 1e-4), 0,
    )  # fmt: skip
    return local_map


def tracked(local_map: LocalMap, observed: F64, guess: F64, sigma_px: float = 0.3) -> Track:
    """A pose measured against the points of keyframe 0."""
    n = len(observed)
    rho, b = local_map.rho[0, :n], local_map.bearing[0, :n]
    T_m_k = local_map.T_m_k[0]
    X = np.column_stack([b, np.ones(n)]) / rho[:, None] @ T_m_k[:3, :3].T + T_m_k[:3, 3]
    T, inlier = guess.copy(), np.ones(n, np.bool_)
    sigma, ray = np.full(n, sigma_px), np.full((n, 3), 1e-4)
    inliers, rms = pose_kernels.optimise_pose(T, X, ray, observed, sigma, local_map.intrinsics, 2, 8, 1e6, inlier)
    return Track(
        T, np.arange(n), observed, sigma, np.ones(n), inlier, int(inliers), float(rms), n, X, ray
    )  # fmt: skip
