"""Scans that landmarks make, and what of them is free."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import sparse_kernels as kernels
from kiteline_basestation.grid.sparse_scan import GROUND, OBSTACLE, LandmarksAround, sparse_ground, sparse_scan
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from tests.basestation.flat_rooms import camera

CAMERA = RectifiedCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.1, True, np.eye(4))


def made_of(
    points_k: F64, plane: F64, seen: Bool | None = None, views: I64 | None = None, close: Bool | None = None
) -> tuple[ColumnScan, U8] | None:
    """A scan of landmarks (n,3) in the camera, and labels; all seen, each observed by three keyframes."""
    seen = np.ones(len(points_k), np.bool_) if seen is None else seen
    views = np.full(len(points_k), 3) if views is None else views
    around = LandmarksAround(points_k, seen, np.ones(len(points_k), np.bool_) if close is None else close, views)
    return sparse_scan(GridConfig(), CAMERA, camera(0.0, 0.0, 0.0), around, plane)


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
    made = made_of(points_k, view.plane)
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
        assert made_of(points, level) is None
    floor = np.column_stack([rng.uniform(-3, 3, 200), np.ones(200), rng.uniform(1, 6, 200)])
    assert made_of(floor, level) is not None
    assert made_of(floor, level, close=np.zeros(200, np.bool_)) is None, "a floor that far keyframes alone saw"
    view = sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), ceiling, 1.0)
    assert view is not None and view.plane is None and np.isnan(view.lowest_m)
    assert sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), np.full((3, 3), np.nan), 1.0) is None


def scan_from(
    height_m: float, points: F64, seen: list[bool] | None = None, views: list[int] | None = None
) -> ColumnScan:
    """A scan of landmarks (n,3) about a camera above a floor that a grid of unseen landmarks shows."""
    x, y = np.meshgrid(np.arange(0.5, 9.0, 0.5), np.arange(-4.0, 4.5, 0.5))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -height_m)])
    local = np.concatenate([points + [0.0, 0.0, -height_m], floor])
    mine = np.concatenate([np.ones(len(points), bool) if seen is None else seen, np.zeros(len(floor), bool)])
    points_k = np.column_stack([-local[:, 1], -local[:, 2], local[:, 0]])
    observed = np.concatenate([np.full(len(points), 3) if views is None else views, np.full(len(floor), 3)])
    made = made_of(points_k, np.array([-height_m, 0.0, 0.0]), mine, observed)
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
    assert scan.free_m[k] == pytest.approx(6.0, abs=0.03) and scan.free_from_m[k] == pytest.approx(3.43, abs=0.05)
    assert np.count_nonzero(scan.free_m) == 1 and not np.isfinite(scan.obstacle_m).any()
    low = scan_from(0.6, np.array([[6.0, 0.1, 0.0]]))
    assert low.free_from_m[k] == 0.0, "the camera itself is lower"


def test_a_ray_to_an_obstacle_frees_up_to_it_if_that_is_low() -> None:
    k = ahead(scan_from(1.4, np.array([[6.0, 0.1, 0.0]])), 0.1 / 6.0)
    low = scan_from(1.4, np.array([[6.0, 0.1, 0.35]]))
    assert low.obstacle_m[k] == pytest.approx(6.0, abs=0.01) and low.bands[k] == 1
    assert low.free_m[k] == pytest.approx(5.9, abs=0.03), "nothing around what stands"
    assert low.free_from_m[k] == pytest.approx(4.57, abs=0.05), "0.6 m high after three quarters of its way"
    for height in (0.8, 1.6):
        high = scan_from(1.4, np.array([[6.0, 0.1, height]]))
        assert np.isfinite(high.obstacle_m[k]) and high.free_m[k] == 0.0
    above = scan_from(0.2, np.array([[6.0, 0.1, 0.5]]))
    assert above.free_m[k] == pytest.approx(5.9, abs=0.03) and above.free_from_m[k] == 0.0


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
    made = made_of(points_k, np.array([-1.5, 0.1, 0.0]))
    nearest = np.sort(np.hypot(points[:, 0], points[:, 1]))[:20]
    assert made is not None and made[0].camera_height_m == pytest.approx(1.5 - 0.1 * np.median(nearest), abs=0.02)


FLOOR, WALL = [6.0, 0.1, 0.0], [6.0, 0.1, 0.55]  # landmarks in one column, seen from 1.4 m above the floor
COLUMN = 18


def test_what_lies_between_two_rays_of_a_column_is_unknown() -> None:
    """A ray to the floor at 2 m and one to a wall, low for its last 0.3 m, say nothing of a box between them."""
    scan = scan_from(1.4, np.array([[2.0, 0.04, 0.0], WALL]))
    assert scan.free_m[COLUMN] == pytest.approx(2.0, abs=0.03)
    assert scan.free_from_m[COLUMN] == pytest.approx(2.0 * 0.8 / 1.4, abs=0.03)
    both = scan_from(1.4, np.array([[4.0, 0.08, 0.0], FLOOR]))
    assert both.free_from_m[COLUMN] == pytest.approx(4.0 * 0.8 / 1.4, abs=0.03), "rays that overlap are one"
    assert both.free_m[COLUMN] == pytest.approx(6.0, abs=0.03)


def test_nothing_is_free_behind_the_nearest_obstacle_of_a_column() -> None:
    scan = scan_from(1.4, np.array([[3.0, 0.05, 0.4], FLOOR]))
    assert scan.obstacle_m[COLUMN] == pytest.approx(3.0, abs=0.01) and scan.free_m[COLUMN] < 2.95


def test_a_ray_frees_what_lies_a_little_beside_it() -> None:
    scan = scan_from(1.4, np.array([[3.0, 0.1, 0.0]]))
    for k in (COLUMN - 1, COLUMN, COLUMN + 1):
        apart = abs(scan.azimuths_rad[k] - 0.1 / 3.0)
        assert scan.free_m[k] == pytest.approx(min(3.0, 0.125 / apart), abs=0.06), "0.125 m beside it"
    assert np.count_nonzero(scan.free_m) == 3, "beyond, it is too high as far as that"
    beside = scan_from(1.4, np.array([[3.0, 0.1, 0.0], [2.5, 0.16, 0.4]]))
    assert beside.free_m[COLUMN + 1] < 2.45, "no farther than an obstacle"


def test_nothing_is_free_around_what_other_keyframes_saw_standing() -> None:
    """A low ray passes below a table top that this keyframe does not see."""
    top = [4.0, 0.05, 0.75]
    assert scan_from(1.4, np.array([FLOOR])).free_from_m[COLUMN] < 3.5
    scan = scan_from(1.4, np.array([FLOOR, top]), [True, False])
    assert not np.isfinite(scan.obstacle_m[COLUMN]) and scan.free_m[COLUMN] == pytest.approx(6.0, abs=0.03)
    assert scan.free_from_m[COLUMN] == pytest.approx(4.1, abs=0.03)


def test_a_landmark_of_two_views_that_stands_alone_is_an_error() -> None:
    points = np.array([FLOOR, [4.0, 0.05, 0.75], [4.0, 0.2, 1.0]])
    sure = scan_from(1.4, points[:2], views=[2, 3])
    assert sure.obstacle_m[COLUMN] == pytest.approx(4.0, abs=0.01) and sure.free_m[COLUMN] < 3.95
    alone = scan_from(1.4, points[:2], views=[2, 2])
    assert not np.isfinite(alone.obstacle_m).any() and alone.free_m[COLUMN] == pytest.approx(6.0, abs=0.03)
    accompanied = scan_from(1.4, points, views=[2, 2, 2])
    assert accompanied.obstacle_m[COLUMN] == pytest.approx(4.0, abs=0.01)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_accompanied_points_are_those_of_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 2.0, (rng.integers(0, 30), 3))
    found = np.full(len(points), 7, np.uint8)
    kernels.mark_accompanied(points, 0.4, found)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.diag(np.full(len(points), np.inf))
    assert found.tolist() == (apart <= 0.4).any(axis=1).astype(int).tolist()


FIRST, STEP, WIDTH, BIN = -0.8, 0.045, 0.1, 0.05


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_cells_of_rays_are_those_of_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m, n, bins = 12, 36, 80
    azimuth, end = rng.uniform(FIRST, FIRST + n * STEP, m), rng.uniform(0.2, 4.5, m)
    start = end * rng.uniform(0.0, 1.0, m)
    stop = np.where(rng.random(n) < 0.3, rng.uniform(0.5, 4.0, n), np.inf)
    centre = FIRST + (np.arange(n) + 0.5) * STEP
    expected = np.zeros((n, bins), np.uint8)
    for i in range(m):
        own = int((azimuth[i] - FIRST) // STEP)
        for columns in (range(own, n), range(own - 1, -1, -1)):
            for c in columns:
                reach = end[i] if c == own else min(end[i], WIDTH / max(abs(centre[c] - azimuth[i]), 1e-9))
                if reach <= start[i]:
                    break
                expected[c, int(np.rint(start[i] / BIN)) : int(np.rint(min(reach, stop[c]) / BIN))] = 1
                if stop[c] < reach and c != own:
                    break
    free = np.zeros((n, bins), np.uint8)
    kernels.mark_rays(azimuth, start, end, stop, FIRST, STEP, WIDTH, BIN, free)
    assert np.array_equal(free, expected)

    distance = rng.uniform(0.02, 5.0, m)
    half = np.arcsin(np.minimum(WIDTH / distance, 1.0))
    for a, d, h in zip(azimuth, distance, half, strict=True):
        touched = (centre + 0.5 * STEP > a - h) & (centre - 0.5 * STEP <= a + h)
        expected[touched, max(int(np.rint((d - WIDTH) / BIN)), 0) : int(np.rint((d + WIDTH) / BIN))] = 0
    kernels.clear_around(azimuth, distance, FIRST, STEP, WIDTH, BIN, free)
    assert np.array_equal(free, expected)

    runs = np.empty((n, 2), np.int64)
    kernels.longest_runs(free, runs)
    for row, (begin, after) in zip(expected, runs.tolist(), strict=True):
        lengths = [0, *map(len, "".join(map(str, row.tolist())).split("0"))]
        assert after - begin == max(lengths) and row[begin:after].all()
        assert not after or "1" * (after - begin) not in "".join(map(str, row[: after - 1].tolist())), "the nearest"
