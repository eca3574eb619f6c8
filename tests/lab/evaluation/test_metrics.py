import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core.arrays import F64, I64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment, associate, evaluate, match, truth_at, umeyama

PERIOD_NS = 50_000_000

tangents = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


def flight(n: int = 120, seed: int = 3) -> Trajectory:
    """A wavy path that turns, n poses at 20 Hz."""
    s = np.arange(n) / 20.0
    rng = np.random.default_rng(seed)
    poses = np.stack([se3.exp(np.concatenate([np.zeros(3), [0.3 * np.sin(t), 0.2 * np.cos(t), 0.5 * t]])) for t in s])
    poses[:, :3, 3] = np.stack([2.0 * np.cos(s), 1.5 * np.sin(s), 0.3 * s], axis=1) + 0.01 * rng.normal(size=(n, 3))
    return Trajectory(1_403_715_273_262_142_976 + PERIOD_NS * np.arange(n, dtype=np.int64), poses)


def moved(trajectory: Trajectory, T: F64, scale: float = 1.0) -> Trajectory:
    poses = trajectory.T_w_b.copy()
    poses[:, :3, 3] *= scale
    return Trajectory(trajectory.t_ns, T @ poses)


def part(trajectory: Trajectory, keep: I64) -> Trajectory:
    return Trajectory(trajectory.t_ns[keep], trajectory.T_w_b[keep])


@given(tangents)
def test_ate_and_rpe_do_not_depend_on_where_the_estimate_s_world_lies(xi: F64) -> None:
    truth = flight()
    noisy = Trajectory(truth.t_ns, truth.T_w_b @ se3.exp(np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0])))
    there, here = evaluate(moved(noisy, se3.exp(xi)), truth), evaluate(noisy, truth)
    assert there.ate_m.rmse == pytest.approx(here.ate_m.rmse, abs=1e-9)
    assert there.rpe_frame.rotation_deg.rmse == pytest.approx(here.rpe_frame.rotation_deg.rmse, abs=1e-7)
    assert there.rpe_frame.translation_m.rmse == pytest.approx(here.rpe_frame.translation_m.rmse, abs=1e-9)


@given(tangents, st.floats(0.2, 5.0))
def test_umeyama_recovers_a_similarity_exactly(xi: F64, scale: float) -> None:
    points = flight().T_w_b[:, :3, 3]
    T = se3.exp(xi)
    found, found_scale = umeyama(points, scale * points @ T[:3, :3].T + T[:3, 3], with_scale=True)
    np.testing.assert_allclose(found, T, atol=1e-9)
    assert found_scale == pytest.approx(scale, rel=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_umeyama_never_mirrors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 6, 3))
    T, _ = umeyama(source, target)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


@given(tangents.map(lambda xi: 0.05 * xi))
def test_no_small_motion_fits_better_than_umeyama(xi: F64) -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(20, 3))
    target = source + 0.1 * rng.normal(size=(20, 3))
    T, _ = umeyama(source, target)
    best = ((se3.transform(T, source) - target) ** 2).sum()
    assert ((se3.transform(se3.exp(xi) @ T, source) - target) ** 2).sum() >= best - 1e-12


def test_known_answers() -> None:
    """Zigzag by 3 cm about a straight truth: every figure can be written down."""
    n = 41
    truth = np.tile(np.eye(4), (n, 1, 1))
    truth[:, 0, 3] = 0.1 * np.arange(n)
    est = truth.copy()
    est[:, 1, 3] = 0.03 * (-1.0) ** np.arange(n)
    t_ns = 100_000_000 * np.arange(n, dtype=np.int64)
    e = evaluate(Trajectory(t_ns, est), Trajectory(t_ns, truth), TrajectoryAlignment.ORIGIN)
    assert e.ate_m.max == pytest.approx(0.06)  # the first pose lies on the truth, each second one 6 cm beside
    assert e.ate_m.mean == pytest.approx(0.06 * 20 / 41)
    assert e.rpe_frame.translation_m.rmse == pytest.approx(0.06)
    assert e.rpe_frame.rotation_deg.max == pytest.approx(0.0)
    assert e.rpe_second.translation_m.max == pytest.approx(0.0, abs=1e-12)  # ten frames on, the same side again
    assert e.rpe_second.translation_m.n == 31
    assert e.path_m == pytest.approx(4.0)
    assert e.kitti is None
    centred = evaluate(Trajectory(t_ns, est), Trajectory(t_ns, truth))
    assert centred.ate_m.rmse == pytest.approx(0.03, rel=1e-3)


def test_a_steady_turn_is_the_rotation_error() -> None:
    truth = flight()
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(0.25)]))
    poses = [truth.T_w_b[0]]
    for a, b in zip(truth.T_w_b[:-1], truth.T_w_b[1:]):
        poses.append(poses[-1] @ se3.inverse(a) @ b @ turn)
    e = evaluate(Trajectory(truth.t_ns, np.stack(poses)), truth)
    assert e.rpe_frame.rotation_deg.mean == pytest.approx(0.25, rel=1e-6)
    assert e.rpe_frame.rotation_deg.max == pytest.approx(0.25, rel=1e-6)
    assert e.rpe_frame.translation_m.max == pytest.approx(0.0, abs=1e-9)


def test_scale_is_found_only_when_asked_for() -> None:
    truth = flight()
    half = moved(truth, se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])), 0.5)
    with_scale = evaluate(half, truth, TrajectoryAlignment.SIM3)
    assert with_scale.scale == pytest.approx(2.0)
    assert with_scale.ate_m.rmse == pytest.approx(0.0, abs=1e-9)
    assert with_scale.rpe_frame.translation_m.max == pytest.approx(0.0, abs=1e-9)
    assert evaluate(half, truth).ate_m.rmse > 0.3


