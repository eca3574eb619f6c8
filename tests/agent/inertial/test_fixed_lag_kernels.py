"""Terms of the fixed-lag smoother: Jacobians against differences, sums and elimination against plain references."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.inertial import fixed_lag_kernels as kernels
from kiteline_agent.inertial import inertial_kernels
from kiteline_agent.inertial.fixed_lag import tilt_of
from kiteline_agent.inertial.preintegration import preintegrate
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.lag_flights import CALIBRATION, CAMERA, T_B_C, make_flight, see
from tests.core.helpers_from_python import from_python

SEEDS = st.integers(0, 2**31)


@given(SEEDS)
@settings(max_examples=15)
def test_tilt_is_a_chart_of_directions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tilt = rng.uniform(-1.0, 1.0, 2)
    down, jac, moved, unused = np.empty(3), np.empty((3, 2)), np.empty(3), np.empty((3, 2))
    inertial_kernels.down_of_tilt(tilt, down, jac)
    np.testing.assert_allclose(down, -se3.so3_exp(np.array([tilt[0], tilt[1], 0.0]))[:, 2], atol=1e-12)
    np.testing.assert_allclose(tilt_of(9.81 * down), tilt, atol=1e-9)
    for a in range(2):
        step = np.zeros(2)
        step[a] = 1e-6
        inertial_kernels.down_of_tilt(tilt + step, moved, unused)
        np.testing.assert_allclose(jac[:, a], (moved - down) / 1e-6, atol=2e-6)


def moved_by(rot: F64, state: F64, x: F64) -> tuple[F64, F64]:
    return rot @ se3.so3_exp(x[:3]), state + x[3:]


@given(SEEDS)
@settings(max_examples=10)
def test_imu_jacobian_agrees_with_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = make_flight(seed, 1)
    motion = preintegrate(flight.samples(0), 0.02 * rng.normal(size=6), CALIBRATION)
    ri, rj = se3.so3_exp(rng.normal(size=3)), np.eye(3)
    rj = ri @ motion.turn @ se3.so3_exp(0.2 * rng.normal(size=3))
    si, sj, tilt = rng.normal(size=12) * 0.3, rng.normal(size=12) * 0.3, 0.3 * rng.normal(size=2)

    def residual(x: F64) -> tuple[F64, F64]:
        a, sa = moved_by(ri, si, x[:15])
        b, sb = moved_by(rj, sj, x[15:30])
        res, jac = np.empty(9), np.empty((9, 32))
        from_python(inertial_kernels.imu_terms)(
            a, sa, b, sb, tilt + x[30:], 9.81, motion.dt_s, motion.turn, motion.vp, motion.jac, motion.bias, res, jac
        )
        return res, jac

    at, jac = residual(np.zeros(32))
    h = 1e-6
    numeric = np.column_stack([(residual(h * e)[0] - residual(-h * e)[0]) / (2 * h) for e in np.eye(32)])
    np.testing.assert_allclose(jac, numeric, atol=2e-7)
    assert np.abs(at).max() > 1e-3


@given(SEEDS)
@settings(max_examples=10)
def test_velocity_terms_agree_with_a_plain_reference(seed: int) -> None:
    """Information and right side of a body velocity whose Jacobian is taken by differences."""
    rng = np.random.default_rng(seed)
    r, state, measured = se3.so3_exp(rng.normal(size=3)), rng.normal(size=12), rng.normal(size=3)
    half = rng.normal(size=(3, 3))
    info = half @ half.T

    def residual(x: F64) -> F64:
        turned, moved = moved_by(r, state, x)
        return np.asarray(turned.T @ moved[3:6] - measured)

    e = 1e-6
    jac = np.column_stack([(residual(e * d) - residual(-e * d)) / (2 * e) for d in np.eye(15)])
    h, b = np.zeros((20, 20)), np.zeros(20)
    cost = from_python(inertial_kernels.velocity_terms)(r, state[3:6].copy(), measured, info, h, b, 2)
    res = residual(np.zeros(15))
    np.testing.assert_allclose(h[2:17, 2:17], jac.T @ info @ jac, atol=1e-7)
    np.testing.assert_allclose(b[2:17], -jac.T @ info @ res, atol=1e-7)
    assert cost == pytest.approx(res @ info @ res)
    assert np.count_nonzero(h) == 36
    assert np.count_nonzero(b) == 6


@given(SEEDS)
@settings(max_examples=10)
def test_visual_terms_agree_with_a_plain_reference(seed: int) -> None:
    """Information and right side of whitened residuals whose Jacobian is taken by differences."""
    rng = np.random.default_rng(seed)
    flight = make_flight(seed, 1)
    points = see(flight, 0, rng, 0.3, 25)
    points = replace(points, ray=0.02 * rng.normal(size=points.xyz.shape))
    r, p = flight.pose(0)[:3, :3].copy(), flight.pose(0)[:3, 3].copy()
    c = CAMERA
    T_c_b = se3.inverse(T_B_C)

    def project(rot: F64, pos: F64, xyz: F64) -> F64:
        x = se3.transform(T_c_b, (xyz - pos) @ rot)
        return np.array([c.fx * x[0] / x[2] + c.cx, c.fy * x[1] / x[2] + c.cy, c.bf / x[2]])

    h, b = np.zeros((6, 6)), np.zeros(6)
    e = 1e-6
    for k in range(len(points.xyz)):
        rows = 3 if points.observed[k, 2] >= 0 else 2
        xyz = points.xyz[k]
        res = (project(r, p, xyz) - points.observed[k])[:rows]
        jac = np.empty((rows, 6))
        for a in range(6):
            d = e * np.eye(6)[a]
            up = project(r @ se3.so3_exp(d[:3]), p + d[3:], xyz)
            low = project(r @ se3.so3_exp(-d[:3]), p - d[3:], xyz)
            jac[:, a] = (up - low)[:rows] / (2 * e)
        v = (project(r, p, xyz + e * points.ray[k]) - project(r, p, xyz - e * points.ray[k]))[:rows] / (2 * e)
        info = np.linalg.inv(points.sigma_px[k] ** 2 * np.eye(rows) + np.outer(v, v))
        e2, knee = res @ info @ res, 0.5 * 9.21 * (1.3 if rows == 3 else 1.0)
        weight = 0.5 * (1.0 if e2 < knee else np.sqrt(knee / e2))
        h += weight * jac.T @ info @ jac
        b -= weight * jac.T @ info @ res
    got_h, got_b = np.empty((6, 6)), np.empty(6)
    from_python(inertial_kernels.visual_terms)(
        r, p, np.ascontiguousarray(T_c_b[:3, :3]), T_c_b[:3, 3].copy(), np.array([c.fx, c.fy, c.cx, c.cy, c.bf]),
        len(points.xyz), points.xyz, points.ray, points.observed, points.sigma_px, points.inlier, 9.21,
        0.5, got_h, got_b,
    )  # fmt: skip
    np.testing.assert_allclose(got_h, h, rtol=1e-5, atol=1e-5 * np.abs(h).max())
    np.testing.assert_allclose(got_b, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())


@given(SEEDS, st.integers(1, 6))
@settings(max_examples=15)
def test_elimination_is_the_schur_complement(seed: int, keep: int) -> None:
    rng = np.random.default_rng(seed)
    m = rng.normal(size=(12, 8))
    h, b = m.T @ m + 0.1 * np.eye(8), rng.normal(size=8)
    a = np.column_stack([h, b])
    assert from_python(kernels.eliminate)(a, keep, 8)
    inner = np.linalg.inv(h[:keep, :keep])
    rest = h[keep:, keep:] - h[keep:, :keep] @ inner @ h[:keep, keep:]
    np.testing.assert_allclose(np.triu(a[keep:, keep:8]), np.triu(rest), atol=1e-8)
    np.testing.assert_allclose(a[keep:, 8], b[keep:] - h[keep:, :keep] @ inner @ b[:keep], atol=1e-8)
    assert not from_python(kernels.eliminate)(-np.column_stack([h, b]), keep, 8)
