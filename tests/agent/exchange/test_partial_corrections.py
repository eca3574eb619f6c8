"""A disparity offset that was found has moved the local map: a part of the base's poses would tear it."""

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import KeyframeHeader, KeyframePose, RefinedLandmarks, SubmapPlacement
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId
from tests.agent.plain_landmarks import plain_landmarks

CAMERA = RectifiedCamera(752, 480, 400.0, 400.0, 370.0, 240.0, 0.11, True, np.eye(4))
CONFIG = AgentConfig()
STEP_M, SHARE = 1.0, 0.97  # between keyframes, as told; and what is left of it with the offset that was found
TICK_NS = 50_000_000
OFFSET_PX = np.array([1.0, 0.0, 0.0, 0.0, 0.0])


class _Flight:
    """Keyframes 0, 1, 2, ... in a row along x, each at twice the fitting distance where the base says nothing else."""

    def __init__(self, keyframes: int) -> None:
        self.map = LocalMap(CAMERA, CONFIG.local_map)
        cache = MapCache(CAMERA, CONFIG.map_cache, None)
        self.corrections = Corrections(self.map, cache, CONFIG.smoothing)
        self.covariance = PoseCovariance(self.map, np.eye(4), CONFIG.covariance, has_body=False, has_depth=True)
        for k in range(keyframes):
            self.add(k, STEP_M)

    def add(self, k: int, step_m: float) -> None:
        n, parent = 30, KeyframeId(k - 1 if k else NO_KEYFRAME)
        T_p_k = _at(step_m if k else 0.0)
        T_m_k = self.map.T_m_k[self.map.slot_of(parent)] @ T_p_k if k else T_p_k
        self.map.add(
            KeyframeHeader(KeyframeId(k), k, parent, T_p_k, n), T_m_k,
            plain_landmarks(np.full((n, 2), 200.0), 0.25), k,
        )  # fmt: skip

    def find_offset(self) -> None:
        """An offset is found on board: all steps were too long."""
        for slot in range(len(self.map.keyframe)):
            self.covariance._shift_k[slot] = 0.0
            self.covariance._shift_k[slot, 0, 0] = (1.0 - SHARE) * self.map.T_m_k[slot, 0, 3]
        self.covariance.correct_disparities(OFFSET_PX)

    def told(self, **x_m: float) -> bool:
        """The base sets keyframes (k0=x, k1=x, ...); whether the map moved."""
        records = [KeyframePose(KeyframeId(int(name[1:])), _at(x)) for name, x in x_m.items()]
        return self.corrections.take(records, [])[0]

    @property
    def x_m(self) -> list[float]:
        """Of the keyframes."""
        slots = np.flatnonzero(self.map.keyframe != NO_KEYFRAME)
        return [round(float(x), 9) for x in self.map.T_m_k[slots, 0, 3]]


def _at(x: float) -> np.ndarray:
    return se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0]))


def test_poses_below_keyframes_that_moved_here_wait_for_those_between() -> None:
    """The base knows of no offset yet: it bundles the newest keyframes where the agent told that they are."""
    flight = _Flight(5)
    flight.find_offset()
    assert flight.x_m == [0.0, 0.97, 1.94, 2.91, 3.88]
    assert not flight.told(k3=3.001, k4=4.002)
    assert flight.x_m == [0.0, 0.97, 1.94, 2.91, 3.88]
    assert not flight.told(k2=1.96)  # keyframe 1 may lie anywhere
    assert flight.told(k1=0.98, k3=2.94, k4=3.92)
    assert flight.x_m == [0.0, 0.98, 1.96, 2.94, 3.92]
    assert flight.told(k4=4.02)  # both sides agree on all others


def test_poses_that_the_base_computed_before_it_knew_the_offset_do_not_undo_it() -> None:
    flight = _Flight(4)
    assert flight.told(k1=1.03, k2=2.06, k3=3.09)
    flight.find_offset()
    moved = [0.0, 0.9991, 1.9982, 2.9973]
    assert flight.x_m == pytest.approx(moved)
    flight.told(k1=1.031, k2=2.062, k3=3.093)
    assert flight.x_m == pytest.approx([0.0, *(x + 0.001 * k for k, x in enumerate(moved[1:], 1))], abs=1e-4)


def test_poses_of_a_base_that_knows_the_offset_are_taken_as_they_are() -> None:
    flight = _Flight(4)
    assert flight.told(k1=1.03, k2=2.06, k3=3.09)
    flight.find_offset()
    assert flight.told(k1=0.98, k2=1.96, k3=2.94)
    assert flight.x_m == [0.0, 0.98, 1.96, 2.94]


def test_what_the_base_set_before_stays_where_the_offset_moved_it_if_the_base_sets_a_part() -> None:
    flight = _Flight(4)
    assert flight.told(k1=1.03, k2=2.06, k3=3.09)
    flight.find_offset()
    assert flight.told(k3=3.13)
    assert flight.x_m == pytest.approx([0.0, 0.9991, 1.9982, 3.13 - 0.09 * 1.03])


def test_landmarks_told_before_the_offset_was_found_are_corrected_by_it() -> None:
    flight = _Flight(2)
    flight.map.share(KeyframeId(1), 30)
    rho = np.full(30, 0.27)
    flight.corrections.take([RefinedLandmarks(KeyframeId(1), np.arange(30), rho, np.zeros((30, 2)))], [])
    before = flight.map.rho[1, 0]
    flight.find_offset()
    assert flight.told(k1=1.06)
    assert before != pytest.approx(0.27)
    assert flight.map.rho[1, :30] == pytest.approx(0.27 - OFFSET_PX[0] / CAMERA.bf)


