"""Links between keyframes: they hold the poses of those that see few points, and are loose where many are seen."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, OdometryFactorConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper_state import map_state, restore_map
from kiteline_basestation.refinement.bundle_window import BundleWindow, bundle_window
from kiteline_basestation.refinement.disparity_calibration import with_border
from kiteline_basestation.refinement.odometry_factors import (
    median_depths,
    with_odometry_factors,
    without_odometry_factors,
)
from kiteline_codec.schema import InertialSteps
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id
from kiteline_core.optimisation.bundle import bundle

CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 376.0, 240.0, 0.11, True, np.eye(4))
SUBMAP = submap_id(0, 0, 0)
KEYFRAMES, BIRTHS = 6, 14
IDS = [keyframe_id(SUBMAP, k) for k in range(KEYFRAMES)]
CONFIG = BaseConfig()


def flight(
    noise_px: float, births: int = BIRTHS, unseen: int = -1, turn_rad: float = 0.0
) -> tuple[SparseMap, list[np.ndarray]]:  # fmt: skip
    """Keyframes along x with new landmarks each, seen again by the next; links are exact, pixels are not.

    unseen: a keyframe that sees none of those before it. turn_rad: about y, from each to the next.
    """
    rng = np.random.default_rng(1)
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(0), CAMERA)
    turns = [se3.so3_exp(turn_rad * k * np.array([0.0, 1.0, 0.4])) for k in range(KEYFRAMES)]
    truth = [se3.from_rt(turn, np.array([0.15 * k, 0.0, 0.0])) for k, turn in enumerate(turns)]
    before: tuple[np.ndarray, np.ndarray] = (np.zeros((0, 3)), np.zeros(0, np.int64))
    for k, T in enumerate(truth):
        keyframe = keyframe_id(SUBMAP, k)
        before = (before[0][:0], before[1][:0]) if k == unseen else before
        seen = len(before[1])
        parent = KeyframeId(keyframe - 1) if k else NO_KEYFRAME
        T_p_k = se3.inverse(truth[k - 1]) @ T if k else T
        sparse_map.add_keyframe(keyframe, k, parent, T_p_k, births + seen)
        uv = rng.uniform(60, (690, 420), (births, 2)).astype(np.float32)
        rho = rng.uniform(0.2, 0.5, births)
        noisy = (rho + rng.normal(0, noise_px, births) / CAMERA.bf).astype(np.float32)
        index = np.arange(births, dtype=np.uint16)
        sparse_map.put_new_landmarks(
            keyframe, 0, index, uv, noisy, np.zeros(births, np.uint8), np.zeros(births, np.uint8),
            rng.integers(0, 256, (births, 32)).astype(np.uint8),
        )  # fmt: skip
        if seen:
            local = se3.transform(se3.inverse(T), before[0])
            at = local[:, :2] / local[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
            at = (at + rng.normal(0, noise_px, at.shape)).astype(np.float32)
            depth = (1.0 / local[:, 2] + rng.normal(0, noise_px, seen) / CAMERA.bf).astype(np.float32)
            rows = np.arange(births, births + seen, dtype=np.uint16)
            sparse_map.put_observations(keyframe, 0, rows, at, depth, np.zeros(seen, np.uint8), before[1])
        ray = np.column_stack([(uv - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones(births)])
        before = se3.transform(T, ray / rho[:, None]), keyframe << 11 | np.arange(births)
    return sparse_map, truth


def window(sparse_map: SparseMap, free: Sequence[KeyframeId] = IDS) -> BundleWindow:
    return bundle_window(sparse_map, list(free), CONFIG.bundle_window, CONFIG.measurement)


def error_m(poses: np.ndarray, truth: list[np.ndarray]) -> float:
    return float(max(np.linalg.norm(np.linalg.inv(a)[:3, 3] - b[:3, 3]) for a, b in zip(poses, truth, strict=True)))


def test_links_hold_what_few_points_cannot() -> None:
    sparse_map, truth = flight(noise_px=1.5)
    part = window(sparse_map)
    alone = bundle(part.problem, CONFIG.bundle)
    linked = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    assert len(linked.points) > len(part.problem.points)
    result = without_odometry_factors(part, bundle(linked, CONFIG.bundle))
    assert len(result.points) == len(part.points)
    assert len(result.inlier) == len(part.slots)
    assert error_m(result.T_c_m, truth) < 0.5 * error_m(alone.T_c_m, truth)


def test_few_points_hardly_move_what_the_agent_tracked() -> None:
    """Its steps rest on ten times as many landmarks as a thin link carries."""
    sparse_map, truth = flight(noise_px=0.25)
    part = window(sparse_map)
    alone = bundle(part.problem, CONFIG.bundle)
    linked = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    result = without_odometry_factors(part, bundle(linked, CONFIG.bundle))
    assert error_m(result.T_c_m, truth) < 0.05 * error_m(alone.T_c_m, truth)


def test_keyframes_that_see_nothing_of_those_before_them_are_held_by_their_parent() -> None:
    sparse_map, _ = flight(noise_px=0.1, births=40, unseen=3)
    part = window(sparse_map, IDS[3:])
    held = dict(zip((sparse_map.keyframes.id[part.rows] - keyframe_id(SUBMAP, 0)).tolist(), part.problem.free))
    assert held == {2: False, 3: True, 4: True, 5: True}
    linked = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    moved = linked.T_c_m.copy()
    moved[1:, 0, 3] += 0.02  # all of them together
    result = bundle(replace(linked, T_c_m=moved), CONFIG.bundle)
    assert np.linalg.norm(result.T_c_m[1:, :3, 3] - linked.T_c_m[1:, :3, 3], axis=1).max() < 0.004


def test_a_culled_parent_holds_nothing() -> None:
    sparse_map, _ = flight(noise_px=0.1, births=40)
    culled, *free = IDS[2:]
    sparse_map.cull_keyframe(culled)
    part = window(sparse_map, free)
    assert sparse_map.rows[culled] not in part.rows.tolist()


def turn_error(poses: np.ndarray, truth: list[np.ndarray]) -> float:
    return float(max(np.linalg.norm(se3.so3_log(a[:3, :3] @ b[:3, :3])) for a, b in zip(poses, truth, strict=True)))


def test_keyframes_with_many_points_are_told_how_they_turned_and_no_lengths() -> None:
    sparse_map, truth = flight(noise_px=0.5)
    for row in sparse_map.rows.values():  # the agent's steps are 3 % too long, its turns are right
        sparse_map.keyframes.T_p_k[row, :3, 3] *= 1.03
    part = window(sparse_map)
    far = replace(part, problem=replace(part.problem, T_c_m=np.stack([se3.inverse(T) for T in truth])))
    alone = bundle(far.problem, CONFIG.bundle)
    loose, firm = (
        without_odometry_factors(
            part,
            bundle(with_odometry_factors(sparse_map, far, OdometryFactorConfig(enough_observations=e)), CONFIG.bundle),
        )
        for e in (5, 80)
    )
    assert turn_error(loose.T_c_m, truth) < 0.5 * turn_error(alone.T_c_m, truth)

    def length(poses: np.ndarray) -> float:
        return float(np.linalg.norm(np.linalg.inv(poses[-1])[:3, 3]))

    true_m = 0.15 * (KEYFRAMES - 1)
    assert abs(length(loose.T_c_m) - true_m) < 0.5 * abs(length(firm.T_c_m) - true_m)


def test_turns_that_are_all_off_the_same_way_count_less() -> None:
    sigma = {}
    for name, signs in (("alike", (1, 1, 1, 1, 1, 1)), ("by chance", (1, 1, -1, -1, 1, -1))):
        sparse_map, truth = flight(noise_px=0.1)
        for sign, row in zip(signs, sparse_map.rows.values(), strict=True):
            off = se3.from_rt(se3.so3_exp(np.array([0.0, sign * 5e-4, 0.0])), np.zeros(3))
            sparse_map.keyframes.T_p_k[row] = sparse_map.keyframes.T_p_k[row] @ off
        part = window(sparse_map)
        part = replace(part, problem=replace(part.problem, T_c_m=np.stack([se3.inverse(T) for T in truth])))
        sigma[name] = with_odometry_factors(sparse_map, part, OdometryFactorConfig(enough_observations=5)).sigma[-1, 0]
    assert sigma["alike"] > 1.3 * sigma["by chance"]


def test_links_of_a_worn_rig_count_less() -> None:
    sparse_map, _ = flight(noise_px=0.3)
    part = window(sparse_map)
    sparse_map.keyframes.t_ns[: len(sparse_map)] = 2_000_000_000 * np.arange(len(sparse_map))  # as over a radio
    good = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors).sigma[len(part.slots) :]
    sparse_map.disparity_sigma_px[AgentId(0)] = 0.2
    worn = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors).sigma[len(part.slots) :]
    assert good.max() < 0.3
    assert worn.min() > 5.0 * good.max()


def test_links_of_few_points_are_measured_with_the_offset_of_the_border() -> None:
    """A synthetic point has a disparity where the child sees it, which the offset changes, and none in the parent."""
    sparse_map, _ = flight(noise_px=0.3)
    part = window(sparse_map)
    problem, agents = with_border(sparse_map, part.slots, part.problem, CONFIG.disparity)
    assert agents == (AgentId(0),)
    linked = with_odometry_factors(sparse_map, replace(part, problem=problem), CONFIG.odometry_factors)
    assert len(linked.border.group) == len(linked.border.terms) == len(linked.camera) > len(part.slots)
    disparity = linked.measured[len(part.slots) :, 2].reshape(-1, 2)
    assert ((disparity >= 0.0).sum(1) == 1).all()
    assert np.array_equal(linked.border.group[len(part.slots) :] == 0, disparity.ravel() >= 0.0)
    many = OdometryFactorConfig(enough_observations=5)  # rotations alone, of points far away: no disparity counts there
    linked = with_odometry_factors(sparse_map, replace(part, problem=problem), many)
    assert (linked.border.group[len(part.slots) :] == -1).all()
    assert bundle(linked, CONFIG.bundle).offset.shape == (1, 5)


OFFSET = np.array([0.5, 0.0, 0.0, 0.0, 0.0])


def test_steps_follow_the_disparity_offset_as_it_becomes_known() -> None:
    """Disparities are half a pixel too large; the agent did not know when it measured its steps by them."""
    sparse_map, truth = flight(noise_px=0.0, births=70)
    sparse_map.keypoints.inv_depth[: sparse_map.slots] += OFFSET[0] / CAMERA.bf
    part = window(sparse_map)
    told = bundle(part.problem, replace(CONFIG.bundle, robust_trials=20)).T_c_m
    for k in range(1, KEYFRAMES):
        sparse_map.keyframes.T_p_k[sparse_map.rows[IDS[k]]] = told[k - 1] @ se3.inverse(told[k])
    blind = replace(
        part, problem=replace(part.problem, T_c_m=told, sigma=1e3 * part.problem.sigma)
    )  # links alone count
    sparse_map.disparity_offset_px[AgentId(0)] = OFFSET
    few = replace(CONFIG.odometry_factors, enough_observations=1000)
    for known, least, most in (({}, 0.0, 0.5), ({IDS[0]: OFFSET}, 0.98, 1.02)):  # it stands if the agent knew
        sparse_map.measured_with_px = dict(known)
        linked = with_odometry_factors(sparse_map, blind, few)
        result = bundle(linked, replace(CONFIG.bundle, robust_trials=20))
        assert least <= error_m(result.T_c_m, truth) / error_m(told, truth) <= most


def test_a_map_notes_which_offset_each_keyframe_was_measured_with() -> None:
    sparse_map, better, keyframes = SparseMap(), OFFSET + 0.1, IDS
    for k, keyframe in enumerate(keyframes):
        if k in (2, 4):
            sparse_map.disparity_offset_px[AgentId(0)] = OFFSET if k == 2 else better
        sparse_map.add_keyframe(keyframe, k, KeyframeId(keyframe - 1) if k else NO_KEYFRAME, np.eye(4), 0)
    other = keyframe_id(submap_id(1, 0, 0), 0)
    sparse_map.add_keyframe(other, 0, NO_KEYFRAME, np.eye(4), 0)
    sparse_map.add_keyframe(keyframes[1], 1, keyframes[0], np.eye(4), 0)  # its header again: measured as it was
    expected = [0.0, 0.0, 0.5, 0.5, 0.6, 0.6]
    again = SparseMap()  # a later process that receives all of them at once
    again.disparity_offset_px[AgentId(0)] = better
    for k, keyframe in enumerate(keyframes):
        again.add_keyframe(keyframe, k, KeyframeId(keyframe - 1) if k else NO_KEYFRAME, np.eye(4), 0)
    restore_map(again, map_state(sparse_map))
    for one in (sparse_map, again):
        assert [one.offset_measured_with(k)[0] for k in keyframes] == expected
        assert not one.offset_measured_with(other).any()


def test_steps_in_a_scene_without_disparities_are_taken_as_told() -> None:
    """A changed offset leaves none of the synthetic points' disparities: all would be behind infinity."""
    sparse_map, _ = flight(noise_px=0.0)
    sparse_map.keypoints.inv_depth[: sparse_map.slots] *= 0.005
    part = window(sparse_map)
    sparse_map.disparity_offset_px[AgentId(0)] = 4.0 * OFFSET
    far = replace(part, problem=replace(part.problem, measured=part.problem.measured * (1.0, 1.0, 0.005)))
    linked = with_odometry_factors(sparse_map, far, CONFIG.odometry_factors)
    added = linked.measured[len(part.slots) :]
    assert len(added) and (added[:, 2] > 0.0).all()


