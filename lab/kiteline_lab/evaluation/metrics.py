"""Errors of a trajectory against ground truth. Pure: arrays in, numbers out.

ATE and RPE after J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012); alignment after
S. Umeyama (PAMI 1991); t_rel and r_rel after A. Geiger et al., the KITTI odometry benchmark (CVPR 2012).
"""

from dataclasses import asdict, dataclass
from enum import Enum

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3

MAX_DIFFERENCE_NS = 10_000_000  # largest difference in time of two poses that are compared (as in evo and TUM's tools)
FARTHEST_M = 1e9  # of a position; squares of such as 1e200 overflow, on which a singular value decomposition never ends
MAX_BRIDGE_NS = 50_000_000  # ground truth at 20 Hz or more is interpolated; the error on a drone is below 1 mm
GAP_FACTOR = 1.5  # a step longer than this many median steps is a gap: poses are missing there
SECOND_TOLERANCE = 0.1  # an RPE pair "one second apart" may be 10 % off
END_SLACK_NS = 5_000_000  # stamps jitter: the last full second may end this much after the last pose
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)  # the benchmark's own
KITTI_STEP_S = 1.0  # one segment start a second: the benchmark's ten frames


class TrajectoryAlignment(Enum):
    """How the estimate's frame is aligned with that of the ground truth."""

    SE3 = "se3"  # least squares over rotation and translation
    SIM3 = "sim3"  # and scale: for a monocular camera
    ORIGIN = "origin"  # the first pose on the first pose


@dataclass(frozen=True, slots=True)
class Spread:
    """Root mean square, mean and maximum of n values."""

    rmse: float
    mean: float
    max: float
    n: int


@dataclass(frozen=True, slots=True)
class Relative:
    """Relative pose errors over one step: metres and degrees."""

    translation_m: Spread
    rotation_deg: Spread


@dataclass(frozen=True, slots=True)
class KittiDrift:
    """Mean over segments of 100 to 800 m: drift in percent of the path, and degrees per 100 m."""

    t_rel_percent: float
    r_rel_deg_per_100m: float
    segments: int


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All errors that `kiteline eval` reports. None where the trajectories are too short for one."""

    alignment: str
    scale: float
    matched: int  # pairs of an estimated and a true pose
    estimated: int  # poses in the estimate
    coverage: float  # share of the ground truth's time during which the estimate has poses
    frames_covered: float  # matched poses over the frames in the ground truth's time at the estimate's rate
    path_m: float  # length of the true path over the matched poses
    ate_m: Spread
    rpe_frame: Relative | None
    rpe_second: Relative | None
    kitti: KittiDrift | None

    def as_dict(self) -> dict[str, object]:
        """Nested plain values, for JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Matched:
    """Pairs of poses at equal times. t_ns: (n,) of the estimate. estimate: (n,4,4) aligned. truth: (n,4,4)."""

    t_ns: I64
    estimate: F64
    truth: F64
    scale: float


def associate(est_ns: I64, truth_ns: I64, max_difference_ns: int = MAX_DIFFERENCE_NS) -> tuple[I64, I64]:
    """Match times: for each estimate the nearest truth, each used once. Returns indices (k,), (k,).

    Both inputs increase strictly. Of two estimates nearest to one truth, the nearer is matched (the earlier on a tie).
    """
    if len(truth_ns) == 0 or len(est_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.searchsorted(truth_ns, est_ns).clip(1, max(1, len(truth_ns) - 1))
    after = np.minimum(after, len(truth_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(truth_ns[before] - est_ns) <= np.abs(truth_ns[after] - est_ns), before, after)
    away = np.abs(truth_ns[nearest] - est_ns)
    candidates = np.flatnonzero(away <= max_difference_ns)
    order = candidates[np.lexsort((candidates, away[candidates], nearest[candidates]))]
    first = np.ones(len(order), bool)
    first[1:] = nearest[order][1:] != nearest[order][:-1]
    chosen = np.sort(order[first])
    return chosen.astype(np.int64), nearest[chosen].astype(np.int64)


def truth_at(est_ns: I64, truth: Trajectory, max_difference_ns: int = MAX_DIFFERENCE_NS) -> tuple[I64, F64]:
    """Ground truth at the times of an estimate: indices (k,) of the estimated poses that have one, poses (k,4,4).

    Between true poses at most MAX_BRIDGE_NS apart it is interpolated (constant velocity and rotation rate); the nearest
    pose would add the path of half a period to the error, 10 mm at 1 m/s and 50 Hz. Sparser truth is matched with the
    nearest pose within max_difference_ns, each used once.
    """
    n = len(truth.t_ns)
    if n == 0 or len(est_ns) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 4, 4))
    after = np.searchsorted(truth.t_ns, est_ns)
    exact = (after < n) & (truth.t_ns[np.minimum(after, n - 1)] == est_ns)
    inside = (after > 0) & (after < n) & ~exact
    gap = np.where(inside, truth.t_ns[np.minimum(after, n - 1)] - truth.t_ns[np.maximum(after - 1, 0)], 0)
    bridged = inside & (gap <= MAX_BRIDGE_NS)
    poses = np.zeros((len(est_ns), 4, 4))
    poses[exact] = truth.T_w_b[after[exact]]
    for i in np.flatnonzero(bridged):
        j = int(after[i])
        part = float(est_ns[i] - truth.t_ns[j - 1]) / float(gap[i])
        poses[i] = _between_poses(truth.T_w_b[j - 1], truth.T_w_b[j], part)
    known = exact | bridged
    rest = np.flatnonzero(~known)
    i_rest, j_rest = associate(est_ns[rest], truth.t_ns, max_difference_ns)
    fresh = ~np.isin(j_rest, after[exact])
    poses[rest[i_rest[fresh]]] = truth.T_w_b[j_rest[fresh]]
    known[rest[i_rest[fresh]]] = True
    found = np.flatnonzero(known)
    return found.astype(np.int64), poses[found]


