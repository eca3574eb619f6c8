"""The ground that landmarks show: not a box's top, not a table's, and known about keyframes that do not see it."""

import numpy as np
import pytest

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.landmark_ground import GroundView, LandmarkGround
from kiteline_basestation.grid.sparse_scan import sparse_ground
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId
from tests.basestation.flat_rooms import camera


def patch(x: tuple[float, float], y: tuple[float, float], z: float, n: int) -> F64:
    """Points (n,3) on a level rectangle, x ahead of a camera at the origin."""
    return np.random.default_rng(n).uniform([x[0], y[0], z - 0.02], [x[1], y[1], z + 0.02], (n, 3))


def ground_of(points: F64, unit_m: float = 1.0) -> GroundView:
    points_k = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
    view = sparse_ground(GridConfig(), camera(0.0, 0.0, 0.0), points_k, unit_m)
    assert view is not None
    return view


WALL = np.random.default_rng(0).uniform([5.0, -3.0, -0.5], [5.02, 3.0, 1.0], (60, 3))


def test_a_box_is_no_ground_where_landmarks_lie_lower_and_three_of_them_are_errors() -> None:
    top = np.concatenate([patch((1.0, 2.5), (-1.0, 1.0), -0.8, 60), WALL])
    lower = patch((2.0, 4.0), (-2.0, 2.0), -1.4, 4)
    assert ground_of(top).plane == pytest.approx([-0.8, 0.0, 0.0], abs=0.03)
    assert ground_of(np.concatenate([top, lower[:3]])).plane == pytest.approx([-0.8, 0.0, 0.0], abs=0.03)
    assert ground_of(np.concatenate([top, lower])).plane is None
    many = np.concatenate([top, patch((1.0, 2.5), (-1.0, 1.0), -0.8, 500), lower])
    assert ground_of(many).plane is not None, "of many landmarks more may be errors"


def test_landmarks_a_little_below_are_those_of_the_ground() -> None:
    floor = np.concatenate([patch((1.0, 2.5), (-1.0, 1.0), -0.8, 60), WALL])
    assert ground_of(np.concatenate([floor, patch((1.0, 2.5), (-1.0, 1.0), -0.88, 30)])).plane is not None
    assert ground_of(np.concatenate([floor, patch((1.0, 2.5), (-1.0, 1.0), -1.0, 4)])).plane is None


def test_what_stands_on_the_ground_does_not_lift_it_and_is_less_than_half_of_it() -> None:
    floor = patch((1.0, 4.0), (-1.0, 1.0), -1.0, 60)
    assert ground_of(np.concatenate([floor, patch((1.0, 4.0), (-1.0, 1.0), -0.9, 24)])).plane == pytest.approx(
        [-1.0, 0.0, 0.0], abs=0.02
    )
    assert ground_of(np.concatenate([floor, patch((1.0, 4.0), (-1.0, 1.0), -0.86, 36)])).plane is None


def test_a_narrow_strip_of_ground_tells_no_slope_across() -> None:
    strip = patch((1.0, 8.0), (-0.05, 0.05), -1.5, 300)
    strip[:, 2] += 0.15 * strip[:, 0] + 0.3 * strip[:, 1]
    plane = ground_of(strip).plane
    assert plane is not None and abs(plane[2]) < 0.05 and plane[1] == pytest.approx(0.15, abs=0.02)


def test_a_few_landmarks_are_no_ground() -> None:
    floor = patch((1.0, 4.0), (-2.0, 2.0), -1.0, 8)
    assert ground_of(floor).plane is not None
    assert ground_of(floor[:7]).plane is None
    assert ground_of(-floor).plane is None


def test_the_lower_edges_of_walls_are_no_ground() -> None:
    """A camera in a small room does not see the floor, and all walls from the same height on."""
    rng = np.random.default_rng(3)
    walls = np.concatenate([rng.uniform([3.0, -2.0, -1.0], [3.02, 2.0, 1.0], (300, 3)) for _ in "ab"])
    assert ground_of(walls).plane is None
    floor = patch((1.0, 3.0), (-2.0, 2.0), -1.0, 90)
    assert ground_of(np.concatenate([walls, floor])).plane == pytest.approx([-1.0, 0.0, 0.0], abs=0.05)


def test_far_ground_is_level_where_it_may_be_and_a_ramp_is_not() -> None:
    floor = patch((6.0, 9.0), (-2.0, 2.0), -1.5, 60) + np.column_stack(
        [np.zeros((60, 2)), np.linspace(-0.04, 0.04, 60)]
    )
    assert ground_of(floor).plane == pytest.approx([-1.5, 0.0, 0.0], abs=0.02)
    ramp = patch((1.0, 9.0), (-3.0, 3.0), -1.5, 300)
    ramp[:, 2] += 0.15 * ramp[:, 0]
    assert ground_of(ramp).plane == pytest.approx([-1.5, 0.15, 0.0], abs=0.05)


