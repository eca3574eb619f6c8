"""One camera without an IMU, whose lengths are in a unit of its own: the base beside the tracker alone."""

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

_RATIO, _WORST_RATIO = 1.0, 1.1
_LINKS = {"wifi": (0, 0), "radio": (1000, 500)}  # bytes a second up and down; 0: no limit
_SECONDS = 20.0
_STARTS_S = {
    "room_flight": (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
    "euroc_mh01_air": (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0),
}


def run(bench: Bench) -> list[Bar]:
    """Ratios of live and refined ATE, aligned by a similarity, to the ATE without a base."""
    bars, rows = list[Bar](), list[tuple[object, ...]]()
    recordings = {
        "room_flight": load(bench.source("room_flight.mcap")).left_only().without_imu(),
        "euroc_mh01_air": load(bench.source("euroc_mh01_air"), mono=True, imu=False),
    }
    for name, recording in recordings.items():
        parts = {s: recording.seconds(s, s + _SECONDS) for s in bench.chosen(_STARTS_S[name])}
        alone_m = {
            s: _ate_m(flown(bench, f"{name} from {s:g} s", part, base=False), "live") for s, part in parts.items()
        }
        for link, bytes_s in _LINKS.items():
            errors_m = {s: _with_base(bench, part, link, bytes_s) for s, part in parts.items()}
            for k, path in enumerate(("live", "base")):
                ratios = [errors_m[s][k] / alone_m[s] for s in parts]
                what = f"{name}, {link}: ATE {path} over that of the tracker alone"
                bars += spread(what, ratios, _RATIO, "", 2, worst=_WORST_RATIO)
            rows += [(name, link, s, 1e3 * alone_m[s], *(1e3 * e for e in errors_m[s])) for s in parts]
    columns = ("flight", "link", "start s", "tracker alone", "live", "base")
    table(bench, "ATE in mm, aligned by a similarity", columns, rows)
    return bars


def _with_base(bench: Bench, part: Recording, link: str, bytes_s: tuple[int, int]) -> tuple[float, float]:
    """Errors in m, live and at the base."""
    flight = flown(bench, f"  with a base over {link}", part, bytes_s=bytes_s, profile=link)
    live_m, base_m = _ate_m(flight, "live"), _ate_m(flight, "base")
    bench.say(f"  ATE live {live_m:.4f}, base {base_m:.4f} m")
    return live_m, base_m


def _ate_m(flight: Flown, path: str) -> float:
    found = flight.matched(path, TrajectoryAlignment.SIM3)
    return float("inf") if found is None else float(np.sqrt(np.mean(metrics.position_errors(found) ** 2)))
