"""The height of the ground over a flight: boxes and tables that look like a floor, ramps, and what is withdrawn."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.ground_height import GroundHeight, Seen, Verdict, without_ground

UP_C = np.array([0.0, -1.0, 0.0])
T_W_O = se3.exp(np.array([3.0, -2.0, 1.0, 0.4, -0.2, 0.9]))  # heights do not depend on the axes of o
LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def seen(x: float, z: float, ground_z: float | None, lowest_z: float | None, far_m: float = 4.0) -> Seen:
    """A view along x from a height z of ground at ground_z up to far_m, and of points down to lowest_z."""
    n = 21
    azimuth = np.linspace(-0.6, 0.6, n)
    free = np.full(n, 0.0 if ground_z is None else far_m)
    height = float("nan") if ground_z is None else z - ground_z
    scan = ColumnScan(
        UP_C, azimuth[0], azimuth[1] - azimuth[0], np.minimum(free, 1.0), free, np.full(n, np.inf),
        np.zeros(n, np.uint8), free, height,
    )  # fmt: skip
    T = T_W_O @ se3.from_rt(LOOKS_AHEAD, np.array([x, 0.0, z]))
    return Seen(T, scan, ground_z is not None, float("nan") if lowest_z is None else z - lowest_z)


def expected(ground: GroundHeight[int], x: float, z: float) -> float | None:
    found = ground.expected(seen(x, z, None, None).T_o_c, UP_C)
    return None if found is None else found.height_m


def fly(ground: GroundHeight[int], *views: Seen, first: int = 0) -> list[Verdict[int]]:
    return [ground.note(first + k, view) for k, view in enumerate(views)]


def test_a_floor_is_believed_once_two_places_agree() -> None:
    ground: GroundHeight[int] = GroundHeight()
    one, same_place, two = fly(ground, *(seen(x, 1.2, 0.0, 0.1) for x in (0.0, 0.02, 0.5)))
    assert not one.believed and not same_place.believed
    assert two.believed == [0, 1, 2]
    assert expected(ground, 1.0, 1.7) == pytest.approx(1.7)
    (after,) = fly(ground, seen(1.0, 1.5, 0.02, 0.1), first=3)
    assert after.believed == [3]


def test_a_box_top_is_never_believed_however_often_it_is_seen() -> None:
    ground: GroundHeight[int] = GroundHeight()
    small = [seen(0.02 * k, 1.6, 0.9, 0.85, far_m=1.7) for k in range(30)]
    assert not any(v.believed for v in fly(ground, *small))
    wide_above_lower_points = [seen(0.1 * k, 1.6, 0.9, 0.2) for k in range(30)]
    assert not any(v.believed for v in fly(ground, *wide_above_lower_points))
    assert expected(ground, 0.0, 1.6) is None


def test_the_floor_beside_a_box_is_believed_and_the_box_is_not() -> None:
    ground: GroundHeight[int] = GroundHeight()
    views = [seen(0.3 * k, 1.6, 0.9 if k % 2 else 0.0, 0.1) for k in range(8)]
    believed = [tag for v in fly(ground, *views) for tag in v.believed]
    assert believed and not any(tag % 2 for tag in believed)
    assert expected(ground, 0.0, 1.6) == pytest.approx(1.6)


def test_scans_of_a_large_table_are_withdrawn_when_something_lower_is_seen() -> None:
    ground: GroundHeight[int] = GroundHeight()
    table = fly(ground, *(seen(0.2 * k, 1.6, 0.8, None) for k in range(6)))
    assert [tag for v in table for tag in v.believed] == list(range(6))
    first, second = fly(ground, *(seen(x, 1.6, None, 0.1) for x in (1.2, 1.4)), first=6)
    assert not first.withdrawn  # one view may be an error
    assert second.withdrawn == list(range(6))
    assert expected(ground, 1.4, 1.6) is None
    floor = fly(ground, *(seen(1.4 + 0.2 * k, 1.6, 0.0, 0.1) for k in range(3)), first=8)
    assert [tag for v in floor for tag in v.believed] == [8, 9, 10]
    assert not any(v.withdrawn for v in floor)


def test_a_box_top_is_not_believed_with_a_floor_that_is_a_little_lower_elsewhere() -> None:
    """Ground may climb that much on the way, but points lower than the box were seen right beside it."""
    ground: GroundHeight[int] = GroundHeight()
    box = seen(0.0, 1.6, 0.22, None)
    beside = [seen(x, 1.6, None, -0.1) for x in (0.1, 0.2)]
    floor = [seen(x, 1.6, 0.0, None) for x in (2.0, 2.3)]
    assert [tag for v in fly(ground, box, *beside, *floor) for tag in v.believed] == [3, 4]


def test_scans_of_another_vertical_are_withdrawn_and_the_height_is_sought_again() -> None:
    """A flight that begins in motion knows its vertical after a second; before, a level camera seems to look down."""
    ground: GroundHeight[int] = GroundHeight()
    tilted = np.array([0.0, -np.cos(0.1), np.sin(0.1)])
    views = (seen(0.5 * k, 1.2, 0.0, 0.1) for k in range(3))
    wrong = [view._replace(scan=replace(view.scan, up_c=tilted)) for view in views]
    assert sorted(tag for v in fly(ground, *wrong) for tag in v.believed) == [0, 1, 2]
    first, second, third = fly(ground, *(seen(1.5 + 0.5 * k, 1.2, 0.0, 0.1) for k in range(3)), first=3)
    assert sorted(first.withdrawn) == [0, 1, 2] and not first.believed
    assert not second.believed and third.believed == [4, 5]
    assert expected(ground, 3.0, 1.2) == pytest.approx(1.2)


def test_a_single_wrong_point_below_the_floor_changes_nothing() -> None:
    ground: GroundHeight[int] = GroundHeight()
    views = [seen(0.2 * k, 1.2, 0.0, -2.0 if k == 5 else 0.1) for k in range(12)]
    verdicts = fly(ground, *views)
    assert not any(v.withdrawn for v in verdicts)
    assert sum(len(v.believed) for v in verdicts) == 12


def test_a_road_uphill_is_not_withdrawn() -> None:
    ground: GroundHeight[int] = GroundHeight()
    views = [seen(2.0 * k, 1.65 + 0.16 * k, 0.16 * k, 0.16 * k, far_m=15.0) for k in range(40)]
    verdicts = fly(ground, *views)
    assert not any(v.withdrawn for v in verdicts)
    assert sum(len(v.believed) for v in verdicts) == 40


def test_the_height_is_unknown_after_a_long_way_without_a_view_of_the_ground() -> None:
    ground: GroundHeight[int] = GroundHeight()
    ground.start_at((T_W_O @ [0.0, 0.0, 0.0, 1.0])[:3])
    fly(ground, *(seen(0.3 * k, 1.2, None, 0.3) for k in range(20)))
    assert expected(ground, 6.0, 1.2) == pytest.approx(1.2)
    assert expected(ground, 8.5, 1.2) is None


def test_a_scan_without_ground_keeps_its_line_of_sight_alone() -> None:
    scan = seen(0.0, 1.2, 0.0, None).scan
    blank = without_ground(scan)
    assert np.isnan(blank.camera_height_m) and not blank.free_m.any() and not blank.bands.any()
    assert np.isinf(blank.obstacle_m).all() and np.array_equal(blank.clear_m, scan.clear_m)


def test_ground_that_is_seen_a_little_lower_again_and_again_takes_the_place_of_the_first() -> None:
    """A height that was too large by less than what refutes it does not stay."""
    ground: GroundHeight[int] = GroundHeight()
    fly(ground, *(seen(x, 1.6, 0.2, 0.05) for x in (0.0, 0.3)))
    assert expected(ground, 0.3, 1.6) == pytest.approx(1.4)
    once = fly(ground, seen(0.4, 1.6, 0.0, 0.05), first=2)
    assert expected(ground, 0.4, 1.6) == pytest.approx(1.4)  # one view may be an error
    later = fly(ground, *(seen(0.4 + 0.2 * k, 1.6, 0.0, 0.05) for k in range(1, 4)), first=3)
    assert expected(ground, 1.0, 1.6) == pytest.approx(1.6)
    assert not once[0].believed and later[-1].believed


def test_a_box_beside_the_way_does_not_lift_the_ground() -> None:
    ground: GroundHeight[int] = GroundHeight()
    fly(ground, *(seen(x, 1.6, 0.0, 0.05) for x in (0.0, 0.3)))
    boxes = fly(ground, *(seen(0.4 + 0.1 * k, 1.6, 0.2, 0.1) for k in range(6)), first=2)
    assert not any(v.believed for v in boxes)
    assert expected(ground, 1.0, 1.6) == pytest.approx(1.6)


def known_floor() -> GroundHeight[int]:
    ground: GroundHeight[int] = GroundHeight()
    assert fly(ground, *(seen(x, 1.2, 0.0, 0.1) for x in (0.0, 0.5)))[1].believed == [0, 1]
    return ground


def test_views_of_something_lower_count_only_one_after_the_other() -> None:
    ground = known_floor()
    low, floor = seen(0.6, 1.2, None, -0.6), seen(0.6, 1.2, 0.0, 0.1)
    assert not any(v.withdrawn for v in fly(ground, low, floor, low, floor, low, first=2))
    assert expected(ground, 0.6, 1.2) == pytest.approx(1.2)
    ground = known_floor()
    step, floor = seen(0.6, 1.2, -0.3, -0.2), seen(0.6, 1.2, 0.0, 0.1)
    fly(ground, step, floor, step, first=2)
    assert expected(ground, 0.6, 1.2) == pytest.approx(1.2)
    fly(ground, step, first=5)
    assert expected(ground, 0.6, 1.2) is None
    fly(ground, *(seen(x, 1.2, -0.3, -0.2) for x in (0.6, 1.0)), seen(1.0, 1.2, -0.6, -0.5), first=6)
    assert expected(ground, 1.0, 1.2) == pytest.approx(1.5), "one lower view, again"


@pytest.mark.parametrize("count", [2, 3])
def test_after_something_lower_was_seen_the_count_begins_anew(count: int) -> None:
    """The floor that takes the place of a table is not given up by one wrong view."""
    ground: GroundHeight[int] = GroundHeight()
    fly(ground, *(seen(0.2 * k, 1.6, 0.8, None) for k in range(count)))
    fly(ground, *(seen(x, 1.6, None, 0.1) for x in (1.2, 1.4)), first=10)
    fly(ground, *(seen(1.4 + 0.2 * k, 1.6, 0.0, 0.1) for k in range(3)), first=20)
    fly(ground, seen(2.0, 1.6, None, -0.6), first=30)
    assert expected(ground, 2.0, 1.6) == pytest.approx(1.6)


def test_two_places_agree_the_better_the_nearer_they_are() -> None:
    for x, z, agree in ((0.5, 0.14, True), (0.5, 0.16, False), (5.0, 0.24, True), (5.0, 0.26, False)):
        ground: GroundHeight[int] = GroundHeight()
        verdict = fly(ground, seen(0.0, 1.2, 0.0, None), seen(x, 1.2, z, None))[1]
        assert bool(verdict.believed) == agree, (x, z)
    near: GroundHeight[int] = GroundHeight()
    assert not fly(near, seen(0.0, 1.2, 0.0, 0.1), seen(0.08, 1.2, 0.0, 0.1))[1].believed, "one place"


def test_ground_may_fall_on_the_way_to_what_was_seen_lower() -> None:
    ground = known_floor()
    assert not any(v.withdrawn for v in fly(ground, *(seen(4.5, 1.2, None, -0.5) for _ in "ab"), first=2))
    assert fly(known_floor(), *(seen(1.0, 1.2, None, -0.5) for _ in "ab"), first=2)[1].withdrawn == [0, 1]


def test_narrow_ground_is_wide_where_it_is_seen_from_places_that_lie_apart() -> None:
    views = [seen(x, 1.2, 0.0, None, far_m=1.5) for x in (0.0, 0.3, 3.5)]
    beside, apart = fly(GroundHeight(), *views)[1:]
    assert not beside.believed and apart.believed == [0, 1, 2]
    aslant = [seen(x, 1.2, 0.0, None, far_m=2.2) for x in (0.0, 0.2)]
    assert not fly(GroundHeight(), *aslant)[1].believed, "2.6 m wide"


def test_a_climb_does_not_lose_the_ground_below() -> None:
    assert expected(known_floor(), 0.5, 10.0) == pytest.approx(10.0)


def test_a_vertical_that_is_a_little_better_known_changes_nothing() -> None:
    ground, view = known_floor(), seen(1.0, 1.2, 0.0, 0.1)
    up_c = np.array([0.0, -np.cos(0.05), np.sin(0.05)])
    assert not ground.note(2, view._replace(scan=replace(view.scan, up_c=up_c))).withdrawn
