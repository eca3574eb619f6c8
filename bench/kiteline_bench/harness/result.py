"""What came of a flight: of one agent in this process, with its errors, or of processes with their report."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.step import Estimate
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_lab.evaluation import metrics, trajectories
from kiteline_lab.evaluation.metrics import TrajectoryAlignment
from kiteline_lab.flights.outcome import FlightOutcome

_WINDOW_NS = 1_000_000_000
_FEWEST = 4  # poses from which a trajectory is compared with the truth


@dataclass(frozen=True, slots=True)
class PoseError:
    """Error of one frame's pose relative to the first frame.

    odometry: (6,) of T_o_b, as cov_o describes it: translation in o, rotation about the body's axes. position_m,
    rotation_rad: of T_m_b, or of T_o_b without a map pose (all submaps begin in the axes of o). tilt_rad: of T_l_b;
    nan while that is withheld.
    """

    estimate: Estimate
    odometry: F64
    position_m: float
    rotation_rad: float
    tilt_rad: float

    @property
    def nees(self) -> float:
        """Normalised squared error of T_o_b; 6 on average if the covariance is consistent."""
        return float(self.odometry @ np.linalg.solve(self.estimate.cov_o + 1e-14 * np.eye(6), self.odometry))


@dataclass(slots=True)
class AgentRun:
    """Flight of one agent; the lists have an entry per frame.

    estimates: None for a dropped frame. truth: T_w_b (4,4) or None. cpu_ns: CPU time of the step, 0 if dropped.
    placed: whether the base had placed the frame's submap by then. metric_submap: submap at the end, None while its
    unit of length is not the metre; metric: whether it is, after each frame. cached_keyframes: most that the agent's
    map cache held.
    """

    t_ns: list[int] = field(default_factory=list)
    estimates: list[Estimate | None] = field(default_factory=list)
    truth: list[F64 | None] = field(default_factory=list)
    cpu_ns: list[int] = field(default_factory=list)
    events: list[tuple[str, ...]] = field(default_factory=list)
    placed: list[bool] = field(default_factory=list)
    metric: list[bool] = field(default_factory=list)
    bytes_up: int = 0
    bytes_down: int = 0
    cached_keyframes: int = 0
    metric_submap: int | None = None

    @property
    def found(self) -> list[Estimate]:
        """Estimates of the frames that were not dropped."""
        return [e for e in self.estimates if e is not None]

    @property
    def tracked(self) -> list[Estimate]:
        """Estimates with a pose in the map."""
        return [e for e in self.found if e.tracked and e.T_m_b is not None]

    @property
    def dropped(self) -> int:
        """Number of frames that were passed over."""
        return sum(e is None for e in self.estimates)

    @property
    def lost(self) -> int:
        """Number of frames without a pose that were not dropped."""
        return len(self.estimates) - self.dropped - len(self.tracked)

    @property
    def submaps(self) -> int:
        """Number of submaps with a tracked frame."""
        return len({e.submap for e in self.tracked})

    @property
    def first_tracked(self) -> int:
        """Index of the first estimate with a pose; their number if none has one."""
        found = self.found
        return next((k for k, e in enumerate(found) if e.tracked), len(found))

    @property
    def lost_after_start(self) -> int:
        """Number of estimates without a pose after the first with one."""
        return sum(not e.tracked for e in self.found[self.first_tracked :])

    def frames_until_tracked(self, first: int) -> int:
        """Number of frames after frame `first` until images track again; all that are left if they do not."""
        after = (k for k, e in enumerate(self.found[first:]) if e.tracked and not e.bridged)
        return next(after, len(self.found) - first)

    def frames_with_event(self, prefix: str) -> list[int]:
        """Frames in which an event begins with a text."""
        return [k for k, events in enumerate(self.events) if any(e.startswith(prefix) for e in events)]

    def evaluate(
        self, estimates: Iterable[Estimate], alignment: TrajectoryAlignment = TrajectoryAlignment.SE3, frame: str = "m"
    ) -> metrics.Evaluation | None:
        """Compare T_m_b (frame "m") or T_o_b ("o") of estimates with the truth; None with too few poses or no truth."""
        poses = [(e.t_ns, e.T_m_b if frame == "m" else e.T_o_b) for e in estimates if e.T_m_b is not None]
        known = [(t, T) for t, T in zip(self.t_ns, self.truth, strict=True) if T is not None]
        if len(poses) < _FEWEST or len(known) < _FEWEST:
            return None
        return metrics.evaluate(_trajectory(poses), _trajectory(known), alignment)

    def ate_m(self, frame: str = "m") -> float:
        """ATE (rmse) of tracked frames in m; nan without truth or with too few of them."""
        found = self.evaluate(self.tracked, frame=frame)
        return float("nan") if found is None else found.ate_m.rmse

    def drift_m(self, begin: int, end: int) -> float:
        """Error of the odometry's motion over frames begin..end, in m."""
        found, first, last = self.found, self.truth[begin - 1], self.truth[end - 1]
        assert first is not None and last is not None
        moved = se3.inverse(found[begin - 1].T_o_b) @ found[end - 1].T_o_b
        return float(np.linalg.norm((moved - se3.inverse(first) @ last)[:3, 3]))

    def largest_jump_m(self, period_ns: int) -> float:
        """Largest motion of the odometry between two frames, per frame period."""
        found = self.found
        return max(
            float(np.linalg.norm(b.T_o_b[:3, 3] - a.T_o_b[:3, 3])) / max((b.t_ns - a.t_ns) / period_ns, 1.0)
            for a, b in pairwise(found)
        )

    def errors(self) -> list[PoseError]:
        """Errors of all frames from the first one with a pose on against the truth, relative to that frame."""
        out: list[PoseError] = []
        start: tuple[F64, F64] | None = None
        for e, true in zip(self.estimates, self.truth, strict=True):
            assert e is not None and true is not None
            if e.initialising:
                continue
            start = start or (e.T_o_b, true)
            odometry = pose_error(start, e.T_o_b, true)
            claimed = odometry if e.T_m_b is None else pose_error(start, e.T_m_b, true)
            position, rotation = (float(np.linalg.norm(part)) for part in (claimed[:3], claimed[3:]))
            out.append(PoseError(e, odometry, position, rotation, tilt_rad(e, true)))
        return out

    def load_percent(self, period_ns: int) -> float:
        """CPU time over the whole flight, in percent of one core."""
        return 100.0 * sum(self.cpu_ns) / (self.t_ns[-1] - self.t_ns[0] + period_ns)

    def peak_percent(self, settled_ns: int) -> float:
        """Largest CPU time of any one-second window that ends `settled_ns` after the start or later."""
        return 100.0 * busiest_window(np.array(self.t_ns, np.int64), np.array(self.cpu_ns, np.int64), settled_ns)


