"""The camera of disparity images: its pixels are those of the full camera, reduced."""

import numpy as np
import pytest

from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.disparity import DisparityCamera


@pytest.mark.parametrize(("baseline_m", "columns"), [(0.11, 1), (0.5, 2)])
def test_pixels_of_the_full_image_lie_where_their_points_are_projected(baseline_m: float, columns: int) -> None:
    full = RectifiedCamera(752, 480, 430.0, 420.0, 371.0, 244.0, baseline_m, True, np.eye(4))
    camera = DisparityCamera.of(full)
    assert camera.columns == columns
    rng = np.random.default_rng(3)
    xy = rng.uniform([-0.8, -0.5], [0.8, 0.5], (200, 2))
    row, column = camera.at(xy * [full.fx, full.fy] + [full.cx, full.cy])
    u, v = xy[:, 0] * camera.fx + camera.cx, xy[:, 1] * camera.fy + camera.cy
    np.testing.assert_array_equal(column, np.rint(u).astype(int))
    np.testing.assert_array_equal(row, np.rint(v).astype(int))
    row, column = camera.at(np.array([[-50.0, -50.0], [900.0, 600.0]]))  # beside the image: the nearest pixel
    assert (row.tolist(), column.tolist()) == ([0, camera.height - 1], [0, camera.width - 1])