def test_the_lowest_landmarks_are_told_less_what_ground_may_fall() -> None:
    view = ground_of(np.concatenate([WALL, [[4.0, 0.0, -2.0]] * 3 + [[5.0, 0.0, -1.5]]]))
    assert view.lowest_m == pytest.approx(1.5 - 0.06 * 5.0)
    assert np.isnan(
        ground_of(np.concatenate([patch((1.0, 2.0), (0.0, 1.0), 1.0, 30), [[4.0, 0.0, -2.0]] * 3])).lowest_m
    )


def test_what_is_seen_is_kept_by_its_middle_and_spread() -> None:
    floor = np.array([[x, y, -1.0] for x in (2.0, 4.0) for y in (-1.0, 1.0)] * 3)
    view = ground_of(floor)
    assert view.centre_k == pytest.approx([0.0, 1.0, 3.0]) and view.spread_m2 == pytest.approx(2.0)


def seen(height_m: float = 1.0, lowest_m: float = 1.0, spread_m2: float = 2.0, unit_m: float = 1.0) -> GroundView:
    """A view of ground ahead. height_m: NaN without ground."""
    if np.isnan(height_m):
        return GroundView(None, lowest_m, np.zeros(3), 0.0, unit_m)
    return GroundView(np.array([-height_m, 0.0, 0.0]), lowest_m, np.array([0.0, height_m, 2.0]), spread_m2, unit_m)


MOVED = camera(30.0, -20.0, 2.0, 5.0) @ np.linalg.inv(camera(0.0, 0.0, 0.0))  # what is seen does not depend on it


def heights(*views: tuple[GroundView, tuple[float, float, float]], scale: float = 1.0) -> list[float]:
    """Height of the ground below the camera by each of these views at these places; NaN: unknown."""
    ground = LandmarkGround()
    keyframes = [KeyframeId(k) for k in range(len(views))]
    poses = np.array([MOVED @ camera(x, y, 0.0, z) for _, (x, y, z) in views])
    poses[:, :3, :3] *= scale
    for keyframe, (view, _) in zip(keyframes, views, strict=True):
        ground.put(keyframe, view)
    found = []
    for k in keyframes:
        plane = ground.heights(poses[k, :3, 3], keyframes, poses)[k]
        found.append(np.nan if plane is None else -float(plane[0]))
    return found


def test_two_places_must_agree_on_the_ground() -> None:
    here, beside, lower = (0.0, 0.0, 0.0), (0.2, 0.0, 0.0), seen(1.4, 1.0)
    assert np.isnan(heights((seen(), here))).all()
    assert np.isnan(heights((seen(), here), (seen(), (0.05, 0.0, 0.0)))).all()
    assert np.isnan(heights((seen(), here), (lower, beside))).all()
    assert heights((seen(), here), (seen(1.06), beside)) == pytest.approx([1.03, 1.03])
    assert np.isnan(heights((seen(), here), (seen(1.2), beside))).all()
    assert np.isnan(heights((seen(), here), (seen(), (0.0, 9.0, 0.0)))).all(), "too far apart"
    assert heights((seen(), here), (seen(1.2), (0.0, 2.0, 0.0))) == pytest.approx([1.1, 1.1]), "it may climb"
    assert np.isnan(heights((seen(), here), (seen(1.2), (0.0, 0.5, 0.0)))).all()
    assert np.isnan(heights((seen(), here), (seen(1.27), (0.0, 6.0, 0.0)))).all(), "not by more than 0.15 m"


def test_ground_is_wider_than_a_table() -> None:
    """A disc of 3 m has a mean square of 1.125 m2."""
    here, beside = (0.0, 0.0, 0.0), (0.0, 0.2, 0.0)
    assert np.isnan(heights((seen(spread_m2=1.1), here), (seen(spread_m2=1.1), beside))).all()
    assert heights((seen(spread_m2=1.15), here), (seen(spread_m2=1.15), beside)) == pytest.approx([1.0, 1.0])
    apart = heights((seen(spread_m2=0.2), here), (seen(spread_m2=0.2), (0.0, 2.2, 0.0)))
    assert apart == pytest.approx([1.0, 1.0]), "seen at two places that lie apart"
    apart = heights((seen(spread_m2=0.2), here), (seen(spread_m2=0.2), (2.2, 0.0, 0.0)))
    assert apart == pytest.approx([1.0, 1.0])
    assert np.isnan(heights((seen(spread_m2=0.2), here), (seen(spread_m2=0.2), (1.2, 1.2, 0.0)))).all()


