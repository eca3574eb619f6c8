"""Paths, and inertial samples that are consistent with them."""

from pathlib import Path as FilePath

import numpy as np
import pytest

from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.sensors.imu import measure
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.world.built_in_paths import built_in_path
from kiteline_hw.sim.world.path import GRAVITY, Path
from kiteline_hw.sim.world.path_fit import fit, read_trajectory
from kiteline_hw.sim.world.scenes import SCENES

T_B_C = make_rig().T_b_c


def integrate(path: Path, seconds: float, rate_hz: int) -> tuple[np.ndarray, np.ndarray]:
    """Dead reckoning from noiseless samples, midpoint rule: final pose and the true one."""
    t_ns = (np.arange(int(seconds * rate_hz) + 1) * (1_000_000_000 // rate_hz)).astype(np.int64)
    batch = measure(path, t_ns, 0, ImuCalibration(), 0, noise=False)
    start = path.motion(np.array([0.0]))
    r, p, v = start.T_w_b[0, :3, :3], start.T_w_b[0, :3, 3], start.velocity[0]
    dt = 1.0 / rate_hz
    for k in range(len(t_ns) - 1):
        r_next = r @ se3.so3_exp(0.5 * (batch.gyro[k] + batch.gyro[k + 1]) * dt)
        a = 0.5 * (r @ batch.accel[k] + r_next @ batch.accel[k + 1]) - [0.0, 0.0, GRAVITY]
        p, v, r = p + v * dt + 0.5 * a * dt * dt, v + a * dt, r_next
    return se3.from_rt(r, p), path.motion(np.array([seconds])).T_w_b[0]


@pytest.mark.parametrize("scene", SCENES)
def test_imu_samples_integrate_to_the_path(scene: str) -> None:
    found, true = integrate(built_in_path(scene, 6.0, T_B_C), 5.0, 1000)
    error = se3.log(se3.inverse(true) @ found)
    assert np.linalg.norm(error[:3]) < 0.003
    assert np.linalg.norm(error[3:]) < 2e-4


def test_real_drone_motion_integrates_too(data_dir: FilePath) -> None:
    path = read_trajectory(data_dir / "trajectories" / "V1_02_medium.txt", T_B_C)
    found, true = integrate(Path(path.coefficients, path.knot_s, path.length_s, 20.0, 0.0), 3.0, 1000)
    error = se3.log(se3.inverse(true) @ found)
    assert np.linalg.norm(error[:3]) < 0.005
    assert np.linalg.norm(error[3:]) < 5e-4


def test_at_rest_the_imu_measures_gravity() -> None:
    path = built_in_path("room", 5.0, T_B_C)
    t_ns = np.arange(0, 950_000_000, 5_000_000)
    batch = measure(path, t_ns, 0, ImuCalibration(), 0, noise=False)
    assert np.abs(batch.gyro).max() < 1e-12
    up = path.motion(np.array([0.0])).T_w_b[0, :3, :3].T @ [0.0, 0.0, 1.0]
    assert np.allclose(batch.accel, GRAVITY * up, atol=1e-9)
    assert up[0] > 0.9, "this body has x up, as EuRoC's"


def test_noise_and_bias_have_the_stated_densities() -> None:
    path = built_in_path("room", 41.0, T_B_C)
    t_ns = np.arange(0, 40_000_000_000, 5_000_000)
    calibration = ImuCalibration()
    clean = measure(path, t_ns, 0, calibration, 5, noise=False)
    noisy = measure(path, t_ns, 0, calibration, 5)
    error = noisy.gyro - clean.gyro
    assert np.diff(error, axis=0).std() / np.sqrt(2) == pytest.approx(calibration.gyro_noise * np.sqrt(200), rel=0.05)
    error = noisy.accel - clean.accel
    assert np.diff(error, axis=0).std() / np.sqrt(2) == pytest.approx(calibration.accel_noise * np.sqrt(200), rel=0.05)
    assert 0.001 < np.abs(error.mean(0)).max() < 0.3, "a bias is there, and of a sane size"
    short = measure(path, t_ns[:500], 0, calibration, 5)
    assert np.array_equal(short.gyro, noisy.gyro[:500])


def test_a_path_starts_at_rest_and_reaches_the_speed_of_its_source() -> None:
    t = np.arange(0.0, 8.0, 0.05)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, 0, 3] = 1.5 * t
    path = fit(t, poses, 0.2, 1e-3)
    motion = path.motion(np.array([0.0, 0.9, 4.0]))
    assert np.allclose(motion.velocity, [[0, 0, 0], [0, 0, 0], [1.5, 0, 0]], atol=1e-6)
    assert path.motion(np.array([path.duration_s])).T_w_b[0, 0, 3] == pytest.approx(1.5 * t[-1], abs=1e-6)


def test_fit_follows_its_data(data_dir: FilePath) -> None:
    file = data_dir / "trajectories" / "V1_02_medium.txt"
    rows = np.loadtxt(file)
    path = read_trajectory(file, T_B_C)
    still = Path(path.coefficients, path.knot_s, path.length_s, 0.0, 0.0)
    motion = still.motion(rows[:, 0] - rows[0, 0])
    assert np.linalg.norm(motion.T_w_b[:, :3, 3] - rows[:, 1:4], axis=1).max() < 0.01
    angles = [
        np.linalg.norm(se3.so3_log(se3.rotation_from_quaternion(q[[3, 0, 1, 2]]).T @ t[:3, :3]))
        for q, t in zip(rows[::50, 4:], motion.T_w_b[::50], strict=True)
    ]
    assert max(angles) < 0.02


def test_kitti_poses_are_gravity_aligned(data_dir: FilePath) -> None:
    path = read_trajectory(data_dir / "trajectories" / "KITTI_06.txt", T_B_C)
    rows = np.loadtxt(data_dir / "trajectories" / "KITTI_06.txt").reshape(-1, 3, 4)
    t_w_c = path.motion(np.array([30.0])).T_w_b[0] @ T_B_C
    assert (t_w_c[:3, :3] @ [0.0, -1.0, 0.0])[2] > 0.98, "the camera's up is the world's"
    p = path.positions(1.0)
    assert np.ptp(p[:, 2]) == pytest.approx(np.ptp(rows[:, 1, 3]), abs=0.3)
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).sum() == pytest.approx(1230, rel=0.03)
    speed = np.linalg.norm(path.motion(np.arange(5.0, 100.0, 0.1)).acceleration, axis=1)
    assert np.median(speed) < 2.0, "a car, not a shaker"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected at least 10"),
        ("1 2 3\n" * 20, "3 numbers"),
        ("not a number\n", "no table of numbers"),
        ("0 0 0 0 0 0 0 1\n" * 20, "increase"),
        ("nan 0 0 0 0 0 0 1\n" * 20, "finite"),
    ],
)
def test_invalid_trajectories_raise(tmp_path: FilePath, text: str, words: str) -> None:
    file = tmp_path / "t.txt"
    file.write_text(text)
    with pytest.raises(SourceError, match=words):
        read_trajectory(file, T_B_C)


def test_a_missing_trajectory_raises(tmp_path: FilePath) -> None:
    with pytest.raises(SourceError, match="cannot be read"):
        read_trajectory(tmp_path / "none.txt", T_B_C)
