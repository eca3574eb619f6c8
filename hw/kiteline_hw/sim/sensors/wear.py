"""The wear of a rig: how cameras, IMU and stamps differ from the calibration that is told to an agent.

Each kind of wear is drawn from a seed of its own, so a kind that is left out changes none of the others. A magnitude is
the nominal one times 0.7 to 1.3; signs and directions are random.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs.rig_json import rig_to_json

Rng = np.random.Generator

KINDS = ("lens", "extrinsics", "imu", "vibration", "range", "noise", "stamps", "gaps", "pairs")
_SPREAD = (0.7, 1.3)  # factor on a nominal magnitude
_REFERENCE_WIDTH_PX = 752  # image width for which WearConfig gives lengths in px


@dataclass(frozen=True, slots=True)
class WearConfig:
    """Nominal magnitudes of the wear, by kind."""

    # lens
    focal: float = 0.002  # share of the focal length; a plastic mount over 20 to 30 kelvin
    centre_px: float = 0.8  # px at 752 px width; a lens that was turned in its thread, or a landing
    # extrinsics
    camera_imu_rad: float = 5.2e-3  # 0.3 degrees; cameras and IMU on separate boards of a frame that bends
    stereo_rad: float = 1.05e-3  # 0.06 degrees; torsion of the bar between the cameras
    stereo_m: float = 3e-4  # m; the same bar, a screw that was tightened again
    # imu
    imu_scale: float = 0.01  # share, each axis; data sheets of consumer IMUs give 1 to 3 %
    imu_misalignment_rad: float = 8.7e-3  # 0.5 degrees, each sensing axis; data sheets give 0.5 to 1 degree
    # vibration
    vibration_m_s2: float = 1.5  # m/s^2, standard deviation of each axis; small quadrotors with soft mounts
    vibration_rad_s: float = 0.02  # rad/s, likewise of the gyro
    vibration_at_rest: float = 0.15  # share of it while the motors idle before take-off
    # range
    accel_range_m_s2: float = 19.6  # 2 g: the range at power-on of common IMUs
    gyro_range_rad_s: float = 4.36  # 250 degrees/s, likewise
    # noise
    noise_factor: float = 2.0  # drawn noise density over the told one; data sheets are measured without a vehicle
    walk_factor: float = 3.0  # the same of the biases' random walks, which change with temperature
    # stamps
    late_s: float = 4e-3  # s; frames are stamped when they have been read out
    jitter_s: float = 4e-4  # s, standard deviation of a frame's stamp; a busy USB bus
    # gaps
    sample_loss: float = 0.005  # share of IMU samples that are lost singly
    gap_every_s: float = 10.0  # s, mean time between longer gaps; a bus that was blocked
    gap_s: float = 0.04  # s, their mean length
    # pairs
    pair_loss: float = 0.02  # share of frames whose right image is lost


NO_WEAR = WearConfig(
    focal=0.0, centre_px=0.0, camera_imu_rad=0.0, stereo_rad=0.0, stereo_m=0.0, imu_scale=0.0,
    imu_misalignment_rad=0.0, vibration_m_s2=0.0, vibration_rad_s=0.0, accel_range_m_s2=np.inf,
    gyro_range_rad_s=np.inf, noise_factor=1.0, walk_factor=1.0, late_s=0.0, jitter_s=0.0, sample_loss=0.0,
    gap_every_s=np.inf, gap_s=0.0, pair_loss=0.0,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tones:
    """A vibration as a sum of tones and white noise. frequency_hz, amplitude, phase (n, 3): of the three axes."""

    frequency_hz: F64
    amplitude: F64
    phase: F64
    white: float

    def at(self, t_s: F64) -> F64:
        """The tones (m, 3) at times (m,), without the noise. Rotors hunt by a few per cent around their speed."""
        hunting = 0.4 * np.sin(2 * np.pi * 0.7 * t_s)[:, None, None]
        angle = 2 * np.pi * self.frequency_hz * (t_s[:, None, None] + 0.05 * hunting) + self.phase
        return np.asarray((self.amplitude * np.sin(angle)).sum(1))


@dataclass(frozen=True, slots=True)
class ImuWear:
    """What an IMU does to its samples: gyro = gyro_matrix (3,3) @ true + bias + noise, likewise the accelerometer.

    noise: the densities that are drawn. accel_tones, gyro_tones: vibration in flight. ranges in m/s^2 and rad/s.
    sample_loss, gap_chance: a sample's, of a single loss and of the begin of a gap of about gap_samples.
    """

    accel_matrix: F64
    gyro_matrix: F64
    noise: ImuCalibration
    accel_tones: Tones
    gyro_tones: Tones
    vibration_at_rest: float
    accel_range: float
    gyro_range: float
    sample_loss: float
    gap_chance: float
    gap_samples: float


@dataclass(frozen=True, slots=True)
class WornRig:
    """The true rig for which `told` is the calibration. late_s: frame stamp minus the IMU's time of its exposure."""

    seed: int
    told: CameraRig
    true: CameraRig
    imu: ImuWear
    late_s: float
    jitter_s: float
    pair_loss: float

    def stamps(self, exposed_ns: I64) -> I64:
        """Stamps (n,) of frames exposed at these times (n,); they increase."""
        draws = np.random.default_rng([self.seed, 67]).standard_normal(len(exposed_ns))
        late = self.late_s + self.jitter_s * np.clip(draws, -3.0, 3.0)
        return np.asarray(exposed_ns + np.round(1e9 * late).astype(np.int64))

    def has_partner(self, frames: int) -> Bool:
        """Whether the right image of each frame (n,) arrives."""
        return np.asarray(np.random.default_rng([self.seed, 71]).random(frames) >= self.pair_loss)

    def to_json(self) -> dict[str, Any]:
        """What a calibration in flight should find: the told and the true rig, the IMU's errors, the time offset."""
        w = self.imu
        return {
            "seed": self.seed,
            "told": rig_to_json(self.told, None),
            "true": rig_to_json(self.true, w.noise),
            "accel_matrix": w.accel_matrix.tolist(),
            "gyro_matrix": w.gyro_matrix.tolist(),
            "vibration_m_s2": _deviation(w.accel_tones).tolist(),
            "vibration_rad_s": _deviation(w.gyro_tones).tolist(),
            "frame_stamps_late_s": self.late_s,
            "frame_stamps_jitter_s": self.jitter_s,
            "imu_samples_lost": w.sample_loss + w.gap_chance * w.gap_samples,
            "right_images_lost": self.pair_loss,
        }


