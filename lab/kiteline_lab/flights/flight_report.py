"""What a flight leaves: the refined trajectory composed from both halves, the report, its table, a check of it all."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.step import Estimate
from kiteline_core.geometry import se3, sim3, tum

F64 = NDArray[np.float64]
Report = dict[str, Any]

AGENT_KEYS = (
    "frames", "tracked", "bridged", "lost", "dropped", "submaps", "keyframes", "bytes_up", "bytes_down",
    "bytes_per_keyframe", "timing",
)  # fmt: skip
AGENT_TIMINGS = ("cpu_ms_per_frame", "decode_ms", "rss_mib")
BASE_KEYS = ("map_points", "loops", "merges", "digest_equal", "timing")
BASE_TIMINGS = ("bundle_ms", "grid_ms", "rss_mib")


def compose(frames: Sequence[Estimate], T_w_k: Mapping[int, F64], T_b_c: F64) -> list[tuple[int, F64]]:
    """Every tracked frame in w: (t_ns, T_w_b), from the agent's frames and the base's keyframe poses (camera in w, with
    the scale of the agent's unit of length in w where that is another).

    Where the base moved the keyframe that follows, the frames up to it take on their share of that correction, so that
    the path has no step where the reference changes. A frame whose keyframe the base does not hold (still on its way
    when the flight ended) hangs on the agent's own submap, placed where the nearest earlier keyframe that the base does
    hold puts it; before the first such keyframe, where that first one puts it. Frames of a submap of which the base
    holds nothing have no place in w: left out.
    """
    poses: list[tuple[int, F64]] = []
    placed: dict[int, F64] = {}  # submap -> S_w_m that its latest known keyframe implies
    waiting: dict[int, list[tuple[int, F64]]] = {}
    T_c_b = se3.inverse(T_b_c)
    for run, bend in _runs(frames, T_w_k, T_b_c):
        begin_ns = run[0].t_ns
        for frame in run:
            assert frame.T_m_b is not None
            submap = int(frame.submap)
            known = T_w_k.get(int(frame.keyframe))
            if known is not None:
                if bend is not None:
                    known = known @ se3.exp((frame.t_ns - begin_ns) / (bend[0] - begin_ns) * bend[1])
                S_w_c = known @ frame.T_k_c
                placed[submap] = sim3.normalise(S_w_c @ se3.inverse(frame.T_m_b @ T_b_c))
                early = waiting.pop(submap, ())
                poses.extend((t_ns, placed[submap] @ T_m_c) for t_ns, T_m_c in early)
                poses.append((frame.t_ns, S_w_c))
            elif submap in placed:
                poses.append((frame.t_ns, placed[submap] @ frame.T_m_b @ T_b_c))
            else:
                waiting.setdefault(submap, []).append((frame.t_ns, frame.T_m_b @ T_b_c))
    poses.sort(key=lambda pose: pose[0])
    # The arm from eye to body is in metres, whatever the unit in which the eye measures.
    return [(t_ns, se3.orthonormalise(sim3.rigid(S_w_c) @ T_c_b)) for t_ns, S_w_c in poses]


def _runs(
    frames: Sequence[Estimate], T_w_k: Mapping[int, F64], T_b_c: F64
) -> Iterator[tuple[list[Estimate], tuple[int, F64] | None]]:
    """Tracked frames that hang on one keyframe, without a gap; when the next keyframe was born, and by how much the
    base moved it, seen from here: a tangent vector (6,). None where the run ends otherwise.
    """
    run: list[Estimate] = []
    seen: set[int] = set()
    for frame in frames:
        if not frame.tracked or frame.T_m_b is None:
            if run:
                yield run, None
            run = []
            continue
        if run and frame.keyframe != run[-1].keyframe:
            born = int(frame.keyframe) not in seen and frame.submap == run[-1].submap
            yield run, (_bend(run[-1], frame, T_w_k, T_b_c) if born else None)
            run = []
        seen.add(int(frame.keyframe))
        run.append(frame)
    if run:
        yield run, None


def _bend(last: Estimate, born: Estimate, T_w_k: Mapping[int, F64], T_b_c: F64) -> tuple[int, F64] | None:
    """last: the last frame on a keyframe. born: the next one, which became a keyframe."""
    old, new = T_w_k.get(int(last.keyframe)), T_w_k.get(int(born.keyframe))
    if old is None or new is None:
        return None
    step = se3.inverse(last.T_o_b @ T_b_c) @ born.T_o_b @ T_b_c  # of the camera, as the agent saw it
    change = sim3.inverse(old) @ new @ born.T_k_c @ se3.inverse(last.T_k_c @ step)
    return born.t_ns, se3.log(sim3.rigid(change))


def write_tum(path: Path, poses: Iterable[tuple[int, F64]]) -> None:
    """Write poses (t_ns, T_a_b) as a TUM file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(tum.line(t_ns, pose) for t_ns, pose in poses))


