"""A worn rig is moved by hand as `kiteline calibrate imu` asks for: what it finds of the IMU, against the truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.sim.config import read_config
from kiteline_hw.sim.source import SimSource
from kiteline_lab.calibration import calibrate
from kiteline_lab.flights import simulate

SEEDS = (31, 32, 33)
_WEAR = ("lens", "extrinsics", "imu", "noise", "stamps")  # in a hand nothing vibrates
_SCENE = "room?scale=0.5"
_RATE_HZ = 50.0
_OFFSET_MS, _TURN_DEG, _GYRO_LEFT, _HONEST = 0.5, 0.25, 1.0 / 3.0, 2.0
_R_w_c = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x of w
_HEIGHT_M = 1.2
_REST_S = 1.5  # s that a simulated flight takes longer than its path: it rests and eases in first
# Begin and end in s, axis of the camera, amplitude in rad (of rests: the angle), Hz (0: a rest).
TURNS = ((1.0, 6.0, 0, 0.35, 0.6), (6.0, 11.0, 1, 0.4, 0.55), (11.0, 16.0, 2, 0.5, 0.55))
RESTS = ((22.0, 25.0, 2, 0.9, 0.0), (25.0, 28.0, 2, -0.9, 0.0), (28.0, 31.0, 0, 0.8, 0.0), (31.0, 34.0, 0, -0.8, 0.0))
SHAKES = ((16.0, 18.0, 0, 0.12, 0.9), (18.0, 20.0, 1, 0.12, 0.9), (20.0, 22.0, 2, 0.12, 0.9))  # amplitude in m
Moves = tuple[tuple[float, float, int, float, float], ...]


def run(bench: Bench) -> list[Bar]:
    """Calibrate several worn rigs; the worst of each."""
    found = [_calibrated(bench, seed) for seed in bench.chosen(SEEDS)]
    worst = {name: max(one[name] for one in found) for name in found[0]}
    left = ", ".join(f"{one['accel']:.2f}" for one in found)
    bench.more.append(f"Of the error of the accelerometer's axes is left: {left}.")
    name = "guided motion"
    return [
        at_most(f"{name}: time offset, error", worst["offset_ms"], _OFFSET_MS, "ms", 2),
        at_most(f"{name}: rotation of the camera against the IMU, error", worst["turn_deg"], _TURN_DEG, "degrees", 2),
        at_most(f"{name}: axes of the gyro, error that is left", worst["gyro"], _GYRO_LEFT, "", 2),
        at_most(f"{name}: errors of axes over their deviations, rms", worst["honest"], _HONEST, "", 2),
    ]


def _calibrated(bench: Bench, seed: int) -> dict[str, float]:
    bench.say(f"a worn rig is moved by hand, seed {seed}")
    folder = bench.folder / f"guided-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    flight = record(folder / "guided.mcap", seed, TURNS + RESTS, SHAKES)
    if calibrate.main(["imu", str(flight), "--rig", str(folder / "rig.toml")]):
        return dict.fromkeys(("offset_ms", "turn_deg", "gyro", "accel", "honest"), float("inf"))
    return errors(folder / "rig.toml", flight)


def record(out: Path, seed: int, turns: Moves, shakes: Moves, scene: str = _SCENE) -> Path:
    """Render such a motion, unless it is there."""
    if not out.exists():
        T_b_c = SimSource(read_config(scene, seed=seed, seconds=1.0)).rig.T_b_c
        path, seconds = out.with_suffix(".txt"), max(end for _, end, *_ in turns) + _REST_S
        np.savetxt(path, trajectory(T_b_c, turns, shakes), fmt="%.7f")
        simulate.main([scene, "--trajectory", str(path), "--seconds", f"{seconds:g}", "--seed", f"{seed}",
                       "--rig", "worn", "--wear", *_WEAR, "--force", "--out", str(out)])  # fmt: skip
    return out


def trajectory(T_b_c: F64, turns: Moves, shakes: Moves) -> F64:
    """Rows (n,8) of a TUM file: the body with T_b_c (4,4), whose camera is turned, then shaken, and held at angles."""
    t_s = np.arange(0.0, max(end for _, end, *_ in turns), 1.0 / _RATE_HZ)
    angles, shifts = np.zeros((len(t_s), 3)), np.zeros((len(t_s), 3))
    for out, moves in ((angles, turns), (shifts, shakes)):
        for begin, end, axis, size, rate_hz in moves:
            ease_s = 0.4 if rate_hz else 0.8
            wave = np.sin(2.0 * np.pi * rate_hz * (t_s - begin)) if rate_hz else 1.0
            out[:, axis] += _ease((t_s - begin) / ease_s) * _ease((end - t_s) / ease_s) * size * wave
    rows = []
    for t, (nod, pan, roll), shift in zip(t_s, angles, shifts, strict=True):
        R = _R_w_c @ se3.so3_exp(np.array([0, pan, 0])) @ se3.so3_exp(np.array([nod, 0, 0]))
        R = R @ se3.so3_exp(np.array([0, 0, roll]))
        T_w_b = se3.from_rt(R, _R_w_c @ shift + [0.0, 0.0, _HEIGHT_M]) @ se3.inverse(T_b_c)
        w, x, y, z = se3.quaternion_from_rotation(T_w_b[:3, :3])
        rows.append([t, *T_w_b[:3, 3], x, y, z, w])
    return np.array(rows)


def _ease(share: F64) -> F64:
    """From 0 to 1 with the shares from 0 to 1, smoothly."""
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


def errors(rig: Path, flight: Path) -> dict[str, float]:
    """What is wrong in a rig file. gyro, accel: over the error of the calibration told; honest: over deviations."""
    from kiteline_agent.runtime import rig_file

    known: KnownImuConfig = rig_file.load(str(rig)).imu
    truth: Any = json.loads(flight.with_suffix(".rig_truth.json").read_text())
    told, true = (np.reshape(truth[name]["T_b_c"], (4, 4))[:3, :3] for name in ("told", "true"))
    out, over = {"offset_ms": 1e3 * abs(known.offset_s[0] + truth["frame_stamps_late_s"])}, []
    for name, axes, sigma in (("gyro", known.gyro, known.gyro_sigma), ("accel", known.accel, known.accel_sigma)):
        wanted = told @ true.T @ np.linalg.inv(np.array(truth[f"{name}_matrix"]))  # in the body's axes by the camera
        if not axes:
            out[name] = 1.0
            continue
        error = np.reshape(axes, (3, 3)) - wanted
        out[name] = float(np.linalg.norm(error) / np.linalg.norm(wanted - np.eye(3)))
        over += (error.ravel() / np.array(sigma)).tolist()
        if name == "gyro":
            skew = 0.5 * (error - error.T)
            out["turn_deg"] = float(np.degrees(np.linalg.norm(skew) / np.sqrt(2.0)))
    return {**out, "honest": float(np.sqrt(np.mean(np.square(over))))}
