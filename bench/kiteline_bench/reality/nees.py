"""Whether poses err as their covariance says: worn rigs in simulated flights, one camera and a real IMU."""

from pathlib import Path

import numpy as np

from kiteline_bench.agent.consistency import Counts, nees_bar, quality_bars
from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import random_flight
from kiteline_bench.reality.one_camera.euroc import FLIGHT

FLIGHTS = tuple(range(200, 230))  # numbers of random flights
REAL_STARTS_S = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0)  # of 35 s


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    return [*_worn(bench), *_one_camera(bench)]


def _one_camera(bench: Bench) -> list[Bar]:
    """A real flight forward and backward: errors grow with the distance from the start, by the scale."""
    recording, counts, rows = load(bench.source(FLIGHT), mono=True), Counts(), []
    for way, played in (("forward", recording), ("backward", recording.backward())):
        for start_s in bench.chosen(REAL_STARTS_S):
            errors = fly_alone(played.seconds(start_s, 1e9)).errors()
            counts.add(errors)
            largest = max(errors, key=lambda error: error.position_m)
            told_m = float(np.sqrt(np.trace(largest.estimate.cov_o[:3, :3])))
            rows.append((way, start_s, largest.position_m, told_m, min(e.estimate.quality for e in errors)))
            bench.say(f"{FLIGHT} {way} from {start_s:g} s: off by {largest.position_m:.2f} m, told {told_m:.2f} m")
    table(bench, f"{FLIGHT}, one camera with IMU",
          ("way", "start s", "largest error m", "its deviation m", "least quality"), rows)  # fmt: skip
    return quality_bars([counts], f"{FLIGHT}, one camera: ")


def _worn(bench: Bench) -> list[Bar]:
    """Flights with and without the IMU."""
    counts = {True: Counts(), False: Counts()}
    rows = []
    for number in bench.chosen(FLIGHTS):
        flight = random_flight(number, Path(bench.source("trajectories")), bench.folder, rig="worn")
        for inertial in (True, False):
            errors = fly_alone(flight.recording if inertial else flight.recording.without_imu()).errors()
            counts[inertial].add(errors)
            rows.append(
                (
                    number,
                    "yes" if inertial else "no",
                    counts[inertial].nees[-1],
                    max(e.position_m for e in errors),
                    np.degrees(max(e.rotation_rad for e in errors)),
                )
            )
        bench.say(
            f"worn flight {number}: NEES {counts[True].nees[-1]:.1f} with IMU, {counts[False].nees[-1]:.1f} without"
        )
    table(bench, "Worn flights", ("number", "IMU", "NEES", "largest error m", "degrees"), rows)
    return [
        nees_bar(f"worn rigs: NEES of {len(counts[True].nees)} flights with IMU", counts[True]),
        nees_bar(f"worn rigs: NEES of {len(counts[True].nees)} flights without IMU", counts[False]),
        *quality_bars(list(counts.values())),
    ]
