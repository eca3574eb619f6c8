"""One camera and an IMU high above ground, where landmarks are far: the base beside the tracker alone."""

from kiteline_bench.agent.altitude import CLIMBS, STARTS_S, climbing
from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.reality.base import COLUMNS, Row, beside_alone

_SECONDS = 30.0


def run(bench: Bench) -> list[Bar]:
    """Ratios of live and refined ATE to the ATE without a base."""
    bars, rows = list[Bar](), list[Row]()
    for climb in CLIMBS:
        recording = climbing(bench, climb, _SECONDS, mono=True)
        parts = {start_s: recording.seconds(start_s, _SECONDS) for start_s in bench.chosen(STARTS_S)}
        compared = beside_alone(bench, climb.name, parts)
        bars, rows = bars + compared[0], rows + compared[1]
    table(bench, "ATE in mm", COLUMNS, rows)
    return bars
