"""Gross failures of the monocular start with an IMU: random starts in every real recording, forward and backward."""

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.faults import samples_from
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.flown import Flown, flown, spread, start_of, wrong_metres
from kiteline_bench.reality.one_camera.euroc import FLIGHT

_AT_REST = "euroc_v101_start"  # moves by a few centimetres in two seconds: no scale is to be told
_RENDERED = "room_flight.mcap"
_STARTS = (("forward", 10), ("backward", 10), ("rendered", 4))  # so many random starts each
_SECONDS = 14.0
_SEED = 4100
_LATE_S, _LATE_STARTS_S = 5.0, (0.0, 3.0, 6.0, 9.0, 12.0)  # of the first sample; s of the real flight, whole from there
_MOST_WAIT_S, _MOST_WRONG, _MOST_M = 15.0, 5.0, 0.1  # s, %, m: other bars are those of samples from the first image on


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
    late = []
    for start_s in bench.chosen(_LATE_STARTS_S):
        part = samples_from(real.seconds(start_s, 1e9), _LATE_S)
        late.append(flown(bench, f"samples from {_LATE_S:g} s on, from {start_s:g} s", part, base=False))
    return [
        wrong_metres(metric),
        at_most("starts that never became metric", len(rows) - len(metric), 0, "", 0),
        at_most(f"{_AT_REST}, nearly at rest: metric said", int(np.isfinite(rest[2])), 0, "", 0),
        *_late(bench, late),
    ]  # fmt: skip


def _late(bench: Bench, flights: list[Flown]) -> list[Bar]:
    """A map in a unit of its own, as no sample comes at first, goes on in metres."""
    rows = [
        (
            f.metric_after_s - _LATE_S,
            100.0 * f.false_metric(),
            f.ate_m("odometry", f.metric_after_s),
            f.lost_after_metric,
        )
        for f in flights
    ]
    table(bench, f"{FLIGHT}, samples from {_LATE_S:g} s after the first image on", (
        "metric s after the first sample", "largest of metric windows, %", "ATE of the odometry from then on m",
        "frames without a pose then"), rows)  # fmt: skip
    waits, wrong, errors, lost = (list(column) for column in zip(*rows, strict=True))
    name = f"samples from {_LATE_S:g} s on"
    return [
        *spread(f"{name}: metric after the first sample", waits, _MOST_WAIT_S, "s", 1),
        at_most(f"{name}: scale off in a metric window, worst", max(wrong), _MOST_WRONG, "%", 2),
        at_most(f"{name}: ATE of the odometry in metres, worst", max(errors), _MOST_M, "m"),
        at_most(f"{name}: frames without a pose in metres", sum(lost), 0, "", 0),
    ]
