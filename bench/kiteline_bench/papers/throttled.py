"""Throttled flights: one recording in a mode of `kiteline fly` with a share of a core, and the paper's errors of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.result import FlownProcesses
from kiteline_core.frame import Trajectory
from kiteline_hw.ports import SourceError
from kiteline_lab.evaluation import metrics, trajectories
from kiteline_lab.evaluation.metrics import Matched, TrajectoryAlignment
from kiteline_lab.evaluation.trajectories import TrajectoryError

MODES = {
    "tracker": "tracker",
    "local": "tracker + mapper, one computer",
    "distributed": "distributed",
    "monolith": "monolith",
}  # of `kiteline fly`: the paper's configurations


@dataclass(frozen=True, slots=True)
class Errors:
    """The paper's columns, of live poses aligned at the first one: largest absolute and relative errors in m and
    degrees, and the RMSE of the relative ones. Relative: from one pose to the next, however far apart they are.
    """

    max_abs_m: float
    max_rel_m: float
    rmse_rel_m: float
    max_abs_deg: float
    max_rel_deg: float
    rmse_rel_deg: float


NO_ERRORS = Errors(*[float("inf")] * 6)


@dataclass(frozen=True, slots=True)
class Throttled:
    """One flight. base_max_m: largest absolute error of the base's path. tracking_ms: mean, from frame to pose.

    live: live poses beside the truth, aligned at the first one; None with fewer than three.
    """

    mode: str
    percent: float
    errors: Errors
    base_max_m: float
    frames: int
    posed: int
    lost: int
    dropped: int
    submaps: int
    tracking_ms: float
    loops: int
    live: Matched | None

    @property
    def missing(self) -> float:
        """Share of the frames that have no pose."""
        return (self.lost + self.dropped) / self.frames


def fly_throttled(bench: Bench, source: Path, mode: str, percent: float, *, imu: bool, mono: bool) -> Throttled:
    """Fly in lock-step with `percent` of a core; 0: no limit."""
    folder = f"{source.stem}-{mode}-{percent:g}"
    flown = bench.fly(source, folder, mode=mode, cpu_percent=percent, imu=imu, mono=mono)
    return outcome(flown, source, mode, percent)


def outcome(flown: FlownProcesses, source: Path, mode: str, percent: float, until_m: float = 0.0) -> Throttled:
    """What came of a flight. until_m: errors only as far as the true path is this long; 0: all of it."""
    truth = trajectories.read(f"mcap:{source}").trajectory
    agent = flown.agent()
    errors, live = paper_errors(flown.folder / "agent0" / "live.tum", truth, until_m)
    base, _ = paper_errors(flown.folder / "base" / "agent0.tum", truth, until_m)
    loops = int(flown.base["loops"]) if flown.report["base"] else 0
    return Throttled(
        mode, percent, errors, base.max_abs_m, agent["frames"], agent["tracked"], agent["lost"], agent["dropped"],
        agent["submaps"], agent["timing"]["tracking_ms"]["mean"], loops, live,
    )  # fmt: skip


def paper_errors(file: Path, truth: Trajectory, until_m: float = 0.0) -> tuple[Errors, Matched | None]:
    """Errors of a TUM file's poses, and the poses beside the truth; infinite errors with fewer than three."""
    if not file.exists():
        return NO_ERRORS, None
    try:
        found = metrics.match(trajectories.read(str(file)).trajectory, truth, TrajectoryAlignment.ORIGIN)
    except (SourceError, TrajectoryError, ValueError):
        return NO_ERRORS, None
    n = len(found.t_ns)
    if until_m > 0.0:
        path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(found.truth[:, :3, 3], axis=0), axis=1))])
        n = max(int(np.searchsorted(path, until_m)), 2)
    cut = Matched(found.t_ns[:n], found.estimate[:n], found.truth[:n], found.scale)
    step_m, step_rad = metrics.relative_errors(cut, np.arange(n - 1), np.arange(1, n))
    turned = cut.truth[:, :3, :3].transpose(0, 2, 1) @ cut.estimate[:, :3, :3]
    cosine = np.clip((np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    errors = Errors(
        float(metrics.position_errors(cut).max()), float(step_m.max()), float(np.sqrt(np.mean(step_m**2))),
        float(np.degrees(np.arccos(cosine)).max()), float(np.degrees(step_rad.max())),
        float(np.degrees(np.sqrt(np.mean(step_rad**2)))),
    )  # fmt: skip
    return errors, cut


def medians(flights: Sequence[Throttled]) -> Errors:
    """Each error's median over several starts."""
    names = Errors.__dataclass_fields__
    return Errors(*(float(np.median([getattr(flight.errors, name) for flight in flights])) for name in names))
