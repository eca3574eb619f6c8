"""Disks that become full at random instants of a live flight: real file systems, of a few MiB, filled by a file.

They are mounted in a name space of their own, in which agent and base run; where that is not allowed, the bars fail.
"""

import json
import shutil
import sys

from kiteline_basestation.store.integrity import check
from kiteline_basestation.store.store import read
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, run_command
from kiteline_codec.schema import KeyframeHeader
from kiteline_hw.logs.mcap_log import LogReader

_TIMEOUT_S = 500.0
_INSTANTS = 20


def run(bench: Bench) -> list[Bar]:
    """A live flight whose three disks are full twenty times, and starts of both processes on full disks."""
    out = bench.folder / "trust_disk"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    recording = bench.source("room_flight.mcap")
    bench.say(f"flying {recording} on disks that are full at {_INSTANTS} instants")
    command = ["unshare", "-rm", sys.executable, "-m", "kiteline_bench.trust.small_disks", recording, str(out)]
    done = run_command([*command, str(_INSTANTS)], _TIMEOUT_S)
    if done.returncode != 0:
        return [is_true("disk full in flight", "measured", False, done.stderr.strip().splitlines()[-1])]
    found = json.loads((out / "found.json").read_text())
    said = found["agent"] + found["base"]
    checked = check(read(out / "store"))
    stored = sum(k.kind == KeyframeHeader.KIND for c in checked.saved.agents.values() for k in c.received)
    logs = sorted(out.glob("logs/**/*.mcap"))
    whole = steps = 0
    for path in logs:
        with LogReader(path) as log:
            whole += log.cut is None
            steps += log.topics.get("/step", 0)
    told = sorted({line for line in said if "No space" in line or "is full" in line})
    bench.more.append(
        f"Full {found['fills']} times for {found['full_s']:.1f} s of {found['flown_s']:.0f} s; {len(logs)} logs, "
        f"{steps} steps.\n\n" + "\n".join(f"    {line}" for line in told)
    )
    return [
        at_most("tracebacks", sum("Traceback" in line for line in said), 0, "", 0),
        is_true("flights that ended in order", "all", found["codes"] == [0] * len(found["codes"]), str(found["codes"])),
        is_true("the disk is told once by each process", "once", found["told"] == [1, 1], str(found["told"])),
        is_true("keyframes that the base acknowledged, in its store", "all",
                stored == found["keyframes"] > 0 and not checked.faults,
                f"{stored} of {found['keyframes']}, {len(checked.faults)} faults"),
        is_true("logs that can be read", "all", whole == len(logs) > 0, f"{whole} of {len(logs)}"),
        is_true("a new start on full disks", "flies", found["restarted"] > 0, f"{found['restarted']} frames tracked"),
    ]  # fmt: skip
