"""Results of a flight: refined trajectories, accuracy against the truth, plot, report.json."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kiteline_agent.runtime.flight_log import ESTIMATE, estimate_from_json
from kiteline_agent.runtime.frame_counts import FrameCounts, live_pose
from kiteline_agent.step import Estimate
from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.wording import counted
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment
from kiteline_lab.flights.flight_report import Report, statistic, write_report, write_tum
from kiteline_lab.flights.outcome import FlightOutcome
from kiteline_lab.flights.plan import FlightPlan
from kiteline_lab.flights.refined_path import refined_path
from kiteline_lab.plots.plot import Line, can_plot, plot_trajectories

_MOST_PLACED = 0.95  # share of live poses in w: a few more come before the base's first answer


def write_results(out: Path, plan: FlightPlan, outcome: FlightOutcome) -> Report:
    """Write what the processes themselves did not, and report.json; returns the report. No plot without matplotlib."""
    report: Report = {"agents": [], "base": None, "drain": {"agents": []}, "notes": sorted(outcome.notes)}
    lines: list[Line] = []
    for k, (source, spec) in enumerate(zip(plan.sources, plan.agents, strict=True)):
        estimates = read_estimates(Path(spec.folder) / "log.mcap")
        part = outcome.agents[k]
        mine: Report = _with_statistics(part) if part is not None else _from_log(source, estimates)
        mine.pop("drain", None)
        truth = source.ground_truth
        # Without a scale in metres a trajectory has a unit of its own.
        alignment = TrajectoryAlignment.SIM3 if mine.get("scale") == "own" else TrajectoryAlignment.SE3
        if part is None:  # it may have ended between writing its trajectories and its log: the log counts
            write_tum(out / f"agent{k}" / "live.tum", _live(estimates))
            write_tum(out / f"agent{k}" / "odometry.tum", _odometry(estimates))
        judged = in_unit_of_end(estimates, mine)
        report["notes"] += left_out_notes(k, estimates, judged)
        live, odometry = _live(judged), _odometry(judged)
        mine["accuracy"] = {
            "live": _accuracy(live, truth, alignment),
            "odometry": _accuracy(odometry, truth, alignment),
        }
        label = f"agent {k} " if len(plan.sources) > 1 else ""
        own_unit = alignment is TrajectoryAlignment.SIM3
        lines.append(live_line(f"{label}live", judged, own_unit))
        drained: Report = dict(part["drain"]) if part is not None else {}
        if outcome.base is not None:
            T_b_c = Rectifier(source.rig).camera.T_b_c
            refined = refined_path(estimates, outcome.at_last_frame, T_b_c)
            write_tum(out / "base" / f"agent{k}.tum", refined)
            mine["accuracy"]["base"] = _accuracy(refined, truth, alignment)
            lines.append(Line(f"{label}base", _trajectory(refined), own_unit))
            drained["accuracy"] = _accuracy(refined_path(estimates, outcome.drained, T_b_c), truth, alignment)
        report["agents"].append(mine)
        report["drain"]["agents"].append(drained)
    if outcome.base is not None:
        base = _with_statistics(outcome.base)
        report["drain"]["base"] = base.pop("drain")
        report["base"] = base
    if can_plot():
        _plot(out / "trajectory.png", lines, plan.sources)
    write_report(out / "report.json", report)
    return report


def _live(estimates: Sequence[Estimate]) -> list[tuple[int, F64]]:
    return [(e.t_ns, pose) for e in estimates if (pose := live_pose(e)) is not None]


def _odometry(estimates: Sequence[Estimate]) -> list[tuple[int, F64]]:
    return [(e.t_ns, e.T_o_b) for e in estimates if not e.initialising]


def in_unit_of_end(estimates: Sequence[Estimate], agent: Report) -> Sequence[Estimate]:
    """Estimates whose unit is as that at the flight's end: metres, or one of the map's own."""
    own = set(agent.get("own_unit_submaps", []))
    ends_in_own = agent.get("scale") == "own"
    return [e for e in estimates if (e.submap in own) == ends_in_own] if own else estimates


def left_out_notes(agent: int, estimates: Sequence[Estimate], judged: Sequence[Estimate]) -> list[str]:
    """A note of the poses that are not among those judged; none if these are no poses, as before the first map."""
    left_out = sum(e.tracked for e in estimates) - sum(e.tracked for e in judged)
    if left_out == 0:
        return []
    poses = counted(left_out, "pose")
    return [f"agent {agent}: {poses} in another unit of length than those at the end: left out of accuracy and plot"]


def read_estimates(log: Path) -> list[Estimate]:
    """All estimates in an agent's log, even in one that was cut; empty without a log."""
    if not log.exists():
        return []
    try:
        with LogReader(log) as reader:
            return [estimate_from_json(message.json()) for message in reader.messages((ESTIMATE,))]
    except SourceError:
        return []  # it was cut before anything was written


def _with_statistics(part: Report) -> Report:
    timing = {key: statistic(value) if isinstance(value, list) else value for key, value in part["timing"].items()}
    return {**part, "timing": timing}


def _from_log(source: FrameSource, estimates: Sequence[Estimate]) -> Report:
    """The report of an agent that ended without one, from its log."""
    counts = FrameCounts()
    for estimate in estimates:
        counts.count(estimate)
    timing = {"cpu_ms_per_frame": statistic([]), "decode_ms": statistic([]), "rss_mib": 0.0}
    return {"source": source.name, **counts.as_report(), "ended_early": True, "timing": timing}


def _trajectory(poses: Sequence[tuple[int, F64]]) -> Trajectory:
    t_ns = np.array([t for t, _ in poses], np.int64)
    return Trajectory(t_ns, np.array([pose for _, pose in poses], np.float64).reshape(-1, 4, 4))


def live_line(name: str, estimates: Sequence[Estimate], own_unit: bool) -> Line:
    """The live poses to draw: those in w alone if many are in a frame of their own, which fits nothing else."""
    shown = [e for e in estimates if live_pose(e) is not None]
    placed = [e for e in shown if e.T_w_b is not None]
    if 0 < len(placed) < _MOST_PLACED * len(shown):
        name += f", the {len(placed) / len(shown):.0%} in w"
        shown = placed
    return Line(name, _trajectory(_live(shown)), own_unit)


def _accuracy(
    poses: Sequence[tuple[int, F64]], truth: Trajectory | None, alignment: TrajectoryAlignment
) -> dict[str, float] | None:
    """Errors against the truth; None where there is none to compare with."""
    if truth is None or not poses:
        return None
    try:
        found = metrics.evaluate(_trajectory(poses), truth, alignment)
    except ValueError:
        return None
    out = {"matched": found.matched, "ate_m": round(found.ate_m.rmse, 6), "ate_max_m": round(found.ate_m.max, 6)}
    if found.rpe_frame is not None:
        out["rpe_mm"] = round(1000.0 * found.rpe_frame.translation_m.rmse, 4)
        out["rpe_deg"] = round(found.rpe_frame.rotation_deg.rmse, 5)
    return out


def _plot(path: Path, lines: Sequence[Line], sources: Sequence[FrameSource]) -> None:
    truth = sources[0].ground_truth if len(sources) == 1 else None
    drawn = [line for line in lines if len(line.trajectory.t_ns)]
    title = sources[0].name if len(sources) == 1 else f"{len(sources)} agents"
    plot_trajectories(path, drawn, truth, title, align=True)
