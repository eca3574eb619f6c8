"""Whether the agent says "metric" only where lengths are right: monocular with IMU from a hundred starts."""

from __future__ import annotations

from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.simulated import random_flight
from kiteline_bench.reality.euroc import FLIGHT
from kiteline_bench.reality.flown import flown

_SIMULATED = tuple(range(300, 327))  # numbers of random flights; every second one by a worn rig
_SIMULATED_STARTS_S = (0.0, 2.0, 4.0)
_REAL_STARTS_S = tuple(float(k) for k in range(20))
_SECONDS, _REAL_SECONDS = {"true": 14.0, "worn": 26.0}, 12.0  # vibration lets the scale be known late, or not at all
_FALSE = 0.05


def run(bench: Bench) -> list[Bar]:
    """The largest scale error of a window that was said to be metric; and how many starts became metric."""
    rows = []
    real = load(bench.source(FLIGHT), mono=True)
    for start_s in bench.chosen(_REAL_STARTS_S):
        rows.append(_row(bench, FLIGHT, start_s, real.seconds(start_s, start_s + _REAL_SECONDS)))
    for number in bench.chosen(_SIMULATED):
        rig = ("true", "worn")[number % 2]
        flight = random_flight(
            number, Path(bench.source("trajectories")), bench.folder, seconds=_SECONDS[rig], mono=True, rig=rig
        ).recording
        for start_s in _SIMULATED_STARTS_S:
            rows.append(_row(bench, f"{rig} {number}", start_s, flight.seconds(start_s, 1e9)))
    table(bench, "Monocular with IMU", ("flight", "start s", "metric after s", "scale off at worst %"), rows)
    wrong = sum(row[3] > 100.0 * _FALSE for row in rows)
    metric = sum(row[2] < 1e9 for row in rows)
    return [
        at_most(f"metric said while the scale of 5 s is off by more than {100 * _FALSE:g} %, of {len(rows)} starts",
                wrong, 0, "", 0),
        is_true("starts that became metric", ">= 80 %", metric >= 0.8 * len(rows), f"{metric} of {len(rows)}"),
    ]  # fmt: skip


def _row(bench: Bench, name: str, start_s: float, recording: Recording) -> tuple[str, float, float, float]:
    flight = flown(bench, f"{name} from {start_s:g} s", recording, base=False)
    row = (name, start_s, flight.metric_after_s, 100.0 * flight.false_metric())
    bench.say(f"  metric after {row[2]:.1f} s, scale off by up to {row[3]:.1f} %")
    return row
