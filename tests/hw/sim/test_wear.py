"""The worn rig: what is drawn is what the measurements show, and the calibration that is told stays the good one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.sensors import imu, wear
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import START_NS, SimSource, open_sim

SMALL: dict[str, Any] = {"scale": 0.2, "texture_bits": 7}
FACTOR = (0.7 - 1e-6, 1.3 + 1e-6)


def drawn(seed: int, *kinds: str) -> wear.WornRig:
    rig = make_rig()
    chosen = wear.selected(kinds or wear.KINDS, wear.WearConfig())
    return wear.draw(rig, rig, ImuCalibration(), seed, chosen)


def angle(T: np.ndarray) -> float:
    return float(np.linalg.norm(se3.so3_log(T[:3, :3])))


def test_magnitudes_are_the_nominal_ones_and_signs_are_random() -> None:
    nominal = wear.WearConfig()
    focal = []
    for seed in range(12):
        worn = drawn(seed)
        told, true = worn.told, worn.true
        assert told.right is not None and true.right is not None and told.T_c_r is not None and true.T_c_r is not None
        for a, b in ((told.left, true.left), (told.right, true.right)):
            focal.append(b.fx / a.fx - 1.0)
            assert FACTOR[0] <= abs(focal[-1]) / nominal.focal <= FACTOR[1]
            assert FACTOR[0] <= np.hypot(b.cx - a.cx, b.cy - a.cy) / nominal.centre_px <= FACTOR[1]
        assert FACTOR[0] <= angle(se3.inverse(told.T_b_c) @ true.T_b_c) / nominal.camera_imu_rad <= FACTOR[1]
        moved = se3.inverse(told.T_c_r) @ true.T_c_r
        assert FACTOR[0] <= angle(moved) / nominal.stereo_rad <= FACTOR[1]
        assert np.linalg.norm(moved[:3, 3]) == pytest.approx(nominal.stereo_m, rel=0.31)
        for axes in (worn.imu.accel_matrix, worn.imu.gyro_matrix):
            scale = np.linalg.norm(axes, axis=1)
            assert (np.abs(scale - 1.0) / nominal.imu_scale <= FACTOR[1]).all()
            tilt = np.arccos(np.diag(axes) / scale)
            assert (tilt / nominal.imu_misalignment_rad >= FACTOR[0]).all()
            assert (tilt / nominal.imu_misalignment_rad <= FACTOR[1]).all()
        assert FACTOR[0] <= worn.late_s / nominal.late_s <= FACTOR[1]
    assert min(focal) < 0.0 < max(focal)


def test_a_kind_that_is_left_out_changes_no_other() -> None:
    everything, some = drawn(3), drawn(3, "imu", "stamps")
    assert np.array_equal(everything.imu.accel_matrix, some.imu.accel_matrix) and everything.late_s == some.late_s
    assert (some.true.left, some.true.right) == (some.told.left, some.told.right)
    assert np.array_equal(some.true.T_b_c, some.told.T_b_c) and some.pair_loss == 0.0
    assert drawn(3).to_json() == everything.to_json() != drawn(4).to_json()


def samples(seconds: float, *kinds: str, **options: Any) -> tuple[SimSource, ImuBatch]:
    source = open_sim("room", seconds=seconds, rig="worn", wear=kinds, **(SMALL | options))
    return source, source.imu_samples()


def test_worn_axes_measure_what_their_matrices_say() -> None:
    source, worn = samples(6.0, "imu")
    calibration = ImuCalibration(rate_hz=200.0)
    plain = imu.measure(source.path, worn.t_ns, START_NS, calibration, 0)
    good = imu.measure(source.path, worn.t_ns, START_NS, calibration, 0, noise=False)
    w = source.worn.imu
    assert np.allclose(worn.gyro - plain.gyro, good.gyro @ (w.gyro_matrix - np.eye(3)).T, atol=1e-12)
    assert np.allclose(worn.accel - plain.accel, good.accel @ (w.accel_matrix - np.eye(3)).T, atol=1e-12)
    assert np.linalg.norm(worn.accel - plain.accel, axis=1).max() > 0.05


def test_vibration_has_its_deviation_in_flight_and_less_at_rest() -> None:
    source, shaken = samples(12.0, "vibration")
    calm = imu.measure(source.path, shaken.t_ns, START_NS, ImuCalibration(rate_hz=200.0), 0)
    shake = shaken.accel - calm.accel
    told = np.array(source.worn.to_json()["vibration_m_s2"])
    flying = (shaken.t_ns - START_NS) * 1e-9 > 2.5
    assert np.allclose(shake[flying].std(0), told, rtol=0.08)
    assert np.allclose(shake[: int(0.9 * 200)].std(0), 0.15 * told, rtol=0.25)


def test_saturation_clips_and_gaps_lose_samples() -> None:
    source, shaken = samples(8.0, "range", "vibration")
    assert (source.worn.imu.accel_range, source.worn.imu.gyro_range) == (19.6, 4.36)
    assert np.abs(shaken.accel).max() > 12.0 and np.abs(shaken.gyro).max() > 0.4
    narrow = replace(source.worn.imu, accel_range=12.0, gyro_range=0.4)
    calibration = ImuCalibration(rate_hz=200.0)
    clipped = imu.measure(source.path, shaken.t_ns, START_NS, calibration, 0, wear=narrow)
    assert np.abs(clipped.accel).max() == 12.0 and np.abs(clipped.gyro).max() == 0.4
    _, whole = samples(40.0, "noise")
    _, holed = samples(40.0, "noise", "gaps")
    lost = 1.0 - len(holed.t_ns) / len(whole.t_ns)
    assert 0.002 < lost < 0.03 and np.diff(holed.t_ns).max() >= 4 * 5_000_000
    assert np.isin(holed.t_ns, whole.t_ns).all()


def test_noise_is_not_the_told_one() -> None:
    source, noisy = samples(1.0, "noise")
    assert 1.4 <= source.worn.imu.noise.gyro_noise / source.imu.gyro_noise <= 2.6
    assert 2.1 <= source.worn.imu.noise.accel_walk / source.imu.accel_walk <= 3.9
    still = noisy.gyro[:180]  # at rest
    drawn_std = source.worn.imu.noise.gyro_noise * np.sqrt(200.0)
    assert np.allclose(np.diff(still, axis=0).std(0) / np.sqrt(2.0), drawn_std, rtol=0.25)


def test_frames_are_stamped_late_with_jitter_and_the_truth_is_that_of_their_exposure() -> None:
    source, _ = samples(10.0, "stamps")
    truth, clean = source.ground_truth, open_sim("room", seconds=10.0, **SMALL).ground_truth
    late_s = (truth.t_ns - clean.t_ns) * 1e-9
    assert late_s.mean() == pytest.approx(source.worn.late_s, abs=1e-4)
    assert late_s.std() == pytest.approx(source.worn.jitter_s, rel=0.3)
    assert (np.diff(truth.t_ns) > 0).all() and np.array_equal(truth.T_w_b, clean.T_w_b)


def test_right_images_get_lost_and_samples_come_in_order() -> None:
    source = open_sim("room", seconds=4.0, rig="worn", rig_seed=2, **SMALL)
    items = list(source)
    frames = [item for item in items if isinstance(item, Frame)]
    assert 1 <= sum(frame.right is None for frame in frames) <= 8
    last = 0
    for item in items:
        stamps = item.t_ns if isinstance(item, ImuBatch) else np.array([item.t_ns])  # type: ignore[union-attr]
        assert len(stamps) and stamps[0] >= last
        last = int(stamps[-1])


def test_a_worn_rig_tells_the_calibration_of_a_true_one() -> None:
    worn, true = open_sim("room", rig="worn", seconds=0.5, **SMALL), open_sim("room", seconds=0.5, **SMALL)
    assert worn.rig.left == true.rig.left and worn.imu == true.imu
    assert worn.worn.true.left != true.worn.true.left
    assert not np.array_equal(worn.render(3, worn.cameras()).left, true.render(3, true.cameras()).left)


@pytest.mark.parametrize("text", ["room?rig=old", "room?rig=worn&wear=rust"])
def test_unknown_wear_is_named(text: str) -> None:
    with pytest.raises(SourceError, match=r"unknown (rig|wear)"):
        open_sim(text, texture_bits=6)


@pytest.mark.parametrize("text", ["room?wear=lens", "room?rig_seed=3"])
def test_wear_of_a_true_rig_is_refused(text: str) -> None:
    with pytest.raises(SourceError, match="worn rig"):
        open_sim(text, texture_bits=6)


@pytest.mark.parametrize("text", ["room?start=nan", "room?seconds=inf", "room?read_noise=nan"])
def test_numbers_that_are_not_finite_are_refused(text: str) -> None:
    with pytest.raises(SourceError, match="finite"):
        open_sim(text, texture_bits=6)
