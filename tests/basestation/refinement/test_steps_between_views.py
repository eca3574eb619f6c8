"""Steps of the agent between keyframes that look different ways, or over a longer time, hold what follows."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_core.optimisation.bundle import bundle
from tests.basestation.refinement.test_odometry_factors import CAMERA, CONFIG, IDS, SUBMAP, flight, window


@pytest.mark.parametrize("moved_m", [(0.0, 0.0, 0.0), (1.5, 0.0, 1.0), (-2.0, 0.5, -1.0)])
@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.8, -0.6, 0.0), (0.0, 0.96, 0.28)])
@pytest.mark.parametrize("angle_rad", [0.3, 0.75, 1.2, 1.8, 2.4, 2.9])
def test_keyframes_after_a_turn_are_held_by_their_parent(
    angle_rad: float, axis: tuple[float, ...], moved_m: tuple[float, ...]
) -> None:
    sparse_map, _ = flight(noise_px=0.1, births=40, unseen=3)
    turn = se3.from_rt(se3.so3_exp(angle_rad * np.array(axis)), np.array(moved_m))
    T_w_2, T_w_3 = sparse_map.pose(IDS[2]), sparse_map.pose(IDS[3])
    assert T_w_2 is not None and T_w_3 is not None
    sparse_map.keyframes.T_p_k[sparse_map.rows[IDS[3]]] = se3.inverse(T_w_2) @ T_w_3 @ turn
    for keyframe in IDS[3:]:
        T_3_k = se3.inverse(T_w_3) @ sparse_map.pose(keyframe)
        sparse_map.set_world_pose(keyframe, T_w_3 @ turn @ T_3_k, carry=False)
    linked = with_odometry_factors(sparse_map, window(sparse_map, IDS[3:]), CONFIG.odometry_factors)
    expected = np.linalg.inv(linked.T_c_m)
    together = se3.exp(np.array([0.02, -0.01, 0.015, 0.01, 0.02, -0.01]))  # 27 mm, 24 mrad
    begin = linked.T_c_m.copy()
    begin[1:] = begin[1:] @ se3.inverse(T_w_3 @ together @ se3.inverse(T_w_3))
    result = np.linalg.inv(bundle(replace(linked, T_c_m=begin), CONFIG.bundle).T_c_m)
    for T, held in zip(result[1:], expected[1:], strict=True):
        error = se3.inverse(held) @ T
        assert np.linalg.norm(error[:3, 3]) < 0.006
        assert np.linalg.norm(se3.so3_log(error[:3, :3])) < 0.003


def test_views_that_are_opposite_have_no_step() -> None:
    sparse_map, _ = flight(noise_px=0.1, births=40, unseen=3)
    row = sparse_map.rows[IDS[3]]
    sparse_map.keyframes.T_p_k[row] = se3.from_rt(np.diag([-1.0, 1.0, -1.0]), np.array([0.1, 0.0, 0.0]))
    part = window(sparse_map, IDS[3:])
    links = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors).camera[len(part.problem.camera) :]
    assert 0 not in links.tolist()  # that of keyframe 2
    assert {1, 2, 3} <= set(links.tolist())


def test_steps_over_a_longer_time_hold_less() -> None:
    sparse_map, _ = flight(noise_px=0.1, births=4)
    part = window(sparse_map)

    def sigma_px(step_s: float) -> float:
        for k, keyframe in enumerate(IDS):
            sparse_map.keyframes.t_ns[sparse_map.rows[keyframe]] = round(1e9 * step_s * k)
        linked = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
        return float(np.median(linked.sigma[len(part.problem.camera) :]))

    assert sigma_px(0.1) == sigma_px(0.5)
    assert 1.2 * sigma_px(0.5) < sigma_px(2.0) < 2.0 * sigma_px(0.5)  # rotations are held as before


def flight_of_one_camera(births: int, unseen: int = -1, turn_rad: float = 0.0) -> SparseMap:
    """A map in a unit of its own, where each keyframe begins so many landmarks, and the next one sees them again."""
    sparse_map, _ = flight(noise_px=0.0, births=births, unseen=unseen, turn_rad=turn_rad)
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    sparse_map.measures_depth.discard(AgentId(0))
    assert sparse_map.is_up_to_scale(SUBMAP)
    return sparse_map


def test_a_step_in_a_map_without_a_unit_holds_what_follows() -> None:
    sparse_map = flight_of_one_camera(births=30, unseen=3)
    linked = with_odometry_factors(sparse_map, window(sparse_map, IDS[3:]), CONFIG.odometry_factors)
    begin, told = linked.T_c_m.copy(), linked.T_c_m[1] @ se3.inverse(linked.T_c_m[0])
    about = linked.T_c_m[0]
    moved = se3.inverse(about) @ se3.exp(np.array([0.03, 0.02, 0.0, 0.0, 0.01, 0.005])) @ about
    begin[1:] = begin[1:] @ moved  # all that follow the step, together
    result = bundle(replace(linked, T_c_m=begin), CONFIG.bundle).T_c_m
    error = se3.inverse(told) @ result[1] @ se3.inverse(result[0])
    assert np.linalg.norm(se3.so3_log(error[:3, :3])) < 0.001  # 11 mrad before
    assert np.linalg.norm(error[:3, 3]) < 0.003  # 36 mm before, of a step of 150


def test_a_map_without_a_unit_that_sees_enough_is_left_to_its_images() -> None:
    sparse_map = flight_of_one_camera(births=90)
    part = window(sparse_map)
    assert with_odometry_factors(sparse_map, part, CONFIG.odometry_factors) is part.problem
