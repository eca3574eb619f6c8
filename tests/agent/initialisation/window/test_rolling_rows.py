"""Windows of a camera with a rolling shutter: corners that its rows show are taken to the keyframes' stamps."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.preintegration import BiasPrior, Samples
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.window.lens_correction import moved
from kiteline_agent.initialisation.window.rolling_rows import RollingRows, shifts
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_readout import WindowReadout
from kiteline_agent.initialisation.window.window_samples import WindowSamples
from kiteline_agent.initialisation.window.window_state import finished
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_hw.sim.sensors import imu as sim_imu
from kiteline_hw.sim.world.built_in_paths import built_in_path
from kiteline_hw.sim.world.path import Path

T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.03, -0.02]))
CAMERA = RectifiedCamera(720, 450, 450.0, 450.0, 360.0, 225.0, 0.1, False, T_B_C)
READOUT_S, ROW_S = 0.03, 0.03 / 450
KEYFRAMES, HASTE = 13, 0.4


def path_of(seed: int) -> Path:
    path = built_in_path("room", 12.0 / HASTE, T_B_C, seed)
    return Path(path.coefficients, path.knot_s * HASTE, path.length_s * HASTE, 0.7, 0.0)


def window(seed: int, row_s: float = ROW_S) -> tuple[CornerObservations, WindowSamples, RollingRows, F64]:
    """Corners of keyframes 0.25 s apart, each seen when its row is exposed, samples, and true poses T_w_b (K,4,4)."""
    rng, path = np.random.default_rng(seed), path_of(seed)
    t_ns = 500_000_000 + 250_000_000 * np.arange(KEYFRAMES, dtype=np.int64)
    imu_t = np.arange(0, int(t_ns[-1]) + 200_000_000, 5_000_000, dtype=np.int64)
    measured = sim_imu.measure(path, imu_t, 0, ImuCalibration(), seed)
    buffer = SampleBuffer(100.0, 0.5)
    buffer.push(ImuBatch(measured.t_ns, measured.gyro, measured.accel))
    truth = path.motion(t_ns * 1e-9).T_w_b
    cloud = truth[:, :3, 3].mean(axis=0) + rng.uniform(-5.0, 5.0, (400, 3))
    xy, seen = np.zeros((KEYFRAMES, len(cloud), 2)), np.zeros((KEYFRAMES, len(cloud)), np.bool_)
    for k, stamp_ns in enumerate(t_ns):
        after_s = np.zeros(len(cloud))
        for _ in range(4):  # until each landmark's row is the one that is exposed then
            T_w_c = path.motion(stamp_ns * 1e-9 + after_s).T_w_b @ T_B_C
            p = np.einsum("nji,nj->ni", T_w_c[:, :3, :3], cloud - T_w_c[:, :3, 3])
            shown = p[:, :2] / np.maximum(p[:, 2:], 1e-3)
            after_s = np.clip(shown[:, 1] * CAMERA.fy, -225.0, 225.0) * row_s
        seen[k] = (p[:, 2] > 0.4) & (np.abs(shown) < np.array([0.8, 0.5])).all(axis=1)
        xy[k] = shown + 0.3 / CAMERA.fx * rng.normal(size=shown.shape)
    corners = CornerObservations(xy, seen, np.arange(len(cloud)))
    corners = corners.part(np.flatnonzero(seen.sum(axis=0) >= 3)[:120])
    samples = WindowSamples(buffer, lambda s: s, [int(t) for t in t_ns], 0.0)
    still = RollingShutter(CAMERA, READOUT_S, CAMERA.height, None, np.zeros(6))
    return corners, samples, RollingRows(1e-9 * (t_ns - t_ns[0]), samples.rates(0.0), still), truth


def bundle(corners: CornerObservations, samples: WindowSamples, rows: RollingRows | None) -> InertialBundle:
    prior = BiasPrior(np.zeros(6), np.repeat([0.1, 0.2], 3))
    config = replace(InertialBundleConfig(), sigma_px=0.5)
    return InertialBundle(corners, samples.at, ImuCalibration(), T_B_C, CAMERA.fx, 9.81, prior, config, rows=rows)


def measured(readout: WindowReadout, seed: int, row_s: float, lens: F64 | None = None) -> tuple[float, float] | None:
    """What a window gives that is solved as if every row were taken at the stamp."""
    corners, samples, rows, _ = window(seed, row_s)
    if lens is not None:
        corners = replace(corners, xy=moved(corners.xy, lens))
    solver = bundle(corners, samples, None)
    found = solver.solve()
    assert found is not None
    measuring = readout.measuring(solver, found, lambda r: bundle(corners, samples, r), rows.with_readout(0.0), 0.5)
    with np.errstate(all="ignore"):
        return finished(measuring)


def length(p: F64) -> float:
    return float(np.linalg.norm(p - p.mean(axis=0)))


def test_a_window_of_rows_is_as_good_as_their_pixels() -> None:
    """From nothing: without rows' times corners are off by pixels, and lengths with them."""
    told, untold = [], []
    for seed in range(4):
        corners, samples, rows, truth = window(seed)
        for found, off in (
            (bundle(corners, samples, rows).solve(), told),
            (bundle(corners, samples, None).solve(), untold),
        ):
            assert found is not None
            off.append((abs(np.log(length(found.state.p) / length(truth[:, :3, 3]))), found.reprojection_px))
    scale, reprojection_px = np.array(told).T
    assert reprojection_px.max() < 0.3 * np.sqrt(2.0) * 1.1
    assert np.median(np.array(untold)[:, 1]) > 1.2 * np.median(reprojection_px)
    assert scale.max() < 0.02


