"""One flight with a base, or without, compared with the truth; and tables and bars over several of them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.runtime.frame_counts import live_pose
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_basestation.station import Station
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.harness.faults import Spans
from kiteline_bench.harness.recording import Recording
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import FlyingAgent, fly_recording
from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import Matched, TrajectoryAlignment
from kiteline_lab.flights.refined_path import refined_path

Poses = list[tuple[int, F64]]

_WINDOW_S, _STEP_S = 5.0, 1.0  # of the windows whose scale is compared with the truth
_FALSE = 0.05  # error of a window's scale from which "metric" is wrong
_LEAST_PATH_M = 1.0  # in a window: from less the scale is not known


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight and how long it took. refined: the base's path of the agent, T_w_b; empty without a base.

    box, station: agent and base at the end; no station in a flight without a base.
    """

    run: AgentRun
    refined: Poses
    seconds: float
    box: Agent | None = None
    station: Station | None = None

    @property
    def begin_ns(self) -> int:
        """Stamp of the first frame."""
        return self.run.t_ns[0]

    def poses(self, path: str, from_s: float = 0.0, to_s: float = float("inf")) -> Poses:
        """Poses of the path "live", "base" or "odometry" between two times after the first frame."""
        if path == "base":
            found = self.refined
        elif path == "live":
            found = [(e.t_ns, pose) for e in self.run.found if (pose := live_pose(e)) is not None]
        else:
            found = [(e.t_ns, e.T_o_b) for e in self.run.tracked]
        return [(t, T) for t, T in found if from_s <= (t - self.begin_ns) * 1e-9 < to_s]

    def matched(
        self, path: str, alignment: TrajectoryAlignment = TrajectoryAlignment.SE3, from_s: float = 0.0,
        to_s: float = float("inf"),
    ) -> Matched | None:  # fmt: skip
        """A path beside the truth; None if fewer than four of its poses have a true one."""
        poses, truth = self.poses(path, from_s, to_s), _truth(self.run)
        if len(poses) < 4 or truth is None:
            return None
        estimate = Trajectory(np.array([t for t, _ in poses], np.int64), np.array([T for _, T in poses]))
        try:
            return metrics.match(estimate, truth, alignment)
        except ValueError:
            return None

    def ate_m(
        self, path: str, from_s: float = 0.0, alignment: TrajectoryAlignment = TrajectoryAlignment.SE3
    ) -> float:  # fmt: skip
        """ATE after alignment; infinite without poses."""
        found = self.matched(path, alignment, from_s)
        return float("inf") if found is None else float(np.sqrt(np.mean(metrics.position_errors(found) ** 2)))

    def rpe_mm(self, path: str) -> float:
        """Relative error of one frame in mm."""
        found = self.matched(path)
        if found is None:
            return float("inf")
        n = len(found.t_ns)
        step, _ = metrics.relative_errors(found, np.arange(n - 1), np.arange(1, n))
        return float(1000.0 * np.sqrt(np.mean(step**2)))

    def scale_error(self, path: str, from_s: float = 0.0, to_s: float = float("inf")) -> float:
        """Share by which lengths are off; infinite without poses."""
        found = self.matched(path, TrajectoryAlignment.SIM3, from_s, to_s)
        return float("inf") if found is None else abs(1.0 / found.scale - 1.0)

    @property
    def metric_after_s(self) -> float:
        """Time from the first frame until lengths are said to be metres; infinite if that is never said."""
        said = [t for t, metric in zip(self.run.t_ns, self.run.metric, strict=True) if metric]
        return (said[0] - self.begin_ns) * 1e-9 if said else float("inf")

    @property
    def lost_after_metric(self) -> int:
        """Frames without a pose after lengths were first said to be metres; all of them if that is never said."""
        if not np.isfinite(self.metric_after_s):
            return len(self.run.t_ns)
        after = self.begin_ns + 1e9 * self.metric_after_s
        tracked = {e.t_ns for e in self.run.tracked}
        return sum(t not in tracked for t in self.run.t_ns if t >= after)

    def false_metric(self, without: Spans = ()) -> float:
        """Largest scale error of live poses in a window of 5 s that were all said to be metric; 0 if none were.

        without: windows that touch these spans are left out.
        """
        worst, begin_s = 0.0, self.metric_after_s
        metric = dict(zip(self.run.t_ns, self.run.metric, strict=True))
        truth = _truth(self.run)
        if truth is None:
            return worst
        end_s = (self.run.t_ns[-1] - self.begin_ns) * 1e-9
        while np.isfinite(begin_s) and begin_s < end_s - 0.5 * _WINDOW_S:
            poses = self.poses("live", begin_s, begin_s + _WINDOW_S)
            touched = any(begin_s < b and a < begin_s + _WINDOW_S for a, b in without)
            if len(poses) > 20 and not touched and all(metric[t] for t, _ in poses):
                true = metrics.truth_at(np.array([t for t, _ in poses], np.int64), truth)[1]
                path_m = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum())
                if path_m >= _LEAST_PATH_M:
                    worst = max(worst, self.scale_error("live", begin_s, begin_s + _WINDOW_S))
            begin_s += _STEP_S
        return worst

    def largest_jump_m(self) -> float:
        """Largest change of the live pose between two frames, beside the motion in the odometry frame."""
        found = [(e, pose) for e in self.run.found if (pose := live_pose(e)) is not None]
        jumps = [
            float(np.linalg.norm((pose_b @ se3.inverse(b.T_o_b) @ a.T_o_b)[:3, 3] - pose_a[:3, 3]))
            for (a, pose_a), (b, pose_b) in pairwise(found)
            if a.submap == b.submap
        ]
        return max(jumps, default=0.0)


