"""Gross failures of the monocular start with an IMU: random starts in every real recording, forward and backward."""

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.euroc import FLIGHT
from kiteline_bench.reality.flown import start_of, wrong_metres

_AT_REST = "euroc_v101_start"  # moves by a few centimetres in two seconds: no scale is to be told
_RENDERED = "room_flight.mcap"
_STARTS = (("forward", 10), ("backward", 10), ("rendered", 4))  # so many random starts each
_SECONDS = 14.0
_SEED = 4100


def run(bench: Bench) -> list[Bar]:
    """Starts that say metric while lengths are wrong by more than 5 %, and how long a start takes."""
    real = load(bench.source(FLIGHT), mono=True)
    recordings = {
        "forward": real, "backward": real.backward(), "rendered": load(bench.source(_RENDERED), mono=True),
    }  # fmt: skip
    rng = np.random.default_rng(_SEED)
    rows = []
    for name, count in _STARTS:
        recording = recordings[name]
        latest_s = (recording.items[-1].frame.t_ns - recording.items[0].frame.t_ns) * 1e-9 - _SECONDS
        for start_s in bench.chosen(np.sort(rng.uniform(0.0, latest_s, count)).round(2).tolist()):
            rows.append(start_of(bench, name, start_s, recording.seconds(start_s, start_s + _SECONDS)))
    rest = start_of(bench, _AT_REST, 0.0, load(bench.source(_AT_REST), mono=True))
    table(bench, f"{FLIGHT} forward and backward, a rendered room, and {_AT_REST}",
          ("flight", "start s", "metric after s", "largest of metric windows, %"), [*rows, rest])  # fmt: skip
    metric = [row for row in rows if np.isfinite(row[2])]
    return [
        wrong_metres(metric),
        at_most("starts that never became metric", len(rows) - len(metric), 0, "", 0),
        at_most(f"{_AT_REST}, nearly at rest: metric said", int(np.isfinite(rest[2])), 0, "", 0),
    ]  # fmt: skip
