"""Tiles for agents: near and ahead first, within the bytes that keyframes earn, removed when far."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, TileConfig
from kiteline_basestation.exchange.agent_velocity import AgentVelocity
from kiteline_basestation.exchange.tile_planner import _OVERHEAD_BYTES, TilePlanner
from kiteline_basestation.grid.grid_updates import GridUpdates
from kiteline_basestation.grid.tile_store import Place
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.channel import CodedChannel, coded_channel, settled
from kiteline_codec.schema import GridTile, KeyframeScan, LivePose, messages
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from tests.basestation.flat_rooms import box, camera, scan_of

S = 10**9
AGENT = AgentId(0)
SUBMAP = submap_id(0, 1, 0)
HALL = np.array(box(-3.0, -3.0, 60.0, 3.0) + box(5.0, 1.0, 5.5, 1.5) + box(20.0, -2.0, 21.0, -1.0))


class Flight:
    """An agent that flies along a hall, its base's grid, and the channel between them."""

    def __init__(self, config: TileConfig | None = None, budget_bytes: int = 0) -> None:
        self.map = SparseMap()
        self.map.set_camera(AGENT, RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.2, True, np.eye(4)))
        self.updates = GridUpdates(BaseConfig(), self.map, {SUBMAP: np.eye(4)})
        self.planner = TilePlanner(config or TileConfig(), self.map, self.updates, {SUBMAP: np.eye(4)})
        self.base, self.agent = coded_channel(1, budget_bytes), coded_channel(2)
        self.tiles: dict[tuple[int, int, int], GridTile] = {}
        self.now_ns = 0
        self.keyframes = 0
        self.tile_bytes = 0

    def fly(self, x: float, z: float = 0.0, heading: float = 0.0) -> None:
        """A keyframe at x."""
        keyframe = keyframe_id(SUBMAP, self.keyframes)
        T_m_k = camera(x, 0.0, heading, z)
        self.map.add_keyframe(keyframe, self.now_ns, NO_KEYFRAME, T_m_k, 0)
        scan = scan_of(HALL, x, 0.0, heading)
        self.updates.add_scan(KeyframeScan(keyframe, scan, np.zeros(0, np.uint8)))
        self.keyframes += 1
        self.live = LivePose(AGENT, self.now_ns, keyframe, np.eye(4), 90)
        self.wait(1.0)

    def wait(self, seconds: float) -> None:
        for _ in range(round(20 * seconds)):
            self.updates.update()
            self.planner.update(AGENT, self.live, self.base, self.now_ns)
            for a, b in ((self.base, self.agent), (self.agent, self.base)):
                for record in b.receive(a.poll(self.now_ns), self.now_ns):
                    assert isinstance(record, GridTile)
                    self.tiles[record.column, record.row, record.storey] = record
                    self.tile_bytes += messages.length(record) + _OVERHEAD_BYTES
            for key in self.agent.take_removed():
                self.tiles.pop(GridTile.place(key), None)
            self.now_ns += S // 20


def test_an_agent_holds_the_tiles_around_it_as_the_base_has_them() -> None:
    flight = Flight(replace(TileConfig(), min_changes=1, keyframe_bytes=1e6, most_credit_bytes=1e6))
    for k in range(12):
        flight.fly(0.5 * k)
    flight.wait(20.0)
    grid = flight.updates.grid
    near = [p for p in grid.places if np.hypot((p.column + 0.5) * 3.2 - 5.5, (p.row + 0.5) * 3.2) < 12.0]
    held = [(place, cells) for place in near for cells, known in [grid.cells(place)] if known and place.storey == 0]
    assert len(held) > 8
    for place, cells in held:
        assert np.array_equal(flight.tiles[place.column, place.row, 0].cells, cells)
    assert settled(flight.base)[1] and settled(flight.agent)[1], "digests are equal"


def test_an_update_takes_few_bytes_and_the_nearest_tiles_come_first() -> None:
    flight = Flight()
    for k in range(80):
        flight.fly(0.4 * k)
        if k == 1:
            assert flight.tiles
            assert all(np.hypot((c + 0.5) * 3.2, (r + 0.5) * 3.2) < 10.0 for c, r, _ in flight.tiles)
    assert 50 < flight.tile_bytes / 80 <= 150
    assert (10, 0, 0) in flight.tiles, "where it is"


def test_tiles_that_are_far_or_of_another_storey_are_removed() -> None:
    flight = Flight(replace(TileConfig(), keyframe_bytes=1e6, most_credit_bytes=1e6))
    for k in range(10):
        flight.fly(0.5 * k)
    flight.wait(5.0)
    assert (0, 0, 0) in flight.tiles
    for k in range(25):
        flight.fly(5.0 + 1.5 * k)
    flight.wait(5.0)
    assert flight.tiles and (0, 0, 0) not in flight.tiles
    assert all(abs((c + 0.5) * 3.2 - 41.0) < 1.5 * TileConfig().reach_m for c, _, _ in flight.tiles)
    assert len(flight.base.endpoint.own_values()) == len(flight.tiles) == len(flight.planner.sent(AGENT))
    for k in range(4):
        flight.fly(41.0 + 0.2 * k, z=5.0)
    flight.wait(5.0)
    assert {s for _, _, s in flight.tiles} == {2}


