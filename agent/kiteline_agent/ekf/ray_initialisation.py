"""Delayed initialisation of landmarks: the point nearest to its rays, with its covariance, tested before it enters.

Source: "Monocular EKF-SLAM with delayed landmark initialisation" (the analytical initialisation). The covariance is
that of the linearised pixels given the poses in the state; what the rays say beyond the point tests them, and corrects
the poses from which they were seen.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kiteline_agent.ekf.filter_state import FilterState
from kiteline_agent.ekf.ray_kernels import position_by_rays
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3


class NewLandmark(NamedTuple):
    """A landmark that may enter. across: (3,size) covariance with the state. cov: (3,3)."""

    point: F64
    across: F64
    cov: F64


def largest_parallax(rays: F64, seen: Bool) -> F64:
    """Largest angle (n,) in rad between the last view's ray and another one. rays: (n,v,3). seen: (n,v)."""
    cosine = np.einsum("nvj,nj->nv", rays, rays[:, -1])
    return np.asarray(np.arccos(np.clip(np.where(seen, cosine, 1.0).min(axis=1), -1.0, 1.0)))


def project(xy: F64, T_o_c: F64, point: F64) -> tuple[F64, F64, F64]:
    """Residual (v,2) of normalised image points (v,2), Jacobian (v,2,3) by the point, depths (v,). T_o_c: (v,4,4)."""
    local = np.einsum("vji,vj->vi", T_o_c[:, :3, :3], point - T_o_c[:, :3, 3])
    z = local[:, 2]
    safe = np.where(z > 1e-3, z, 1e-3)
    ahead = local[:, :2] / safe[:, None]
    jacobian = (T_o_c[:, :3, :2] - T_o_c[:, :3, 2:3] * ahead[:, None, :]).transpose(0, 2, 1) / safe[:, None, None]
    return xy - ahead, jacobian, z


@dataclass(frozen=True, slots=True)
class RayTrack:
    """Observations of one track. views: (v,) past views. xy: (v,2) x/z, y/z in them, or (v+1,2) with the camera of now
    at the end. sigma: deviation of these.
    """

    views: I64
    xy: F64
    sigma: float


@dataclass(frozen=True, slots=True)
class Rays:
    """A track's rays, linearised and split by the point where they meet, in deviations of an observation.

    0 = by_point error of the point + by_state error of the state + white noise, and residual = H error of the state +
    white noise, where the point is eliminated. point: (3,). columns: (k,) of the state. by_point: (3,3). by_state:
    (3,k). H: (m,k). residual: (m,).
    """

    point: F64
    columns: I64
    by_point: F64
    by_state: F64
    H: F64
    residual: F64


def linearised(state: FilterState, track: RayTrack, T_o_c: F64, view_T_o_c: F64) -> Rays | None:
    """The rays of a track with the camera now at T_o_c (4,4) and past views (n,4,4); None if they do not meet ahead."""
    views, is_seen_now = track.views, len(track.xy) > len(track.views)
    poses = np.concatenate([view_T_o_c[views], T_o_c[None]]) if is_seen_now else view_T_o_c[views]
    point = np.empty(3)
    if not position_by_rays(track.xy, poses, point):
        return None
    residual, by_point, z = project(track.xy, poses, point)
    if not (z > 1e-3).all():
        return None
    # by_point (xi_l - xi_pi - [l]x (xi_R - xi_Ri)); of the camera now, the rotations cancel.
    turned = by_point @ se3.skew(point)
    by_state = np.zeros((len(poses), 2, 6 + 6 * len(views)))
    if is_seen_now:
        by_state[-1, :, :3] = -by_point[-1]
    for k in range(len(views)):
        at = 6 + 6 * k
        by_state[k, :, at : at + 3] = -by_point[k]
        by_state[k, :, at + 3 : at + 6] = turned[k]
        by_state[k, :, 3:6] = -turned[k]
    q, r = np.linalg.qr(by_point.reshape(-1, 3) / track.sigma, mode="complete")
    if np.abs(np.diagonal(r)).min() * track.sigma < 1e-9:
        return None
    flat = q.T @ by_state.reshape(-1, by_state.shape[2]) / track.sigma
    columns = state.view_columns(views)
    return Rays(point, columns, r[:3], flat[:3], flat[3:], (q.T @ residual.ravel())[3:] / track.sigma)


def rays_meet(state: FilterState, rays: Rays, gate: float) -> bool:
    """True if rays meet as well as the state's covariance allows, by chi-square over degrees of freedom."""
    spread = rays.H @ state.covariance(rays.columns) @ rays.H.T + np.eye(len(rays.H))
    return bool(rays.residual @ np.linalg.solve(spread, rays.residual) <= gate * len(rays.H))


def new_landmark(state: FilterState, rays: Rays) -> NewLandmark:
    """The landmark of rays."""
    P = state.rows(rays.columns)
    inverse = np.linalg.inv(rays.by_point)
    gain = -inverse @ rays.by_state
    cov = gain @ P[:, rays.columns] @ gain.T + inverse @ inverse.T
    return NewLandmark(rays.point, gain @ P, 0.5 * (cov + cov.T))


def distance_share(state: FilterState, rays: Rays) -> float:
    """Deviation of the distance from the camera over that distance, without what moves camera and landmark alike."""
    block = state.covariance(rays.columns)
    inverse = np.linalg.inv(rays.by_point)
    relative = -inverse @ rays.by_state
    relative[:, :3] -= np.eye(3)
    to_point = rays.point - state.T_o_c[:3, 3]
    distance = float(np.linalg.norm(to_point))
    ray = to_point / distance
    variance = ray @ (relative @ block @ relative.T + inverse @ inverse.T) @ ray
    return float(np.sqrt(variance)) / distance
