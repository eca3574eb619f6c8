"""The agent's bars for odometry: it bridges image losses, gives a monocular map its metre, costs nothing where bad."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from kiteline_bench.harness import faults
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import SimulatedFlight
from kiteline_core.frame import OdometryBatch
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

_BLACK_S = 2.0
_BLACK_FROM_S = (6.0, 12.0, 18.0)
_STALE_NS = 200_000_000
_BAD_SECONDS = 20.0


def bars(bench: Bench, flights: Mapping[str, SimulatedFlight]) -> list[Bar]:
    """All of them. flights: by name."""
    out: list[Bar] = []
    for name, flight in flights.items():
        bench.say(f"flying {name} with odometry, with black images and monocular")
        good = flight.odometry()
        out += image_loss_bars(name, load(flight.recording).without_imu(), good)
        out += monocular_bars(name, load(flight.recording, mono=True).without_imu(), good)
    bench.say("flying with bad odometry")
    out += _bad_bars(flights)
    return out


def image_loss_bars(name: str, recording: Recording, good: OdometryBatch) -> list[Bar]:
    """Two seconds of black at several moments, without an IMU: error of the odometry at their end."""
    with_odometry, without, late = [], [], 0
    for from_s in _BLACK_FROM_S:
        begin = round(from_s * 1e9 / recording.period_ns)
        end = begin + round(_BLACK_S * 1e9 / recording.period_ns)
        if end + 5 > len(recording.items):
            continue
        black = faults.changed(recording, begin, end, faults.black)
        run = fly_alone(black.with_odometry(good))
        with_odometry.append(run.drift_m(begin, end))
        without.append(fly_alone(black.with_odometry(None)).drift_m(begin, end))
        late = max(late, run.frames_until_tracked(end))
    worst, ratio = max(with_odometry), max(with_odometry) / max(without)
    return [
        at_most(f"{name}, {_BLACK_S:g} s of black, odometry and no IMU: off at the end, worst "
                f"(without odometry {max(without):.2f} m)", worst, 0.15, "m", 3),
        at_most(f"{name}, {_BLACK_S:g} s of black, odometry: relative to without", ratio, 0.25, "", 3),
        at_most(f"{name}, {_BLACK_S:g} s of black, odometry: frames from texture to a pose", late + 1, 3, "", 0),
    ]  # fmt: skip


def monocular_bars(name: str, recording: Recording, good: OdometryBatch) -> list[Bar]:
    """Left camera and odometer, without an IMU: lengths in metres."""
    run = fly_alone(recording.with_odometry(good))
    in_metres = {t for t, metric in zip(run.t_ns, run.metric, strict=True) if metric}
    metric = [e for e in run.found if e.tracked and e.t_ns in in_metres]
    first_ns = metric[0].t_ns if metric else run.t_ns[-1]
    found = run.evaluate(metric, TrajectoryAlignment.SIM3, "o")  # corrections of the scale begin new submaps
    off_percent = float("inf") if found is None else 100.0 * abs(1.0 / found.scale - 1.0)
    return [
        at_most(f"{name}, monocular and odometry: scale off by", off_percent, 5.0, "%", 1),
        at_most(f"{name}, monocular and odometry: metres after", (first_ns - run.t_ns[0]) * 1e-9, 15.0, "s", 1),
    ]


# bad odometry


def _zero(flight: SimulatedFlight) -> OdometryBatch:
    good = flight.odometry()
    return replace(good, velocity=np.zeros_like(good.velocity), rate=np.zeros_like(good.rate))


def _wrong_axes(flight: SimulatedFlight) -> OdometryBatch:
    """Forward, right, down in place of forward, left, up: two of three axes point the other way."""
    good, flip = flight.odometry(), np.array([1.0, -1.0, -1.0])
    return replace(good, velocity=good.velocity * flip, rate=good.rate * flip)


def _stale(flight: SimulatedFlight) -> OdometryBatch:
    good = flight.odometry()
    return replace(good, t_ns=good.t_ns + _STALE_NS)


BAD: dict[str, Callable[[SimulatedFlight], OdometryBatch]] = {
    "5 % off": lambda flight: flight.odometry(odometry_scale=1.05),
    "slips": lambda flight: flight.odometry(odometry_slip=0.25),
    "dead": _zero,
    "wrong axes": _wrong_axes,
    "0.2 s late": _stale,
    "noisy": lambda flight: flight.odometry(odometry_noise=0.5),
}


def _bad_bars(flights: Mapping[str, SimulatedFlight]) -> list[Bar]:
    """Accuracy with bad odometry over that without, all flights together: of one flight 10 % are chance."""
    out = []
    for imu in (True, False):
        recordings = {}
        for name, flight in flights.items():
            recording = load(flight.recording).seconds(0.0, _BAD_SECONDS)
            recordings[name] = recording if imu else recording.without_imu()
        plain = sum(_ate_m(recording.with_odometry(None)) for recording in recordings.values())
        ratios = {
            kind: sum(_ate_m(recording.with_odometry(spoil(flights[name]))) for name, recording in recordings.items())
            / plain
            for kind, spoil in BAD.items()
        }
        what = "IMU" if imu else "no IMU"
        listed = ", ".join(f"{kind} {ratio:.2f}" for kind, ratio in ratios.items())
        out.append(at_most(f"bad odometry, {what}: ATE relative to none ({listed})", max(ratios.values()), 1.1, "", 2))
    return out


def _ate_m(recording: Recording) -> float:
    """ATE of the odometry frame; infinite if half of the frames have no pose."""
    run = fly_alone(recording)
    posed = sum(e.T_m_b is not None for e in run.found)
    found = run.evaluate(run.found, frame="o")
    return float("inf") if found is None or posed < len(run.found) // 2 else found.ate_m.rmse