def test_landmarks_that_come_without_poses_are_of_the_offset_of_the_poses_before() -> None:
    flight = _Flight(4)
    flight.map.share(KeyframeId(1), 30)
    assert flight.told(k1=1.03, k2=2.06, k3=3.09)
    flight.find_offset()
    flight.corrections.take([RefinedLandmarks(KeyframeId(1), np.arange(30), np.full(30, 0.3), np.zeros((30, 2)))], [])
    assert flight.map.rho[1, :30] == pytest.approx(0.3 - OFFSET_PX[0] / CAMERA.bf)


@pytest.mark.parametrize("placed", [False, True])
def test_live_poses_follow_an_offset_without_a_jump_whether_or_not_a_base_is_there(*, placed: bool) -> None:
    """Keyframe and camera at 3 m move back by 90 mm at once; live poses do so in 33 frames."""
    flight = _Flight(1)
    if placed:
        flight.corrections.take([SubmapPlacement(SubmapId(0), np.eye(4))], [])
    live = [_live(flight, 0.0, 0)]
    flight.corrections.move_on_board(SubmapId(0), np.eye(4))
    live += [_live(flight, 0.09, n * TICK_NS) for n in range(1, 60)]
    assert live[0] in (None, 3.0)  # in the submap, without a placement
    steps = np.diff([3.0, *live[1:]])
    assert steps.min() >= -0.003
    assert steps.max() <= 1e-9
    assert live[35] == pytest.approx(2.91)
    assert np.ptp(live[35:]) < 1e-9


def test_a_placement_that_comes_later_changes_the_frame_and_nothing_else() -> None:
    flight = _Flight(1)
    flight.corrections.move_on_board(SubmapId(0), np.eye(4))
    before = _live(flight, 0.09, TICK_NS)
    flight.corrections.take([SubmapPlacement(SubmapId(0), _at(7.0))], [])
    assert before is not None
    assert _live(flight, 0.09, 2 * TICK_NS) == pytest.approx(7.0 + before, abs=0.003)


def test_a_placement_keeps_what_live_poses_leave_out() -> None:
    """Corrections turned the map as a whole before it was placed; 1.5 mm and 0.2 mrad were between the two poses."""
    flight = _Flight(4)
    flight.corrections.move_on_board(SubmapId(0), np.eye(4))
    _live(flight, 0.0, 0)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.004]))
    poses = {KeyframeId(k): turn @ _at(STEP_M * k) for k in range(1, 4)}
    assert flight.corrections.take([KeyframePose(k, T_m_k) for k, T_m_k in poses.items()], [])[0]
    T_m_b, T_o_m = poses[KeyframeId(3)], se3.inverse(turn)
    S_w_m = se3.exp(np.array([7.0, 3.0, 0.0, 0.0, 0.0, 2.0]))
    before = flight.corrections.in_world(SubmapId(0), T_m_b, T_o_m, TICK_NS, metric=True)
    flight.corrections.take([SubmapPlacement(SubmapId(0), S_w_m)], [])
    after = flight.corrections.in_world(SubmapId(0), T_m_b, T_o_m, TICK_NS, metric=True)
    assert before is not None and after is not None
    np.testing.assert_allclose(after, S_w_m @ before, atol=1e-6)


def test_a_later_submap_that_is_placed_first_begins_live_poses_anew() -> None:
    flight = _Flight(1)
    flight.corrections.move_on_board(SubmapId(0), np.eye(4))
    _live(flight, 0.0, 0)
    flight.map.activate(SubmapId(1))
    x_m = []
    for n, placed in enumerate([SubmapPlacement(SubmapId(1), _at(5.0)), SubmapPlacement(SubmapId(0), _at(0.6))], 1):
        flight.corrections.take([placed], [])
        T_w_b = flight.corrections.in_world(SubmapId(1), np.eye(4), _at(3.0), n * TICK_NS, metric=True)
        assert T_w_b is not None
        x_m.append(float(T_w_b[0, 3]))
    assert x_m == [5.0, 5.0]


def _live(flight: _Flight, back_m: float, t_ns: int) -> float | None:
    """x of the live pose of a vehicle at 3 m in o, whose map moved it back."""
    T_w_b = flight.corrections.in_world(SubmapId(0), _at(3.0 - back_m), _at(back_m), t_ns, metric=True)
    return None if T_w_b is None else float(T_w_b[0, 3])


def test_keyframes_made_since_are_where_the_base_composes_them_if_their_parents_are() -> None:
    flight = _Flight(3)
    flight.find_offset()
    flight.add(3, SHARE)
    flight.add(4, SHARE)
    assert not flight.told(k4=3.9)
    assert flight.told(k1=0.98, k2=1.96)
    assert flight.x_m == pytest.approx([0.0, 0.98, 1.96, 2.93, 3.9])


def test_without_an_offset_a_part_may_move() -> None:
    """What the agent told is what both sides hold."""
    flight = _Flight(4)
    assert flight.told(k3=3.04)
    assert flight.x_m == [0.0, 1.0, 2.0, 3.04]
