"""What the agent knows of how its submaps lie to each other, from the placements that a base sends."""

import copy
from collections.abc import Callable

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, SmoothingConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import DisparityCalibration, GravityAlignment, Key, SubmapPlacement
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId, submap_id

FIRST, SECOND = submap_id(AgentId(0), 1, 0), submap_id(AgentId(0), 1, 1)
FAR = se3.exp(np.array([1.3, -0.6, 0.1, 0.0, 0.0, 0.4]))


@pytest.fixture
def corrections() -> Corrections:
    return made(None)


def made(calibrate: Callable[[DisparityCalibration], list[str]] | None) -> Corrections:
    camera, config = RectifiedCamera(752, 480, 450.0, 450.0, 370.0, 240.0, 0.11, True, np.eye(4)), AgentConfig()
    local_map = LocalMap(camera, config.local_map)
    local_map.activate(FIRST)
    cache = MapCache(camera, config.map_cache, None)
    return Corrections(local_map, cache, config.smoothing, calibrate)


def test_an_offset_of_disparities_goes_to_the_right_camera_if_there_is_one() -> None:
    taken: list[DisparityCalibration] = []
    record = DisparityCalibration(AgentId(0), np.full(5, 0.25), 0.1)

    def calibrate(given: DisparityCalibration) -> list[str]:
        taken.append(given)
        return ["the rig is worn"]

    moved, events = made(calibrate).take([record], [])
    assert taken == [record] and events == ["the rig is worn"] and not moved
    assert made(None).take([record], []) == (False, [])


def test_a_placement_by_odometry_recognises_nothing_however_far_it_lies(corrections: Corrections) -> None:
    assert not corrections.is_recognised(SECOND)
    corrections.take([SubmapPlacement(FIRST, np.eye(4)), SubmapPlacement(SECOND, FAR)], [])
    assert not corrections.is_recognised(SECOND)


def test_a_submap_is_recognised_until_its_merge_is_undone(corrections: Corrections) -> None:
    corrections.take([SubmapPlacement(SECOND, FAR, recognised=True)], [])
    assert corrections.is_recognised(SECOND)
    corrections.take([SubmapPlacement(SECOND, FAR)], [])
    assert not corrections.is_recognised(SECOND)


def test_a_withdrawn_placement_recognises_nothing(corrections: Corrections) -> None:
    corrections.take([SubmapPlacement(SECOND, FAR, recognised=True)], [])
    corrections.take([], [Key(SubmapPlacement.KIND, int(SECOND), 0)])
    assert not corrections.is_recognised(SECOND)
    assert corrections.in_world(SECOND, np.eye(4), np.eye(4), 0, metric=True) is None


def test_poses_in_the_world_end_where_a_submap_has_no_place_in_it(corrections: Corrections) -> None:
    """They went on where the map lay that a user deleted, or by the merge that was found wrong."""
    corrections.take([SubmapPlacement(FIRST, FAR, recognised=True)], [])
    assert corrections.in_world(FIRST, np.eye(4), np.eye(4), 0, metric=True) is not None
    corrections.take([], [Key(SubmapPlacement.KIND, int(FIRST), 0)])
    assert corrections.in_world(FIRST, np.eye(4), np.eye(4), 50_000_000, metric=True) is None
    assert corrections.in_world(SECOND, np.eye(4), FAR, 100_000_000, metric=True) is None
    corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    placed = corrections.in_world(FIRST, np.eye(4), np.eye(4), 150_000_000, metric=True)
    assert np.allclose(placed, np.eye(4))  # at once, not at the speed of corrections


def test_a_world_of_the_agents_own_does_not_end_with_a_placement_that_was_never_applied(
    corrections: Corrections,
) -> None:
    corrections.move_on_board(FIRST, FAR)
    corrections.take([], [Key(SubmapPlacement.KIND, int(FIRST), 0)])
    assert np.allclose(in_world(corrections), np.eye(4))


TILTED = GravityAlignment(FIRST, se3.exp(np.array([0.2, 0.1, 0.0, 0.4, -0.2, 0.0])))


def in_world(corrections: Corrections) -> F64:
    """T_w_b of a body at the origin of the first submap, nothing of which was reported before."""
    placed = copy.deepcopy(corrections).in_world(FIRST, np.eye(4), np.eye(4), 0, metric=True)
    assert placed is not None
    return placed


@pytest.mark.parametrize("before", [True, False])
def test_a_start_in_motion_is_upright_until_the_base_knows(corrections: Corrections, before: bool) -> None:
    """The base places the first submap before it has heard of gravity."""
    if before:
        corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    corrections.set_upright(TILTED)
    if not before:
        corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    assert np.allclose(in_world(corrections), TILTED.T_l_m)
    moved = se3.from_rt(np.eye(3), np.array([3.0, 0.0, 0.0])) @ TILTED.T_l_m
    corrections.take([SubmapPlacement(FIRST, moved)], [])
    assert np.allclose(in_world(corrections), moved)


