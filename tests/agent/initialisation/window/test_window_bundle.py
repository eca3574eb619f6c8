"""The window of a monocular start in metres: scale, gravity, biases and honest deviations, from simulated corners."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.preintegration import BiasPrior, Samples, TimeOffset
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.window.corner_terms import _MAX_RMS, CornerTerms
from kiteline_agent.initialisation.window.inertial_terms import NO_OFFSET, CutSamples, InertialTerms
from kiteline_agent.initialisation.window.lens_correction import TERMS, moved
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_kernels import add_observations
from kiteline_agent.initialisation.window.window_noise import NoiseEvidence, WindowNoise
from kiteline_agent.initialisation.window.window_samples import WindowSamples
from kiteline_agent.initialisation.window.window_state import WarmStart, WindowSolution, finished
from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_hw.sim.sensors import imu as sim_imu
from kiteline_hw.sim.world.built_in_paths import built_in_path
from kiteline_hw.sim.world.path import Path

T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.03, -0.02]))
FOCAL = 450.0
CONFIG = InertialBundleConfig()
PRIOR = BiasPrior(np.zeros(6), np.repeat([0.1, 0.2], 3))
CALIBRATION = ImuCalibration()


def window(
    seed: int, keyframes: int = 13, haste: float = 0.4, noise_px: float = 0.5, still: bool = False,
    lost_s: tuple[float, float] = (0.0, 0.0), late_s: float = 0.0, uneven_s: float = 0.0,
) -> tuple[CornerObservations, CutSamples, F64]:  # fmt: skip
    """Corners, samples and true poses T_w_b (K,4,4) of keyframes 0.25 s apart.

    lost_s: between these are no samples. late_s: by which samples are stamped late. uneven_s: deviation of the times
    of keyframes from a constant rate.
    """
    rng = np.random.default_rng(seed)
    path = built_in_path("room", 12.0 / haste, T_B_C, seed)
    path = Path(path.coefficients, path.knot_s * haste, path.length_s * haste, 0.7, 8.0 if still else 0.0)
    t_ns = 500_000_000 + 250_000_000 * np.arange(keyframes, dtype=np.int64)
    t_ns += np.round(1e9 * uneven_s * np.random.default_rng(seed + 50).normal(size=keyframes)).astype(np.int64)
    imu_t = np.arange(0, int(t_ns[-1]) + 200_000_000, 5_000_000, dtype=np.int64)
    samples = sim_imu.measure(path, imu_t, 0, CALIBRATION, seed)
    here = (imu_t * 1e-9 < lost_s[0]) | (imu_t * 1e-9 >= lost_s[1])
    buffer = SampleBuffer(100.0, 0.5)
    stamps = samples.t_ns + round(late_s * 1e9)
    buffer.push(ImuBatch(stamps[here], samples.gyro[here], samples.accel[here]))
    truth = path.motion(t_ns * 1e-9).T_w_b
    cloud = truth[:, :3, 3].mean(axis=0) + rng.uniform(-5.0, 5.0, (400, 3))
    xy, seen = np.zeros((keyframes, len(cloud), 2)), np.zeros((keyframes, len(cloud)), np.bool_)
    for k, T in enumerate(truth):
        p = se3.transform(se3.inverse(T @ T_B_C), cloud)
        z = np.maximum(p[:, 2:], 1e-3)
        seen[k] = (p[:, 2] > 0.4) & (np.abs(p[:, :2] / z) < np.array([0.8, 0.5])).all(axis=1)
        xy[k] = p[:, :2] / z + noise_px / FOCAL * rng.normal(size=(len(cloud), 2))
    corners = CornerObservations(xy, seen, np.arange(len(cloud)))
    corners = corners.part(np.flatnonzero(seen.sum(axis=0) >= 3)[:120])
    return corners, WindowSamples(buffer, lambda s: s, [int(t) for t in t_ns], 0.0).at, truth


def changed(cut: CutSamples, change: Callable[[Samples], Samples]) -> CutSamples:
    """The samples, each interval changed."""

    def at(offset_s: float) -> list[Samples] | None:
        intervals = cut(offset_s)
        return None if intervals is None else [change(samples) for samples in intervals]

    return at


def bundle(corners: CornerObservations, cut: CutSamples, offset: TimeOffset = NO_OFFSET) -> InertialBundle:
    return InertialBundle(corners, cut, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, CONFIG, offset=offset)


def scale_of(solution: WindowSolution, truth: F64) -> float:
    p, q = solution.state.p, truth[:, :3, 3]
    return float(np.linalg.norm(p - p.mean(axis=0)) / np.linalg.norm(q - q.mean(axis=0)))


@pytest.mark.parametrize("seed", range(6))
def test_scale_gravity_and_motion_are_found_without_a_first_guess(seed: int) -> None:
    corners, cut, truth = window(seed)
    found = bundle(corners, cut).solve()
    assert abs(np.log(scale_of(found, truth))) < max(4.0 * found.scale_sigma, 0.01)
    assert found.scale_sigma < 0.05
    down_b = found.T_w_b[:3, :3].T @ found.gravity / 9.81
    assert np.degrees(np.arccos(np.clip(down_b @ truth[-1, :3, :3].T @ [0.0, 0.0, -1.0], -1.0, 1.0))) < 1.5
    moved = se3.inverse(truth[0]) @ truth[-1]
    np.testing.assert_allclose(
        (se3.inverse(se3.from_rt(found.state.R[0], found.state.p[0])) @ found.T_w_b)[:3, :3], moved[:3, :3], atol=0.02
    )
    assert found.reprojection_px == pytest.approx(0.5 * np.sqrt(2.0), rel=0.35)


@pytest.mark.parametrize("late_s", [-0.15, -0.08, -0.01, 0.0, 0.02, 0.15])
def test_the_time_offset_is_found_and_costs_no_scale(late_s: float) -> None:
    corners, cut, truth = window(1, keyframes=16, noise_px=0.2, late_s=late_s)
    found = bundle(corners, cut, TimeOffset(0.0, 0.02)).solve()
    assert found.fits and abs(found.offset.offset_s - late_s) < max(4.0 * found.offset.sigma_s, 1e-4)
    assert found.offset.sigma_s < 2e-3
    known = bundle(corners, cut, TimeOffset(late_s, 1e-6)).solve()
    assert known.offset.offset_s == pytest.approx(late_s, abs=1e-5)
    assert abs(np.log(scale_of(found, truth) / scale_of(known, truth))) < 0.5 * known.scale_sigma
    assert known.scale_sigma < found.scale_sigma < 1.05 * known.scale_sigma


def test_errors_change_with_the_time_offset_as_their_derivatives_say() -> None:
    corners, cut, _ = window(2)
    state = bundle(corners, cut).solve().state
    terms = InertialTerms(cut, TimeOffset(0.0, 0.02), CALIBRATION, 9.81, PRIOR, CONFIG, WindowNoise())
    terms.integrate(state)
    slope = np.array([terms._jacobian(state, e, k, terms._tilt(state)) for k, e in enumerate(terms._errors(state))])
    errors = []
    for offset_s in (-0.004, 0.004):
        moved_state = replace(state, offset_s=offset_s)
        terms.integrate(moved_state)
        errors.append(terms._errors(moved_state))
    by_difference = (errors[1] - errors[0]) / 0.008
    for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
        size = np.linalg.norm(by_difference[:, rows])
        assert np.linalg.norm(slope[:, rows, 29] - by_difference[:, rows]) < 0.15 * size


def test_deviations_of_the_scale_are_honest() -> None:
    """Over seeds, errors are as large as their deviations say: not larger, and not ten times smaller."""
    ratios = []
    for seed in range(12):
        corners, cut, truth = window(seed, keyframes=11)
        found = bundle(corners, cut).solve()
        ratios.append(np.log(scale_of(found, truth)) / found.scale_sigma)
    assert 0.05 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_errors_of_the_lens_are_found_and_do_not_bend_the_path() -> None:
    """A lens that shows pixels up to 2 px off, and a camera that is turned by 3 mrad against the IMU."""
    lens = np.array([0.004, 1.0 / FOCAL, -1.0 / FOCAL, -0.006, 0.005, -0.003, 0.002, 0.001])
    shown = [0, 3, 4]  # a shift of the centre and a rotation resemble each other too much to be told apart
    told_apart, calibrated, known = [], [], []
    for seed in range(4):
        corners, cut, truth = window(seed, keyframes=16, noise_px=0.2)
        worn = replace(corners, xy=np.where(corners.seen[..., None], moved(corners.xy, lens), corners.xy))
        config = replace(CONFIG, sigma_px=0.3)
        fixed = np.eye(TERMS) * 1e12
        for info, paths in ((None, known), (fixed, calibrated)):
            found = InertialBundle(worn, cut, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, config, lens_info=info).solve()
            assert found is not None
            paths.append(_bend(found, truth))
            if info is None:
                off = (found.state.lens - lens)[shown]
                told_apart.append(off / np.sqrt(np.diag(found.lens_cov))[shown])
    assert np.sqrt(np.mean(np.square(told_apart))) < 1.6
    assert np.mean(known) < 0.5 * np.mean(calibrated)


def _bend(found: WindowSolution, truth: F64) -> float:
    """By how much a path differs from the true one, rms, in shares of its size, whatever its scale."""
    p, q = found.state.p - found.state.p.mean(axis=0), truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    p, q = p / np.linalg.norm(p), q / np.linalg.norm(q)
    u, _, vt = np.linalg.svd(q.T @ p)
    return float(np.linalg.norm(q - p @ (u @ vt).T))


@pytest.mark.parametrize("factor", [0.55, 1.8])
def test_a_warm_start_of_another_size_ends_at_the_scale_that_a_vibrating_imu_tells(factor: float) -> None:
    """Inverse depths are not linear in the scale: steps along it were rejected, and the solver crept or stopped."""
    corners, cut, _ = window(3, keyframes=14)
    noise = WindowNoise(accel=12.0)
    args = (corners, cut, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, CONFIG, noise)
    solver = InertialBundle(*args)
    right = solver.solve()
    xyz, _ = solver.landmarks_of(right.state)
    camera = right.state.p + right.state.R @ T_B_C[:3, 3]
    away = (factor - 1.0) * (camera - camera[0])
    wrong = replace(right.state, p=right.state.p + away, v=factor * right.state.v)
    found = InertialBundle(*args).solve(WarmStart(wrong, camera[0] + factor * (xyz - camera[0])))
    assert found.converged
    assert found.cost < right.cost + 0.5
    ratio = np.linalg.norm(found.state.p - found.state.p[0]) / np.linalg.norm(right.state.p - right.state.p[0])
    assert abs(np.log(ratio)) < 0.5 * right.scale_sigma


def test_a_noisier_model_of_the_imu_knows_the_scale_less_well() -> None:
    corners, cut, _ = window(1)
    found = [
        InertialBundle(
            corners, cut, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, CONFIG, WindowNoise(noise, noise, noise)
        ).solve()
        for noise in (0.5, 1.0, 3.0)
    ]
    sigma = [s.scale_sigma for s in found if s is not None]
    assert len(sigma) == 3 and sigma[0] < sigma[1] < sigma[2]
    assert all(s is not None and s.converged for s in found)


@pytest.mark.parametrize("seed", range(3))
def test_samples_that_are_missing_count_as_missing(seed: int) -> None:
    corners, cut, truth = window(seed, lost_s=(2.1, 2.5))
    found = bundle(corners, cut).solve()
    assert found.fits and abs(np.log(scale_of(found, truth))) < max(4.0 * found.scale_sigma, 0.01)
    whole = bundle(*window(seed)[:2]).solve()
    assert whole.scale_sigma < found.scale_sigma < 2.0 * whole.scale_sigma
    trusted = bundle(corners, changed(cut, lambda s: replace(s, density=None))).solve()
    assert trusted.imu_chi2 > 3.0 * found.imu_chi2


@pytest.mark.parametrize("factor", [1.0, 12.0])
def test_noise_of_the_accelerometer_is_found_from_more_than_there_is(factor: float) -> None:
    """An IMU that shakes: its noise is `factor` times that of the error model."""
    corners, cut, _ = window(2, keyframes=24)
    rng = np.random.default_rng(3)
    sigma = factor * CONFIG.imu_inflation * CALIBRATION.accel_noise * np.sqrt(CALIBRATION.rate_hz)
    shaken_once = [replace(s, accel=s.accel + sigma * rng.standard_normal(s.accel.shape)) for s in cut(0.0) or []]

    def shaken(_offset_s: float) -> list[Samples]:
        return shaken_once

    noise, config = WindowNoise(accel=20.0), replace(CONFIG, sigma_px=0.5, huber=1.5)  # corners are as good as said
    for _ in range(3):
        found = InertialBundle(corners, shaken, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, config, noise).solve()
        noise = found.evidence.updated(noise)
    assert 0.5 * factor < noise.accel < 2.0 * factor
    assert noise.gyro < 3.0


def test_noise_of_the_accelerometer_is_not_believed_below_its_least() -> None:
    """A window whose path follows the vibration leaves few errors to show it."""
    few = NoiseEvidence(chi2=np.array([1.0, 1.0, 1.0]), expected=np.array([30.0, 30.0, 3.0]))
    before = WindowNoise(1.0, 4.0, 1.0)
    assert few.updated(before).accel < 1.0
    assert few.updated(before, 3.0).accel == 3.0
    many = NoiseEvidence(chi2=np.array([30.0, 40.0, 3.0]), expected=np.array([30.0, 30.0, 3.0]))
    assert many.updated(before, 3.0) == many.updated(before)


def walking(corners: CornerObservations, truth: F64, share: float, seed: int) -> tuple[CornerObservations, Bool]:
    """The corners, a share of them on things that walk across the view from one keyframe to the next; and which."""
    rng = np.random.default_rng(seed)
    walks = rng.random(len(corners.ids)) < share
    step = rng.choice([-1.0, 1.0], len(walks)) * rng.uniform(0.02, 0.04, len(walks))  # 10 to 20 px
    xy = corners.xy.copy()
    xy[:, walks, 0] += (np.arange(len(truth))[:, None] * step)[:, walks]
    return replace(corners, xy=xy), walks


@pytest.mark.parametrize("seed", [0, 1, 2, 4])  # from nothing, one window in five ends in another minimum
def test_corners_that_walk_are_left_out(seed: int) -> None:
    corners, cut, truth = window(seed)
    crowd, walks = walking(corners, truth, 0.3, seed)
    found = bundle(crowd, cut).solve()
    still = bundle(corners.part(np.flatnonzero(~walks)), cut).solve()
    assert found is not None and still is not None and found.converged
    # as by the still corners alone
    assert abs(np.log(scale_of(found, truth) / scale_of(still, truth))) < 0.5 * still.scale_sigma
    assert found.scale_sigma < 1.2 * still.scale_sigma
    assert found.reprojection_px < 1.2 * still.reprojection_px
    # and they become no landmarks of the map
    placed = finished(bundle(crowd, cut).placing_landmarks(found.state))
    newest = corners.seen[-1]
    assert (placed.depth_sigma[walks & newest] > 0.25).mean() > 0.9
    assert (placed.depth_sigma[~walks & newest] < 0.25).mean() > 0.7


def test_costs_with_and_without_walking_corners_can_be_compared() -> None:
    """What is left out costs as much as just before, not nothing: else the worst solution had the lowest cost."""
    corners, cut, truth = window(1)
    crowd, walks = walking(corners, truth, 0.3, 1)
    with_them, without = bundle(crowd, cut).solve(), bundle(crowd.part(np.flatnonzero(~walks)), cut).solve()
    observations = np.count_nonzero(corners.seen[:, walks])
    each = CONFIG.huber * (_MAX_RMS - 0.5 * CONFIG.huber)
    assert with_them.cost - without.cost == pytest.approx(observations * each, rel=0.2)  # some corners that stay, too


@pytest.mark.parametrize("seed", range(4))
def test_without_walking_corners_the_solution_is_no_worse(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    corners, cut, _ = window(seed)
    found = bundle(corners, cut).solve()
    monkeypatch.setattr(CornerTerms, "leave_out", lambda *_: False)
    before = bundle(corners, cut).solve()
    assert found is not None and before is not None and found.converged
    assert found.cost < before.cost + 1.0


def test_a_still_camera_tells_no_scale() -> None:
    corners, cut, _ = window(3, still=True)
    found = bundle(corners, cut).solve()
    assert found is None or found.scale_sigma > 0.1


def test_a_warm_start_ends_where_a_cold_one_does() -> None:
    corners, cut, truth = window(4, keyframes=14)
    first = bundle(
        replace(corners, xy=corners.xy[:12], seen=corners.seen[:12]), lambda offset_s: (cut(offset_s) or [])[:11]
    )
    before = first.solve()
    xyz, _ = first.landmarks_of(before.state)
    xyz[::7] = np.nan  # new corners
    warm, cold = bundle(corners, cut).solve(WarmStart(before.state, xyz)), bundle(corners, cut).solve()
    assert warm is not None and cold is not None
    assert abs(np.log(scale_of(warm, truth) / scale_of(cold, truth))) < 0.5 * cold.scale_sigma


def test_the_state_is_that_of_the_newest_keyframe() -> None:
    corners, cut, truth = window(5)
    found = bundle(corners, cut).solve()
    xyz = np.full(3, np.nan)
    assert found.cov.shape == (17, 17) and np.linalg.eigvalsh(found.cov).min() > 0.0 and np.isnan(xyz).all()
    speed = np.linalg.norm(truth[-1, :3, 3] - truth[-2, :3, 3]) / 0.25
    assert np.linalg.norm(found.velocity) == pytest.approx(speed, rel=0.4, abs=0.1)


def test_landmarks_are_placed_with_known_poses() -> None:
    corners, cut, truth = window(2)
    few = bundle(corners.part(np.arange(min(60, len(corners.ids)))), cut).solve()
    every = finished(bundle(corners, cut).placing_landmarks(few.state))
    known = (every.depth_sigma < 0.1) & corners.seen[-1]
    assert known.sum() > 10
    # true depths by the observations themselves: the ray through the newest pixel at that depth meets the others
    T = truth @ T_B_C
    ray = np.append(corners.xy[-1], np.ones((len(known), 1)), axis=1) * every.depth_m[:, None] / scale_of(few, truth)
    world = se3.transform(T[-1], ray)
    off = []
    for k in range(len(truth)):
        p = se3.transform(se3.inverse(T[k]), world)
        good = corners.seen[k] & known
        off.append(np.linalg.norm(p[good, :2] / p[good, 2:] - corners.xy[k][good], axis=1) * FOCAL)
    assert np.median(np.concatenate(off)) < 6.0


def test_a_landmark_that_diverges_is_not_computed_with_beyond_all_bounds() -> None:
    corners, cut, _ = window(0)
    problem = bundle(corners, cut)
    found = problem.solve()
    assert found is not None
    system = problem._linearise(found.state, inertial=True)
    corners = replace(system.corners, bp=np.full_like(system.corners.bp, 1e200))
    far = problem._moved(found.state, np.zeros(len(system.b)), replace(system, corners=corners))
    assert np.isfinite(problem._cost(far, inertial=True))


def test_normal_equations_of_observations_are_those_of_their_jacobians() -> None:
    """Beside sums of outer products of each observation's Jacobian, taken by matrices of numpy."""
    rng = np.random.default_rng(3)
    n, m, sigma = 4, 7, 0.002
    xy, error, y = rng.normal(size=(n, m, 2)), rng.normal(size=(n, m, 2)), rng.normal(size=(n, m, 3))
    z, rho = rng.uniform(0.5, 2.0, (n, m)), rng.uniform(0.1, 1.0, m)
    weight = rng.uniform(0.2, 1.0, (n, m)) * (rng.uniform(size=(n, m)) < 0.7)
    R = np.array([se3.so3_exp(v) for v in rng.normal(size=(n, 3))])
    axes = np.array([se3.so3_exp(v) for v in rng.normal(size=(m, 3))])
    R_bc, t_bc, p, origin = (
        se3.so3_exp(rng.normal(size=3)),
        rng.normal(size=3),
        rng.normal(size=(n, 3)),
        np.ones((m, 3)),
    )
    seen = 6 * n + TERMS
    start = rng.normal(size=(seen, seen))  # what was summed before is kept
    hpp, bp, hpk = np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((m, 3, seen))
    hkk, bk, lens = start.copy(), np.zeros(seen), slice(6 * n, seen)
    add_observations(xy, error, weight, sigma, y, z, R_bc, R, p, t_bc, rho, origin, axes, hpp, bp, hpk, hkk, bk)
    point_h, point_b, mixed = np.zeros_like(hpp), np.zeros_like(bp), np.zeros_like(hpk)
    pose_h, pose_b = start.copy(), np.zeros_like(bk)
    for k in range(n):
        for i in range(m):
            slope = (R_bc[:, :2].T - xy[k, i][:, None] * R_bc[:, 2]) / z[k, i] / sigma
            place = np.column_stack([R[k].T @ axes[i][:, :2], R[k].T @ (origin[i] - p[k]) - t_bc])
            of_point = slope @ place
            of_pose = np.column_stack([slope @ se3.skew(y[k, i]), -rho[i] * slope @ R[k].T])
            w, at = weight[k, i], slice(6 * k, 6 * k + 6)
            unit = np.eye(TERMS)
            of_lens = np.stack([moved(xy[k, i], a) - xy[k, i] for a in unit], axis=1) / sigma  # linear in the factors
            point_h[i] += w * of_point.T @ of_point
            point_b[i] += w * of_point.T @ error[k, i]
            mixed[i][:, at] += w * of_point.T @ of_pose
            pose_h[at, at] += w * of_pose.T @ of_pose
            pose_b[at] += w * of_pose.T @ error[k, i]
            mixed[i][:, lens] += w * of_point.T @ of_lens
            pose_h[lens, at] += w * of_lens.T @ of_pose
            pose_h[lens, lens] += w * of_lens.T @ of_lens
            pose_b[lens] += w * of_lens.T @ error[k, i]
    for found, wanted in ((hpp, point_h), (bp, point_b), (hpk, mixed), (hkk, pose_h), (bk, pose_b)):
        assert np.allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
        assert np.abs(found).max() > 0.0
