"""Flights that begin in motion, cameras that take few images a second, bad images, flickering light, faulty IMUs."""

from collections.abc import Callable

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.faults import (
    every_nth,
    flickering,
    hidden_at_times,
    late_samples,
    samples_in_bursts,
    scattered_stamps,
    smeared,
    some,
    torn,
    wall,
    without_samples,
    wrong_samples,
)
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_core.geometry import se3
from kiteline_lab.evaluation import metrics

FLIGHT = "room_flight.mcap"
STARTS_S = (3.0, 5.0, 7.0, 9.0, 11.0, 13.0, 15.0)  # of 22 s
_FIRST, _BEGIN_S, _SECONDS = 4, 3.0, 6.0  # index of the fifth frame; s that count as the begin, and s that are flown
_MOST_M, _MOST_DEG = 0.03, 2.0
STREET = "kitti_straight"  # 10 images a second, 1.2 m between two
_STREET_STEPS, _STREET_STARTS, _STREET_FRAMES = (1, 2, 3, 4), tuple(range(12)), 8  # every so many images of it
_ROOM_STEPS, _ROOM_STARTS_S = (2, 4), (0.0, 5.0)  # the same of FLIGHT, which has 20 a second
_STREET_M, _ROOM_M = 0.1, 0.02
_PLAIN, _SAMPLES = "as recorded", "0.3 s without IMU in every 5 s"
_LATE, _EARLY, _SCATTER = "IMU stamps 20 ms late", "IMU stamps 80 ms early", "camera stamps scatter by 2 ms"
_BURSTS = "IMU samples stamped in bursts of 16 ms"
_WRONG = "three IMU samples in a hundred wrong"
_OF_IMU, _BY_CHANCE = (_SAMPLES, _LATE, _EARLY, _BURSTS), (_WRONG, _SCATTER)  # those that need an IMU
_FAULTS: dict[str, Callable[[Recording, int], Recording]] = {
    _PLAIN: lambda recording, _: recording,
    "one image in ten blank": lambda recording, seed: some(recording, 0.1, wall, seed),
    "one image in twenty torn": lambda recording, seed: some(recording, 0.05, torn, seed),
    "one image in twenty smeared": lambda recording, seed: some(recording, 0.05, smeared, seed),
    "every image another exposure": lambda recording, seed: flickering(recording, 0.25, seed),
    "nine tenths of the view hidden, 0.4 s in every 2.5 s": lambda recording, seed: hidden_at_times(
        recording, 0.9, 2.5, 0.4, seed
    ),
    _SAMPLES: lambda recording, _: without_samples(recording, 5.0, 0.3),
    _LATE: lambda recording, _: late_samples(recording, 0.02),
    _EARLY: lambda recording, _: late_samples(recording, -0.08),
    _BURSTS: lambda recording, _: samples_in_bursts(recording, 0.016),
    _WRONG: lambda recording, seed: wrong_samples(recording, 0.01, seed),
    _SCATTER: lambda recording, seed: scattered_stamps(recording, 0.002, seed),
}  # exposures: by a factor whose logarithm has a deviation of a quarter
_SEEDS = (0, 1, 2)
_PART_S, _ONE_CAMERA = (5.0, 15.0), "euroc_mh01_air"  # s of FLIGHT; and a flight of one camera and an IMU
_ONE_CAMERA_S, _ONE_CAMERA_M = (0.0, 15.0), 0.15  # s of it, and 1.5 times the bar of its live path


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    return [*_in_motion(bench), *_slow_cameras(bench), *_faulty_sensors(bench)]


def _in_motion(bench: Bench) -> list[Bar]:
    """Largest errors of position and rotation in the first seconds, the path aligned as a whole."""
    recording = load(bench.source(FLIGHT))
    rows = []
    for start_s in bench.chosen(STARTS_S):
        part = recording.seconds(start_s, start_s + _SECONDS)
        joined = flown(bench, f"{FLIGHT} from {start_s:g} s", part)
        alone = flown(bench, "the same without a base", part, base=False)
        rows.append((start_s, *_begin(alone), *_begin(joined), _lost(joined)))
        bench.say("  begin: alone {:.3f} m {:.2f} deg, live {:.3f} m {:.2f} deg, lost {:.0f}".format(*rows[-1][1:]))
    columns = ("start s", "alone m", "degrees", "live m", "degrees", "frames without a pose after the fifth")
    table(bench, f"{FLIGHT}, largest error from the fifth frame until {_BEGIN_S:g} s", columns, rows)
    return [
        *spread("start in motion: live off from the fifth frame on", [row[3] for row in rows], _MOST_M, "m"),
        *spread("start in motion: live turned from the fifth frame on", [row[4] for row in rows], _MOST_DEG, "degrees",
                2),
        *spread("start in motion: frames without a pose after the fifth", [row[5] for row in rows], 0.0, "", 0),
    ]  # fmt: skip