def test_drift_along_a_long_way_is_kitti_s_percent() -> None:
    n = 3001
    truth = np.tile(np.eye(4), (n, 1, 1))
    truth[:, 2, 3] = 0.5 * np.arange(n)  # 1500 m at 10 Hz
    est = truth.copy()
    est[:, 2, 3] *= 1.02
    t_ns = 100_000_000 * np.arange(n, dtype=np.int64)
    k = evaluate(Trajectory(t_ns, est), Trajectory(t_ns, truth)).kitti
    assert k.t_rel_percent == pytest.approx(2.0, rel=0.01)
    assert k.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-9)
    assert k.segments == sum(len(range(0, 3000 - 2 * int(length), 10)) for length in metrics.KITTI_LENGTHS_M)


@given(
    st.sets(st.integers(0, 300), min_size=0, max_size=30),
    st.sets(st.integers(0, 300), min_size=0, max_size=30),
    st.integers(0, 20),
)
def test_association_is_the_brute_force_one(est: set[int], truth: set[int], limit: int) -> None:
    a, b = np.array(sorted(est), np.int64), np.array(sorted(truth), np.int64)
    i, j = associate(a, b, limit)
    assert len(set(j.tolist())) == len(j)
    assert all(np.abs(a[i] - b[j]) <= limit)
    wanted = {}
    for k, t in enumerate(a.tolist()):
        if len(b) and np.abs(b - t).min() <= limit:
            first = int(np.argmin(np.abs(b - t)))  # the earlier of two that are as near
            best = wanted.get(first)
            if best is None or abs(b[first] - t) < abs(b[first] - a[best]):
                wanted[first] = k
    assert dict(zip(j.tolist(), i.tolist())) == wanted


def test_a_gappy_estimate_against_truth_of_another_rate() -> None:
    fine = flight(1200)  # stands for 200 Hz
    truth = Trajectory(fine.t_ns[0] + 5_000_000 * np.arange(1200, dtype=np.int64), fine.T_w_b)
    every = part(truth, np.arange(0, 1200, 10))
    keep = np.concatenate([np.arange(0, 40), np.arange(70, 120)])  # 30 of 120 frames lost
    e = evaluate(part(every, keep), truth)
    assert e.matched == e.estimated == 90
    assert e.ate_m.max == pytest.approx(0.0, abs=1e-9)
    assert e.coverage == pytest.approx((39 + 49) * 0.05 / (1199 * 0.005), rel=1e-9)
    assert e.frames_covered == pytest.approx(90 / 120, rel=1e-9)
    assert e.rpe_frame.translation_m.n == 89


def test_too_few_common_poses_say_when_each_runs() -> None:
    truth = flight()
    late = Trajectory(truth.t_ns + 10**12, truth.T_w_b)
    with pytest.raises(ValueError, match=r"only 0 of 120 .* the truth from 1403715273"):
        match(late, truth, TrajectoryAlignment.SE3)


@pytest.mark.parametrize("at_m", [1e10, 1e200, 1e308])
def test_a_position_beyond_any_flight_is_refused_at_once(at_m: float) -> None:
    """Where squares overflowed, the alignment never ended."""
    far = flight()
    far.T_w_b[5, :3, 3] = at_m, -at_m, 0.0
    for pair in ((far, flight()), (flight(), far)):
        with pytest.raises(ValueError, match="from the origin, expected at most"):
            match(*pair, TrajectoryAlignment.SE3)


def test_a_standing_estimate_has_no_scale() -> None:
    truth = flight()
    still = Trajectory(truth.t_ns, np.tile(np.eye(4), (120, 1, 1)))
    assert evaluate(still, truth).ate_m.rmse > 1.0
    with pytest.raises(ValueError, match="no scale"):
        evaluate(still, truth, TrajectoryAlignment.SIM3)


def test_dense_truth_is_met_between_its_stamps() -> None:
    """A fast steady motion, truth at 50 Hz, frames at 20 Hz: every second frame lies midway between two true poses."""

    def at(t_ns: I64) -> Trajectory:
        poses = np.stack([se3.exp(np.array([0.0, 0.0, 0.0, 0.1, 0.2, 1.5]) * t) for t in t_ns / 1e9])
        poses[:, :3, 3] = np.outer(t_ns / 1e9, [2.0, 1.0, -0.5])
        return Trajectory(t_ns, poses)

    truth, est = at(20_000_000 * np.arange(101, dtype=np.int64)), at(50_000_000 * np.arange(41, dtype=np.int64))
    e = evaluate(est, truth, TrajectoryAlignment.ORIGIN)
    assert e.matched == 41
    assert e.ate_m.max == pytest.approx(0.0, abs=1e-9)
    assert e.rpe_frame.rotation_deg.max == pytest.approx(0.0, abs=1e-5)


def test_sparse_truth_is_not_invented_in_between() -> None:
    truth = flight(20)
    sparse = part(truth, np.arange(0, 20, 4))  # a pose each 200 ms
    i, poses = truth_at(truth.t_ns + 3_000_000, sparse)
    assert i.tolist() == [0, 4, 8, 12, 16]
    np.testing.assert_array_equal(poses, sparse.T_w_b)
    outside, _ = truth_at(truth.t_ns[-1:] + 20_000_000, truth)
    assert outside.tolist() == []
