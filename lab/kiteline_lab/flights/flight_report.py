"""Numbers of report.json, and its table on the terminal."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import tum
from kiteline_core.wording import counted

Report = dict[str, Any]


def write_tum(path: Path, poses: Iterable[tuple[int, F64]]) -> None:
    """Write poses (t_ns, T_a_b) as a TUM file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(tum.line(t_ns, pose) for t_ns, pose in poses))


def statistic(values: Sequence[float]) -> dict[str, float]:
    """mean, p50 and p95 of values; zeros where there are none."""
    if not len(values):
        return {"mean": 0.0, "p50": 0.0, "p95": 0.0}
    a = np.asarray(values, np.float64)
    p50, p95 = np.percentile(a, [50, 95])
    return {"mean": round(float(a.mean()), 3), "p50": round(float(p50), 3), "p95": round(float(p95), 3)}


def write_report(path: Path, report: Report) -> None:
    """Write report.json. Raises ValueError when a number in it is not finite: JSON has no word for that."""
    text = json.dumps(report, indent=2, allow_nan=False)
    path.write_text(text + "\n")


def without_timing(report: Any) -> Any:
    """The reproducible part of a report: the same without any `timing`."""
    if isinstance(report, dict):
        return {key: without_timing(value) for key, value in report.items() if key != "timing"}
    if isinstance(report, list):
        return [without_timing(value) for value in report]
    return report


def table(report: Report) -> str:
    """The flight in a few lines, for people."""
    rows = [["agent", "frames", "tracked", "lost", "dropped", "ATE live", "ATE base", "keyframes", "B/keyframe",
             "CPU ms/frame", "RSS MiB"]]  # fmt: skip
    for k, agent in enumerate(report["agents"]):
        accuracy = agent.get("accuracy", {})
        cpu = agent["timing"]["cpu_ms_per_frame"]
        rows.append(
            [str(k), str(agent["frames"]), str(agent["tracked"]), str(agent["lost"]), str(agent["dropped"]),
             _metres(accuracy.get("live")), _metres(accuracy.get("base")), str(agent["keyframes"]),
             f"{agent['bytes_per_keyframe']:.0f}", f"{cpu['mean']:.1f} (p95 {cpu['p95']:.1f})",
             f"{agent['timing']['rss_mib']:.0f}"]
        )  # fmt: skip
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths)) for row in rows]
    base = report.get("base")
    if base:
        digests = {True: "equal", False: "NOT equal"}.get(base["digest_equal"], "not compared")
        lines.append(
            f"base: {counted(base.get('keyframes', 0), 'keyframe')}, {counted(base['map_points'], 'point')}, "
            f"{counted(base['loops'], 'loop')}, {counted(base['merges'], 'merge')}, digests {digests}, "
            f"bundle {base['timing']['bundle_ms']['p50']:.1f} ms, {base['timing']['rss_mib']:.0f} MiB"
        )
    notes = (*report.get("notes", ()), *_link_notes(report), *_agent_notes(report["agents"]))
    lines.extend(f"note: {note}" for note in notes)
    return "\n".join(lines)


def _link_notes(report: Report) -> Iterator[str]:
    """What became of the map on its way to the base, if not all of it has arrived."""
    base, drained = report.get("base"), report.get("drain", {}).get("base", {})
    if base and base["digest_equal"] is False and not base.get("agents_lost") and "flight_ms" in drained:
        yield (
            f"{drained['flight_ms'] / 1000:.0f} s after the last frame the link had not carried the whole map yet; "
            "a link with more bytes a second does (--link-bytes)"
        )


def _agent_notes(agents: Sequence[Report]) -> Iterator[str]:
    """How each agent's map began, what its source skipped, by reason, and its other notes. What was skipped once is
    told in full.
    """
    for k, agent in enumerate(agents):
        skipped, told = agent.get("skipped", {}), agent.get("notes", ())
        examples = {note.partition(": ")[0]: note for note in told}
        notes = []
        if waited := agent.get("initialising", 0):
            notes.append(f"{waited} of the lost frames came before there was a map")
        if agent.get("scale") == "own" and agent["tracked"]:
            notes.append("lengths are in a unit of their own, as nothing told the metre; ATE with the scale fitted")
        notes += [f"{n} skipped: {examples.get(reason, reason) if n == 1 else reason}" for reason, n in skipped.items()]
        notes += [note for note in told if note.partition(": ")[0] not in skipped]  # no examples
        yield from (f"agent {k}: {note}" if len(agents) > 1 else note for note in notes)


def _metres(accuracy: Mapping[str, float] | None) -> str:
    return "-" if not accuracy else f"{accuracy['ate_m']:.4f} m"