def _slow_cameras(bench: Bench) -> list[Bar]:
    """Odometry of the tracker alone, without an IMU: before the second image nothing tells how fast the vehicle is."""
    street, room = load(bench.source(STREET)), load(bench.source(FLIGHT)).without_imu()
    rows: list[tuple[str, int, int, int, float, float]] = []
    for step in _STREET_STEPS:
        parts = [way.part(start, start + step * _STREET_FRAMES)
                 for way in (street, street.backward()) for start in bench.chosen(_STREET_STARTS)]  # fmt: skip
        rows.append((STREET, step, *_every(bench, STREET, parts, step)))
    for step in _ROOM_STEPS:
        parts = [room.seconds(start_s, 1e9) for start_s in bench.chosen(_ROOM_STARTS_S)]
        rows.append((f"{FLIGHT}, no IMU", step, *_every(bench, FLIGHT, parts, step)))
    table(bench, "Cameras that take few images", ("flight", "every so many images", "starts", "frames without a pose",
          "ATE of the odometry m, median", "worst"), rows)  # fmt: skip
    bars = []
    for name, images, limit in (
        (STREET, "every image to every 4th", _STREET_M), (f"{FLIGHT}, no IMU", "every 2nd and 4th image", _ROOM_M),
    ):  # fmt: skip
        own, what = [row for row in rows if row[0] == name], f"{name}, {images}"
        bars.append(at_most(f"{what}: frames without a pose", sum(row[3] for row in own), 0, "", 0))
        bars.append(at_most(f"{what}: ATE of the odometry, worst", max(row[5] for row in own), limit, "m"))
    return bars


def _faulty_sensors(bench: Bench) -> list[Bar]:
    """Odometry of the tracker alone where images are bad, light flickers, samples are missing, wrong or late.

    The flight of one camera has no error at all if its scale is never known: infinite.
    """
    street, room = load(bench.source(STREET)), load(bench.source(FLIGHT)).seconds(*_PART_S)
    air = load(bench.source(_ONE_CAMERA), mono=True)
    flights = (
        (STREET, (street, street.backward()), _STREET_M),
        (FLIGHT, (room,), _ROOM_M),
        (f"{FLIGHT}, no IMU", (room.without_imu(),), _ROOM_M),
        (_ONE_CAMERA, tuple(way.seconds(*_ONE_CAMERA_S) for way in (air, air.backward())), _ONE_CAMERA_M),
    )
    rows: list[tuple[str, str, int, int, float, float]] = []
    bars = []
    for name, ways, limit in flights:
        for fault, change in _FAULTS.items():
            if fault in (*_OF_IMU, *_BY_CHANCE) and ways[0].imu is None:
                continue
            seeds = (0,) if fault in (_PLAIN, *_OF_IMU) else bench.chosen(_SEEDS)
            found = [flown(bench, f"{name}, {fault}", change(way, seed), base=False) for way in ways for seed in seeds]
            waits = sum(e.initialising for flight in found for e in flight.run.found)
            errors = [flight.ate_m("odometry") for flight in found]
            rows.append((name, fault, len(found), waits // len(found), float(np.median(errors)), max(errors)))
            if fault != _PLAIN:
                bars.append(at_most(f"{name}, {fault}: ATE of the odometry, worst", max(errors), limit, "m"))
    table(bench, "Faulty sensors", ("flight", "fault", "flights", "frames before a map, mean",
          "ATE of the odometry m, median", "worst"), rows)  # fmt: skip
    return bars


def _every(bench: Bench, name: str, parts: list[Recording], step: int) -> tuple[int, int, float, float]:
    """Number of flights, frames without a pose, median and worst ATE of the odometry."""
    lost, errors = 0, []
    for part in parts:
        whole = len(part.items) // step * step
        flight = flown(
            bench, f"{name}, every {step}. image", every_nth(part.part(0, whole), 0, whole, step), base=False
        )
        lost += sum(not e.tracked for e in flight.run.found)
        errors.append(flight.ate_m("odometry"))
    return len(parts), lost, float(np.median(errors)), max(errors)


def _begin(flight: Flown) -> tuple[float, float]:
    """Largest errors in m and degrees of live poses between the fifth frame and the end of the begin."""
    found = flight.matched("live")
    if found is None:
        return float("inf"), float("inf")
    at = (found.t_ns >= flight.run.t_ns[_FIRST]) & (found.t_ns < flight.begin_ns + 1e9 * _BEGIN_S)
    if not at.any():
        return float("inf"), float("inf")
    turned = [np.linalg.norm(se3.so3_log(true[:3, :3].T @ ours[:3, :3]))
              for ours, true in zip(found.estimate[at], found.truth[at], strict=True)]  # fmt: skip
    return float(metrics.position_errors(found)[at].max()), float(np.degrees(max(turned)))


def _lost(flight: Flown) -> float:
    return float(sum(not e.tracked for e in flight.run.found[_FIRST:]))
