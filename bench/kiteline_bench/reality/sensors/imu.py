"""Stereo with the IMU of a real drone, and with IMUs that are not what the calibration says.

The real samples fly with pairs that are rendered along a spline through the drone's true poses, which is a few
millimetres off: that tells whether the IMU is believed, not what it gains. Wrong IMUs are those of `room_flight` with
the mistakes that users make. Calibrations that are off by what can be estimated in flight are told of both.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.simulated import render
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, Trajectory, joined
from kiteline_core.geometry import se3
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

_REAL, _PATH, _SEED, _SECONDS = "euroc_mh01_air", "MH_01_easy.txt", 61, 30.0
_STARTS_S = (0.0, 3.0, 6.0, 9.0, 12.0)
_REAL_SECONDS, _REAL_STARTS_S = 15.0, (0.0, 9.0)
_ROOM, _ROOM_SECONDS, _ROOM_STARTS_S = "room_flight.mcap", 10.0, (0.0, 4.0, 8.0)
_TIMES, _LEAST_M = 2.0, 0.02  # times the error of the images alone, or m, whichever is larger
_SECOND_NS = 1e9


def run(bench: Bench) -> list[Bar]:
    """Errors with the real IMU over those without one, and errors with wrong IMUs and calibrations."""
    recording, room = _with_real_imu(bench), load(bench.source(_ROOM))
    room_starts = [(s, s + _ROOM_SECONDS) for s in bench.chosen(_ROOM_STARTS_S)]
    real_starts = [(s, s + _REAL_SECONDS) for s in bench.chosen(_REAL_STARTS_S)]
    return [
        *_real(bench, recording),
        *_wrong(bench, "wrong IMU", f"Wrong IMUs, {_ROOM}", room, room_starts, _WRONG),
        *_wrong(bench, "wrong calibration", f"Wrong calibrations, {_ROOM}", room, room_starts, _CALIBRATIONS),
        *_wrong(bench, "wrong calibration of the real IMU", f"Wrong calibrations, real IMU of {_REAL}", recording,
                real_starts, _CALIBRATIONS),
    ]  # fmt: skip


# the real IMU


def _real(bench: Bench, recording: Recording) -> list[Bar]:
    rows = []
    for start_s in bench.chosen(_STARTS_S):
        part = recording.seconds(start_s, np.inf)
        alone = flown(bench, f"real IMU from {start_s:g} s, images alone", part.without_imu(), base=False)
        fused = flown(bench, "  with the IMU", part, base=False)
        rows.append((start_s, 1000.0 * alone.ate_m("live"), 1000.0 * fused.ate_m("live"), _left(fused)))
    table(bench, f"Real IMU of {_REAL}, pairs rendered along its path, ATE in mm",
          ("start s", "images alone", "with the IMU", "the IMU was left"), rows)  # fmt: skip
    return [at_most("real IMU: flights that leave it as wrong", sum(row[3] for row in rows), 0, "", 0)]


def _with_real_imu(bench: Bench) -> Recording:
    """Pairs rendered along the true path of the real flight, with its inertial samples."""
    samples = joined([item.imu for item in load(bench.source(_REAL), mono=True).items if item.imu is not None])
    assert samples is not None
    path = bench.source(f"trajectories/{_PATH}")
    begin_s = float(np.loadtxt(path, max_rows=1)[0])
    start_s = samples.t_ns[0] / _SECOND_NS - begin_s
    command = ["hall?rest=0", "--trajectory", path, "--start", f"{start_s:.6f}", "--seconds", f"{_SECONDS:g}", "--seed",
               f"{_SEED}"]  # fmt: skip
    rendered = load(str(render(bench, "real_imu_hall", command)[0]))
    shift_ns = rendered.items[0].frame.t_ns - round((begin_s + round(start_s, 6)) * _SECOND_NS)
    return rendered.with_imu(replace(samples, t_ns=samples.t_ns + shift_ns))


# wrong IMUs

_Change = Callable[[Recording], Recording]


def _wrong(
    bench: Bench, what: str, title: str, whole: Recording, parts: Sequence[tuple[float, float]],
    changes: Mapping[str, _Change],
) -> list[Bar]:  # fmt: skip
    """Errors of parts of a flight, from and to s, with what is changed in each. what: names the bars."""
    rows, over, kept = [], [], 0
    for start_s, end_s in parts:
        part = whole.seconds(start_s, end_s)
        alone_m = _camera_ate_m(flown(bench, f"{what} from {start_s:g} s, images alone", part.without_imu(),
                                      base=False), part, part)  # fmt: skip
        for name, change in changes.items():
            told = change(part)
            flight = flown(bench, f"  {name}", told, base=False)
            error_m = _camera_ate_m(flight, told, part)
            rows.append((start_s, name, 1000.0 * alone_m, 1000.0 * error_m, _left(flight)))
            over.append(error_m / max(_TIMES * alone_m, _LEAST_M))
            kept += not _left(flight)
    columns = ("start s", "what is wrong", "images alone", "with it", "the IMU was left")
    table(bench, f"{title}, ATE of the camera in mm", columns, rows)
    bench.more.append(f"{kept} of {len(rows)} flights keep such an IMU: calibrated in flight, or it did no harm.")
    return spread(f"{what}: ATE over the larger of {_TIMES:g} x images alone and {_LEAST_M:g} m", over, 1.0, "", 2)


def _left(flight: Flown) -> bool:
    """True if the agent left the IMU."""
    assert flight.box is not None
    return flight.box.motion_reports()["imu_calibration"] is None


def _camera_ate_m(flight: Flown, told: Recording, true: Recording) -> float:
    """ATE of the camera: the body of a wrong T_BS lies elsewhere."""
    truth = true.truth
    assert truth is not None
    poses = flight.poses("odometry")
    estimate = Trajectory(np.array([t for t, _ in poses], np.int64), np.array([T for _, T in poses]) @ told.rig.T_b_c)
    camera = replace(truth, T_w_b=truth.T_w_b @ true.rig.T_b_c)
    matched = metrics.match(estimate, camera, TrajectoryAlignment.SE3)
    return float(np.sqrt(np.mean(metrics.position_errors(matched) ** 2)))


def _turned(axis: int, degrees: float) -> _Change:
    """The camera is said to be turned in the axes of the IMU."""
    turn = se3.from_rt(se3.so3_exp(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))
    return lambda flight: _placed(flight, turn @ flight.rig.T_b_c)


def _moved(*metres: float) -> _Change:
    """The camera is said to be elsewhere in the axes of the IMU."""
    shift = se3.from_rt(np.eye(3), np.array(metres))
    return lambda flight: _placed(flight, shift @ flight.rig.T_b_c)


def _placed(flight: Recording, T_b_c: F64) -> Recording:
    return replace(flight, rig=replace(flight.rig, T_b_c=T_b_c))


def _measuring(gyro: F64, accel: F64, constant: F64) -> _Change:
    """Each axis of gyro and accelerometer times these (3,), and a constant (3,) m/s^2."""
    return lambda flight: _sampled(
        flight, lambda s: ImuBatch(s.t_ns, s.gyro * gyro, s.accel * accel + constant)
    )  # fmt: skip


def _sampled(flight: Recording, change: Callable[[ImuBatch], ImuBatch]) -> Recording:
    samples = joined([item.imu for item in flight.items if item.imu is not None])
    assert samples is not None
    return flight.with_imu(change(samples))


def _late(ms: int) -> _Change:
    return lambda flight: _sampled(flight, lambda s: replace(s, t_ns=s.t_ns + 1_000_000 * ms))


def _slow_clock(flight: Recording) -> Recording:
    first_ns = flight.items[0].frame.t_ns
    return _sampled(
        flight, lambda s: replace(s, t_ns=first_ns + np.asarray(1.2 * (s.t_ns - first_ns), np.int64))
    )  # fmt: skip


_ONE, _NONE = np.ones(3), np.zeros(3)
_WRONG: dict[str, _Change] = {
    "T_BS inverted": lambda flight: _placed(flight, se3.inverse(flight.rig.T_b_c)),
    "camera turned by 90 degrees": _turned(2, 90.0),
    "camera turned by 180 degrees": _turned(1, 180.0),
    "rates in degrees": _measuring(np.degrees(_ONE), _ONE, _NONE),
    "x of the gyro has the other sign": _measuring(np.array([-1.0, 1.0, 1.0]), _ONE, _NONE),
    "a dead gyro": _measuring(_NONE, _ONE, _NONE),
    "forces in g": _measuring(_ONE, _ONE / 9.81, _NONE),
    "forces of the other sign": _measuring(_ONE, -_ONE, _NONE),
    "an accelerometer that stands still": _measuring(_ONE, _NONE, np.array([9.81, 0.0, 0.0])),
    "an accelerometer that gives zeros": _measuring(_ONE, _NONE, _NONE),
    "samples 0.2 s early": _late(-200),
    "a clock that is a fifth too slow": _slow_clock,
}

_CALIBRATIONS: dict[str, _Change] = {
    "camera turned by 3 degrees": _turned(1, 3.0),
    "camera turned by 5 degrees": _turned(2, 5.0),
    "camera turned by 10 degrees": _turned(0, 10.0),
    "lever arm off by 0.3 m": _moved(0.3, 0.0, 0.0),
    "lever arm off by 0.5 m": _moved(0.0, -0.3, 0.4),
    "samples 50 ms late": _late(50),
    "samples 100 ms late": _late(100),
    "samples 100 ms early": _late(-100),
    "gyro 3 % too large": _measuring(1.03 * _ONE, _ONE, _NONE),
    "accelerometer 3 % too large": _measuring(_ONE, 1.03 * _ONE, _NONE),
    "turned by 6 degrees, 40 ms late, lever off by 0.2 m": lambda flight: _turned(1, 6.0)(
        _late(40)(_moved(0.0, 0.2, 0.0)(flight))
    ),
}
