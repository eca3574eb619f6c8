"""Whether the agent says "metric" only where lengths are right: monocular with IMU from a hundred starts."""

from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, is_true, table
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.simulated import random_flight
from kiteline_bench.reality.flown import start_of, wrong_metres
from kiteline_bench.reality.one_camera.euroc import FLIGHT

_SIMULATED = tuple(range(300, 327))  # numbers of random flights; every second one by a worn rig
_SIMULATED_STARTS_S = (0.0, 2.0, 4.0)
_REAL_STARTS_S = tuple(float(k) for k in range(20))
_SECONDS, _REAL_SECONDS = {"true": 14.0, "worn": 26.0}, 12.0  # vibration lets the scale be known late, or not at all


def run(bench: Bench) -> list[Bar]:
    """The largest scale error of a window that was said to be metric; and how many starts became metric."""
    rows = []
    real = load(bench.source(FLIGHT), mono=True)
    for start_s in bench.chosen(_REAL_STARTS_S):
        rows.append(start_of(bench, FLIGHT, start_s, real.seconds(start_s, start_s + _REAL_SECONDS)))
    for number in bench.chosen(_SIMULATED):
        rig = ("true", "worn")[number % 2]
        flight = random_flight(
            number, Path(bench.source("trajectories")), bench.folder, seconds=_SECONDS[rig], mono=True, rig=rig
        ).recording
        for start_s in _SIMULATED_STARTS_S:
            rows.append(start_of(bench, f"{rig} {number}", start_s, flight.seconds(start_s, 1e9)))
    table(bench, "Monocular with IMU", ("flight", "start s", "metric after s", "scale off at worst %"), rows)
    metric = sum(row[2] < 1e9 for row in rows)
    return [
        wrong_metres(rows),
        is_true("starts that became metric", ">= 80 %", metric >= 0.8 * len(rows), f"{metric} of {len(rows)}"),
    ]  # fmt: skip
