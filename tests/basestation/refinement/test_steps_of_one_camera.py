"""Steps of a camera that measures no distances, in metres: they count alike however far its landmarks are."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.config import OdometryFactorConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors
from tests.basestation.refinement.test_odometry_factors import BIRTHS, KEYFRAMES, SUBMAP, residuals_of_steps, window
from tests.basestation.refinement.test_steps_between_views import flight_of_one_camera


def metric_flight_of_one_camera() -> SparseMap:
    sparse_map = flight_of_one_camera(BIRTHS, turn_rad=0.1)
    sparse_map.metric_submaps.add(SUBMAP)
    return sparse_map


def test_lengths_of_one_camera_are_held_weakly_in_the_unit_that_the_map_has() -> None:
    sparse_map, many = metric_flight_of_one_camera(), OdometryFactorConfig(enough_observations=5)
    for unit in (1.0, 1.5):
        if unit != 1.0:
            sparse_map.scale_submap(SUBMAP, unit)
        off, sigma = residuals_of_steps(sparse_map, many)
        weak = sigma == 2.0
        assert np.count_nonzero(weak) == 2 * np.count_nonzero(~weak) > 0  # twelve points beside six
        assert np.abs(off).max() < 1e-6


@pytest.mark.parametrize("enough", [5, 1000])
def test_steps_of_one_camera_count_alike_however_far_its_landmarks_are(enough: int) -> None:
    """A drone flies ten times as high, and ten times as far: the same images, and the same shares of lengths.

    Of the last keyframe nothing is known but its step.
    """
    found, config = list[tuple[np.ndarray, np.ndarray]](), OdometryFactorConfig(enough_observations=enough)
    for times in (1.0, 10.0):
        sparse_map = metric_flight_of_one_camera()
        table = sparse_map.keyframes
        table.T_w_k[: len(sparse_map), :3, 3] *= times
        table.T_p_k[: len(sparse_map), :3, 3] *= times
        sparse_map.keypoints.inv_depth[: sparse_map.slots] /= times
        part = window(sparse_map)
        seen = part.problem.camera < KEYFRAMES - 1
        of = np.repeat(np.arange(len(part.problem.points)), np.diff(part.problem.starts))[seen]
        starts = np.searchsorted(of, np.arange(len(part.problem.points) + 1)).astype(np.int32)
        camera, measured, sigma = (x[seen] for x in (part.problem.camera, part.problem.measured, part.problem.sigma))
        problem = replace(part.problem, starts=starts, camera=camera, measured=measured, sigma=sigma)
        linked = with_odometry_factors(sparse_map, replace(part, problem=problem), config)
        n, disparity = len(camera), linked.measured[len(camera) :, 2]
        found.append((linked.measured[n:, :2], np.column_stack([linked.sigma[n:, 0], linked.sigma[n:, 1] / disparity])))
    for near, far in zip(*found, strict=True):
        assert len(near) and np.allclose(near, far, rtol=1e-4)