def test_offsets_of_steps_do_not_depend_on_the_order_in_which_keyframes_arrive() -> None:
    sparse_map, keyframes = SparseMap(), IDS

    def arrive(*numbers: int) -> None:
        for k in numbers:
            sparse_map.add_keyframe(keyframes[k], k, KeyframeId(keyframes[k] - 1) if k else NO_KEYFRAME, np.eye(4), 0)

    arrive(0, 2, 3)
    sparse_map.disparity_offset_px[AgentId(0)] = OFFSET
    arrive(1, 5, 4)  # 1 was measured before 2
    assert [sparse_map.offset_measured_with(k)[0] for k in keyframes] == [0.0, 0.0, 0.0, 0.0, 0.5, 0.5]


def test_offsets_of_steps_of_a_start_with_smaller_ids_are_not_those_of_an_earlier_start() -> None:
    sparse_map = SparseMap()
    first, second = (keyframe_id(submap_id(0, boot, 0), 3) for boot in (7, 2))
    sparse_map.add_keyframe(first, 0, NO_KEYFRAME, np.eye(4), 0)
    sparse_map.disparity_offset_px[AgentId(0)] = OFFSET
    sparse_map.add_keyframe(second, 1, NO_KEYFRAME, np.eye(4), 0)
    assert not sparse_map.offset_measured_with(first).any()
    assert np.array_equal(sparse_map.offset_measured_with(second), OFFSET)


