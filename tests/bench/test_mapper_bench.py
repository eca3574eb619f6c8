"""What the mapper's benchmark measures with: problems that can be solved, a queue that fills, pieces that overlap."""

import numpy as np

from kiteline_bench.base.mapper import further_kb, map_bytes_a_keyframe, queue_p95_s, ring_of_poses, row_of_cameras
from kiteline_core.optimisation.bundle import BundleConfig, bundle


def test_the_row_of_cameras_is_a_bundle_that_converges() -> None:
    problem = row_of_cameras(12, 300, 8)
    assert np.count_nonzero(problem.free) == 8
    seen = np.diff(problem.starts)
    assert seen.min() >= 2 and all(np.all(np.diff(problem.camera[a : a + n]) > 0) for a, n in zip(problem.starts, seen))
    result = bundle(problem, BundleConfig())
    assert result.final_cost < 0.5 * result.initial_cost
    assert np.count_nonzero(result.inlier) > 0.85 * len(result.inlier)


def test_the_ring_of_poses_drifts_and_has_loops() -> None:
    graph = ring_of_poses(80, 5)
    assert np.count_nonzero(graph.loop) == 5 and np.count_nonzero(graph.held) == 1
    assert graph.edges.max() < 80


def test_a_queue_waits_longer_the_fuller_it_is() -> None:
    quick, slow, over = (queue_p95_s(np.full(20, cost)) for cost in (0.005, 0.045, 0.06))
    assert quick < slow < over
    assert over > 5.0  # more work comes than can be done


def test_memory_grows_with_keypoints() -> None:
    assert 2_000 < map_bytes_a_keyframe(100, 50) < map_bytes_a_keyframe(100, 400)


def test_memory_of_further_keyframes_is_that_of_the_process() -> None:
    short, long = ({"keyframes": n, "timing": {"rss_mib": mib}} for n, mib in ((60, 200.0), (560, 240.0)))
    assert abs(further_kb(short, long) - 40 * 1048.576 / 500) < 1e-9