def selected(kinds: Sequence[str], wear: WearConfig) -> WearConfig:
    """The wear of these KINDS alone."""
    names: dict[str, tuple[str, ...]] = {
        "lens": ("focal", "centre_px"),
        "extrinsics": ("camera_imu_rad", "stereo_rad", "stereo_m"),
        "imu": ("imu_scale", "imu_misalignment_rad"),
        "vibration": ("vibration_m_s2", "vibration_rad_s"),
        "range": ("accel_range_m_s2", "gyro_range_rad_s"),
        "noise": ("noise_factor", "walk_factor"),
        "stamps": ("late_s", "jitter_s"),
        "gaps": ("sample_loss", "gap_every_s", "gap_s"),
        "pairs": ("pair_loss",),
    }
    return replace(NO_WEAR, **{name: getattr(wear, name) for kind in kinds for name in names[kind]})


def draw(told: CameraRig, good: CameraRig, calibration: ImuCalibration, seed: int, wear: WearConfig) -> WornRig:
    """A worn rig. told: its calibration. good: the true rig before it was worn. calibration: the IMU's, as told."""
    rngs = {kind: np.random.default_rng([seed, 61, k]) for k, kind in enumerate(KINDS)}
    left, right, T_c_r = good.left, good.right, good.T_c_r
    sign = _sign(rngs["lens"])  # one temperature: both focal lengths grow or shrink; centres move each for itself
    left = _worn_lens(left, rngs["lens"], wear, sign)
    if right is not None:
        right = _worn_lens(right, rngs["lens"], wear, sign)
    rng = rngs["extrinsics"]
    T_b_c = good.T_b_c @ se3.exp(np.concatenate([np.zeros(3), _vector(rng, wear.camera_imu_rad)]))
    if T_c_r is not None:
        T_c_r = T_c_r @ se3.exp(np.concatenate([_vector(rng, wear.stereo_m), _vector(rng, wear.stereo_rad)]))
    rng = rngs["imu"]
    accel_matrix, gyro_matrix = (_worn_axes(rng, wear) for _ in range(2))
    rng = rngs["vibration"]
    accel_tones, gyro_tones = (_tones(rng, level) for level in (wear.vibration_m_s2, wear.vibration_rad_s))
    noise = _noise(rngs["noise"], calibration, wear)
    rng = rngs["gaps"]
    gap_samples = _amount(rng) * wear.gap_s * calibration.rate_hz
    gap_chance = 1.0 / (wear.gap_every_s * calibration.rate_hz)
    imu = ImuWear(
        accel_matrix, gyro_matrix, noise, accel_tones, gyro_tones, wear.vibration_at_rest, wear.accel_range_m_s2,
        wear.gyro_range_rad_s, _amount(rng) * wear.sample_loss, gap_chance, gap_samples,
    )  # fmt: skip
    true = replace(good, left=left, right=right, T_b_c=T_b_c, T_c_r=T_c_r)
    rng = rngs["stamps"]
    late_s, jitter_s = _amount(rng) * wear.late_s, _amount(rng) * wear.jitter_s
    return WornRig(seed, told, true, imu, late_s, jitter_s, _amount(rngs["pairs"]) * wear.pair_loss)