@pytest.mark.parametrize("wrong", [np.zeros(3), np.full(5, np.nan), np.zeros((5, 1))])
def test_a_saved_state_with_what_is_no_disparity_offset_is_refused(wrong: np.ndarray) -> None:
    """The map is left as it was; else the first bundle would fail on it."""
    good = map_state(SparseMap())
    noted = replace(good, measured_with_px={keyframe_id(SUBMAP, 0): wrong})
    for state in (noted, replace(good, disparity_offset_px={AgentId(0): wrong})):
        sparse_map = SparseMap()
        with pytest.raises(ValueError, match="a disparity offset is"):
            restore_map(sparse_map, state)
        assert not sparse_map.measured_with_px and not sparse_map.disparity_offset_px


def test_a_keyframe_without_observations_stays_tied_to_its_parent() -> None:
    """The parent is in the window though it shares no landmark, fixed, and its odometry factor with it."""
    sparse_map, _ = flight(noise_px=0.5)
    few = replace(CONFIG.bundle_window, max_fixed=0)  # nobody is in the window for what it observes
    part = bundle_window(sparse_map, IDS[3:], few, CONFIG.measurement)
    ids = sparse_map.keyframes.id[part.rows].tolist()
    assert ids == IDS[2:]
    assert part.problem.free.tolist() == [False, True, True, True]
    linked = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    added = linked.camera[len(part.problem.camera) :]
    assert {0, 1} <= set(added.tolist())


