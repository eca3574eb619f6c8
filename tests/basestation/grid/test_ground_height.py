"""Ground and labels of landmarks where there are no scans."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import ground_kernels as kernels
from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_basestation.grid.sparse_scan import GROUND, OBSTACLE, UNLABELLED, label, sparse_ground, sparse_scan
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from tests.basestation.flat_rooms import camera

CAMERA = RectifiedCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.1, True, np.eye(4))


def test_ground_is_the_floor_and_neither_a_table_nor_noise_below() -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(0, 4, (200, 2)), rng.normal(0.0, 0.01, 200)])
    table = np.column_stack([rng.uniform(1, 3, (500, 2)), rng.normal(0.7, 0.01, 500)])
    noise = np.column_stack([rng.uniform(0, 4, (30, 2)), rng.uniform(-2.0, -0.2, 30)])
    points = np.concatenate([floor, table, noise])
    ground = ground_heights(points, np.full(len(points), 1.2))
    np.testing.assert_allclose(ground, 0.0, atol=0.06)


def test_labels_follow_height_and_distance() -> None:
    height = np.array([-0.5, -0.05, 0.05, 0.12, 0.12, 1.9, 2.1, np.nan])
    distance = np.array([1.0, 1.0, 1.0, 0.0, 10.0, 1.0, 1.0, 1.0])
    expected = [UNLABELLED, GROUND, GROUND, OBSTACLE, GROUND, OBSTACLE, UNLABELLED, UNLABELLED]
    assert label(GridConfig(), height, distance).tolist() == expected


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_landmarks_of_a_hall_make_a_scan(slope: float) -> None:
    """A floor 1 m below the camera, a wall 5 m ahead, and before it to the left a box that is lower than the camera."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform([0.5, -4], [5, 4], (500, 2)), np.full(500, -1.0)])
    wall = np.column_stack([np.full(300, 5.0), rng.uniform(-4, 4, 300), rng.uniform(-0.8, 0.9, 300)])
    box = np.column_stack([np.full(60, 3.0), rng.uniform(0.5, 1.5, 60), rng.uniform(-0.8, -0.6, 60)])
    floor = floor[~((floor[:, 0] > 3.0) & (np.abs(floor[:, 1] / floor[:, 0] - 1 / 3) < 0.2))]  # hidden by the box
    points = np.concatenate([floor, wall, box])
    points[:, 2] += slope * points[:, 0]
    points_k = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
    view = sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), points_k, 1.0)
    assert view is not None and view.plane is not None
    made = sparse_scan(GridConfig(), CAMERA, camera(0.0, 0.0, 0.0), points_k, np.ones(len(points), bool), view.plane)
    assert made is not None
    scan, labels = made
    assert np.mean(labels[: len(floor)] == GROUND) > 0.97 and np.mean(labels[len(floor) :] == OBSTACLE) > 0.97
    assert scan.camera_height_m == pytest.approx(1.0 - 0.8 * slope, abs=0.1)
    ahead = scan.azimuths_rad
    at_box, at_wall = np.abs(ahead - 0.32) < 0.1, np.abs(ahead + 0.4) < 0.2
    assert scan.obstacle_m[at_wall] * np.cos(ahead[at_wall]) == pytest.approx(5.0, abs=0.2)
    assert (scan.bands[at_wall] & 4).any()
    assert scan.obstacle_m[at_box] * np.cos(ahead[at_box]) == pytest.approx(3.0, abs=0.2)
    assert (scan.bands[at_box] == 1).all(), "only low"
    assert (scan.free_m[at_wall] > 3.5).mean() > 0.8 and (scan.free_from_m[at_wall] < 2.5).mean() > 0.8