def test_a_merge_stands_even_if_the_other_world_is_not_level(corrections: Corrections) -> None:
    corrections.take([SubmapPlacement(FIRST, FAR, recognised=True)], [])
    corrections.set_upright(TILTED)
    assert np.allclose(in_world(corrections), FAR)
    other = FAR @ se3.exp(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    corrections.take([SubmapPlacement(FIRST, other, recognised=True)], [])
    assert np.allclose(in_world(corrections), other)


def test_a_new_submap_continues_where_odometry_puts_it(corrections: Corrections) -> None:
    """Until the base has placed it; one without a scale in metres waits."""
    corrections.take([SubmapPlacement(FIRST, FAR)], [])
    T_o_b = se3.exp(np.array([0.4, 0.1, -0.2, 0.1, 0.0, 0.3]))
    before = corrections.in_world(FIRST, T_o_b, np.eye(4), 0, metric=True)
    entered = corrections.in_world(SECOND, np.eye(4), T_o_b, 50_000_000, metric=True)
    assert np.allclose(entered, before)
    assert corrections.in_world(SECOND, np.eye(4), T_o_b, 50_000_000, metric=False) is None


def test_a_merge_is_taken_over_at_once_and_later_corrections_slowly(corrections: Corrections) -> None:
    corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    near = se3.from_rt(np.eye(3), np.array([0.3, 0.0, 0.0]))
    for t_ns in (0, 50_000_000):
        corrections.in_world(FIRST, np.eye(4), np.eye(4), t_ns, metric=True)
    corrections.take([SubmapPlacement(FIRST, near, recognised=True)], [])
    merged = corrections.in_world(FIRST, np.eye(4), np.eye(4), 100_000_000, metric=True)
    corrections.take([SubmapPlacement(FIRST, np.eye(4), recognised=True)], [])
    later = corrections.in_world(FIRST, np.eye(4), np.eye(4), 150_000_000, metric=True)
    assert merged is not None and np.allclose(merged, near)
    assert 0.29 < later[0, 3] < 0.3


def test_a_merge_of_a_submap_that_began_in_a_tracked_frame_is_smoothed(corrections: Corrections) -> None:
    """Its map only changed its scale: odometry has placed it to some centimetres."""
    corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    corrections.in_world(FIRST, np.eye(4), np.eye(4), 0, metric=True)
    corrections.note_continued(FIRST)
    moved = se3.from_rt(np.eye(3), np.array([0.04, 0.0, 0.0]))
    path = []
    for k in range(1, 60):
        if k == 3:
            corrections.take([SubmapPlacement(FIRST, moved, recognised=True)], [])
        told = corrections.in_world(FIRST, np.eye(4), np.eye(4), 50_000_000 * k, metric=True)
        path.append(told[0, 3])
    assert np.diff(path).max() < 0.003
    assert path[-1] == pytest.approx(0.04)


def test_time_without_a_placement_does_not_add_up_to_a_jump(corrections: Corrections) -> None:
    corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    for k in range(2):
        corrections.in_world(FIRST, np.eye(4), np.eye(4), 50_000_000 * k, metric=True)
    for k in range(2, 12):  # a new submap, not placed yet
        corrections.in_world(SECOND, np.eye(4), np.eye(4), 50_000_000 * k, metric=True)
    corrections.take([SubmapPlacement(SECOND, se3.from_rt(np.eye(3), np.array([0.2, 0.0, 0.0])))], [])
    told = corrections.in_world(SECOND, np.eye(4), np.eye(4), 600_000_000, metric=True)
    assert 0.0 < told[0, 3] < 0.003


@pytest.mark.parametrize("scale_sigma", [0.0, 0.001])
def test_places_are_corrected_by_shares_where_lengths_rest_on_accelerations(
    corrections: Corrections, scale_sigma: float
) -> None:
    """4 cm: within 2 s at the least speed, else a tenth of what is left a second. The filter of scales takes all."""
    corrections.take([SubmapPlacement(FIRST, np.eye(4), scale_sigma=scale_sigma)], [])
    moved = se3.from_rt(np.eye(3), np.array([0.04, 0.0, 0.0]))
    told = None
    for k in range(1, 43):
        if k == 3:
            corrections.take([SubmapPlacement(FIRST, moved, scale_sigma=scale_sigma)], [])
        told = corrections.in_world(FIRST, np.eye(4), np.eye(4), 50_000_000 * k, metric=True)
    assert told[0, 3] == pytest.approx(0.04 if scale_sigma == 0.0 else 0.04 * (1.0 - np.exp(-0.2)), rel=0.02)


T_B_C = se3.exp(np.array([0.1, -0.05, 0.02, 0.3, 0.1, -1.2]))
CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.1, False, T_B_C)
SUBMAP = submap_id(3, 1, 0)


@pytest.mark.parametrize("pace", [0.0, 0.5])
def test_a_place_with_a_scale_stretches_the_way_but_not_the_arm(pace: float) -> None:
    config = AgentConfig()
    window = MapCache(CAMERA, config.map_cache, None)
    local_map = LocalMap(CAMERA, config.local_map)
    base = Corrections(local_map, window, SmoothingConfig(max_m_s=pace, max_rad_s=pace, snap_m=0.3))
    T_m_c = se3.exp(np.array([2.0, 1.0, 0.3, 0.1, 0.4, -0.2]))
    T_m_b, T_o_m = T_m_c @ se3.inverse(T_B_C), se3.exp(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.7]))
    assert base.in_world(SUBMAP, T_m_b, T_o_m, 0, metric=False) is None
    S_w_m = sim3.of(2.7, se3.exp(np.array([1.0, -4.0, 0.2, 0.02, 0.0, 1.3])))
    assert not base.take([SubmapPlacement(SUBMAP, S_w_m)], [])[0]  # the local map, and with it odometry, stays
    told = base.in_world(SUBMAP, T_m_b, T_o_m, 50_000_000, metric=False)
    assert np.allclose(told, sim3.place(S_w_m, T_m_c) @ se3.inverse(T_B_C), atol=1e-9)
    eye, body = (told @ T_B_C)[:3, 3], told[:3, 3]
    assert np.isclose(np.linalg.norm(eye - body), np.linalg.norm(T_B_C[:3, 3]))
    base.take([], [Key(SubmapPlacement.KIND, int(SUBMAP), 0)])
    assert base.in_world(SUBMAP, T_m_b, T_o_m, 100_000_000, metric=False) is None