def test_median_depths_are_those_of_each_camera_s_disparities_or_of_the_map_if_it_measures_none() -> None:
    sparse_map, _ = flight(0.3, 40, unseen=3)
    part = window(sparse_map)
    problem = part.problem
    measured = problem.measured.copy()
    measured[problem.camera == 2, 2] = -1.0
    unranged = np.arange(KEYFRAMES) == 2
    depth = median_depths(replace(problem, measured=measured), unranged)
    of = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))
    for k in range(KEYFRAMES):
        disparity = measured[(problem.camera == k) & (measured[:, 2] > 0), 2]
        by_map = se3.transform(problem.T_c_m[k], problem.points[of[problem.camera == k]])[:, 2]
        expected = CAMERA.bf / np.median(CAMERA.bf / by_map if k == 2 else disparity)
        assert depth[k] == pytest.approx(expected, rel=1e-6)
    nothing = replace(problem, points=problem.points - [0.0, 0.0, 100.0], measured=np.full_like(measured, -1.0))
    assert np.isnan(median_depths(nothing, unranged)).all()  # all behind
    assert np.isnan(median_depths(replace(problem, measured=measured), np.zeros(KEYFRAMES, np.bool_))[2])


def test_inertial_steps_tie_a_keyframe_without_a_parent() -> None:
    sparse_map, _ = flight(noise_px=0.5)
    part = window(sparse_map)
    expected = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    row = sparse_map.rows[IDS[3]]
    T_p_k = sparse_map.keyframes.T_p_k[row].copy()
    sparse_map.keyframes.parent[row], sparse_map.keyframes.T_p_k[row] = NO_KEYFRAME, np.eye(4)
    apart = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    assert len(apart.points) < len(expected.points)
    rest = np.zeros((1, 3))
    sparse_map.inertial_steps[IDS[3]] = InertialSteps(
        IDS[3], IDS[2], 2e-3, np.ones(1), rest, T_p_k[None, :3, 3], rest, rest
    )
    tied = with_odometry_factors(sparse_map, part, CONFIG.odometry_factors)
    assert np.allclose(tied.measured, expected.measured) and np.allclose(tied.points, expected.points)