def statistic(values: Sequence[float], digits: int = 3) -> dict[str, float]:
    """mean, p50 and p95 of values; zeros where there are none."""
    if not len(values):
        return {"mean": 0.0, "p50": 0.0, "p95": 0.0}
    a = np.asarray(values, np.float64)
    p50, p95 = np.percentile(a, [50, 95])
    return {"mean": round(float(a.mean()), digits), "p50": round(float(p50), digits), "p95": round(float(p95), digits)}


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
            f"base: {base.get('keyframes', 0)} keyframes, {base['map_points']} points, {base['loops']} loops, "
            f"{base['merges']} merges, digests {digests}, bundle {base['timing']['bundle_ms']['p50']:.1f} ms, "
            f"{base['timing']['rss_mib']:.0f} MiB"
        )
    lines.extend(f"note: {note}" for note in report.get("notes", ()))
    return "\n".join(lines)


def _metres(accuracy: Mapping[str, float] | None) -> str:
    return "-" if not accuracy else f"{accuracy['ate_m']:.4f} m"


def check_contract(out: Path) -> list[str]:
    """Every breach of the contract of a flight's folder, in words; empty when it is kept."""
    breaches: list[str] = []
    try:
        report = json.loads((out / "report.json").read_text())
    except (OSError, ValueError) as error:
        return [f"report.json: {error}"]
    agents = report.get("agents")
    if not isinstance(agents, list) or not agents:
        return ["report.json: `agents` must be a list with an entry for each agent"]
    for k, agent in enumerate(agents):
        breaches += _check_agent(out, k, agent, bool(report.get("base")))
    if report.get("base"):
        breaches += _check_base(out, report["base"])
    breaches += _starts_with(out / "trajectory.png", (b"\x89PNG",))
    return breaches


def _check_agent(out: Path, k: int, agent: Report, with_base: bool) -> list[str]:
    where = f"agents[{k}]"
    breaches = [f"{where}.{key} is missing" for key in AGENT_KEYS if key not in agent]
    if breaches:
        return breaches
    breaches += _check_timing(where, agent["timing"], AGENT_TIMINGS)
    if agent["tracked"] + agent["lost"] + agent["dropped"] != agent["frames"]:
        breaches.append(f"{where}: tracked + lost + dropped must be frames")
    counts = {name: _check_tum(out / f"agent{k}" / f"{name}.tum", breaches) for name in ("live", "odometry")}
    if counts["live"] != agent["tracked"]:
        breaches.append(f"{where}: live.tum has {counts['live']} rows for {agent['tracked']} tracked frames")
    if counts["odometry"] > agent["frames"]:
        breaches.append(f"{where}: odometry.tum has {counts['odometry']} rows for {agent['frames']} frames")
    breaches += _starts_with(out / f"agent{k}" / "log.mcap", (b"\x89MCAP",))
    if with_base:
        _check_tum(out / "base" / f"agent{k}.tum", breaches)
    return breaches


def _check_base(out: Path, base: Report) -> list[str]:
    breaches = [f"base.{key} is missing" for key in BASE_KEYS if key not in base]
    breaches += _check_timing("base", base.get("timing", {}), BASE_TIMINGS)
    breaches += _starts_with(out / "base" / "map.ply", (b"ply\n",))
    breaches += _starts_with(out / "base" / "grid.pgm", (b"P5", b"P2"))
    breaches += _starts_with(out / "base" / "log.mcap", (b"\x89MCAP",))
    grid = out / "base" / "grid.yaml"
    text = grid.read_text() if grid.exists() else ""
    for key in ("image:", "resolution:", "origin:", "occupied_thresh:", "free_thresh:"):
        if key not in text:
            breaches.append(f"base/grid.yaml: {key} is missing")
    return breaches


def _check_timing(where: str, timing: Report, keys: Sequence[str]) -> list[str]:
    breaches = [f"{where}.timing.{key} is missing" for key in keys if key not in timing]
    for key, value in timing.items():
        if key.endswith(("_ms", "_frame")) and not (isinstance(value, dict) and {"mean", "p50", "p95"} <= set(value)):
            breaches.append(f"{where}.timing.{key} must have mean, p50 and p95")
    return breaches


def _check_tum(path: Path, breaches: list[str]) -> int:
    """How many poses a TUM file holds; what is wrong with it is added to `breaches`."""
    if not path.exists():
        breaches.append(f"{path.name} is missing in {path.parent.name}/")
        return 0
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    where = f"{path.parent.name}/{path.name}"
    last = -math.inf
    for number, row in enumerate(rows, 1):
        if len(row) != 8 or len(row[0].partition(".")[2]) < 6:
            breaches.append(f"{where}: row {number} is not `t x y z qx qy qz qw` with microseconds at least")
            return len(rows)
        values = [float(cell) for cell in row]
        norm = math.sqrt(sum(v * v for v in values[4:]))
        if not all(map(math.isfinite, values)) or abs(norm - 1.0) > 1e-3 or values[0] <= last:
            breaches.append(f"{where}: row {number} is not finite, not a unit quaternion or not later than the last")
            return len(rows)
        last = values[0]
    return len(rows)


def _starts_with(path: Path, magics: Sequence[bytes]) -> list[str]:
    where = f"{path.parent.name}/{path.name}"
    if not path.exists():
        return [f"{where} is missing"]
    with path.open("rb") as file:
        head = file.read(8)
    return [] if any(head.startswith(magic) for magic in magics) else [f"{where} is not what its name says"]
