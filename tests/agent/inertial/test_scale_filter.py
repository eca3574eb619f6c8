"""The scale of a monocular map, watched by displacements of images and IMU: its deviation is honest."""

import numpy as np
import pytest

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.scale_filter import _IMAGE_RAD, _IMU_INFLATION, _START_SCALE, MAP_WALK, ScaleFilter
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

CALIBRATION = ImuCalibration()
GRAVITY = np.array([0.0, 0.0, -9.81])
HZ, EVERY, SECONDS, DEPTH_M = 200.0, 80, 16.0, 4.0
CHI2_99_9_OF_24 = 51.2


def flown(seed: int, accel_noise: float, told: float) -> tuple[float, float, float]:
    """The filter's scale and deviation after a flight of 16 s, and the true scale. The map's own scale drifts."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS, 1.0 / HZ)
    p, a, v = (np.zeros((len(t), 3)) for _ in range(3))
    for axis in range(3):
        for _ in range(3):
            w, size, phase = 2 * np.pi / rng.uniform(3.0, 8.0), rng.uniform(0.2, 0.8), rng.uniform(0.0, 2 * np.pi)
            p[:, axis] += size * np.sin(w * t + phase)
            v[:, axis] += size * w * np.cos(w * t + phase)
            a[:, axis] -= size * w * w * np.sin(w * t + phase)
    density = accel_noise * _IMU_INFLATION * CALIBRATION.accel_noise
    walk = np.cumsum(0.01 / np.sqrt(HZ) * rng.standard_normal((len(t), 3)), axis=0)
    force = a - GRAVITY + 0.05 * rng.standard_normal(3) + walk + density * np.sqrt(HZ) * rng.standard_normal(a.shape)
    at = np.arange(0, len(t), EVERY)
    drift = MAP_WALK * np.sqrt(EVERY / HZ) * rng.standard_normal(len(at))
    units = np.exp(_START_SCALE * rng.standard_normal() + np.cumsum(drift))  # of the map, in a metre
    steps = np.diff(p[at], axis=0) * units[1:, None]
    seen = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    seen = seen + _IMAGE_RAD * DEPTH_M * rng.standard_normal(seen.shape)
    found = ScaleFilter(CALIBRATION, 9.81, np.zeros(3))
    off = (0.05 * rng.standard_normal(3), 0.05 * rng.standard_normal(3))
    found.start(v[0] + off[0], GRAVITY + off[1], np.zeros(6), told)
    for k in range(len(at) - 1):
        part = slice(at[k], at[k + 1] + 1)
        samples = Samples(t[part] - t[at[k]], np.zeros((EVERY + 1, 3)), force[part])
        poses = [se3.from_rt(np.eye(3), seen[i]) for i in (k, k + 1)]
        found.add(poses[0], poses[1], samples, np.zeros(3), DEPTH_M)
    scale, sigma = found.scale
    return scale, sigma, 1.0 / float(units[-1])


@pytest.mark.parametrize("accel_noise", [0.3, 1.0, 10.0])
def test_deviations_are_honest_whatever_the_rotors_do(accel_noise: float) -> None:
    found = np.array([flown(seed, accel_noise, accel_noise) for seed in range(24)])
    error = np.log(found[:, 0] / found[:, 2])
    assert np.sum((error * found[:, 0] / found[:, 1]) ** 2) < CHI2_99_9_OF_24
    assert np.sqrt(np.mean(error**2)) < (0.015 if accel_noise < 5.0 else 0.03)


def test_noise_that_the_start_found_is_used() -> None:
    """With ten times the noise that is told, deviations are too small."""
    told, untold = (np.array([flown(seed, 15.0, told) for seed in range(12)]) for told in (15.0, 1.0))
    ratio = [np.sqrt(np.mean((np.log(f[:, 0] / f[:, 2]) * f[:, 0] / f[:, 1]) ** 2)) for f in (told, untold)]
    assert ratio[0] < 0.7 * ratio[1]
