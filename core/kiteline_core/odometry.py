"""Odometer velocities: conversion to the body frame, checks, concatenation."""

from collections.abc import Sequence

import numpy as np

from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_core.geometry import se3

_MAX_SPEED = 1e3  # m/s and rad/s; more is a device fault
_MAX_VARIANCE = 1e12  # (m/s)^2 and (rad/s)^2; more only loses precision
_ANY_RATE = 100.0  # (rad/s)^2; any measured axis is far more precise
_LIKELY_RATE = 0.25  # (rad/s)^2; rotation about an unmeasured axis of a calm vehicle


def in_body(batch: OdometryBatch, T_b_d: F64) -> OdometryBatch:
    """Convert a batch from the frame of a device d to the body. T_b_d: (4,4).

    On a rigid vehicle the rates differ by the rotation only, and the velocity also by the lever arm:
    v_b = R_b_d v_d - w_b x t_b_d.
    """
    r, lever = T_b_d[:3, :3], T_b_d[:3, 3]
    rate, rate_cov = batch.rate @ r.T, r @ batch.rate_cov @ r.T
    measured_rate = np.einsum("nij,nj->ni", _gain(rate_cov, _ANY_RATE), rate)
    velocity = batch.velocity @ r.T - np.cross(measured_rate, lever)
    arm = se3.skew(lever)
    unknown = _gain(rate_cov, _LIKELY_RATE) @ rate_cov  # covariance of the rate, bounded on unmeasured axes
    return OdometryBatch(batch.t_ns, velocity, rate, r @ batch.velocity_cov @ r.T + arm @ unknown @ arm.T, rate_cov)


def _gain(cov: F64, prior: float) -> F64:
    """Gain (n,3,3) of measurements with covariance (n,3,3) on a zero prior: 1 if precise, 0 if unmeasured."""
    return np.asarray(prior * np.linalg.inv(cov + prior * np.eye(3)))


def joined(batches: Sequence[OdometryBatch]) -> OdometryBatch | None:
    """Concatenate batches; None for an empty list."""
    if len(batches) < 2:
        return batches[0] if batches else None
    return OdometryBatch(
        np.concatenate([b.t_ns for b in batches]),
        np.concatenate([b.velocity for b in batches]),
        np.concatenate([b.rate for b in batches]),
        np.concatenate([b.velocity_cov for b in batches]),
        np.concatenate([b.rate_cov for b in batches]),
    )


def chosen(batch: OdometryBatch, keep: Bool | slice) -> OdometryBatch:
    """Select samples by a mask (n,) or a slice."""
    return OdometryBatch(
        batch.t_ns[keep], batch.velocity[keep], batch.rate[keep], batch.velocity_cov[keep], batch.rate_cov[keep]
    )  # fmt: skip


def usable(batch: OdometryBatch) -> Bool:
    """Mask (n,) of samples with plausible values, and covariances in which no two axes correlate by more than 1."""
    moving = np.concatenate([batch.velocity, batch.rate], axis=1)
    good = np.asarray((np.abs(moving) < _MAX_SPEED).all(axis=1))
    for cov in (batch.velocity_cov, batch.rate_cov):
        diagonal = np.diagonal(cov, axis1=1, axis2=2)
        good &= ((diagonal >= 0.0) & (diagonal < _MAX_VARIANCE)).all(axis=1)
        root = np.sqrt(np.where(good[:, None], diagonal, 0.0))
        good &= (np.abs(cov) <= 1.001 * root[:, :, None] * root[:, None, :]).all(axis=(1, 2))
    return np.asarray(good)


def variances(sigma: Sequence[float]) -> F64:
    """Covariance (3,3) of three standard deviations along the axes; infinite ones become UNMEASURED."""
    return np.diag([min(s * s, UNMEASURED) for s in sigma])