def tilt_rad(estimate: Estimate, truth: F64) -> float:
    """Tilt of T_l_b against the true T_w_b (4,4); nan while it is withheld."""
    if estimate.T_l_b is None:
        return float("nan")
    return float(np.arccos(np.clip((estimate.T_l_b[:3, :3] @ truth[:3, :3].T)[2, 2], -1.0, 1.0)))


def pose_error(start: tuple[F64, F64], T_a_b: F64, truth: F64) -> F64:
    """Error (6,) [translation in a, rotation about the body's axes] of a pose; start: (estimate, truth) of frame 0."""
    found, true = se3.inverse(start[0]) @ T_a_b, se3.inverse(start[1]) @ truth
    moved = start[0][:3, :3] @ (found[:3, 3] - true[:3, 3])
    return np.concatenate([moved, se3.so3_log(true[:3, :3].T @ found[:3, :3])])


def busiest_window(t_ns: I64, cpu_ns: I64, settled_ns: int) -> float:
    """Largest share of a core in any one-second window that ends `settled_ns` after the first time or later."""
    total = np.concatenate([[0], np.cumsum(cpu_ns)])
    first = np.searchsorted(t_ns, t_ns - _WINDOW_NS, side="right")
    sums = total[1:] - total[first]
    return float(sums[t_ns >= t_ns[0] + settled_ns].max(initial=0)) / _WINDOW_NS


@dataclass(frozen=True, slots=True)
class FlownProcesses:
    """What `kiteline fly` left: its folder, report.json and how the processes ended."""

    folder: Path
    report: dict[str, Any]
    outcome: FlightOutcome

    @property
    def base(self) -> dict[str, Any]:
        """The base's part of the report."""
        return dict(self.report["base"])

    def agent(self, number: int = 0) -> dict[str, Any]:
        """An agent's part of the report."""
        return dict(self.report["agents"][number])

    def accuracy(self, trajectory: str = "base", agent: int = 0) -> dict[str, float]:
        """Errors of the trajectory "live", "odometry" or "base"; infinite where there is nothing to compare."""
        found = self.report["agents"][agent]["accuracy"][trajectory]
        return dict(found) if found is not None else {"ate_m": float("inf")}

    def ate_m(self, trajectory: str = "base", agent: int = 0) -> float:
        """ATE in m."""
        return float(self.accuracy(trajectory, agent)["ate_m"])

    def joint_ate_m(self, sources: Sequence[Path]) -> float:
        """ATE of all agents' refined trajectories under one alignment; infinite if an agent has none."""
        ours, theirs = [], []
        for i, source in enumerate(sources):
            path = self.folder / "base" / f"agent{i}.tum"
            if not path.exists() or not path.read_text().strip():
                return float("inf")
            estimate, truth = trajectories.read(str(path)).trajectory, trajectories.read(f"mcap:{source}").trajectory
            found, true = metrics.truth_at(estimate.t_ns, truth)
            ours.append(estimate.T_w_b[found, :3, 3])
            theirs.append(true[:, :3, 3])
        return aligned_rmse_m(np.concatenate(ours), np.concatenate(theirs))


def aligned_rmse_m(ours: F64, theirs: F64) -> float:
    """RMSE of positions (n,3) after the best rigid alignment."""
    T, _ = metrics.umeyama(ours, theirs)
    return float(np.sqrt(np.mean(np.sum((se3.transform(T, ours) - theirs) ** 2, axis=1))))


def _trajectory(poses: Sequence[tuple[int, F64]]) -> Trajectory:
    return Trajectory(np.array([t for t, _ in poses], np.int64), np.array([T for _, T in poses]))
