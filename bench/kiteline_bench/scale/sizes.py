"""A map of 20,000 keyframes, and a day of silence and flights: their trials run in processes of their own."""

from typing import Any

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.scale import trials

_KEYFRAMES, _FULL_KEYFRAMES = 2500, 20_000
_FLOWN = 600  # of the full ones the last that are flown; the others are copies of the first place
_HOURS = 24
_FLIGHTS, _FULL_FLIGHTS = 16, 96
_RECORDED, _FULL_RECORDED = 30, 60  # keyframes of each flight, a second apart
_SOURCE = "room_flight.mcap"


def run_map(bench: Bench) -> list[Bar]:
    """One agent's way through many places and back to the first one."""
    keyframes = _FULL_KEYFRAMES if bench.full else _KEYFRAMES
    bench.say(f"mapping {keyframes} keyframes")
    flown = ("--flown", str(_FLOWN)) if bench.full else ()
    found = trials.start("map", bench.source(_SOURCE), "--keyframes", str(keyframes), *flown, say=bench.say)
    count, rss = np.array(found["keyframes"], float), np.array(found["rss_mib"])
    late = count >= 0.2 * count[-1]
    kb = float(np.polyfit(count[late], rss[late], 1)[0]) * 2**20 / 1000.0
    last = found["last_ms"]
    bench.more.append(_curve(found))
    return [
        at_most(f"a map of {int(count[-1])} keyframes: CPU of a step, p95", float(np.percentile(last, 95)), 20.0,
                "ms", 1),
        at_most("memory of the process for each keyframe", kb, 60.0, "kB", 1),
        is_true("the loop over all of it", "closed", found["loops"] >= 1, f"{found['loops']} loops"),
        at_most("from its recognition until pose graph and bundle are applied", found["loop_s"], 10.0, "s", 1),
    ]  # fmt: skip


def _curve(found: dict[str, Any]) -> str:
    """CPU of steps and memory as the map grows."""
    step, most = np.array(found["step_ms"]), np.array(found["most_ms"])
    lines = ["| keyframes | step, mean | step with a keyframe, p95 | most | memory |", "|---|---|---|---|---|"]
    ends = [int(k) for k in found["keyframes"]]
    chosen = sorted({ends[round(i)] for i in np.linspace(0, len(ends) - 1, 8)})
    begin = 0
    for end in chosen:
        part, memory = slice(begin, end), f"{found['rss_mib'][ends.index(end)]:.0f} MiB"
        flown = np.flatnonzero(most[part]) + begin  # the others are copies
        times = "copies | | " if not len(flown) else (
            f"{step[flown].mean():.1f} ms | {np.percentile(most[flown], 95):.1f} ms | {most[flown].max():.0f} ms"
        )  # fmt: skip
        lines.append(f"| {end} | {times} | {memory} |")
        begin = end
    before_m, after_m = found["error_m"]
    copies = " Copies of the first place hold what agent and base wrote of it, but no scans." if 0.0 in most else ""
    told = f"Longest step while the loop was closed: {found['loop_step_ms']:.0f} ms; error of the last place "
    return "\n".join([*lines, "", f"{told}{before_m:.2f} m before, {after_m:.2f} m after.{copies}"])


def run_day(bench: Bench) -> list[Bar]:
    """Flights that come, land and are deleted, over a day of simulated time."""
    flights = _FULL_FLIGHTS if bench.full else _FLIGHTS
    recorded = _FULL_RECORDED if bench.full else _RECORDED
    bench.say(f"{_HOURS} hours with {flights} flights of {recorded} keyframes")
    options = ("--hours", str(_HOURS), "--flights", str(flights), "--recorded", str(recorded))
    found = trials.start("day", bench.source(_SOURCE), *options, say=bench.say)
    rss = found["rss_mib"]
    grown = max(rss[flights // 2 :]) - max(rss[: flights // 4])
    after = " ".join(f"{mib:.0f}" for mib in rss)
    bench.more.append(f"Resident memory in MiB after each flight: {after}. {found['keyframes']} keyframes in all.")
    return [at_most("resident memory, second half of the day over its first quarter", grown, 5.0, "MiB", 1)]