def test_without_a_floor_there_is_no_scan() -> None:
    rng = np.random.default_rng(0)
    ceiling = np.column_stack([rng.uniform(-3, 3, 200), np.full(200, -1.5), rng.uniform(1, 6, 200)])
    level = np.array([-1.0, 0.0, 0.0])
    for points in (ceiling, np.full((3, 3), np.nan)):
        seen = np.ones(len(points), bool)
        assert sparse_scan(GridConfig(), CAMERA, camera(0.0, 0.0, 0.0), points, seen, level) is None
    view = sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), ceiling, 1.0)
    assert view is not None and view.plane is None and np.isnan(view.lowest_m)
    assert sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), np.full((3, 3), np.nan), 1.0) is None


def test_ground_that_is_known_about_is_found_below_a_box_that_shows_more() -> None:
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform([1, -2], [5, 2], (40, 2)), rng.normal(-1.0, 0.01, 40)])
    box = np.column_stack([rng.uniform([1, -2], [3, 2], (500, 2)), rng.normal(-0.6, 0.01, 500)])
    points = np.concatenate([floor, box])
    assert ground_heights(points, np.zeros(540)) == pytest.approx(-0.6, abs=0.1), "lowest peak"
    known = ground_heights(points, np.zeros(540), np.array([-1.08, 0.0, 0.0]))
    assert known == pytest.approx(-1.0, abs=0.05)
    floor[:, 2] += 0.2 * floor[:, 0] - 0.1 * floor[:, 1]
    known = ground_heights(floor, np.full(40, 1.0), np.array([-1.0, 0.2, -0.1]))
    assert known == pytest.approx(floor[:, 2], abs=0.08)


def ground_reference(count: F64, seed: int, seed_bin: int, reach: int, share: float, least: float) -> I64:
    rows, columns, bins = count.shape
    ground = {(seed // columns, seed % columns): seed_bin}
    queue = list(ground)
    while queue:
        r, c = queue.pop(0)
        for place in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
            if place in ground or not (0 <= place[0] < rows and 0 <= place[1] < columns):
                continue
            window = range(max(0, ground[r, c] - reach), min(bins - 1, ground[r, c] + reach) + 1)
            h = count[place]
            need = max(share * max(h[b] for b in window), least)
            peaks = [b for b in window if h[b] >= need and (b == window[-1] or h[b] >= h[b + 1])]
            ground[place] = peaks[0] if peaks else ground[r, c]
            queue.append(place)
    return np.array([[ground[r, c] for c in range(columns)] for r in range(rows)])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_ground_spreads_as_in_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 9, (rng.integers(1, 5), rng.integers(1, 5), 20)).astype(np.float32)
    start, start_bin, reach = int(rng.integers(count.shape[0] * count.shape[1])), int(rng.integers(20)), 3
    ground = np.zeros(count.shape[:2], np.int32)
    kernels.spread_ground(count, start, start_bin, reach, 0.25, 4.0, ground, np.zeros(ground.size, np.int32))
    assert np.array_equal(ground, ground_reference(count.astype(float), start, start_bin, reach, 0.25, 4.0))


def scan_from(height_m: float, points: F64, seen: list[bool] | None = None) -> ColumnScan:
    """A scan of landmarks (n,3) about a camera above a floor that a grid of unseen landmarks shows."""
    x, y = np.meshgrid(np.arange(0.5, 9.0, 0.5), np.arange(-4.0, 4.5, 0.5))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -height_m)])
    local = np.concatenate([points + [0.0, 0.0, -height_m], floor])
    mine = np.concatenate([np.ones(len(points), bool) if seen is None else seen, np.zeros(len(floor), bool)])
    points_k = np.column_stack([-local[:, 1], -local[:, 2], local[:, 0]])
    made = sparse_scan(GridConfig(), CAMERA, camera(0.0, 0.0, 0.0), points_k, mine, np.array([-height_m, 0.0, 0.0]))
    assert made is not None
    return made[0]


def ahead(scan: ColumnScan, azimuth_rad: float) -> int:
    return int(np.argmin(np.abs(scan.azimuths_rad - azimuth_rad)))


