"""One camera without an IMU, whose lengths are in a unit of its own: the base beside the tracker alone."""

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.base import COLUMNS, Row, beside_alone
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

_SECONDS = 20.0
_STARTS_S = {
    "room_flight": (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
    "euroc_mh01_air": (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0),
}


def run(bench: Bench) -> list[Bar]:
    """Ratios of live and refined ATE, aligned by a similarity, to the ATE without a base."""
    bars, rows = list[Bar](), list[Row]()
    recordings = {
        "room_flight": load(bench.source("room_flight.mcap")).left_only().without_imu(),
        "euroc_mh01_air": load(bench.source("euroc_mh01_air"), mono=True, imu=False),
    }
    for name, recording in recordings.items():
        parts = {s: recording.seconds(s, s + _SECONDS) for s in bench.chosen(_STARTS_S[name])}
        compared = beside_alone(bench, name, parts, TrajectoryAlignment.SIM3)
        bars, rows = bars + compared[0], rows + compared[1]
    table(bench, "ATE in mm, aligned by a similarity", COLUMNS, rows)
    return bars
