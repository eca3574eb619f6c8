"""The scale of a map by inertial steps: the truth, an IMU that is silent about it, maps whose scale drifts."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.config import InertialScaleConfig
from kiteline_basestation.inertial import band_kernels
from kiteline_basestation.inertial.chain import Segment, path_along
from kiteline_basestation.inertial.map_scale import MapScale, in_metres, map_scale, tells_scale
from kiteline_basestation.inertial.scale_drift import bent, drift_along, shared_landmarks
from kiteline_codec.schema import InertialSteps
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId
from kiteline_core.optimisation.bundle import BundleProblem, BundleResult
from tests.basestation.inertial_maps import T_B_C, body, steps

CONFIG = InertialScaleConfig()


def a_map(
    scale: float, lively: float = 1.0, seed: int = 0, seconds: float = 20.0, *, last: float | None = None
) -> tuple[tuple[Segment, ...], F64]:
    """Segments between keyframes 0.9 s apart, and T_w_c (k,4,4) of a map `scale` times too large.

    last: the scale at its end, if it drifts evenly.
    """
    rng, times = np.random.default_rng(seed), np.arange(0.0, seconds, 0.9)
    T_w_c = np.array([body(t, lively) @ T_B_C for t in times])
    scales = np.linspace(scale, scale if last is None else last, len(times) - 1)
    legs = np.diff(T_w_c[:, :3, 3], axis=0)
    T_w_c[:, :3, 3] = scale * T_w_c[0, :3, 3] + np.concatenate([np.zeros((1, 3)), np.cumsum(scales[:, None] * legs, 0)])
    bias = np.array([0.05, -0.1, 0.08])
    segments = []
    for i, (a, b) in enumerate(pairwise(times)):
        seen = steps(a, b, 6, lively, float(scales[i]), rng, bias)
        record = InertialSteps(KeyframeId(i + 1), KeyframeId(i), 2e-3, **seen)
        segments.append(Segment(i, i + 1, se3.inverse(T_B_C), 3.0, 1.0, record))
    return tuple(segments), T_w_c


def scale_of(segments: tuple[Segment, ...], T_w_c: F64) -> MapScale | None:
    """The scale along a map whose keyframes share no landmarks."""
    return map_scale(segments, T_w_c, np.zeros((len(T_w_c), len(T_w_c))), CONFIG)


def a_problem(T_w_c: F64, points: F64) -> BundleProblem:
    """A bundle problem in which every camera observes every point."""
    k, n = len(T_w_c), len(points)
    starts = np.arange(0, k * n + 1, k, dtype=np.int32)
    camera = np.tile(np.arange(k, dtype=np.int32), n)
    none = np.zeros((k * n, 3))
    return BundleProblem(
        np.linalg.inv(T_w_c), np.zeros((k, 5)), np.ones(k, np.bool_), points, starts, camera, none, none[:, :2]
    )


def solved(problem: BundleProblem) -> BundleResult:
    """The problem as its own result."""
    return BundleResult(problem.T_c_m, problem.points, np.ones(len(problem.camera), np.bool_), 0.0, 0.0, 0, 0)


@given(st.integers(0, 1 << 30), st.integers(2, 12), st.integers(1, 5), st.integers(1, 3))
def test_the_band_is_solved_as_the_full_matrix(seed: int, n: int, w: int, b: int) -> None:
    rng = np.random.default_rng(seed)
    full = np.zeros((n + b, n + b))
    for j in range(n):
        full[j, j : min(j + w, n)] = rng.normal(0.0, 1.0, min(w, n - j))
    full[:n, n:] = rng.normal(0.0, 1.0, (n, b))
    full = full + full.T + 20.0 * np.eye(n + b)
    rhs = rng.normal(0.0, 1.0, n + b)
    band = np.zeros((n, w))
    for j in range(n):
        band[j, : min(w, n - j)] = full[j, j : min(j + w, n)]
    border, corner = full[:n, n:].copy(), full[n:, n:].copy()
    x, x_corner = rhs[:n].copy(), rhs[n:].copy()
    assert band_kernels.factor(band, border, corner, x, x_corner)
    expected = np.linalg.solve(full, rhs)
    assert np.allclose(np.linalg.inv(corner), np.linalg.inv(full)[n:, n:], atol=1e-10)
    x_corner = np.linalg.solve(corner, x_corner)
    band_kernels.substitute(band, border, x, x_corner)
    assert np.allclose(np.concatenate([x, x_corner]), expected, atol=1e-10)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    band = np.array([[1.0, 2.0], [1.0, 0.0]])
    assert not band_kernels.factor(band, np.zeros((2, 1)), np.eye(1), np.zeros(2), np.zeros(1))


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.04])
def test_the_scale_is_found_within_its_deviation(scale: float) -> None:
    off = []
    for seed in range(4):
        segments, T_w_c = a_map(scale, seed=seed)
        found = scale_of(segments, T_w_c)
        assert found.sigma < 0.02
        off.append(np.log(np.mean(found.metres) * scale) / found.sigma)
    assert np.abs(off).max() < 2.5
    assert np.abs(np.mean(off)) < 1.0


def test_a_flight_without_accelerations_keeps_the_agents_scale() -> None:
    segments, T_w_c = a_map(0.95, lively=0.0)
    found = scale_of(segments, T_w_c)
    assert found.sigma > 0.02
    assert np.abs(found.metres - 1.0).max() < 0.02
    told = tuple(replace(s, metre=0.95) for s in segments)  # the unit of the agent
    found = scale_of(told, T_w_c)
    assert np.abs(found.metres - 0.95).max() < 0.02


def test_the_path_ends_where_the_keyframes_are() -> None:
    segments, T_w_c = a_map(1.0)
    moved = T_w_c.copy()
    moved[1:, :3, 3] += np.array([0.05, -0.02, 0.03])
    moved[3] = moved[3] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, -0.02, 0.01]))
    path = path_along(segments, moved)
    ends = np.concatenate([[0], np.cumsum([len(s.steps.dt_s) for s in segments])])
    assert np.allclose(path.camera[ends], moved[:, :3, 3], atol=1e-9)
    assert np.allclose(path.R_w_b[ends] @ T_B_C[:3, :3], moved[:, :3, :3], atol=1e-6)
    assert path.fresh.sum() == 1
    apart = path_along((*segments[:4], *segments[6:]), moved)
    assert apart.fresh.sum() == 2
    assert len(apart.camera) == len(apart.begin) + 2


def test_a_gap_in_the_chain_costs_little() -> None:
    segments, T_w_c = a_map(0.95)
    found = scale_of((*segments[:10], *segments[13:]), T_w_c)
    assert abs(np.mean(found.metres) * 0.95 - 1.0) < 0.02


def test_few_or_mad_steps_tell_nothing() -> None:
    segments, T_w_c = a_map(0.95)
    assert tells_scale(segments) and not tells_scale(segments[:2])
    assert scale_of((), T_w_c) is None
    T_w_c[3, 0, 3] = np.nan
    assert scale_of(segments, T_w_c) is None


def test_a_bundle_is_scaled_about_the_camera_that_it_held() -> None:
    segments, T_w_c = a_map(0.95)
    points = np.random.default_rng(1).normal(0.0, 3.0, (20, 3))
    problem = a_problem(T_w_c, points)
    result = solved(problem)
    scaled = in_metres(result, problem, segments, 2, replace(CONFIG, drift=1e-9))
    assert np.array_equal(scaled.T_c_m[2], result.T_c_m[2])
    before = np.einsum("kij,nj->kni", result.T_c_m[:, :3, :3], points) + result.T_c_m[:, None, :3, 3]
    after = np.einsum("kij,nj->kni", scaled.T_c_m[:, :3, :3], scaled.points) + scaled.T_c_m[:, None, :3, 3]
    ratio = after / before  # no pixel moves
    assert np.ptp(ratio) < 1e-6
    assert ratio.mean() == pytest.approx(1.0 / 0.95, abs=0.02)


def test_a_map_whose_scale_drifts_is_bent() -> None:
    segments, T_w_c = a_map(0.97, last=1.05)
    problem = a_problem(T_w_c, np.zeros((0, 3)))
    mended = np.linalg.inv(in_metres(solved(problem), problem, segments, 0, CONFIG).T_c_m)[:, :3, 3]
    true = np.array([(body(0.9 * i, 1.0) @ T_B_C)[:3, 3] for i in range(len(T_w_c))])

    def lengths(places: F64) -> F64:
        """Of the legs, over the true ones: means of the first and the last third."""
        legs, true_legs = (np.linalg.norm(np.diff(p, axis=0), axis=1) for p in (places, true))
        third = len(legs) // 3
        return np.array([legs[part].sum() / true_legs[part].sum() for part in (slice(third), slice(-third, None))])

    assert np.abs(lengths(T_w_c[:, :3, 3]) - 1.0).min() > 0.015
    assert np.abs(lengths(mended) - 1.0).max() < 0.012


def test_a_torn_map_tells_no_scale() -> None:
    segments, T_w_c = a_map(0.97)
    shared = np.zeros((len(T_w_c), len(T_w_c)))
    T_w_c[-3:, :3, 3] += 0.6 * (T_w_c[-3:, :3, 3] - T_w_c[-4, :3, 3])
    assert map_scale(segments, T_w_c, shared, CONFIG) is None
    loose = map_scale(segments, T_w_c, shared, replace(CONFIG, most_drift=1e9))
    assert np.ptp(loose.metres) > 0.05


def test_where_a_path_comes_back_to_landmarks_both_passes_have_one_scale() -> None:
    segments, T_w_c = a_map(1.0)
    path, back = path_along(segments, T_w_c), T_w_c.copy()
    back[-1] = T_w_c[0]
    shared = np.zeros((len(T_w_c), len(T_w_c)))
    shared[0, -1] = shared[-1, 0] = 50.0
    sigmas = []
    for landmarks in (0.0 * shared, shared):
        drift = drift_along(segments, path, back, landmarks, CONFIG)
        cov = np.linalg.inv(drift.information + np.outer(drift.mean, drift.mean))
        between = drift.at_keyframes[-1] - drift.at_keyframes[0]
        sigmas.append(float(np.sqrt(between @ cov @ between)))
    assert sigmas[0] > 2.0 * CONFIG.drift  # over several views
    assert sigmas[1] < 0.5 * CONFIG.drift


def test_a_bent_loop_stays_closed_and_landmarks_move_with_their_views() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 13)
    T_w_c = np.array([se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, a])), [np.cos(a), np.sin(a), 0.0]) for a in angle])
    points = T_w_c[:, :3, 3] + np.array([0.0, 0.0, 2.0])
    problem = a_problem(T_w_c, points)
    beside = np.eye(13, k=1) + np.eye(13, k=-1)
    beside[0, 12] = beside[12, 0] = 1.0  # where the loop closes
    growth = np.linspace(1.0, 1.1, 13)
    loop = bent(solved(problem), problem, beside, growth, 0)
    path = bent(solved(problem), problem, np.where(np.abs(np.subtract.outer(range(13), range(13))) == 1, 1.0, 0.0),
                growth, 0)  # fmt: skip
    gaps = [float(np.linalg.norm(p[12] - p[0])) for p in (np.linalg.inv(r.T_c_m)[:, :3, 3] for r in (loop, path))]
    assert gaps[1] > 0.08
    assert gaps[0] < 0.002
    even = bent(solved(problem), problem, beside, np.full(13, 1.1), 4)
    assert np.allclose(even.points, T_w_c[4, :3, 3] + 1.1 * (points - T_w_c[4, :3, 3]))


def test_a_rejected_observation_moves_no_landmark() -> None:
    T_w_c = np.tile(np.eye(4), (4, 1, 1))
    T_w_c[:, 0, 3] = [0.0, 1.0, 2.0, 30.0]
    problem = a_problem(T_w_c, np.array([[1.0, 0.0, 4.0]]))
    result = solved(problem)
    result = replace(result, inlier=problem.camera != 3)
    growth = np.array([1.0, 1.0, 1.0, 1.05])
    beside = np.eye(4, k=1) + np.eye(4, k=-1)
    assert np.abs(bent(result, problem, beside, growth, 0).points - result.points).max() < 1e-3


def test_shared_landmarks_are_counted() -> None:
    rng = np.random.default_rng(5)
    seen = rng.random((30, 6)) < 0.4
    inlier = rng.random(seen.sum()) < 0.8
    point, camera = np.nonzero(seen)
    starts = np.concatenate([[0], np.cumsum(seen.sum(axis=1))]).astype(np.int32)
    problem = replace(
        a_problem(np.tile(np.eye(4), (6, 1, 1)), np.zeros((30, 3))), starts=starts, camera=camera.astype(np.int32)
    )
    counted = np.zeros((30, 6))
    counted[point[inlier], camera[inlier]] = 1.0
    expected = counted.T @ counted
    np.fill_diagonal(expected, 0.0)
    assert np.array_equal(shared_landmarks(problem, inlier), expected)


def test_a_change_that_does_not_matter_waits() -> None:
    segments, T_w_c = a_map(0.999)
    found = scale_of(segments, T_w_c)
    problem = a_problem(T_w_c, np.zeros((0, 3)))
    result, largest = solved(problem), float(np.abs(np.log(found.metres)).max())
    patient = replace(CONFIG, hold=1.1 * largest / found.sigma)
    hasty = replace(CONFIG, hold=0.9 * largest / found.sigma)
    assert in_metres(result, problem, segments, 0, patient).T_c_m is result.T_c_m
    assert in_metres(result, problem, segments, 0, hasty).T_c_m is not result.T_c_m
    assert in_metres(result, problem, segments, 0, patient).scale_sigma == pytest.approx(found.sigma)
