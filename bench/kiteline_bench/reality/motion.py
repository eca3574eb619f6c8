"""Flights that begin in motion: live poses from the fifth frame on."""

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_core.geometry import se3
from kiteline_lab.evaluation import metrics

FLIGHT = "room_flight.mcap"
STARTS_S = (3.0, 5.0, 7.0, 9.0, 11.0, 13.0, 15.0)  # of 22 s
_FIRST, _BEGIN_S, _SECONDS = 4, 3.0, 6.0  # index of the fifth frame; s that count as the begin, and s that are flown
_MOST_M, _MOST_DEG = 0.03, 2.0


def run(bench: Bench) -> list[Bar]:
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
