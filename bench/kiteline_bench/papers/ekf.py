"""`kiteline bench papers/ekf`: the Kalman filter's landmarks, trajectory, honesty and cost, beside its paper."""

import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.agent.consistency import nees_band
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, run_command
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_bench.papers.initialisation import Outcome, Setting, compare
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

TITLE = "The Kalman filter and its paper"

RUNS = 50
_FEWER = 10  # runs of each kind of sensor that errs otherwise than the filter believes
_FULL = 290  # landmarks from which the state counts as full
_THIRD = 1.0 / 3.0


@dataclass(frozen=True, slots=True)
class Flown:
    """A run: RMSE of the position in m, by the filter and by odometry alone; NEES, mean over frames and at the end."""

    rmse_m: float
    odometry_m: float
    odometry_end_m: float
    nees: float
    final_nees: float
    full_ms: float  # CPU of a frame with a full state, mean; nan without such frames


def filter_config(model: vehicle.VehicleModel) -> EkfConfig:
    """A configuration that knows the noise of a model, but none of its faults. Errors of its pixels are white."""
    return EkfConfig(sigma_px=model.sigma_px, scale_sigma=model.scale_sigma, walk_px=0.0)


def fly(model: vehicle.VehicleModel, seed: int, config: EkfConfig | None = None) -> Flown:
    """One lap of the loop."""
    cam = vehicle.camera()
    T_c_b = se3.inverse(cam.T_b_c)
    slam = EkfSlam(cam, config or filter_config(model))
    rows = np.array([0, 1, 5] if model.planar else range(6))
    T_o_b, errors, odometry, nees, full = np.eye(4), [], [], [], []
    for frame in vehicle.flight(model, seed):
        is_full = int(slam.state.used.sum()) >= _FULL
        begin = time.process_time_ns()
        if frame.motion is not None:
            slam.predict(frame.motion)
        slam.update(frame.ids, frame.uv)
        if is_full:
            full.append((time.process_time_ns() - begin) * 1e-6)
        T_o_b = T_o_b @ frame.T_b0_b1
        error = pose_error(slam.state.T_o_c @ T_c_b, frame.T_o_b)
        errors.append(error[:3] @ error[:3])
        odometry.append(float(np.sum((T_o_b[:3, 3] - frame.T_o_b[:3, 3]) ** 2)))
        if frame.motion is not None:
            cov = slam.state.pose_covariance(T_c_b)[np.ix_(rows, rows)]
            nees.append(float(error[rows] @ np.linalg.solve(cov, error[rows])))
    return Flown(
        float(np.sqrt(np.mean(errors))), float(np.sqrt(np.mean(odometry))), float(np.sqrt(odometry[-1])),
        float(np.mean(nees)), nees[-1], float(np.mean(full)) if full else float("nan"),
    )  # fmt: skip


def pose_error(found: F64, true: F64) -> F64:
    """Error (6,) of a body pose: translation in o, rotation about the body's axes."""
    return np.concatenate([found[:3, 3] - true[:3, 3], se3.so3_log(true[:3, :3].T @ found[:3, :3])])


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    bars = _landmark_bars(bench)
    full_ms: list[float] = []
    for planar, name in ((True, "ground robot"), (False, "drone")):
        bars += _vehicle_bars(bench, name, vehicle.VehicleModel(planar), full_ms)
    bars.append(at_most("300 landmarks: CPU of a frame of the filter, mean", float(np.nanmean(full_ms)), 4.0, "ms", 2))
    bars.append(_memory_bar())
    return bars


def _landmark_bars(bench: Bench) -> list[Bar]:
    """Positions by rays against those by particles."""
    outcomes = []
    for planar, name in ((True, "ground robot"), (False, "drone")):
        for odometry in (False, True):
            bench.say(f"positioning landmarks of a {name}")
            outcomes += [
                compare(Setting(f"{name}, 3 to 9 m", planar, 3.0, 9.0, 2.5, 10.0, odometry)),
                compare(Setting(f"{name}, 50 m", planar, 50.0, 50.0, 12.0, 60.0, odometry)),
                compare(Setting(f"{name}, 50 m", planar, 50.0, 50.0, 12.0, 10.0, odometry)),
            ]
    bars = [_landmark_bar(o) for o in outcomes]
    ratio = min(o.particles_us / o.rays_us for o in outcomes)
    bars.append(is_true("CPU of 100 particles over that of rays, least", ">= 10", ratio >= 10.0, f"{ratio:.1f}"))
    bench.more.append(_landmark_table(outcomes))
    return bars


