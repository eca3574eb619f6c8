"""Monocular with a real IMU: a real flight from its begin and from later starts, in motion."""

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.flown import flown, spread

FLIGHT = "euroc_mh01_air"
STARTS_S = tuple(2.0 * k for k in range(11))  # of 35 s
_SETTLED_S = 10.0  # from which the scale is judged
_METRIC_S, _SCALE, _FALSE, _LIVE_M, _BASE_M = 5.0, 0.02, 0.05, 0.10, 0.05


def run(bench: Bench) -> list[Bar]:
    """Time until metric, scale, and ATE of live and refined poses, SE3-aligned."""
    recording = load(bench.source(FLIGHT), mono=True)
    flights, rows = [], []
    for start_s in bench.chosen(STARTS_S):
        flight = flown(bench, f"{FLIGHT} from {start_s:g} s", recording.seconds(start_s, 1e9))
        figures = (
            flight.metric_after_s, 100.0 * flight.scale_error("live", _SETTLED_S), 100.0 * flight.false_metric(),
            flight.ate_m("odometry"), flight.ate_m("live"), flight.ate_m("base"), flight.lost_after_metric,
            1000.0 * flight.largest_jump_m(),
        )  # fmt: skip
        flights.append(flight)
        rows.append((start_s, *figures, flight.seconds))
        bench.say("  metric after {:.1f} s, scale {:.2f} %, in a window {:.2f} %, odometry {:.3f}, live {:.3f}, "
                  "base {:.3f} m, lost {}, jump {:.0f} mm".format(*figures))  # fmt: skip
    columns = ("start s", "metric after s", f"scale off from {_SETTLED_S:g} s on, %", "largest of metric windows, %",
               "ATE odometry m", "ATE live m", "ATE base m", "lost after metric", "largest jump mm",
               "seconds")  # fmt: skip
    table(bench, f"{FLIGHT}, monocular with IMU", columns, rows)
    return [
        *spread(f"{FLIGHT}: metric after", [f.metric_after_s for f in flights], _METRIC_S, "s", 1),
        at_most(f"{FLIGHT}: frames lost afterwards, worst", max(f.lost_after_metric for f in flights), 0, "", 0),
        *spread(f"{FLIGHT}: scale off from {_SETTLED_S:g} s on",
                [100.0 * f.scale_error("live", _SETTLED_S) for f in flights], 100.0 * _SCALE, "%", 2),
        at_most(f"{FLIGHT}: metric said while the scale of 5 s is off by, worst",
                100.0 * max(f.false_metric() for f in flights), 100.0 * _FALSE, "%", 2),
        *spread(f"{FLIGHT}: ATE live", [f.ate_m("live") for f in flights], _LIVE_M, "m"),
        *spread(f"{FLIGHT}: ATE base", [f.ate_m("base") for f in flights], _BASE_M, "m"),
    ]  # fmt: skip