def flown(
    bench: Bench, what: str, recording: Recording, *, base: bool = True, bytes_s: tuple[int, int] = (0, 0),
    profile: str = "wifi", config: AgentConfig | None = None,
) -> Flown:  # fmt: skip
    """Fly a recording in this process, and say what was flown and how long it took."""
    begin_s = time.perf_counter()
    if base:
        flight = fly_recording(recording, config, bytes_s=bytes_s, profile=profile)
        keyframes = {int(k): pose for k, pose in keyframe_poses(flight.station.mapper).items()}
        refined = refined_path(flight.agent.found, keyframes, Rectifier(recording.rig).camera.T_b_c)
        result = Flown(flight.agent, refined, time.perf_counter() - begin_s, flight.box, flight.station)
    else:
        agent = FlyingAgent(recording.rig, recording.imu, config)
        for item in recording.items:
            agent.step(item)
        result = Flown(agent.run, [], time.perf_counter() - begin_s, agent.box)
    bench.say(f"{what}: {len(recording.items)} frames in {result.seconds:.0f} s")
    return result


StartRow = tuple[str, float, float, float]  # flight, start in s, metric after s, largest error of a metric window in %


def start_of(bench: Bench, name: str, start_s: float, recording: Recording) -> StartRow:
    """Fly a recording that begins at start_s, without a base, for when it says "metric" and how wrong that is."""
    flight = flown(bench, f"{name} from {start_s:g} s", recording, base=False)
    row = (name, start_s, flight.metric_after_s, 100.0 * flight.false_metric())
    bench.say(f"  metric after {row[2]:.1f} s, scale off by up to {row[3]:.1f} %")
    return row


def wrong_metres(rows: Sequence[StartRow]) -> Bar:
    """The bar on starts that say "metric" while lengths are wrong."""
    wrong = sum(row[3] > 100.0 * _FALSE for row in rows)
    name = f"metric said while the scale of 5 s is off by more than {100 * _FALSE:g} %, of {len(rows)} starts"
    return at_most(name, wrong, 0, "", 0)


def spread(
    name: str, values: Sequence[float], limit: float, unit: str, digits: int = 3, *, worst: float | None = None
) -> list[Bar]:
    """Bars on the median and the worst of several flights. worst: a limit of its own."""
    n = len(values)
    return [
        at_most(f"{name}: median of {n}", float(np.median(values)), limit, unit, digits),
        at_most(f"{name}: worst", float(max(values)), limit if worst is None else worst, unit, digits),
    ]


def _truth(run: AgentRun) -> Trajectory | None:
    known = [(t, T) for t, T in zip(run.t_ns, run.truth, strict=True) if T is not None]
    if len(known) < 4:
        return None
    return Trajectory(np.array([t for t, _ in known], np.int64), np.array([T for _, T in known]))