def residuals_of_steps(sparse_map: SparseMap, config: OdometryFactorConfig) -> tuple[np.ndarray, np.ndarray]:
    """Of the synthetic points where the map lies: pixels (m,2), and deviations (m,)."""
    part = window(sparse_map)
    linked, n = with_odometry_factors(sparse_map, part, config), len(part.problem.camera)
    T = linked.T_c_m[linked.camera[n:]]
    world = np.repeat(linked.points[len(part.points) :], 2, axis=0)
    local = np.einsum("nij,nj->ni", T[:, :3, :3], world) + T[:, :3, 3]
    seen = local[:, :2] / local[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
    return seen - linked.measured[n:, :2], linked.sigma[n:, 0]


@pytest.mark.parametrize("enough", [5, 1000])
def test_steps_that_the_map_has_as_well_leave_no_residuals_and_count_fully(enough: int) -> None:
    sparse_map, _ = flight(noise_px=0.1, turn_rad=0.1)
    off, sigma = residuals_of_steps(sparse_map, OdometryFactorConfig(enough_observations=enough))
    assert len(off) and np.abs(off).max() < 1e-6
    assert enough > 5 or sigma == pytest.approx(0.1)  # rotations differ by nothing


@pytest.mark.parametrize("gap_s", [1, 4])
def test_links_of_a_worn_rig_loosen_with_the_root_of_the_time_between(gap_s: int) -> None:
    sparse_map, _ = flight(noise_px=0.1)
    sparse_map.keyframes.t_ns[: len(sparse_map)] = gap_s * 1_000_000_000 * np.arange(len(sparse_map))
    sparse_map.disparity_sigma_px[AgentId(0)] = 0.2
    _, sigma = residuals_of_steps(sparse_map, OdometryFactorConfig(enough_observations=5))
    assert sigma == pytest.approx(0.5 * np.sqrt(gap_s))
