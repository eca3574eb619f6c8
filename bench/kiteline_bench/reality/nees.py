"""Whether poses of worn rigs err as their covariance says: NEES and quality over simulated flights."""

from pathlib import Path

import numpy as np

from kiteline_bench.agent.consistency import Counts, nees_bar, quality_bars
from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import random_flight

FLIGHTS = tuple(range(200, 230))  # numbers of random flights


def run(bench: Bench) -> list[Bar]:
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