def _between_poses(a: F64, b: F64, part: float) -> F64:
    rotation = se3.so3_exp(part * se3.so3_log(a[:3, :3].T @ b[:3, :3]))
    return se3.from_rt(a[:3, :3] @ rotation, (1.0 - part) * a[:3, 3] + part * b[:3, 3])


def umeyama(source: F64, target: F64, *, with_scale: bool = False) -> tuple[F64, float]:
    """Align points (n,3), n >= 1: the T (4,4) and scale that minimise sum |target - (scale * R source + t)|^2.

    Raises ValueError if `with_scale` and all source points coincide.
    """
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd(t.T @ s / len(source))
    sign = np.ones(3)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        sign[2] = -1.0
    rotation = u @ np.diag(sign) @ vt
    scale = 1.0
    if with_scale:
        variance = float((s**2).sum() / len(source))
        if variance < 1e-12:
            raise ValueError("the estimate does not move: no scale can be found")
        scale = float(d @ sign) / variance
    return se3.from_rt(rotation, mean_t - scale * rotation @ mean_s), scale


def match(
    estimate: Trajectory, truth: Trajectory, alignment: TrajectoryAlignment, max_difference_ns: int = MAX_DIFFERENCE_NS
) -> Matched:
    """Match in time and align. Raises ValueError if fewer than three poses match, or lie beyond any flight."""
    i, true = truth_at(estimate.t_ns, truth, max_difference_ns)
    if len(i) < 3:
        raise ValueError(
            f"only {len(i)} of {len(estimate.t_ns)} poses have a true pose at their time: {_spans(estimate, truth)}"
        )
    est = estimate.T_w_b[i]
    farthest_m = float(max(np.abs(poses[:, :3, 3]).max() for poses in (est, true)))
    if not farthest_m <= FARTHEST_M:
        raise ValueError(f"a position is {farthest_m:.3g} m from the origin, expected at most {FARTHEST_M:.0g} m")
    scale = 1.0
    if alignment is TrajectoryAlignment.ORIGIN:
        t = true[0] @ se3.inverse(est[0])
    else:
        t, scale = umeyama(est[:, :3, 3], true[:, :3, 3], with_scale=alignment is TrajectoryAlignment.SIM3)
    aligned = est.copy()
    aligned[:, :3, :3] = t[:3, :3] @ est[:, :3, :3]
    aligned[:, :3, 3] = scale * est[:, :3, 3] @ t[:3, :3].T + t[:3, 3]
    return Matched(estimate.t_ns[i], aligned, true, scale)


def position_errors(matched: Matched) -> F64:
    """Distance (n,) in m between the aligned estimate and the truth."""
    return np.asarray(np.linalg.norm(matched.estimate[:, :3, 3] - matched.truth[:, :3, 3], axis=1))


def relative_errors(matched: Matched, i: I64, j: I64) -> tuple[F64, F64]:
    """Translation (k,) in m and rotation (k,) in rad of (true motion)^-1 (estimated motion) from poses i to poses j."""
    error = _inverse(_between(matched.truth, i, j)) @ _between(matched.estimate, i, j)
    return np.asarray(np.linalg.norm(error[:, :3, 3], axis=1)), _angles(error[:, :3, :3])