def test_ground_is_none_where_two_views_show_something_lower() -> None:
    table = [(seen(), (0.0, 0.0, 0.0)), (seen(), (0.0, 0.3, 0.0))]
    low = [(seen(np.nan, 1.31), (0.0, 0.5, 0.0)), (seen(np.nan, 1.31), (0.0, 0.0, 0.0))]
    assert heights(*table, low[0])[:2] == pytest.approx([1.0, 1.0]), "one may be an error"
    assert np.isnan(heights(*table, *low)).all()
    high = [(view._replace(lowest_m=1.24), at) for view, at in low]
    assert heights(*table, *high) == pytest.approx([1.0] * 4)
    far = [(view._replace(lowest_m=1.5), (4.0, 0.0, 0.0)) for view, _ in low]
    assert heights(*table, *far)[:2] == pytest.approx([1.0, 1.0]), "ground may fall on the way"
    below = [(view, (0.0, 0.0, -1.2)) for view, _ in low]
    assert heights(*table, *below)[:2] == pytest.approx([1.0, 1.0]), "the storey below says nothing"


def test_ground_is_known_near_those_that_see_it() -> None:
    floor = [(seen(), (0.0, 0.0, 0.0)), (seen(), (0.0, 0.3, 0.0))]
    blind = seen(np.nan, np.nan)
    assert heights(*floor, (blind, (0.0, 7.0, 0.5)))[2] == pytest.approx(1.5)
    assert np.isnan(heights(*floor, (blind, (0.0, 9.0, 0.5)))[2])
    assert np.isnan(heights(*floor, (blind, (0.0, 0.0, 8.5)))[2]), "in height, too"
    assert np.isnan(heights(*floor, (blind, (0.0, 1.0, -1.5)))[2]), "below that ground"
    box = (seen(0.6, 0.9), (0.0, 0.1, 0.0))
    assert heights(*floor, box) == pytest.approx([1.0, 1.0, 1.0]), "not by what it takes for the ground itself"


def test_the_nearest_twenty_tell_the_height() -> None:
    near = [(seen(), (0.1 * k, 0.0, 0.0)) for k in range(11)]
    far = [(seen(1.1), (5.0 + 0.05 * k, 0.0, 0.0)) for k in range(15)]
    assert heights(*near, *far)[0] == pytest.approx(1.0), "eleven of twenty"
    assert heights(*near[1:], *far)[0] == pytest.approx(1.05), "ten of twenty"


def test_heights_are_in_metres_of_the_views_whatever_has_become_of_their_scale() -> None:
    places = [((0.0, 0.0, 0.0)), ((0.0, 0.5, 0.0))]
    assert heights(*[(seen(unit_m=2.0), at) for at in places], scale=2.0) == pytest.approx([1.0, 1.0])
    assert heights(*[(seen(unit_m=2.0), at) for at in places], scale=3.0) == pytest.approx([1.0, 1.0])
    narrow = [(seen(spread_m2=0.6, unit_m=2.0), at) for at in places]
    assert np.isnan(heights(*narrow, scale=2.0)).all()
    assert heights(*narrow, scale=3.0) == pytest.approx([1.0, 1.0]), "what was 2.2 m wide is 3.3 m wide now"


def test_a_ramp_keeps_its_slope_below_those_that_see_it() -> None:
    ground, keyframes = LandmarkGround(), [KeyframeId(0), KeyframeId(1), KeyframeId(2)]
    poses = np.array([camera(0.0, 0.3 * k, 0.0) for k in range(3)])
    for k in keyframes[:2]:
        ground.put(k, seen()._replace(plane=np.array([-1.0, 0.15, 0.02])))
    ground.put(keyframes[2], seen(0.4)._replace(plane=np.array([-0.4, 0.3, 0.0])))
    planes = ground.heights(poses[0, :3, 3], keyframes, poses)
    assert planes[keyframes[0]] == pytest.approx([-1.0, 0.15, 0.02])
    assert planes[keyframes[2]] == pytest.approx([-1.0, 0.0, 0.0])
    ground.remove(keyframes[1])
    assert keyframes[1] not in ground and keyframes[0] in ground
    assert ground.heights(poses[0, :3, 3], [keyframes[0]], poses[:1]) == {keyframes[0]: None}
    assert ground.heights(np.array([99.0, 0.0, 0.0]), [keyframes[0]], poses[:1]) == {}


def test_only_the_nearest_are_compared_and_told_of() -> None:
    """A long flight in one room has thousands of keyframes."""
    ground, keyframes = LandmarkGround(), [KeyframeId(k) for k in range(300)]
    poses = np.array([camera(0.0, 0.02 * k, 0.0) for k in range(300)])
    for k in keyframes:
        ground.put(k, seen() if k < 256 else seen(np.nan, 2.0))
    told = ground.heights(poses[0, :3, 3], keyframes, poses)
    assert list(told) == keyframes[:64] and told[keyframes[0]] == pytest.approx([-1.0, 0.0, 0.0])
    told = ground.heights(poses[200, :3, 3], keyframes, poses)
    assert len(told) == 64 and set(keyframes[169:231]) < set(told)
    assert told[keyframes[200]] is None, "others show more"
