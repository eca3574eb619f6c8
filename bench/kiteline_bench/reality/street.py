"""A real street from several starts: live poses, and the base beside the tracker alone."""

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.flown import flown, spread

FLIGHT = "kitti_straight"
STARTS_S = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2)  # of 5 s
_LIVE_M, _STEP_MM, _RATIO, _WORST_RATIO = 0.06, 10.0, 1.0, 1.1


def run(bench: Bench) -> list[Bar]:
    """ATE and relative error."""
    recording = load(bench.source(FLIGHT))
    rows = []
    for start_s in bench.chosen(STARTS_S):
        part = recording.seconds(start_s, 1e9)
        joined = flown(bench, f"{FLIGHT} from {start_s:g} s", part)
        alone = flown(bench, "the same without a base", part, base=False)
        rows.append((start_s, alone.ate_m("live"), joined.ate_m("live"), joined.ate_m("base"), alone.rpe_mm("live"),
                     joined.rpe_mm("live"), joined.rpe_mm("base"), 100.0 * joined.scale_error("base")))  # fmt: skip
        bench.say("  ATE alone {:.3f} live {:.3f} base {:.3f} m, a frame {:.1f} {:.1f} {:.1f} mm, "
                  "scale of base off by {:.2f} %".format(*rows[-1][1:]))  # fmt: skip
    columns = ("start s", "ATE alone m", "live", "base", "mm a frame alone", "live", "base", "scale of base off by %")
    table(bench, FLIGHT, columns, rows)
    return [
        *spread(f"{FLIGHT}: ATE live", [row[2] for row in rows], _LIVE_M, "m"),
        *spread(f"{FLIGHT}: live, error of a frame", [row[5] for row in rows], _STEP_MM, "mm", 1),
        *spread(f"{FLIGHT}: ATE live over that of the tracker alone", [row[2] / row[1] for row in rows], _RATIO, "", 2,
                worst=_WORST_RATIO),
        *spread(f"{FLIGHT}: ATE base over that of the tracker alone", [row[3] / row[1] for row in rows], _RATIO, "", 2,
                worst=_WORST_RATIO),
    ]  # fmt: skip
