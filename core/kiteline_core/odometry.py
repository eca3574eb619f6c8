"""Velocities of an odometer: brought to the body frame, checked, put together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FASTEST = 1e3  # m/s and rad/s; more is a fault of a device
_VAGUEST = 1e12  # (m/s)^2 and (rad/s)^2; more only loses digits
_ANY_RATE = 100.0  # (rad/s)^2; what is measured at all is measured far better than this
_LIKELY_RATE = 0.25  # (rad/s)^2; a turn about an axis that nothing measures, of a vehicle that drives or flies calmly


def in_body(batch: OdometryBatch, T_b_d: F64) -> OdometryBatch:
    """The same motion told of the body. batch: of the origin and in the axes of a device frame d. T_b_d: (4,4).

    Both frames hang on one rigid vehicle, so the turn rate differs by the axes alone, and the velocity of the body's
    origin by the turn about the device as well: v_b = R_b_d v_d - w_b x t_b_d.
    """
    r, lever = T_b_d[:3, :3], T_b_d[:3, 3]
    rate, rate_cov = batch.rate @ r.T, r @ batch.rate_cov @ r.T
    believed = np.einsum("nij,nj->ni", _gain(rate_cov, _ANY_RATE), rate)
    velocity = batch.velocity @ r.T - np.cross(believed, lever)
    arm = se3.skew(lever)
    turn = _gain(rate_cov, _LIKELY_RATE) @ rate_cov  # what is not known of the turn, measured or not
    return OdometryBatch(batch.t_ns, velocity, rate, r @ batch.velocity_cov @ r.T + arm @ turn @ arm.T, rate_cov)


def _gain(cov: F64, prior: float) -> F64:
    """(n,3,3) by which measurements of covariance cov (n,3,3) count beside zero with a variance: 1 where measured well,
    0 where not at all.
    """
    return np.asarray(prior * np.linalg.inv(cov + prior * np.eye(3)))


def joined(batches: Sequence[OdometryBatch]) -> OdometryBatch | None:
    """Batches one after the other as one; None where there is none."""
    if len(batches) < 2:
        return batches[0] if batches else None
    return OdometryBatch(
        np.concatenate([b.t_ns for b in batches]),
        np.concatenate([b.velocity for b in batches]),
        np.concatenate([b.rate for b in batches]),
        np.concatenate([b.velocity_cov for b in batches]),
        np.concatenate([b.rate_cov for b in batches]),
    )


def chosen(batch: OdometryBatch, keep: Bools | slice) -> OdometryBatch:
    """Some of the samples. keep: (n,) which ones, or a slice."""
    return OdometryBatch(
        batch.t_ns[keep], batch.velocity[keep], batch.rate[keep], batch.velocity_cov[keep], batch.rate_cov[keep]
    )  # fmt: skip


def usable(batch: OdometryBatch) -> Bools:
    """(n,) which samples hold numbers that a vehicle can have, and covariances that are some."""
    moving = np.concatenate([batch.velocity, batch.rate], axis=1)
    good = np.asarray((np.abs(moving) < _FASTEST).all(axis=1))
    for cov in (batch.velocity_cov, batch.rate_cov):
        diagonal = np.diagonal(cov, axis1=1, axis2=2)
        good &= ((diagonal >= 0.0) & (diagonal < _VAGUEST)).all(axis=1)
        root = np.sqrt(np.where(good[:, None], diagonal, 0.0))
        good &= (np.abs(cov) <= 1.001 * root[:, :, None] * root[:, None, :]).all(axis=(1, 2))
    return np.asarray(good)


def variances(sigma: Sequence[float]) -> F64:
    """(3,3) of three deviations along the axes; infinite ones are UNMEASURED."""
    return np.diag([min(s * s, UNMEASURED) for s in sigma])