def _landmark_bar(o: Outcome) -> Bar:
    """Error by rays over that of particles, and the least that an unbiased estimator reaches."""
    ratio, least = o.rays_m / o.particles_m, o.bound_m / o.particles_m
    name = f"{o.setting.name}, {_poses(o)}, particles to {o.setting.range_m:g} m: error by rays over theirs"
    return is_true(name, f"<= {_THIRD:.2f}", ratio <= _THIRD, f"{ratio:.2f} (the bound: {least:.2f})")


def _poses(outcome: Outcome) -> str:
    return "poses by odometry" if outcome.setting.odometry else "poses known"


def _landmark_table(outcomes: list[Outcome]) -> str:
    lines = [
        "| landmark | poses | way | particles to | by rays | by 100 particles | Cramer-Rao bound | CPU |",
        "|---|---|---|---|---|---|---|---|",
        '| the paper\'s, up to 10 m | by encoders | 9 frames | 10 m | 0.14 m | 0.52 m | - | "faster" |',
    ]
    for o in outcomes:
        s = o.setting
        lines.append(
            f"| {s.name} | {'odometry' if s.odometry else 'known'} | {s.way_m:g} m | {s.range_m:g} m "
            f"| {o.rays_m:.3f} m | {o.particles_m:.3f} m | {o.bound_m:.3f} m "
            f"| {o.rays_us:.1f} and {o.particles_us:.1f} us |"
        )
    return "\n".join(lines)


def _vehicle_bars(bench: Bench, name: str, model: vehicle.VehicleModel, full_ms: list[float]) -> list[Bar]:
    """A vehicle on a loop of 60 m: on data of the filter's own model, then with what it does not model."""
    runs, degrees = min(bench.starts or RUNS, RUNS), 3 if model.planar else 6
    bars = []
    for wrong in (0.0, 0.3):
        bench.say(f"{runs} laps of a {name}, {100 * wrong:g} % wrong matches")
        flown = [fly(replace(model, wrong=wrong), seed) for seed in range(runs)]
        full_ms += [f.full_ms for f in flown]
        what = f"{name}, {100 * wrong:g} % wrong matches" if wrong else name
        end = float(np.mean([f.odometry_end_m for f in flown]))
        mean, (low, high) = float(np.mean([f.nees for f in flown])), nees_band(runs, degrees)
        bars += [
            at_most(f"{what}: trajectory error over that of odometry (which ends {100 * end / vehicle.LOOP_M:.1f} % of "
                    "the way off)", _ratio(flown), 0.25, "", 3),
            is_true(f"{what}: mean NEES of {runs} runs", f"{low:.2f} to {high:.2f}", low <= mean <= high,
                    f"{mean:.2f} (at the ends {np.mean([f.final_nees for f in flown]):.2f})"),
        ]  # fmt: skip
    bench.more.append(_fault_table(bench, name, model, min(_FEWER, runs)))
    return bars


def _ratio(flown: list[Flown]) -> float:
    return sum(f.rmse_m for f in flown) / sum(f.odometry_m for f in flown)


def _fault_table(bench: Bench, name: str, model: vehicle.VehicleModel, runs: int) -> str:
    """What becomes of error and NEES where sensors err otherwise than the filter believes."""
    faults = {
        "scale 2 % off, 0.5 % believed": replace(model, scale_sigma=0.02),
        "wheels slip by 10 % for a sixth of the way": replace(model, slip=0.1),
        "turns off by 0.5 degrees a metre": replace(model, turn_bias=0.0087),
        "focal length 0.1 % off": replace(model, focal_error=0.001),
        "focal length 0.3 % off": replace(model, focal_error=0.003),
    }
    degrees = 3 if model.planar else 6
    lines = [f"| {name}, {runs} runs | error / odometry | NEES ({degrees} if honest) |", "|---|---|---|"]
    for fault, changed in faults.items():
        bench.say(f"{runs} laps of a {name}, {fault}")
        flown = [fly(changed, seed, filter_config(model)) for seed in range(runs)]
        lines.append(f"| {fault} | {_ratio(flown):.3f} | {np.mean([f.nees for f in flown]):.1f} |")
    return "\n".join(lines)


_ALONE = "from kiteline_bench.papers.ekf_process import main; main()"


def _memory_bar() -> Bar:
    """Memory of a process that runs the filter alone."""
    done = run_command([sys.executable, "-c", _ALONE], 300.0)
    mib = float(done.stdout) if done.returncode == 0 else float("inf")
    return at_most("a process with the filter at 300 landmarks: RSS", mib, 120.0, "MiB", 0)