def test_there_are_never_more_tiles_than_an_agent_holds_and_none_without_a_place() -> None:
    flight = Flight(replace(TileConfig(), max_tiles=5, keyframe_bytes=1e6, most_credit_bytes=1e6))
    for k in range(40):
        flight.fly(0.7 * k)
        assert len(flight.planner.sent(AGENT)) <= 5
    assert 0 < len(flight.tiles) <= 5
    lost = Flight()
    lost.updates = flight.updates
    lost.planner = TilePlanner(TileConfig(), flight.map, flight.updates, {})
    lost.live = flight.live
    lost.planner.update(AGENT, lost.live, lost.base, 0)
    assert not lost.planner.sent(AGENT)


@pytest.mark.parametrize("budget_bytes", [500, 1000])
def test_a_thin_link_is_never_filled_with_tiles(budget_bytes: int) -> None:
    flight = Flight(replace(TileConfig(), keyframe_bytes=1e6, most_credit_bytes=1e6), budget_bytes)
    assert isinstance(flight.base, CodedChannel)
    for k in range(20):
        flight.fly(0.5 * k)
        assert flight.base.stats.backlog_bytes < 6 * 400
    assert flight.tiles
    assert Place(0, 0, 0) in flight.planner.sent(AGENT)


def test_while_a_loop_is_drawn_no_tile_is_sent_and_then_those_that_changed() -> None:
    flight = Flight(replace(TileConfig(), keyframe_bytes=1e6, most_credit_bytes=1e6))
    for k in range(40):
        flight.fly(0.1 * k)
    flight.wait(5.0)
    for keyframe in flight.map.submaps[SUBMAP]:
        pose = flight.map.pose(keyframe)
        pose[1, 3] += 0.5
        flight.map.set_pose(keyframe, pose)
    before = dict(flight.tiles)
    flight.updates.update()
    assert flight.updates.behind
    flight.now_ns += 10 * S
    flight.planner.update(AGENT, flight.live, flight.base, flight.now_ns)
    assert flight.base.stats.dirty == 0
    flight.wait(10.0)
    assert not flight.updates.behind
    changed = [p for p in before if p in flight.tiles and flight.tiles[p] is not before[p]]
    assert len(changed) > 4


def test_an_agent_that_jumps_costs_no_more_than_one_that_flies() -> None:
    flight = Flight()
    flight.fly(0.0)
    looked: list[Place] = []
    planner = flight.planner
    distance = planner._distance
    planner._distance = lambda place, *ends: looked.append(place) or distance(place, *ends)  # type: ignore[method-assign,assignment,func-returns-value]
    for x in (3000.0, -3000.0):
        T_k_c = np.eye(4)
        T_k_c[2, 3] = x
        flight.live = replace(flight.live, t_ns=flight.now_ns, T_k_c=T_k_c)
        flight.wait(1.0)
    assert 0 < len(looked) < 1000


def test_places_without_a_tile_are_not_measured() -> None:
    """Some 190 places lie within reach of an agent and are looked up once a second: most have no tile."""
    flight = Flight()
    flight.fly(0.0)
    flight.wait(3.0)
    looked: list[Place] = []
    planner = flight.planner
    distance = planner._distance
    planner._distance = lambda place, *ends: looked.append(place) or distance(place, *ends)  # type: ignore[method-assign,assignment,func-returns-value]
    flight.wait(10.0)
    touched = flight.updates.grid.touched
    assert 0 < len(looked) <= 10 * 2 * len(touched) and set(looked) <= {*touched}


@pytest.mark.parametrize("horizon_s", [0.1, 6.0])
def test_tiles_ahead_are_sent_the_sooner_the_farther_motion_is_predicted(horizon_s: float) -> None:
    flight = Flight(TileConfig(horizon_s=horizon_s, max_tiles=4, keyframe_bytes=1e6, most_credit_bytes=1e6))
    for k in range(12):
        flight.fly(1.0 * k)
    ahead_m = [3.2 * (column + 0.5) - 11.0 for column, _, _ in flight.tiles]
    assert (np.mean(ahead_m) > 2.0) == (horizon_s > 1.0), ahead_m


@pytest.mark.parametrize("z", [1000.0, -1000.0])
def test_a_drone_beyond_the_last_storey_gets_no_tiles(z: float) -> None:
    flight = Flight()
    flight.fly(0.0, z=z)
    flight.wait(2.0)
    assert not flight.tiles


FIRST, SECOND = submap_id(AgentId(0), 1, 0), submap_id(AgentId(0), 1, 1)
HERE, THERE = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 1.0])


def test_the_velocity_is_that_since_the_last_plan() -> None:
    velocity = AgentVelocity(0.5)
    assert not velocity.update(10**9, FIRST, HERE).any()
    np.testing.assert_allclose(velocity.update(1_500_000_000, FIRST, THERE), [2.0, 0.0, -4.0])
    np.testing.assert_allclose(velocity.update(2_500_000_000, FIRST, HERE), [-1.0, 0.0, 2.0])


def test_nothing_is_derived_from_another_submap_or_an_old_or_later_plan() -> None:
    velocity = AgentVelocity(0.5)
    velocity.update(10**9, FIRST, HERE)
    assert not velocity.update(1_500_000_000, SECOND, THERE).any()
    assert not velocity.update(4_000_000_000, SECOND, HERE).any()  # five periods later
    assert not velocity.update(3_500_000_000, SECOND, THERE).any()  # the agent's clock went back
    assert velocity.update(4_000_000_000, SECOND, HERE).any()


def test_later_changes_of_the_position_do_not_matter() -> None:
    velocity, position = AgentVelocity(1.0), HERE.copy()
    velocity.update(10**9, FIRST, position)
    position += 5.0
    np.testing.assert_allclose(velocity.update(2 * 10**9, FIRST, THERE), THERE - HERE)