def _amount(rng: Rng) -> float:
    return float(rng.uniform(*_SPREAD))


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _vector(rng: Rng, length: float) -> F64:
    """A vector (3,) in a random direction."""
    direction = rng.standard_normal(3)
    return np.asarray(length * _amount(rng) * direction / np.linalg.norm(direction))


def _worn_lens(camera: CameraModel, rng: Rng, wear: WearConfig, sign: float) -> CameraModel:
    """A lens with a longer or shorter focal length (sign 1 or -1), and its centre moved in a random direction."""
    heading = rng.uniform(0.0, 2 * np.pi)
    focal = 1.0 + sign * wear.focal * _amount(rng)
    shift = wear.centre_px * _amount(rng) * camera.width / _REFERENCE_WIDTH_PX
    cx, cy = camera.cx + shift * np.cos(heading), camera.cy + shift * np.sin(heading)
    return replace(camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=float(cx), cy=float(cy))


def _worn_axes(rng: Rng, wear: WearConfig) -> F64:
    """Sensing axes (rows) with scale errors, each tilted in a random direction."""
    rows = np.eye(3)
    for k in range(3):
        scale = 1.0 + _sign(rng) * wear.imu_scale * _amount(rng)
        tilt, towards = wear.imu_misalignment_rad * _amount(rng), rng.uniform(0.0, 2 * np.pi)
        axis = np.zeros(3)
        axis[k] = np.cos(tilt)
        axis[(k + 1) % 3], axis[(k + 2) % 3] = np.sin(tilt) * np.cos(towards), np.sin(tilt) * np.sin(towards)
        rows[k] = scale * axis
    return rows


def _tones(rng: Rng, level: float) -> Tones:
    """Four rotors at 60 to 95 Hz, and as much power in white noise; level: standard deviation of each axis."""
    frequency = np.repeat(rng.uniform(60.0, 95.0, (4, 1)), 3, axis=1)
    weight = rng.uniform(0.5, 1.5, (4, 3))
    phase = rng.uniform(0.0, 2 * np.pi, (4, 3))
    level *= _amount(rng)
    amplitude = np.sqrt(0.5) * level * np.sqrt(2.0) * weight / np.linalg.norm(weight, axis=0)
    return Tones(frequency, amplitude, phase, float(np.sqrt(0.5) * level))


def _deviation(tones: Tones) -> F64:
    """Standard deviation (3,) of each axis."""
    return np.asarray(np.sqrt(0.5 * (tones.amplitude**2).sum(0) + tones.white**2))


def _noise(rng: Rng, told: ImuCalibration, wear: WearConfig) -> ImuCalibration:
    """The noise densities that are drawn; without wear the told ones."""
    factor = [1.0 + (nominal * _amount(rng) - 1.0) * (nominal != 1.0)
              for nominal in (wear.noise_factor, wear.walk_factor, wear.noise_factor, wear.walk_factor)]  # fmt: skip
    return replace(
        told, gyro_noise=factor[0] * told.gyro_noise, gyro_walk=factor[1] * told.gyro_walk,
        accel_noise=factor[2] * told.accel_noise, accel_walk=factor[3] * told.accel_walk,
    )  # fmt: skip
