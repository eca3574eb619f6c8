"""Rolling shutters whose read-out a calibration tells, or the flight has to find, beside global shutters."""

from dataclasses import replace
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.recording import Recording
from kiteline_bench.harness.simulated import random_flight
from kiteline_bench.reality.flown import Flown, flown, spread

READOUT_S = 0.02
FLIGHTS = {"one camera": tuple(range(700, 714, 2)), "two cameras": (720, 722, 724)}  # random flights, all with an IMU
_SECONDS = 12.0
_TIMES, _LEAST_M = 1.5, 0.02  # times the error with a global shutter, or m, whichever is larger
_OFF_S, _FALSE = 0.005, 0.05  # of a read-out that is found; of lengths that are said to be metres
_KINDS = {"global": (0.0, 0.0), "told": (READOUT_S, READOUT_S), "untold": (READOUT_S, 0.0)}  # true, told


def run(bench: Bench) -> list[Bar]:
    """ATE live and at the base over that with a global shutter; what is found of the read-out; false metres."""
    bars, rows = list[Bar](), list[tuple[object, ...]]()
    for cameras, numbers in FLIGHTS.items():
        flights = [_flights(bench, cameras, number) for number in bench.chosen(numbers)]
        for kind in ("told", "untold"):
            for path in ("live", "base"):
                ratios = [_over(f[kind], f["global"], path) for f in flights]
                bars += spread(f"{cameras}, {kind}: ATE {path} over the larger of {_TIMES:g} x global and "
                               f"{_LEAST_M:g} m", ratios, 1.0, "", 2)  # fmt: skip
        bars += _found(cameras, flights)
        rows += [_row(cameras, n, kind, f[kind]) for n, f in zip(numbers, flights, strict=False) for kind in _KINDS]
    columns = ("cameras", "flight", "read-out", "metric after s", "windows off by at most %", "ATE live m",
               "ATE base m", "found ms")  # fmt: skip
    table(bench, f"Read-outs of {1e3 * READOUT_S:g} ms, and global shutters", columns, rows)
    return bars


def _flights(bench: Bench, cameras: str, number: int) -> dict[str, Flown]:
    """A flight with each kind of shutter."""
    out = {}
    for kind, (true_s, told_s) in _KINDS.items():
        recording = _recording(bench, number, mono=cameras == "one camera", readout_s=true_s)
        rig = replace(recording.rig, left=replace(recording.rig.left, readout_s=told_s))
        flight = flown(bench, f"{cameras}, {number}, {kind}", replace(recording, rig=rig))
        bench.say("  metric after {:.1f} s, windows off by {:.1f} %, live {:.4f}, base {:.4f} m".format(
            *_figures(flight)))  # fmt: skip
        out[kind] = flight
    return out


def _recording(bench: Bench, number: int, *, mono: bool, readout_s: float) -> Recording:
    return random_flight(
        number, Path(bench.source("trajectories")), bench.folder, scale=0.5, seconds=_SECONDS, mono=mono,
        readout_s=readout_s,
    ).recording  # fmt: skip


def _row(cameras: str, number: int, kind: str, flight: Flown) -> tuple[object, ...]:
    found_ms = _readout_ms(flight)
    return (cameras, number, kind, *_figures(flight), "none" if found_ms is None else f"{found_ms:.1f}")


def _figures(flight: Flown) -> tuple[float, float, float, float]:
    """When metres are said, how wrong windows of them are in %, ATE live and at the base in m."""
    return flight.metric_after_s, 100.0 * flight.false_metric(), flight.ate_m("live"), flight.ate_m("base")


def _readout_ms(flight: Flown) -> float | None:
    assert flight.box is not None
    found = flight.box.motion_reports()["readout"]
    return None if found is None else float(found["ms"])


def _over(flight: Flown, with_global: Flown, path: str) -> float:
    return flight.ate_m(path) / max(_TIMES * with_global.ate_m(path), _LEAST_M)


def _found(cameras: str, flights: list[dict[str, Flown]]) -> list[Bar]:
    """Which flights found a read-out, and how right it and the metres are."""
    untold = [ms for f in flights if (ms := _readout_ms(f["untold"])) is not None]
    wrongly = sum(_readout_ms(f["global"]) is not None for f in flights)
    off_ms = max((abs(ms - 1e3 * READOUT_S) for ms in untold), default=float("inf"))
    false = max(f[kind].false_metric() for f in flights for kind in ("told", "untold"))
    return [
        at_most(f"{cameras}: global shutters with a read-out", wrongly, 0, "", 0),
        is_true(f"{cameras}: read-outs that are found", ">= 80 %", len(untold) >= 0.8 * len(flights),
                f"{len(untold)} of {len(flights)}"),
        at_most(f"{cameras}: read-outs that are found are off by, worst", off_ms, 1e3 * _OFF_S, "ms", 1),
        at_most(f"{cameras}: metric said while the scale of 5 s is off by, worst", 100.0 * false, 100.0 * _FALSE, "%",
                2),
    ]  # fmt: skip
