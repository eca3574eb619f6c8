"""The grid as the mapper draws it: from scans and landmarks, after corrections, restarts and deletions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.grid.grid_view import dense
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, KeyframeScan, Record, ScanImages, messages
from kiteline_core.arrays import F64, I8, Bool
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import level_rotation
from kiteline_core.ground.ground_height import without_ground
from kiteline_core.ids import KEYPOINT_BITS, KeyframeId, submap_of_keyframe
from tests.basestation.flat_rooms import box, scan_of

MakeFlight = Callable[..., Any]
ROOM = np.array(box(-4.0, -3.5, 4.0, 3.5))  # that of `make_flight`
HEIGHT_M = 1.5
STEP_NS = 500_000_000


def seen(keyframe: KeyframeId, T_w_s: F64, *of_scan: Any) -> KeyframeScan:
    """What a camera truly saw at T_w_s. of_scan: labels, and what tells a scan between keyframes."""
    up = T_w_s[2, :3]
    ahead = T_w_s[:3, :3] @ level_rotation(up)[:, 0]
    scan = scan_of(ROOM, T_w_s[0, 3], T_w_s[1, 3], float(np.arctan2(ahead[1], ahead[0])))
    record = KeyframeScan(keyframe, replace(scan, up_c=up, camera_height_m=HEIGHT_M + T_w_s[2, 3]), *of_scan)
    return messages.decode(messages.key(record), messages.encode(record))


def scans(flight: Any, first: int = 0, last: int | None = None) -> list[KeyframeScan]:
    """What each keyframe truly saw; even keypoints lie on the ground, odd ones on obstacles."""
    labels = (1 + np.arange(150) % 2).astype(np.uint8)
    return [seen(k, T_w_k, labels) for k, T_w_k in list(zip(flight.keyframes, flight.true_T_w_k))[first:last]]


def between(flight: Any) -> list[KeyframeScan]:
    """What a camera truly saw after each keyframe, ahead of it and turned, as scans that hang on the keyframe."""
    out = []
    for n, (keyframe, T_w_k) in enumerate(zip(flight.keyframes, flight.true_T_w_k, strict=True)):
        for part in (1, 2 + n % 3):
            T_k_s = se3.exp(np.array([0.02, 0.01, 0.1 * part, 0.02, 0.1 * part, -0.03]))
            out.append(seen(keyframe, T_w_k @ T_k_s, np.zeros(0, np.uint8), part, T_k_s))
    return out


def feed(mapper: Mapper, flight: Any, groups: Sequence[Sequence[Record]], more: int = 12) -> list[Record]:
    done: tuple[JobDone, ...] = ()
    published: list[Record] = []
    for n, records in enumerate([[CameraIntrinsics(flight.agent, flight.camera)], *groups, *[[]] * more]):
        output = mapper.step(MapperInput(((flight.agent, tuple(records)),), done), n * STEP_NS)
        done = tuple(run_job(job) for job in output.jobs)
        for _, out in output.publish:
            published.extend(out)
    return published


def with_scans(flight: Any, late: int = 2) -> list[list[Record]]:
    """The records of a flight, with each scan some keyframes after its keyframe."""
    groups: list[list[Record]] = [list(records) for records in flight.records]
    groups += [[] for _ in range(late)]
    for n, scan in enumerate(scans(flight)):
        groups[n + late].append(scan)
    return groups


def from_scratch(mapper: Mapper, records: Sequence[KeyframeScan]) -> ScanGrid:
    grid = ScanGrid(mapper.config.grid)
    for record in reversed(records):
        pose = mapper.map.pose(record.keyframe)
        S_w_m = mapper.placements.get(submap_of_keyframe(record.keyframe))
        camera = mapper.map.cameras[next(iter(mapper.map.cameras))]
        kept = keep(grid.config, record.scan, camera.bf)
        if pose is not None and S_w_m is not None and kept is not None:
            pose = pose if record.T_k_s is None else pose @ record.T_k_s
            grid.put((record.keyframe, record.part), kept, S_w_m @ pose)
    return grid


def assert_equal(a: ScanGrid, b: ScanGrid) -> None:
    assert a.places == b.places
    assert all(np.array_equal(a.log_odds(place), b.log_odds(place)) for place in a.places)


def known(grid: ScanGrid) -> tuple[I8, Bool, Bool]:
    """Cells of the main storey, those well inside the room, and those well outside."""
    cells, corner, cell = dense(grid, grid.main_storey())
    rows, columns = np.indices(cells.shape)
    x, y = corner[0] + (columns + 0.5) * cell, corner[1] + (rows + 0.5) * cell
    return cells, (abs(x) < 3.7) & (abs(y) < 3.2), (abs(x) > 4.4) | (abs(y) > 3.9)


def test_scans_of_a_flight_draw_its_room_and_the_grid_equals_that_of_the_final_poses(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=40, turns=1.5, memory=3)
    mapper = Mapper()
    feed(mapper, flight, with_scans(flight))
    assert_equal(mapper.grid, from_scratch(mapper, scans(flight)))
    assert mapper.settled_grid() is mapper.grid
    cells, inside, outside = known(mapper.grid)
    assert np.mean(cells[inside] == 0) > 0.5 and np.mean(cells[inside] > 0) < 0.01
    assert np.mean(cells[outside] == 0) < 0.002


def test_a_loop_that_moves_keyframes_by_half_a_metre_is_drawn_over_several_steps(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=40, turns=1.5)
    mapper = Mapper()
    feed(mapper, flight, with_scans(flight))
    for n, keyframe in enumerate(flight.keyframes):
        pose = mapper.map.pose(keyframe)
        pose[:3, 3] += [0.5 * n / 39, -0.3 * n / 39, 0.0]
        mapper.map.set_pose(keyframe, pose)
    expected = from_scratch(mapper, scans(flight))
    assert_equal(mapper.settled_grid(), expected)
    steps = 0
    while mapper.settled_grid() is not mapper.grid:
        mapper.step(MapperInput(()), 10**12)
        steps += 1
    assert steps >= 40 // mapper.config.grid.drawn_per_step
    assert_equal(mapper.grid, expected)


def test_scans_between_keyframes_are_drawn_and_move_with_their_keyframe(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=24, turns=0.9)
    mapper, every = Mapper(BaseConfig()), [*scans(flight), *between(flight)]
    groups = [*with_scans(flight)[:-1], [*with_scans(flight)[-1], *between(flight)]]
    feed(mapper, flight, groups)
    assert len(mapper.grid) == len(every)
    assert_equal(mapper.grid, from_scratch(mapper, every))
    cells, inside, outside = known(mapper.grid)
    assert not (cells[outside] == 0).any()
    assert (cells[inside] == 0).sum() > (known(from_scratch(mapper, scans(flight)))[0][inside] == 0).sum()

    turn = se3.exp(np.array([0.4, -0.3, 0.0, 0.0, 0.0, 0.2]))
    for submap in list(mapper.placements):
        mapper.placements[submap] = turn @ mapper.placements[submap]  # type: ignore[index]
    mapper.grid_updates.rebuild()
    while mapper.grid_updates.behind:
        mapper.grid_updates.update()
    assert_equal(mapper.grid, from_scratch(mapper, every))


def test_busy_steps_leave_the_drawing_to_the_next_but_not_for_ever(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=24, turns=0.9)
    mapper = Mapper(BaseConfig())
    feed(mapper, flight, with_scans(flight))
    updates = mapper.grid_updates

    def waits(*busy: bool) -> list[bool]:
        """Whether scans wait after each of some updates, before each of which the map has moved."""
        found = []
        for one in busy:
            updates.rebuild()
            updates.update(busy=one)
            found.append(len(updates._due) == len(flight.keyframes))
        return found

    assert waits(True, True, True, True, True) == [True, True, True, False, True]
    assert waits(False, True, False) == [False, True, False]


def test_a_scan_between_keyframes_is_taken_back_alone(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=12, turns=0.5)
    mapper, later = Mapper(BaseConfig()), between(flight)
    feed(mapper, flight, [*with_scans(flight), later])
    taken, kept = later[4], [*later[:4], *later[5:]]
    n = len(taken.scan)
    blank = replace(
        taken.scan, free_from_m=np.zeros(n), free_m=np.zeros(n), obstacle_m=np.full(n, np.inf),
        bands=np.zeros(n, np.uint8), camera_height_m=float("nan"),
    )  # fmt: skip
    feed(mapper, flight, [[replace(taken, scan=blank)]])
    assert_equal(mapper.grid, from_scratch(mapper, [*scans(flight), *kept]))
    mapper.grid_updates.remove([taken.keyframe])
    rest = [r for r in [*scans(flight), *kept] if r.keyframe != taken.keyframe]
    assert_equal(mapper.grid, from_scratch(mapper, rest))


def test_scans_that_come_before_their_camera_wait_for_it(make_flight: MakeFlight) -> None:
    """Without a camera nobody knows how far their ranges can be used."""
    flight = make_flight(keyframes=12, turns=0.5)
    mapper, groups = Mapper(BaseConfig()), with_scans(flight)
    mapper.step(MapperInput(((flight.agent, tuple(scans(flight))),), ()), 0)
    assert len(mapper.grid) == 0
    feed(mapper, flight, [[r for r in group if not isinstance(r, KeyframeScan)] for group in groups])
    assert_equal(mapper.grid, from_scratch(mapper, scans(flight)))


def test_scans_that_come_before_their_submap_is_placed_are_drawn_then(make_flight: MakeFlight) -> None:
    """Over a thin link landmarks come last, and a submap is placed with its first keyframe that has some."""
    flight = make_flight(keyframes=6, turns=0.3)
    heads = [[r for r in group if isinstance(r, KeyframeHeader)] for group in flight.records]
    late = [[r for r in group if not isinstance(r, KeyframeHeader)] for group in flight.records]
    mapper = Mapper(BaseConfig())
    feed(mapper, flight, [[r for group in heads for r in group], scans(flight)], more=1)
    assert not mapper.placements and len(mapper.grid) == 0
    feed(mapper, flight, late)
    assert mapper.placements and len(mapper.grid) == 6
    assert_equal(mapper.grid, from_scratch(mapper, scans(flight)))


def test_two_runs_are_equal_whatever_the_order_of_scans(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=16, turns=0.6)
    grids = []
    for late in (0, 0, 5):
        mapper = Mapper()
        feed(mapper, flight, with_scans(flight, late))
        grids.append(mapper.grid)
    assert_equal(grids[0], grids[1])
    assert grids[0].revision == grids[1].revision
    assert_equal(grids[0], grids[2])


def test_a_restored_map_has_the_same_grid(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=20, turns=0.8)
    first = Mapper()
    groups: list[list[Record]] = [*with_scans(flight), [*between(flight)]]
    published = feed(first, flight, groups)
    records = [r for group in groups for r in group]
    assert len(first.grid) == 3 * 20
    own = {messages.key(r): r for r in published}
    second = Mapper()
    camera = CameraIntrinsics(flight.agent, flight.camera)
    second.restore(flight.agent, (camera, *records), tuple(own[key] for key in sorted(own)), 0)
    second.restore_state(first.state())
    assert second.idle
    assert_equal(second.settled_grid(), first.grid)
    for _ in range(4):
        second.step(MapperInput(()), 0)
    assert_equal(second.grid, first.grid)


def test_deleted_submaps_leave_the_grid(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=12, turns=0.5)
    mapper = Mapper()
    feed(mapper, flight, with_scans(flight))
    assert mapper.grid.places
    mapper._delete([submap_of_keyframe(flight.keyframes[0])])
    assert not mapper.grid.places and not len(mapper.grid)
    feed(mapper, flight, [scans(flight)])
    assert not mapper.grid.places


def test_landmarks_draw_the_grid_until_scans_come(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=20, turns=1.0, points=1500, scene=floor_and_walls())
    mapper = Mapper()
    feed(mapper, flight, flight.records)
    assert len(mapper.grid) > 12
    cells, inside, outside = known(mapper.grid)
    assert np.mean(cells[inside] == 0) > 0.2 and np.mean(cells[inside] > 0) < 0.05
    assert np.mean(cells[outside] == 0) < 0.01
    landmarks = mapper.map.live_landmarks()
    xyz, _ = mapper.map.positions(landmarks)
    labels = mapper.labels(landmarks)
    assert np.mean(labels[xyz[:, 2] < -1.45] == 1) > 0.7
    assert np.mean(labels[(xyz[:, 2] > -1.2) & (xyz[:, 2] < 0.4)] == 2) > 0.7
    feed(mapper, flight, [scans(flight, 5)])
    assert_equal(mapper.grid, from_scratch(mapper, scans(flight, 5)))


def test_landmarks_wait_until_a_stereo_agent_would_have_sent_a_scan(make_flight: MakeFlight) -> None:
    """Scans tell more: tiles of landmarks, once sent, told walls half a metre too near until scans replaced them."""
    flight = make_flight(keyframes=12, turns=0.6, points=1500, scene=floor_and_walls())
    few = BaseConfig().grid.scanless_keyframes
    mapper = Mapper()
    feed(mapper, flight, flight.records[:few])
    assert len(mapper.grid) == 0
    mapper = Mapper()
    feed(mapper, flight, flight.records)
    assert len(mapper.grid) > few
    unbelieved = KeyframeScan(flight.keyframes[2], without_ground(scans(flight)[0].scan), np.zeros(0, np.uint8))
    mapper = Mapper()
    feed(mapper, flight, [*flight.records, [unbelieved]])
    assert len(mapper.grid) == 0  # it makes scans, and believes none
    images = ScanImages(flight.keyframes[2], np.eye(4), 0, np.array([0.0, -1.0, 0.0]), b"unreadable")
    mapper = Mapper()
    feed(mapper, flight, [*flight.records, [images]])
    assert len(mapper.grid) == 0
    mapper = Mapper()
    one_eye = replace(flight.camera, stereo=False)
    mapper.step(MapperInput(((flight.agent, (CameraIntrinsics(flight.agent, one_eye),)),), ()), 0)
    assert mapper.grid_updates._is_scanless(flight.agent)


def test_labels_of_the_agent_go_by_keypoint(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=6, turns=0.2)
    mapper = Mapper(BaseConfig())
    feed(mapper, flight, with_scans(flight, 0))
    landmarks = mapper.map.live_landmarks()
    index = mapper.map.keypoint_of(landmarks)
    expected = np.where(index < 150, 1 + index % 2, 0)
    assert np.array_equal(mapper.labels(landmarks), expected)
    assert np.array_equal(mapper.map.landmark_ids(landmarks) & ((1 << KEYPOINT_BITS) - 1), index)
    assert not len(mapper.labels(landmarks[:0]))


def floor_and_walls() -> Any:
    """The room of `make_flight` with a floor, as its scene."""
    from tests.basestation import conftest

    rng = np.random.default_rng(1)
    scene = conftest.room(rng, 1800)
    scene.world[:700, 2] = -1.5
    scene.world[:700, :2] = rng.uniform(-1, 1, (700, 2)) * [3.9, 3.4]
    return scene


def test_what_was_drawn_above_a_platform_is_taken_back_once_the_floor_is_seen(make_flight: MakeFlight) -> None:
    """One half of the room is a platform that a camera sees first, the other half shows the floor."""
    scene = floor_and_walls()
    high = scene.world[:, 0] > 0.0
    scene.world[high & (scene.world[:, 2] == -1.5), 2] = -0.8
    scene.world[high & (scene.world[:, 2] < -0.8), 2] += 1.0
    flight = make_flight(keyframes=40, turns=1.0, scene=scene, start=-0.11)
    mapper = Mapper()
    feed(mapper, flight, flight.records[:9])
    early = [mapper.grid_updates.ground_below(k) for k in flight.keyframes[:9]]
    assert early == pytest.approx([-0.8] * 9, abs=0.1)
    mapper = Mapper()
    published = feed(mapper, flight, flight.records, more=30)
    late = [mapper.grid_updates.ground_below(k) for k in flight.keyframes]
    assert late[:6] == [None] * 6
    assert None not in late[15:] and late[15:] == pytest.approx([-1.5] * 25, abs=0.1)
    landmarks = mapper.map.live_landmarks()
    xyz, _ = mapper.map.positions(landmarks)
    on_top = (xyz[:, 0] > 0.8) & (xyz[:, 0] < 3.0) & (np.abs(xyz[:, 2] + 0.8) < 0.05)
    assert np.mean(mapper.labels(landmarks[on_top]) == 1) < 0.05

    own = {messages.key(r): r for r in published}
    again = Mapper()
    records = (CameraIntrinsics(flight.agent, flight.camera), *(r for group in flight.records for r in group))
    again.restore(flight.agent, records, tuple(own[key] for key in sorted(own)), 0)
    again.restore_state(mapper.state())
    again.grid_updates.make_all()
    restored = [again.grid_updates.ground_below(k) for k in flight.keyframes]
    assert restored[:6] == [None] * 6
    assert None not in restored[15:] and restored[15:] == pytest.approx([-1.5] * 25, abs=0.1)


def test_walls_and_boxes_without_a_floor_draw_nothing(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=16, turns=0.8, points=1500)
    mapper = Mapper()
    feed(mapper, flight, flight.records)
    assert len(mapper.map.submaps) == 1 and len(mapper.grid) == 0
    assert (mapper.labels(mapper.map.live_landmarks()) == 0).all()
