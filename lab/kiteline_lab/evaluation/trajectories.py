"""Read trajectories: TUM files, KITTI poses, EuRoC's data.csv, or the ground truth of a recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.errors import KitelineError
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_hw.sources.kinds import is_source
from kiteline_hw.sources.text_files import nanoseconds, seconds_to_ns

KITTI_PERIOD_NS = 100_000_000  # 10 Hz: for KITTI poses without a times.txt
QUATERNION_TOLERANCE = 0.02  # a length further from 1 than this is a wrong column


class TrajectoryError(KitelineError):
    """A file that is no trajectory; the text says where, and what was expected."""


@dataclass(frozen=True, slots=True)
class TrajectoryFile:
    """A trajectory. timed: False for KITTI poses without a times.txt, whose t_ns counts at 10 Hz from 0."""

    trajectory: Trajectory
    timed: bool = True


def read(spec: str) -> TrajectoryFile:
    """Read a trajectory file, or the ground truth of a source (`mcap:FILE`, `euroc:DIR`, a folder, …).

    Raises TrajectoryError; SourceError if the source cannot be read.
    """
    path = Path(spec)
    if is_source(spec) or path.is_dir() or path.suffix == ".mcap":
        return TrajectoryFile(_truth_of_source(spec))
    if not path.is_file():
        raise TrajectoryError(f"{spec}: no such file")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise TrajectoryError(f"{spec}: not a text file; expected TUM lines, KITTI poses or EuRoC's data.csv") from None
    numbered = [(i, s) for i, line in enumerate(lines, 1) if (s := line.strip()) and not s.startswith("#")]
    if not numbered:
        raise TrajectoryError(f"{spec}: holds no pose")
    first = numbered[0][1]
    if "," in first:
        return TrajectoryFile(_euroc(spec, numbered))
    columns = len(first.split())
    if columns == 8:
        return TrajectoryFile(_tum(spec, numbered))
    if columns == 12:
        return _kitti(path, numbered)
    raise TrajectoryError(
        f"{spec}: line {numbered[0][0]} has {columns} columns; expected 8 (TUM: t x y z qx qy qz qw), "
        "12 (KITTI: a 3x4 matrix in rows) or EuRoC's data.csv"
    )


def _truth_of_source(spec: str) -> Trajectory:
    from kiteline_hw.sources.open import open_source

    source = open_source(spec)
    try:
        truth = source.ground_truth
    finally:
        source.close()
    if truth is None or len(truth.t_ns) == 0:
        raise TrajectoryError(f"{spec}: this recording holds no ground truth")
    return truth


def _floats(spec: str, number: int, fields: list[str]) -> list[float]:
    try:
        values = [float(f) for f in fields]
    except ValueError:
        raise TrajectoryError(f"{spec}: line {number}: expected numbers, found {' '.join(fields)[:60]!r}") from None
    if not np.isfinite(values).all():
        raise TrajectoryError(f"{spec}: line {number}: a value is not finite")
    return values


def _time_ns(spec: str, number: int, text: str, parse: Callable[[str], int]) -> int:
    try:
        return parse(text)
    except ValueError as error:
        raise TrajectoryError(f"{spec}: line {number}: {error}") from None


def _pose(spec: str, number: int, position: list[float], q_wxyz: list[float]) -> F64:
    q = np.array(q_wxyz)
    if abs(np.linalg.norm(q) - 1.0) > QUATERNION_TOLERANCE:
        raise TrajectoryError(
            f"{spec}: line {number}: the quaternion has length {np.linalg.norm(q):.3f}, expected 1; "
            "are the columns in order?"
        )
    return se3.from_quaternion(q, np.array(position))


def _in_order(spec: str, numbers: list[int], t_ns: list[int], poses: list[F64]) -> Trajectory:
    times = np.array(t_ns, np.int64)
    steps = np.diff(times)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0)) + 1
        raise TrajectoryError(f"{spec}: line {numbers[k]}: its time is not after that of the pose before")
    return Trajectory(times, np.stack(poses))


def _tum(spec: str, numbered: list[tuple[int, str]]) -> Trajectory:
    times, poses = [], []
    for number, line in numbered:
        fields = line.split()
        if len(fields) != 8:
            raise TrajectoryError(
                f"{spec}: line {number} has {len(fields)} columns, expected 8: t x y z qx qy qz qw; was the file cut?"
            )
        x, y, z, qx, qy, qz, qw = _floats(spec, number, fields[1:])
        times.append(_time_ns(spec, number, fields[0], seconds_to_ns))
        poses.append(_pose(spec, number, [x, y, z], [qw, qx, qy, qz]))
    return _in_order(spec, [n for n, _ in numbered], times, poses)


def _euroc(spec: str, numbered: list[tuple[int, str]]) -> Trajectory:
    times, poses = [], []
    for number, line in numbered:
        fields = [f.strip() for f in line.split(",")]
        if len(fields) < 8:
            raise TrajectoryError(
                f"{spec}: line {number}: expected EuRoC's t_ns, x, y, z, qw, qx, qy, qz, …; found {line[:60]!r}"
            )
        values = _floats(spec, number, fields[1:8])
        times.append(_time_ns(spec, number, fields[0], nanoseconds))
        poses.append(_pose(spec, number, values[:3], values[3:]))
    return _in_order(spec, [n for n, _ in numbered], times, poses)


def _kitti(path: Path, numbered: list[tuple[int, str]]) -> TrajectoryFile:
    poses = []
    for number, line in numbered:
        fields = line.split()
        if len(fields) != 12:
            raise TrajectoryError(f"{path}: line {number} has {len(fields)} columns, expected 12: a 3x4 matrix in rows")
        matrix = np.array(_floats(str(path), number, fields)).reshape(3, 4)
        if np.abs(matrix[:, :3] @ matrix[:, :3].T - np.eye(3)).max() > QUATERNION_TOLERANCE:
            raise TrajectoryError(f"{path}: line {number}: the left 3x3 block is no rotation matrix")
        poses.append(se3.orthonormalise(np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])))
    beside = path.with_name("times.txt")
    timed = beside.is_file() and beside != path
    if timed:
        texts = beside.read_text(encoding="utf-8", errors="replace").split()
        if len(texts) != len(poses):
            raise TrajectoryError(
                f"{beside} has {len(texts)} times, but {path} has {len(poses)} poses: one a pose expected"
            )
        times = [_time_ns(str(beside), i, t, seconds_to_ns) for i, t in enumerate(texts, 1)]
    else:
        times = [i * KITTI_PERIOD_NS for i in range(len(poses))]
    return TrajectoryFile(_in_order(str(path), [n for n, _ in numbered], times, poses), timed)


def read_pair(estimate: str, truth: str) -> tuple[Trajectory, Trajectory]:
    """Read both trajectories. KITTI poses without times take the times of the other one, pose by pose."""
    est, true = read(estimate), read(truth)
    if not true.timed and est.timed:
        true = _timed_by(true, est.trajectory)
    elif not est.timed and true.timed:
        est = _timed_by(est, true.trajectory)
    return est.trajectory, true.trajectory


def _timed_by(poses: TrajectoryFile, clock: Trajectory) -> TrajectoryFile:
    """`poses` with the times of `clock` if both have as many; else at 10 Hz from 0, as KITTI's sources stamp them."""
    if len(poses.trajectory.t_ns) != len(clock.t_ns):
        return poses
    return TrajectoryFile(replace(poses.trajectory, t_ns=clock.t_ns))