def test_the_rate_at_a_stamp_is_that_of_the_path() -> None:
    _, samples, rows, _ = window(2)
    path, t_s = path_of(2), 0.5 + 0.25 * np.arange(KEYFRAMES)
    turned = [se3.so3_log(a[:3, :3].T @ b[:3, :3]) for a, b in
              zip(path.motion(t_s - 0.01).T_w_b, path.motion(t_s + 0.01).T_w_b, strict=True)]  # fmt: skip
    assert rows.rate == pytest.approx(np.array(turned) / 0.02, abs=0.03)  # the gyro's bias and noise
    assert np.isnan(samples.rates(-9.0)).all()


def test_shifts_are_those_of_a_camera_that_goes_on() -> None:
    rng, twist = np.random.default_rng(4), np.array([0.8, -0.5, 0.9, 0.6, -0.7, 0.5])
    xy, rho = rng.uniform(-0.5, 0.5, (1, 60, 2)), rng.uniform(0.1, 1.0, (1, 60))
    dt_s = rng.uniform(-0.015, 0.015, (1, 60))
    seen = np.append(xy[0], np.ones((60, 1)), axis=1) / rho[0, :, None]
    later = np.array(
        [se3.transform(se3.inverse(se3.exp(t * twist)), p[None])[0] for t, p in zip(dt_s[0], seen, strict=True)]
    )
    assert shifts(xy, rho, twist[None], dt_s)[0] == pytest.approx(later[:, :2] / later[:, 2:] - xy[0], abs=3e-4)


def test_samples_are_corrected_before_rates_are_taken() -> None:
    _, samples, rows, _ = window(0)
    twice = WindowSamples(samples._buffer, lambda s: Samples(s.t_s, 2.0 * s.gyro, s.accel), samples._stamps_ns, 0.0)
    assert twice.rates(0.0) == pytest.approx(2.0 * rows.rate)


@pytest.mark.parametrize("sign", [1.0, -1.0])  # -1: rows are read from the bottom up
def test_two_windows_in_turn_tell_a_read_out(sign: float) -> None:
    readout = WindowReadout()
    assert measured(readout, 0, sign * ROW_S) is None  # one alone is not believed
    told = measured(readout, 1, sign * ROW_S)
    assert told is not None
    assert told[0] == pytest.approx(sign * READOUT_S, abs=0.004)
    assert 0.0 < told[1] < 0.2 * READOUT_S


def test_windows_that_disagree_tell_none() -> None:
    readout = WindowReadout()
    measured(readout, 0, ROW_S)
    assert measured(readout, 1, -ROW_S) is None
    measured(readout, 0, ROW_S)
    readout.clear()
    assert measured(readout, 1, ROW_S) is None


@pytest.mark.parametrize("lens", [None, np.array([0.003, 0.001, -0.001, -0.004, 0.003, -0.002, 0.002, 0.001])])
def test_windows_of_a_global_shutter_tell_none(lens: F64 | None) -> None:
    readout = WindowReadout()
    assert all(measured(readout, seed, 0.0, lens) is None for seed in range(6))
