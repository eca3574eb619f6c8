"""`kiteline bench papers/sequences --data DIR`: a user's sequences of KITTI, EuRoC, TUM and TUM-VI, one row each.

Without `--data` the recordings of the benchmarks are flown. Beside ours stand the errors that R. Mur-Artal and
J. D. Tardos print for ORB-SLAM2 ("ORB-SLAM2", T-RO 2017, tables I to III), and those of "DS-PTAM", section 4.3.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed, at_most, is_true, table
from kiteline_bench.harness.result import FlownProcesses
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source, recognise
from kiteline_lab.evaluation import metrics, trajectories
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

TITLE = "Sequences of KITTI, EuRoC, TUM and TUM-VI"

_DEEPEST = 5  # folders below the one that was named
_KINDS = {"kitti": "KITTI", "euroc": "EuRoC", "tum": "TUM"}
# m; by how a sequence's folder begins
_ORB_SLAM2 = {
    "KITTI": {"00": 1.3, "01": 10.4, "02": 5.7, "03": 0.6, "04": 0.2, "05": 0.8, "06": 0.8, "07": 0.5, "08": 3.6,
              "09": 3.2, "10": 1.0},
    "EuRoC": {"V1_01": 0.035, "V1_02": 0.020, "V1_03": 0.048, "V2_01": 0.037, "V2_02": 0.035, "MH_01": 0.035,
              "MH_02": 0.018, "MH_03": 0.028, "MH_04": 0.119, "MH_05": 0.060},
    "TUM": {"rgbd_dataset_freiburg1_desk2": 0.022, "rgbd_dataset_freiburg1_desk": 0.016,
            "rgbd_dataset_freiburg1_room": 0.047, "rgbd_dataset_freiburg2_desk": 0.009,
            "rgbd_dataset_freiburg2_xyz": 0.004, "rgbd_dataset_freiburg3_long_office": 0.010,
            "rgbd_dataset_freiburg3_nostructure_texture_near": 0.019},
}  # fmt: skip
_LEAST_TRACKED = 0.95  # of the frames, where an error stands beside a printed one: less of a path errs less
_DS_PTAM = {"KITTI": {"00": 16.6}, "EuRoC": {"MH_01": 0.266}}  # m, largest absolute error of the distributed system


@dataclass(frozen=True, slots=True)
class DataSequence:
    """A sequence in a folder. kind: KITTI, EuRoC, TUM or TUM-VI. name: of its folder."""

    kind: str
    name: str
    source: str

    @property
    def title(self) -> str:
        """Kind and name."""
        return f"{self.kind} {self.name}"

    def printed_m(self, table_m: dict[str, dict[str, float]]) -> float | None:
        """The error that a paper prints for this sequence; None if it has none."""
        rows = table_m.get(self.kind, {})
        return next((error for begin, error in rows.items() if self.name.startswith(begin)), None)


@dataclass(frozen=True, slots=True)
class SequenceResult:
    """A flown sequence. errors: None without truth. largest_m: aligned at the first pose."""

    sequence: DataSequence
    flown: FlownProcesses
    errors: metrics.Evaluation | None
    largest_m: float | None


def find_sequences(folder: Path) -> list[DataSequence]:
    """All sequences in a folder and below, by their layout, in the order of their paths. Raises SourceError if none."""
    folder = folder.expanduser()
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected one that holds sequences of KITTI, EuRoC, TUM or TUM-VI")
    found = _below(folder, _DEEPEST)
    if not found:
        raise SourceError(
            f"{folder}: no sequence found in it or {_DEEPEST} folders below; expected folders with calib.txt "
            "and image_0/ (KITTI), mav0/ (EuRoC, TUM-VI) or rgb.txt (TUM)"
        )
    return found


def _below(folder: Path, deeper: int) -> list[DataSequence]:
    try:
        scheme = recognise(str(folder)).scheme
    except SourceError:
        scheme = ""
    if scheme in _KINDS:
        truly = _KINDS[scheme] if not (folder / "mav0" / "mocap0").is_dir() else "TUM-VI"
        return [DataSequence(truly, folder.absolute().name, f"{scheme}:{folder}")]
    if not deeper:
        return []
    try:
        inner = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    except PermissionError:
        return []
    return [sequence for entry in inner for sequence in _below(entry, deeper - 1)]


def run(bench: Bench) -> list[Bar]:
    """Fly all sequences, each with a base."""
    found = find_sequences(bench.sequences or bench.data)
    bench.warm()
    bars, results = [], []
    for k, sequence in enumerate(found):
        bench.say(f"sequence {k + 1} of {len(found)}: {sequence.title}")
        folder = f"sequence_{k}_{sequence.name}"
        try:
            result = judged(sequence, bench.fly(sequence.source, folder, shown=True))
        except (FlightFailed, SourceError) as error:
            bars.append(is_true(f"{sequence.title}: flown", "yes", False, str(error)[:200]))
            continue
        results.append(result)
        bars += sequence_bars(result)
    columns = (
        "sequence", "frames", "tracked", "path m", "ATE m", "ORB-SLAM2's", "largest m, first pose aligned", "DS-PTAM's",
        "RPE mm/frame", "RPE mm/s", "t_rel %", "r_rel deg/100 m", "CPU ms/frame",
    )  # fmt: skip
    table(bench, "One row a sequence, errors of the base's refined path", columns, [row(result) for result in results])
    return bars


def judged(sequence: DataSequence, flown: FlownProcesses) -> SequenceResult:
    """Compare the refined path with the truth; one camera without IMU is aligned with scale."""
    source = open_source(sequence.source)
    truth, monocular = source.ground_truth, source.rig.right is None and not source.rig.has_depth
    has_imu = source.imu is not None
    source.close()
    path = flown.folder / "base" / "agent0.tum"
    if truth is None or not path.exists() or not path.read_text().strip():
        return SequenceResult(sequence, flown, None, None)
    estimate = trajectories.read(str(path)).trajectory
    alignment = TrajectoryAlignment.SIM3 if monocular and not has_imu else TrajectoryAlignment.SE3
    try:
        errors = metrics.evaluate(estimate, truth, alignment)
        at_origin = metrics.match(estimate, truth, TrajectoryAlignment.ORIGIN)
    except ValueError:
        return SequenceResult(sequence, flown, None, None)
    return SequenceResult(sequence, flown, errors, float(np.max(metrics.position_errors(at_origin))))


def sequence_bars(result: SequenceResult) -> list[Bar]:
    """A sequence is tracked, and as accurate as a paper says where one does."""
    sequence, agent = result.sequence, result.flown.agent()
    tracked, frames = agent["tracked"], agent["frames"]
    printed_m, largest_m = sequence.printed_m(_ORB_SLAM2), sequence.printed_m(_DS_PTAM)
    least = 0.0 if printed_m is None and largest_m is None else _LEAST_TRACKED
    wanted = f">= {100 * least:g} % of the frames" if least else "some frames"
    met = tracked > 0 and tracked >= least * frames
    out = [is_true(f"{sequence.title}: tracked", wanted, met, f"{tracked} of {frames} frames")]
    if result.errors is not None and printed_m is not None:
        out.append(at_most(f"{sequence.title}: ATE base, beside ORB-SLAM2's", result.errors.ate_m.rmse, printed_m, "m"))
    if result.largest_m is not None and largest_m is not None:
        name = f"{sequence.title}: largest error, first pose aligned, beside DS-PTAM's"
        out.append(at_most(name, result.largest_m, largest_m, "m"))
    return out


def row(result: SequenceResult) -> tuple[object, ...]:
    """A row of the table."""
    sequence, agent, e = result.sequence, result.flown.agent(), result.errors
    frame, second, drift = (None, None, None) if e is None else (e.rpe_frame, e.rpe_second, e.kitti)
    return (
        sequence.title, agent["frames"], agent["tracked"],
        *("--" if e is None else (_text(e.path_m), _text(e.ate_m.rmse))),
        _text(sequence.printed_m(_ORB_SLAM2)), _text(result.largest_m), _text(sequence.printed_m(_DS_PTAM)),
        _mm(frame), _mm(second),
        *("--" if drift is None else (_text(drift.t_rel_percent), _text(drift.r_rel_deg_per_100m))),
        _text(float(agent["timing"]["cpu_ms_per_frame"]["mean"])),
    )  # fmt: skip


def _mm(error: metrics.Relative | None) -> str:
    return _text(None if error is None else 1000.0 * error.translation_m.rmse)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
