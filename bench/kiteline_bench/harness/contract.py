"""Check that a flight's folder and report.json keep their contract."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

from kiteline_lab.flights.flight_report import Report

AGENT_KEYS = (
    "frames", "tracked", "bridged", "lost", "dropped", "submaps", "keyframes", "bytes_up", "bytes_down",
    "bytes_per_keyframe", "timing",
)  # fmt: skip
AGENT_TIMINGS = ("cpu_ms_per_frame", "decode_ms", "rss_mib")
BASE_KEYS = ("map_points", "loops", "merges", "digest_equal", "timing")
BASE_TIMINGS = ("bundle_ms", "grid_ms", "rss_mib")


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
        breaches += _check_agent(out, k, agent, with_base=bool(report.get("base")))
    if report.get("base"):
        breaches += _check_base(out, report["base"])
    breaches += _starts_with(out / "trajectory.png", (b"\x89PNG",))
    return breaches


def _check_agent(out: Path, k: int, agent: Report, *, with_base: bool) -> list[str]:
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
