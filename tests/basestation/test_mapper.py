"""The mapper on synthetic flights: refinement, landmark matching, culling, determinism."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, LandmarkMatchingConfig, TriangulationConfig
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REFINED_POSE, REMOVED
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import (
    CameraIntrinsics,
    CulledLandmarks,
    FusedLandmarks,
    KeyframeHeader,
    KeyframePose,
    LivePose,
    NewLandmarks,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
    messages,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed_groups

MakeFlight = Callable[..., Any]


def errors_m(mapper: Mapper, flight: Any) -> F64:
    poses = [mapper.map.pose(k) for k in flight.keyframes]
    return np.array([np.linalg.norm(p[:3, 3] - t[:3, 3]) for p, t in zip(poses, flight.true_T_m_k) if p is not None])


def drift_m(flight: Any) -> F64:
    return np.array([np.linalg.norm(a[:3, 3] - t[:3, 3]) for a, t in zip(flight.agent_T_m_k, flight.true_T_m_k)])


Mapped = tuple[Any, Mapper]


@pytest.fixture(scope="module")
def two_rounds(make_flight: MakeFlight) -> Mapped:
    """A flight of two rounds and its map, which no test changes."""
    flight = make_flight(keyframes=60, turns=2.0, memory=3)
    mapper = Mapper()
    feed_groups(mapper, flight, flight.records)
    return flight, mapper


def test_mapper_reduces_drift_over_two_rounds(two_rounds: Mapped) -> None:
    flight, mapper = two_rounds
    assert len(mapper.map) == 60
    assert np.sqrt(np.mean(errors_m(mapper, flight) ** 2)) < 0.5 * np.sqrt(np.mean(drift_m(flight) ** 2))


def test_landmark_matching_fuses_only_true_duplicates(two_rounds: Mapped) -> None:
    flight, mapper = two_rounds
    table = mapper.map.keypoints
    slots = np.flatnonzero((table.kind == LANDMARK) & (table.root != np.arange(len(table.root)))).astype(np.int32)
    aliases, roots = mapper.map.landmark_ids(slots).tolist(), mapper.map.landmark_ids(table.root[slots]).tolist()
    doubles = len(flight.point_of) - len(set(flight.point_of.values()))
    assert len(aliases) > 0.8 * doubles
    assert all(flight.point_of[a] == flight.point_of[r] for a, r in zip(aliases, roots))
    assert all(r < a for a, r in zip(aliases, roots))


def test_rounds_stay_unconnected_without_landmark_matching(make_flight: MakeFlight, two_rounds: Mapped) -> None:
    other, joined_other = make_flight(keyframes=60, turns=2.0, memory=3, seed=1), Mapper(WITHOUT_GRID)
    feed_groups(joined_other, other, other.records)
    apart, together = [], []
    for flight, joined in (two_rounds, (other, joined_other)):
        mapper = Mapper(replace(WITHOUT_GRID, landmark_matching=LandmarkMatchingConfig(max_hamming=-1)))
        feed_groups(mapper, flight, flight.records)
        assert mapper.counts.found == 0
        apart.append(np.mean(errors_m(mapper, flight)[40:]))
        together.append(np.mean(errors_m(joined, flight)[40:]))
    assert np.mean(together) < 0.7 * np.mean(apart)


def test_outlier_observations_are_removed(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=20, outliers=0.05, turns=0.5)
    mapper = Mapper()
    published = feed_groups(mapper, flight, flight.records)
    table = mapper.map.keypoints
    slots = np.flatnonzero(table.flags & REMOVED).astype(np.int32)
    keyframes = mapper.map.keyframes.id[table.row[slots]].tolist()
    removed = set(zip(keyframes, mapper.map.keypoint_of(slots).tolist()))
    assert removed == {(r.keyframe, int(i)) for r in published if isinstance(r, RemovedObservations) for i in r.index}
    observations = {(k, int(i)) for k, i in flight.observations if k in flight.keyframes[2:-2]}
    wild = flight.wild & observations
    assert len(removed & wild) > 0.9 * len(wild) > 50
    assert len(removed & (observations - wild)) < 0.08 * len(observations)  # a wild new landmark spoils its point


def test_landmarks_without_later_observations_are_culled(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=16, turns=0.15)
    ghosts: set[tuple[KeyframeId, int]] = set()
    rng = np.random.default_rng(3)
    records = []
    for part in flight.records:
        head = next(r for r in part if isinstance(r, KeyframeHeader))
        index = np.arange(head.keypoints, head.keypoints + 15, dtype=np.uint16)
        ghosts |= {(head.keyframe, int(i)) for i in index}
        new_landmarks = NewLandmarks(
            head.keyframe, 9, index, rng.uniform(300, 450, (15, 2)).astype(np.float32),
            np.full(15, 0.4, np.float32), np.zeros(15, np.uint8), np.zeros(15, np.uint8),
            rng.integers(0, 256, (15, 32), dtype=np.uint8),
        )  # fmt: skip
        records.append([replace(head, keypoints=head.keypoints + 15), *part[1:], new_landmarks])
    mapper = Mapper()
    published = feed_groups(mapper, flight, records)
    last = {r.keyframe: r for r in published if isinstance(r, CulledLandmarks)}
    culled = {(k, int(i)) for k, r in last.items() for i in r.index}
    judged = {g for g in ghosts if g[0] <= flight.keyframes[-5]}
    assert len(culled & judged) > 0.8 * len(judged)
    assert len(culled - ghosts) < 0.1 * len(flight.point_of)


@pytest.mark.parametrize("stereo", [True, False])
def test_landmarks_without_depth_are_triangulated(make_flight: MakeFlight, stereo: bool) -> None:
    flight = make_flight(keyframes=14, turns=0.4, no_depth=0.4 if stereo else 0.0, stereo=True, drift_m=0.0005)
    if not stereo:  # all new landmarks and observations without depth: the poses alone place the points
        flight = make_flight(keyframes=14, turns=0.4, no_depth=1.0, drift_m=0.0005)
    mapper = Mapper()
    published = feed_groups(mapper, flight, flight.records)
    assert mapper.counts.triangulated > 40
    points = mapper.map.live_landmarks()
    seen = np.diff(mapper.map.observations(points)[0])
    blind = mapper.map.keypoints.inv_depth[points] == 0
    xyz, known = mapper.map.positions(points)
    placed = known & blind & (seen >= 3)
    truth = np.array([flight.world[flight.point_of[i]] for i in mapper.map.landmark_ids(points[placed]).tolist()])
    error = np.linalg.norm(xyz[placed] - truth, axis=1)
    assert placed.sum() > 30
    assert np.median(error) < 0.08
    assert any(isinstance(r, RefinedLandmarks) for r in published)


def test_no_triangulation_from_one_viewpoint(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=8, turns=0.2, no_depth=1.0)
    mapper = Mapper(replace(BaseConfig(), triangulation=TriangulationConfig(max_cosine=-1.0)))
    feed_groups(mapper, flight, flight.records)
    assert mapper.counts.triangulated == 0


def test_intake_does_not_depend_on_order_of_records(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=12, turns=0.4)
    rng = np.random.default_rng(9)
    maps = []
    for shuffle in (False, True):
        mapper = Mapper()
        records = [r for part in flight.records for r in part]
        if shuffle:
            records = [records[i] for i in rng.permutation(len(records))]
            records += records[:10]
        # Everything in one step: the same work on the same knowledge, whatever the order.
        published = feed_groups(mapper, flight, [records])
        maps.append((pickle.dumps(published), mapper.summary()["points"]))
    assert maps[0][1] == maps[1][1]
    assert maps[0][0] == maps[1][0]


def test_incomplete_keyframe_is_used_after_the_patience(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=8, turns=0.2)
    late = flight.records[5].pop()
    mapper = Mapper()
    camera: tuple[Record, ...] = (CameraIntrinsics(flight.agent, flight.camera),)
    now_ns = 0
    for part in flight.records:
        mapper.step(MapperInput(((flight.agent, (*camera, *part)),)), now_ns)
        camera = ()
        now_ns += STEP_NS
    assert mapper.counts.keyframes == 7
    mapper.step(MapperInput(()), now_ns + 2_500_000_000)
    assert mapper.counts.keyframes == 8
    before = len(mapper.map.observations_of(flight.keyframes[5]))
    mapper.step(MapperInput(((flight.agent, (late,)),)), now_ns + 3_000_000_000)
    assert mapper.counts.keyframes == 9  # the completed keyframe is searched once more
    assert len(mapper.map.observations_of(flight.keyframes[5])) > before


def test_published_values_match_the_map(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=20, turns=1.0)
    mapper = Mapper()
    published = feed_groups(mapper, flight, flight.records)
    first = flight.keyframes[0]
    assert [r.submap for r in published if isinstance(r, SubmapPlacement)] == [submap_of_keyframe(first)]
    poses = {r.keyframe: r.T_m_k for r in published if isinstance(r, KeyframePose)}
    assert first not in poses  # the first keyframe of a submap holds the gauge
    for keyframe, T_m_k in poses.items():
        held = mapper.map.pose(keyframe)
        assert held is not None
        assert np.array_equal(held, T_m_k)
        assert np.allclose(T_m_k[:3, :3] @ T_m_k[:3, :3].T, np.eye(3), atol=1e-12)
    found = {r.keyframe: r for r in published if isinstance(r, FusedLandmarks)}
    for keyframe, same in found.items():
        new_landmarks = mapper.map.slots_of(keyframe)[same.index]
        assert np.array_equal(mapper.map.landmark_ids(mapper.map.keypoints.root[new_landmarks]), same.point)
    for record in {r.keyframe: r for r in published if isinstance(r, RefinedLandmarks)}.values():
        new_landmarks = mapper.map.slots_of(record.keyframe)[record.index]
        current = mapper.map.keypoints.root[new_landmarks] == new_landmarks
        assert current.all()
        assert np.array_equal(mapper.map.keypoints.refined[new_landmarks], record.inv_depth)


def test_corrections_smaller_than_is_asked_are_not_sent(make_flight: MakeFlight) -> None:
    flight, none = make_flight(keyframes=12, turns=0.6), 1e9

    def sent(kind: type[Record], **publish: float) -> int:
        mapper = Mapper(replace(BaseConfig(), publish=replace(BaseConfig().publish, **publish)))  # type: ignore[arg-type]
        return sum(isinstance(record, kind) for record in feed_groups(mapper, flight, flight.records))

    assert sent(RefinedLandmarks, depth_px=none) < sent(RefinedLandmarks)
    fewest = sent(KeyframePose, pose_m=none, pose_rad=none)
    assert fewest < sent(KeyframePose, pose_m=none, pose_rad=1e-9)
    assert fewest < sent(KeyframePose, pose_m=1e-9, pose_rad=none)


def test_a_superseded_or_unknown_job_changes_nothing(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=6, turns=0.1)
    mapper = Mapper()
    jobs = []
    for n, part in enumerate(flight.records):
        camera: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)]
        output = mapper.step(MapperInput(((flight.agent, tuple(camera + part)),)), n * STEP_NS)
        jobs += [job for job in output.jobs if job.kind == "bundle"]
    assert len(jobs) == 1  # one bundle at a time
    done = run_job(jobs[0])
    assert done.cost_ops > 10_000
    output = mapper.step(MapperInput((), (replace(done, id=999),)), 10 * STEP_NS)
    assert not output.jobs
    output = mapper.step(MapperInput((), (done,)), 11 * STEP_NS)
    assert any(job.kind == "bundle" for job in output.jobs)  # the next one, about what came meanwhile
    assert not mapper.step(MapperInput((), (done,)), 12 * STEP_NS).publish  # a second answer to the same job


def test_submap_without_first_keyframe_begins_at_its_oldest(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=12, turns=0.3)
    mapper = Mapper()
    camera: tuple[Record, ...] = (CameraIntrinsics(flight.agent, flight.camera),)
    for part in flight.records[4:]:
        mapper.step(MapperInput(((flight.agent, (*camera, *part)),)), 0)
        camera = ()
    assert mapper.counts.keyframes == 0
    for _ in range(3):
        mapper.step(MapperInput(()), 20_000_000_000)
    assert mapper.counts.keyframes == 8
    a, b = mapper.map.pose(flight.keyframes[4]), mapper.map.pose(flight.keyframes[9])
    true = se3.inverse(flight.true_T_m_k[4]) @ flight.true_T_m_k[9]
    assert np.allclose(se3.inverse(a) @ b, true, atol=0.05)


def test_summary_describes_each_agent(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=5, turns=0.1, agent=3)
    mapper = Mapper()
    live = LivePose(flight.agent, 77, flight.keyframes[-1], np.eye(4), 80)
    feed_groups(mapper, flight, [*flight.records, [live]])
    summary = mapper.summary()
    agents = summary["agents"]
    assert isinstance(agents, dict)
    assert summary["keyframes"] == 5
    assert agents[3]["keyframes"] == 5
    assert agents[3]["quality"] == 80
    assert agents[3]["T_w_c"] is not None
    view = placed_map(mapper.map, mapper.placements)
    assert len(view.positions) == 5
    assert view.observations[:, 1].max() == len(view.points) - 1
    assert np.bincount(view.observations[:, 1]).min() >= 2
    table = mapper.map.keypoints
    assert not (table.flags[mapper.map.find_landmarks(view.landmark_ids)] & CULLED).any()


def test_mapper_continues_from_restored_state(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=24, turns=1.2, memory=3)
    first = Mapper()
    published = feed_groups(first, flight, flight.records[:20])
    received = (CameraIntrinsics(flight.agent, flight.camera), *(r for part in flight.records[:20] for r in part))
    own = {messages.key(r): r for r in published}
    second = Mapper()
    second.restore(flight.agent, received, tuple(own[key] for key in sorted(own)), 0)
    second.restore_state(first.state())
    assert second.idle
    assert not second.step(MapperInput(()), 0).publish
    assert np.array_equal(
        first.map.landmark_ids(first.map.live_landmarks()), second.map.landmark_ids(second.map.live_landmarks())
    )
    for keyframe in flight.keyframes[:20]:
        a, b = first.map.pose(keyframe), second.map.pose(keyframe)
        assert a is not None and b is not None
        assert np.array_equal(a, b)
        assert np.array_equal(
            first.map.landmark_ids(first.map.landmarks_of(keyframe)),
            second.map.landmark_ids(second.map.landmarks_of(keyframe)),
        )
    assert np.array_equal(
        first.map.positions(first.map.live_landmarks())[0], second.map.positions(second.map.live_landmarks())[0]
    )
    feed_groups(second, flight, flight.records[20:])
    assert second.counts.bundles > 2
    assert len(second.map) == 24


def test_backlog_is_bundled_from_the_oldest_on(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=24, turns=1.2, memory=3)
    mapper = Mapper()
    feed_groups(mapper, flight, [[r for part in flight.records for r in part]])
    assert mapper.idle
    assert mapper.counts.bundles >= 4
    refined = [k for k in flight.keyframes if mapper.map.keyframes.pose_source[mapper.map.rows[k]] == REFINED_POSE]
    assert refined == flight.keyframes[1:]


def test_later_submap_is_placed_by_odometry(make_flight: MakeFlight) -> None:
    flight, later = make_flight(keyframes=4, turns=0.1), make_flight(keyframes=4, turns=0.1, submap=1)
    mapper = Mapper()
    seen_ns = next(r.t_ns for r in later.records[0] if isinstance(r, KeyframeHeader)) - 10**9
    live = LivePose(flight.agent, seen_ns, flight.keyframes[2], se3.exp(np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0])), 80)
    feed_groups(mapper, flight, [*flight.records, [live]])
    published = feed_groups(mapper, later, later.records)
    (placement,) = [r for r in published if isinstance(r, SubmapPlacement)]
    left, begin = mapper.map.pose(live.keyframe), mapper.map.pose(later.keyframes[0])
    assert np.allclose(placement.S_w_m @ begin, left @ live.T_k_c, atol=1e-9)
    assert not placement.recognised


def test_submap_after_a_long_gap_is_not_placed(make_flight: MakeFlight) -> None:
    flight, later = make_flight(keyframes=4, turns=0.1), make_flight(keyframes=4, turns=0.1, submap=1)
    mapper = Mapper()
    seen_ns = next(r.t_ns for r in later.records[0] if isinstance(r, KeyframeHeader)) - 5 * 10**9
    tracked = LivePose(flight.agent, seen_ns, flight.keyframes[2], np.eye(4), 80)
    guessed = LivePose(flight.agent, seen_ns + 49 * 10**8, flight.keyframes[2], np.eye(4), -1)
    feed_groups(mapper, flight, [*flight.records, [tracked], [guessed]])
    assert not any(isinstance(r, SubmapPlacement) for r in feed_groups(mapper, later, later.records))
    assert submap_of_keyframe(later.keyframes[0]) not in mapper.placements
