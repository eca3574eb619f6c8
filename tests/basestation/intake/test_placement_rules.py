"""Where submaps are placed in w, by which unit, and which others move along: rule by rule, without a mapper."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.intake.placements import SubmapPlacements
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import GravityAlignment, LivePose, SubmapPlacement, SubmapTie
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, SubmapId, keyframe_id, submap_id

ONE_EYE = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, False, np.eye(4))
FAR_M = 1e9


def pose(seed: int) -> F64:
    return se3.exp(np.random.default_rng(seed).uniform(-1.0, 1.0, 6))


def of(agent: int, n: int) -> SubmapId:
    return submap_id(agent, 1, n)


A0, A1, A2, A3, A5 = (of(0, n) for n in (0, 1, 2, 3, 5))
B0, C0 = of(1, 0), of(2, 0)


class Told:
    """A publisher that notes what it is told."""

    def __init__(self) -> None:
        self.placed: list[tuple[SubmapId, bool, float, bool]] = []
        self.withdrawn: list[SubmapId] = []

    def publish_placement(
        self, submap: SubmapId, S_w_m: F64, *, recognised: bool, scale_sigma: float, urgent: bool
    ) -> None:
        self.placed.append((submap, recognised, scale_sigma, urgent))

    def withdraw_placement(self, submap: SubmapId) -> None:
        self.withdrawn.append(submap)


class World:
    """Submaps of two keyframes each, by cameras with one eye; those in `metric` are in metres."""

    def __init__(self, *submaps: SubmapId, metric: tuple[SubmapId, ...] = ()) -> None:
        self.map, self.told = SparseMap(), Told()
        for agent in range(3):
            self.map.set_camera(AgentId(agent), ONE_EYE)
        for submap in submaps:
            self.map.add_keyframe(keyframe_id(submap, 0), 10 * submap, NO_KEYFRAME, pose(int(submap)), 0)
            self.map.add_keyframe(keyframe_id(submap, 1), 10 * submap + 5, keyframe_id(submap, 0), pose(7), 0)
        self.map.metric_submaps.update(metric)
        self.intake = SimpleNamespace(
            gravity={}, fresh_scales=set(), last_pose={}, tracked_ns={}, loss_ties={}, fresh_ties=set()
        )
        publisher: Any = self.told
        intake: Any = self.intake
        self.placements = SubmapPlacements(self.map, intake, publisher)

    def place(self, **scales: float) -> dict[SubmapId, F64]:
        """Place submaps, named as here, without a merge, somewhere at a scale. Returns where."""
        for name, scale in scales.items():
            assert self.placements._place(globals()[name], sim3.of(scale, pose(len(self.placements.S_w_m) + 20)))
        return dict(self.placements.S_w_m)

    def merge(self, root: SubmapId, **scales: float) -> dict[SubmapId, F64]:
        """Make submaps one map: where they lie in it, each at a scale. The root lies at the identity."""
        poses = {globals()[name]: sim3.of(scale, pose(int(scale * 10) + 40)) for name, scale in scales.items()}
        poses |= {root: np.eye(4)}
        for submap, S_map_m in poses.items():
            if submap != root:
                self.map.root_submaps[submap] = root
            self.map.move_submap(submap, S_map_m)
        return poses

    def first_camera(self, submap: SubmapId) -> F64:
        """Where the first camera of a submap lies in w, as a rigid motion."""
        return sim3.place(self.placements.S_w_m[submap], self.map.first_pose(submap))


def close(a: F64, b: F64) -> bool:
    return np.allclose(a, b, atol=1e-9)


# -- after the one before ----------------------------------------------------------------------------------------------


def test_a_tie_to_another_agents_submap_places_nothing() -> None:
    world = World(A0, A1, B0)
    world.place(A0=1.0, B0=1.0)
    for before, placed in ((B0, False), (A0, True)):
        world.intake.loss_ties[A1] = SubmapTie(A1, keyframe_id(before, 1), pose(3), 0.01, 0.001)
        world.intake.fresh_ties = {A1}
        assert world.placements.follow_ties() == placed == (A1 in world.placements.S_w_m)


@pytest.mark.parametrize("by", ["tie", "metres"])
def test_all_that_follow_without_a_break_move_along(by: str) -> None:
    """Those without metres with their lengths, one in metres rigidly; one after a gap stays."""
    world = World(A0, A1, A2, A3, A5, metric=(A0, A3))
    before = world.place(A0=1.0, A1=1.0, A2=0.7, A3=1.0, A5=1.0)
    cameras = {s: world.first_camera(s) for s in before}
    if by == "tie":
        world.intake.loss_ties[A1] = SubmapTie(A1, keyframe_id(A0, 1), pose(3), 0.01, 0.001)
        world.intake.fresh_ties = {A1}
        assert world.placements.follow_ties()
        last = world.map.pose(keyframe_id(A0, 1))
        assert last is not None
        assert close(world.first_camera(A1), before[A0] @ last @ pose(3))
    else:
        world.map.metres_per_unit[A1] = 2.0
        world.intake.fresh_scales = {A1}
        assert world.placements.make_metric()
        assert sim3.scale_of(world.placements.S_w_m[A1]) == pytest.approx(2.0)
        assert close(world.first_camera(A1), cameras[A1])
    after = world.placements.S_w_m
    motion = after[A1] @ sim3.inverse(before[A1])
    assert not close(motion, np.eye(4))
    assert close(after[A2], motion @ before[A2])
    assert close(world.first_camera(A3), sim3.place(motion, cameras[A3])) and sim3.scale_of(after[A3]) == 1.0
    assert all(close(after[s], before[s]) for s in (A0, A5))
    assert all(close(world.placements.unmerged[s], after[s]) for s in after)


@pytest.mark.parametrize(
    ("before", "told", "scale"),
    [("metres", 0.5, 0.5), ("metres", None, None), ("a unit", 0.5, 2.0), ("a unit", None, 2.0)],
)
def test_where_an_agent_left_the_one_before_the_next_lies_in_its_unit(
    before: str, told: float | None, scale: float | None
) -> None:
    world = World(A0, A1, metric=(A0,) if before == "metres" else ())
    world.place(A0=1.0 if before == "metres" else 2.0)
    if told is not None:
        world.map.metres_per_unit[A1] = told
    left = LivePose(AgentId(0), 10 * A1 - 10**9, keyframe_id(A0, 1), pose(4), 80)
    world.intake.last_pose[A0] = left
    world.placements.place_new(keyframe_id(A1, 0))
    assert (A1 in world.placements.S_w_m) == (scale is not None)
    if scale is not None:
        last = world.map.pose(keyframe_id(A0, 1))
        assert last is not None and sim3.scale_of(world.placements.S_w_m[A1]) == pytest.approx(scale)
        assert close(world.first_camera(A1), sim3.place(world.placements.S_w_m[A0], last @ left.T_k_c))


# -- merged maps -------------------------------------------------------------------------------------------------------


def test_what_is_separated_goes_back_and_what_had_no_place_alone_has_none() -> None:
    world = World(A0, A1, B0, C0, metric=(A0, A1, B0, C0))
    alone = world.place(A0=1.0, B0=1.0)
    world.merge(A0, A1=1.0, B0=1.1, C0=1.2)
    world.map.metric_submaps.add(A0)
    world.placements.update_map(A0)
    assert list(world.placements.S_w_m) == [A0, B0, A1, C0]
    together = dict(world.placements.S_w_m)
    for submap in (B0, C0):
        del world.map.root_submaps[submap]
    world.told.placed.clear()
    world.placements.separate({A0, A1, B0, C0})
    assert close(world.placements.S_w_m[B0], alone[B0]) and not close(alone[B0], together[B0])
    assert all(close(world.placements.S_w_m[s], together[s]) for s in (A0, A1))
    assert C0 not in world.placements.S_w_m and world.placements.take_withdrawn() == [C0]
    assert world.placements.take_withdrawn() == [] and world.told.withdrawn == [C0]
    assert world.told.placed == [(B0, False, 0.0, False)]
    assert world.placements.state().recognised == {A1}


def test_a_merged_submap_is_told_at_once_and_the_one_that_holds_its_map_is_not_recognised() -> None:
    world = World(A0, B0, C0, metric=(A0, B0, C0))
    world.place(B0=1.0, A0=1.0)
    poses = world.merge(A0, B0=1.0, C0=1.0)
    world.told.placed.clear()
    world.placements.update_map(B0)
    assert sorted(world.told.placed) == [(A0, True, 0.0, True), (C0, True, 0.0, True)]  # B0 defines w
    S_w_map = world.placements.S_w_m[B0] @ sim3.inverse(poses[B0])
    assert all(close(world.placements.S_w_m[s], S_w_map @ poses[s]) for s in poses)
    world.told.placed.clear()
    world.placements.update_map(B0)
    assert world.told.placed == []
    world.map.move_submap(C0, poses[C0] @ se3.exp(np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0])))
    world.placements.update_map(B0)
    assert world.told.placed == [(C0, True, 0.0, False)]


@pytest.mark.parametrize("anchor_is_first", [True, False])
def test_w_takes_on_metres_of_a_merged_map(anchor_is_first: bool) -> None:
    """About the submap that was placed already. One in metres that lies apart moves rigidly, with its first camera."""
    world = World(A0, A1, B0, C0, metric=(B0, C0))
    before = world.place(A0=1.0, A1=0.8, C0=1.0)
    cameras = {s: world.first_camera(s) for s in before}
    anchor = A0 if anchor_is_first else A1
    poses = world.merge(B0, **{"A0" if anchor_is_first else "A1": 2.0})
    grown = 2.0 / sim3.scale_of(before[anchor])
    world.placements.update_map(B0)
    after = world.placements.S_w_m
    assert sim3.scale_of(after[B0]) == pytest.approx(1.0) and sim3.scale_of(after[anchor]) == pytest.approx(2.0)
    assert close(after[anchor][:3, 3], before[anchor][:3, 3])
    assert close(sim3.inverse(after[B0]) @ after[anchor], poses[anchor])
    at = before[anchor][:3, 3]
    motion = sim3.of(grown, se3.from_rt(np.eye(3), at - grown * at))
    other = A1 if anchor_is_first else A0
    assert close(after[other], motion @ before[other])
    assert close(world.first_camera(C0), sim3.place(motion, cameras[C0])) and sim3.scale_of(after[C0]) == 1.0
    assert close(world.placements.unmerged[other], after[other])


def test_a_world_in_metres_stays_where_a_map_in_metres_was_placed_in_another_unit() -> None:
    world = World(A0, A1, B0, metric=(A0, B0))
    before = world.place(A0=1.0, A1=0.8)
    poses = world.merge(B0, A1=2.0)
    world.placements.update_map(B0)
    after = world.placements.S_w_m
    assert close(after[A0], before[A0]) and close(after[A1][:3, 3], before[A1][:3, 3])
    assert sim3.scale_of(after[B0]) == pytest.approx(1.0) and sim3.scale_of(after[A1]) == pytest.approx(2.0)
    assert close(sim3.inverse(after[B0]) @ after[A1], poses[A1])


# -- units and gravity -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("metric", [True, False])
def test_a_unit_that_becomes_known_scales_w_or_the_submap_alone(metric: bool) -> None:
    world = World(A0, B0, C0, metric=(A0,) if metric else ())
    before = world.place(A0=1.0 if metric else 4.0, B0=0.5, C0=0.5)
    cameras = {s: world.first_camera(s) for s in before}
    world.map.root_submaps[C0] = A0  # part of a map: that one scales it
    told: set[SubmapId] = {B0, C0} if metric else {A0}
    world.map.metres_per_unit |= dict.fromkeys(told, 2.0)
    world.intake.fresh_scales = set(told)
    assert world.placements.make_metric()
    after = world.placements.S_w_m
    if metric:
        assert sim3.scale_of(after[B0]) == pytest.approx(2.0) and close(world.first_camera(B0), cameras[B0])
        assert all(close(after[s], before[s]) for s in (A0, C0))
    else:
        assert all(close(after[s], sim3.of(0.5, np.eye(4)) @ before[s]) for s in after)  # from 4 to 2 m
    assert not world.placements.make_metric()


def test_a_unit_that_is_told_of_a_submap_without_a_place_is_used_later() -> None:
    """And those after it are placed with it."""
    world = World(A0, A1, A2, metric=(A0,))
    world.map.metres_per_unit |= {A1: 0.5, A2: 0.25}
    world.intake.fresh_scales = {A1, A2}
    assert not world.placements.make_metric() and world.intake.fresh_scales == {A1, A2}
    world.place(A0=1.0)
    for submap in (A1, A2):
        before = SubmapId(submap - 1)
        world.intake.last_pose[before] = LivePose(AgentId(0), 10 * submap, keyframe_id(before, 1), pose(4), 80)
    assert world.placements.make_metric() and world.intake.fresh_scales == set()
    assert [sim3.scale_of(world.placements.S_w_m[s]) for s in (A0, A1, A2)] == pytest.approx([1.0, 0.5, 0.25])


def test_units_that_grew_in_their_map_are_told_with_how_well_they_are_known() -> None:
    world = World(A0, B0)
    before = world.place(A0=1.0, B0=0.5)
    cameras = {s: world.first_camera(s) for s in before}
    world.map.scaled_submaps.update({A0})
    world.told.placed.clear()
    world.placements.rescale({B0: 1.2}, {A0: 0.01})
    assert sim3.scale_of(world.placements.S_w_m[B0]) == pytest.approx(0.6)
    assert close(world.first_camera(B0), cameras[B0]) and close(world.placements.S_w_m[A0], before[A0])
    assert close(world.placements.unmerged[B0], world.placements.S_w_m[B0])
    assert world.told.placed == [(A0, False, 0.01, False), (B0, False, 0.0, False)]


def test_w_is_levelled_with_the_gravity_of_its_first_submap_in_any_unit() -> None:
    world = World(A0, B0, metric=(B0,))
    before = world.place(A0=2.0, B0=1.0)
    turn = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, -0.1, 0.05]))
    world.intake.gravity[A0] = GravityAlignment(A0, turn)
    assert world.placements.align_with_gravity() and not world.placements.align_with_gravity()
    S_w_a = world.placements.S_w_m[A0]
    assert close(S_w_a, sim3.of(2.0, sim3.with_scaled_translation(turn, 2.0)))
    motion = S_w_a @ sim3.inverse(before[A0])
    assert close(world.placements.S_w_m[B0], motion @ before[B0])
    other = World(A0)
    other.intake.gravity[A0] = GravityAlignment(A0, turn)
    other.placements.place_new(keyframe_id(A0, 0))
    assert close(other.placements.S_w_m[A0], turn)


def test_a_placement_that_is_deleted_leaves_nothing() -> None:
    world = World(A0, B0, metric=(A0, B0))
    world.place(A0=1.0, B0=1.0)
    world.merge(A0, B0=1.0)
    world.placements.update_map(A0)
    world.placements.rescale({}, {A0: 0.02})
    world.placements.delete(B0)
    assert world.told.withdrawn == [B0] and B0 not in world.placements.unmerged
    assert world.placements.state().recognised == frozenset()
    world.told.placed.clear()
    assert world.placements._place(B0, np.eye(4))
    assert world.told.placed == [(B0, False, 0.0, False)]


def test_a_world_whose_first_submap_would_lie_too_far_off_does_not_move() -> None:
    world = World(A0, B0)
    before = world.place(A0=1.0, B0=1.0)
    away = se3.from_rt(np.eye(3), np.array([FAR_M, 0.0, 0.0]))
    assert not world.placements._move_world(away)
    assert all(close(world.placements.S_w_m[s], before[s]) for s in before) and world.placements.far == 0
    assert all(close(world.placements.unmerged[s], before[s]) for s in before)
    assert not world.placements._place(B0, away) and world.placements.far == 1
    assert close(world.placements.S_w_m[B0], before[B0])


def test_a_submap_that_a_merge_leaves_where_it_was_is_told_as_recognised() -> None:
    world = World(A0, B0, metric=(A0, B0))
    world.place(A0=1.0)
    poses = world.merge(A0, B0=1.0)
    assert world.placements._place(B0, world.placements.S_w_m[A0] @ poses[B0])
    world.told.placed.clear()
    world.placements.update_map(A0)
    assert world.told.placed == [(B0, True, 0.0, True)]


def test_metres_of_a_submap_beside_a_world_in_another_unit_change_nothing() -> None:
    world = World(A0, B0)
    before = world.place(A0=1.0, B0=0.5)
    world.map.metres_per_unit[B0] = 2.0
    world.intake.fresh_scales = {B0}
    assert not world.placements.make_metric()
    assert all(close(world.placements.S_w_m[s], before[s]) for s in before)


def test_a_base_that_starts_anew_tells_what_agents_do_not_hold_as_it_is() -> None:
    world = World(A0, B0, C0, metric=(A0, B0, C0))
    alone = world.place(A0=1.0, B0=1.0, C0=1.0)
    world.merge(A0, B0=1.0)
    world.placements.update_map(A0)
    state, again = world.placements.state(), World(A0, B0, C0, metric=(A0, B0, C0))
    again.placements.restore_told(SubmapPlacement(A0, alone[A0], batch=3, scale_sigma=0.01))
    again.placements.restore_told(SubmapPlacement(B0, state.S_w_m[B0], recognised=False))
    again.placements.restore(state)
    assert again.told.placed == [(B0, True, 0.0, False), (C0, False, 0.0, False)]
    assert again.map.scaled_submaps == {A0}
    assert again.placements.state().recognised == {B0} and list(again.placements.S_w_m) == [A0, B0, C0]
    again.told.placed.clear()
    again.placements.separate({B0})  # its map is apart in this one
    assert close(again.placements.S_w_m[B0], alone[B0])
    again.placements.rescale({A0: 1.0}, {})
    assert again.told.placed == [(B0, False, 0.0, False), (A0, False, 0.01, False)]