def test_columns_of_landmarks_span_the_image() -> None:
    scan = scan_from(1.4, np.array([[6.0, 0.1, 0.0]]))
    half = np.arctan(1.0)
    assert len(scan) == 36 and scan.azimuths_rad[0] == pytest.approx(-half * 35 / 36)
    assert scan.azimuths_rad[-1] == pytest.approx(half * 35 / 36)
    outside = scan_from(1.4, np.array([[1.0, 1.3, 0.0], [1.0, -1.3, 0.0], [25.0, 0.0, 0.0], [3.0, 0.0, 2.2]]))
    assert not outside.free_m.any() and not outside.bands.any()
    assert not scan_from(1.4, np.array([[6.0, 0.1, 0.0]]), [False]).free_m.any(), "another keyframe's"


def test_a_ray_to_the_floor_frees_where_it_is_lower_than_boxes_are() -> None:
    scan = scan_from(1.4, np.array([[6.0, 0.1, 0.0]]))
    k = ahead(scan, 0.1 / 6.0)
    assert scan.free_m[k] == pytest.approx(6.0, abs=0.01) and scan.free_from_m[k] == pytest.approx(3.0, abs=0.1)
    assert np.count_nonzero(scan.free_m) == 1 and not np.isfinite(scan.obstacle_m).any()
    low = scan_from(0.6, np.array([[6.0, 0.1, 0.0]]))
    assert low.free_from_m[k] == 0.0, "the camera itself is lower"


def test_a_ray_to_an_obstacle_frees_up_to_it_if_that_is_low() -> None:
    k = ahead(scan_from(1.4, np.array([[6.0, 0.1, 0.0]])), 0.1 / 6.0)
    low = scan_from(1.4, np.array([[6.0, 0.1, 0.35]]))
    assert low.obstacle_m[k] == pytest.approx(6.0, abs=0.01) and low.bands[k] == 1
    assert low.free_m[k] == pytest.approx(6.0, abs=0.01)
    assert low.free_from_m[k] == pytest.approx(4.0, abs=0.1), "0.7 m high after two thirds of its way"
    for height in (0.8, 1.6):
        high = scan_from(1.4, np.array([[6.0, 0.1, height]]))
        assert np.isfinite(high.obstacle_m[k]) and high.free_m[k] == 0.0
    above = scan_from(0.2, np.array([[6.0, 0.1, 0.5]]))
    assert above.free_m[k] == pytest.approx(6.0, abs=0.01) and above.free_from_m[k] == 0.0


def test_landmarks_close_behind_an_obstacle_belong_to_it() -> None:
    k = ahead(scan_from(1.4, np.array([[6.0, 0.1, 0.0]])), 0.1 / 6.0)
    scan = scan_from(1.4, np.array([[3.0, 0.05, 0.35], [3.25, 0.05, 0.9], [3.4, 0.05, 1.5]]))
    assert scan.obstacle_m[k] == pytest.approx(3.0, abs=0.01) and scan.bands[k] == 0b011


def test_the_camera_is_as_high_as_the_ground_next_to_it_lies_low() -> None:
    """Twenty landmarks of the ground next to the camera tell, on a ramp too."""
    rng = np.random.default_rng(5)
    points = rng.uniform([1.0, -1.0, 0.0], [9.0, 1.0, 0.0], (400, 3))
    points[:, 2] = 0.1 * points[:, 0] - 1.5
    points_k = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
    made = sparse_scan(
        GridConfig(), CAMERA, camera(0.0, 0.0, 0.0), points_k, np.ones(400, bool), np.array([-1.5, 0.1, 0.0])
    )
    nearest = np.sort(np.hypot(points[:, 0], points[:, 1]))[:20]
    assert made is not None and made[0].camera_height_m == pytest.approx(1.5 - 0.1 * np.median(nearest), abs=0.02)
