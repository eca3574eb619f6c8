"""People who walk through the view: a hundred flights beside the same ones in the empty scene."""

import math
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Recording
from kiteline_bench.harness.simulated import random_flight
from kiteline_bench.reality.flown import Flown, flown, spread

_FLIGHTS = tuple(range(400, 420))  # numbers of random flights
_STARTS_S = (0.0, 1.0, 2.0, 3.0, 4.0)
_MONOCULAR = 2  # of the starts of each flight: monocular with IMU
_PEOPLE, _SECONDS = 4, 12.0
_TIMES, _LEAST_M = 2.0, 0.01  # times the error in the empty scene, or m, whichever is larger
_FALSE, _WRONG_M = 0.05, 0.3


def run(bench: Bench) -> list[Bar]:
    """ATE over that in the empty scene, false scales and wrong merges."""
    rows: list[tuple[object, ...]] = []
    figures: dict[str, list[tuple[float, ...]]] = {"stereo": [], "monocular": []}
    folder = Path(bench.source("trajectories"))
    for number in bench.chosen(_FLIGHTS):
        crowd, empty = (
            random_flight(number, folder, bench.folder, seconds=_SECONDS, people=people).recording
            for people in (_PEOPLE, 0)
        )
        for k, start_s in enumerate(_STARTS_S):
            cameras = "monocular" if k >= len(_STARTS_S) - _MONOCULAR else "stereo"
            pair = [flown(bench, f"flight {number} from {start_s:g} s, {cameras}, {what}",
                          _part(recording, start_s, mono=cameras == "monocular"))
                    for what, recording in (("empty", empty), (f"{_PEOPLE} people", crowd))]  # fmt: skip
            found = _figures(*pair)
            figures[cameras].append(found)
            rows.append((number, start_s, cameras, *found))
            bench.say("  live {:.3f} m, empty {:.3f}, base {:.3f}, empty {:.3f}".format(*found[:4]))
    columns = ("flight", "start s", "cameras", "live m, people", "empty", "base m, people", "empty",
               "live over its bound",
               "base over its bound", "false metric %", "wrong merges")  # fmt: skip
    table(bench, "People", columns, rows)
    bars = []
    for cameras, found_of in figures.items():
        for name, column in (("live", 4), ("base", 5)):
            # Flights that get no scale in the empty scene either have nothing to compare with.
            ratios = [found[column] for found in found_of if not math.isnan(found[column])]
            bars += spread(f"people, {cameras}: ATE {name} over the larger of {_TIMES:g} x empty and {_LEAST_M:g} m",
                           ratios, 1.0, "", 2)  # fmt: skip
    everything = [found for found_of in figures.values() for found in found_of]
    return [
        *bars,
        at_most("people: metric said while the scale of 5 s is off by, worst", max(found[6] for found in everything),
                100.0 * _FALSE, "%", 1),
        at_most("people: flights with wrong merges or loops", sum(found[7] for found in everything), 0, "", 0),
    ]  # fmt: skip


def _part(recording: Recording, start_s: float, *, mono: bool) -> Recording:
    part = recording.seconds(start_s, 1e9)
    return part.left_only() if mono else part


def _figures(empty: Flown, crowd: Flown) -> tuple[float, ...]:
    figures = [flight.ate_m(path) for path in ("live", "base") for flight in (crowd, empty)]
    ratios = [a / max(_TIMES * b, _LEAST_M) for a, b in (figures[:2], figures[2:])]
    return (*figures, *ratios, 100.0 * crowd.false_metric(), float(_wrong_merge(crowd)))


def _wrong_merge(flight: Flown) -> bool:
    """Whether the base merged maps or closed loops, and its map is far off where the odometry is not."""
    if flight.station is None:
        return False
    counts = flight.station.mapper.summary()
    joined = int(str(counts["merges"])) + int(str(counts["loops"]))
    return joined > 0 and flight.ate_m("base") > max(_WRONG_M, 2.0 * flight.ate_m("odometry"))