def kitti_drift(matched: Matched) -> KittiDrift | None:
    """Drift over segments of KITTI's lengths; None if the path is shorter than the shortest of them."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(matched.truth[:, :3, 3], axis=0), axis=1))])
    step_ns = float(np.median(np.diff(matched.t_ns)))
    stride = max(1, round(KITTI_STEP_S * 1e9 / step_ns))
    translation, rotation = [], []
    for length in KITTI_LENGTHS_M:
        start = np.arange(0, len(path), stride)
        end = np.searchsorted(path, path[start] + length, side="right")
        start, end = start[end < len(path)], end[end < len(path)]
        if len(start):
            t, r = relative_errors(matched, start, end)
            translation.append(t / length)
            rotation.append(r / length)
    if not translation:
        return None
    t_all, r_all = np.concatenate(translation), np.concatenate(rotation)
    return KittiDrift(100.0 * float(t_all.mean()), 100.0 * float(np.degrees(r_all.mean())), len(t_all))


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: TrajectoryAlignment = TrajectoryAlignment.SE3,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> Evaluation:
    """All errors of `kiteline eval`. Raises ValueError if fewer than three poses match in time."""
    matched = match(estimate, truth, alignment, max_difference_ns)
    n = len(matched.t_ns)
    frame = _relative(matched, np.arange(n - 1), np.arange(1, n))
    true_path = np.linalg.norm(np.diff(matched.truth[:, :3, 3], axis=0), axis=1).sum()
    time_part, frame_part = _coverage(estimate.t_ns, truth.t_ns, n)
    return Evaluation(
        alignment=alignment.value,
        scale=matched.scale,
        matched=n,
        estimated=len(estimate.t_ns),
        coverage=time_part,
        frames_covered=frame_part,
        path_m=float(true_path),
        ate_m=_spread(position_errors(matched)),
        rpe_frame=frame,
        rpe_second=_relative(matched, *_one_second_pairs(matched.t_ns)),
        kitti=kitti_drift(matched),
    )


def _one_second_pairs(t_ns: I64) -> tuple[I64, I64]:
    goal = t_ns + 1_000_000_000
    after = np.searchsorted(t_ns, goal).clip(1, len(t_ns) - 1)
    j = np.where(np.abs(t_ns[after - 1] - goal) < np.abs(t_ns[after] - goal), after - 1, after)
    near = (np.abs(t_ns[j] - goal) <= SECOND_TOLERANCE * 1e9) & (j > np.arange(len(t_ns)))
    i = np.flatnonzero(near & (goal <= t_ns[-1] + END_SLACK_NS))
    return i.astype(np.int64), j[i].astype(np.int64)


def _coverage(est_ns: I64, truth_ns: I64, matched: int) -> tuple[float, float]:
    span_ns = int(truth_ns[-1] - truth_ns[0])
    steps = np.diff(est_ns)
    usual_ns = float(np.median(steps))
    start = np.clip(est_ns[:-1], truth_ns[0], truth_ns[-1])
    end = np.clip(est_ns[1:], truth_ns[0], truth_ns[-1])
    inside = int((end - start)[steps <= GAP_FACTOR * usual_ns].sum())
    frames = span_ns / usual_ns + 1.0
    return min(1.0, inside / span_ns) if span_ns else 1.0, min(1.0, matched / max(1.0, np.floor(frames)))


def _relative(matched: Matched, i: I64, j: I64) -> Relative | None:
    if len(i) == 0:
        return None
    translation, rotation = relative_errors(matched, i, j)
    return Relative(_spread(translation), _spread(np.degrees(rotation)))


def _between(poses: F64, i: I64, j: I64) -> F64:
    return np.asarray(_inverse(poses[i]) @ poses[j])


def _inverse(poses: F64) -> F64:
    out = np.zeros_like(poses)
    out[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out


def _angles(rotations: F64) -> F64:
    """Angles (n,) in rad; from sine and cosine, so that small angles keep their precision."""
    r = rotations
    axis = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=1), np.trace(r, axis1=1, axis2=2) - 1.0))


def _spread(values: F64) -> Spread:
    return Spread(float(np.sqrt((values**2).mean())), float(values.mean()), float(values.max()), len(values))


def _spans(estimate: Trajectory, truth: Trajectory) -> str:
    e, t = estimate.t_ns, truth.t_ns
    if len(e) == 0 or len(t) == 0:
        return "one of them is empty"
    e_s, t_s = e / 1e9, t / 1e9
    return f"the estimate runs from {e_s[0]:.3f} to {e_s[-1]:.3f} s, the truth from {t_s[0]:.3f} to {t_s[-1]:.3f} s"
