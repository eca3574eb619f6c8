"""The sparse map: composed poses, points on anchors, observations, and sections in any order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.map.map_tables import CULLED, OBSERVATION, REMOVED, LandmarkDescriptors
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import I32
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id

CAMERA = RectifiedCamera(640, 480, 400.0, 410.0, 320.0, 240.0, 0.1, True, np.eye(4))
SUBMAP = submap_id(3, 1, 0)
Slots = I32


def kf(n: int) -> KeyframeId:
    return keyframe_id(SUBMAP, n)


def slots(*numbers: int) -> Slots:
    return np.array(numbers, np.int32)


class Writer:
    """Write keyframes of ten keypoints: new landmarks 0..5, observations 6..9 of 0..3 of the keyframe before."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self.map = sparse_map

    def head(self, n: int) -> None:
        T = se3.exp(np.array([0.1, 0.01 * n, 0.0, 0.01, 0.0, 0.02]))
        self.map.add_keyframe(kf(n), n * 10, kf(n - 1) if n else NO_KEYFRAME, T, 10 if n else 6)

    def new_landmarks(self, n: int) -> None:
        rng = np.random.default_rng(n)
        self.map.put_new_landmarks(
            kf(n), 0, np.arange(6, dtype=np.uint16), rng.uniform(50, 400, (6, 2)).astype(np.float32),
            np.full(6, 0.25, np.float32), np.zeros(6, np.uint8), np.zeros(6, np.uint8),
            rng.integers(0, 256, (6, 32), dtype=np.uint8),
        )  # fmt: skip

    def observations(self, n: int) -> None:
        if n:
            points = np.array([point_id(kf(n - 1), i) for i in range(4)], np.int64)
            self.map.put_observations(
                kf(n), 0, np.arange(6, 10, dtype=np.uint16), np.full((4, 2), 100, np.float32), np.zeros(4, np.float32),
                np.zeros(4, np.uint8), points,
            )  # fmt: skip

    def everything(self, n: int) -> None:
        self.head(n)
        self.new_landmarks(n)
        self.observations(n)


def chain(length: int) -> SparseMap:
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(3), CAMERA)
    writer = Writer(sparse_map)
    for n in range(length):
        writer.everything(n)
    return sparse_map


def by_id(sparse_map: SparseMap) -> list[tuple[object, ...]]:
    """The whole map in words that know nothing of rows and slots."""
    out: list[tuple[object, ...]] = []
    for keyframe in sorted(sparse_map.rows):
        pose = sparse_map.pose(keyframe)
        out.append((keyframe, None if pose is None else pose.tobytes(), sparse_map.is_complete(keyframe)))
    roots = sparse_map.live_landmarks()
    roots = roots[np.argsort(sparse_map.landmark_ids(roots))]
    starts, seen = sparse_map.observations(roots)
    ids = sparse_map.keyframes.id[sparse_map.keypoints.row[seen]]
    xyz, known = sparse_map.positions(roots)
    for i, point in enumerate(sparse_map.landmark_ids(roots).tolist()):
        where = xyz[i].tobytes() if known[i] else None
        out.append((point, where, ids[starts[i] : starts[i + 1]].tolist()))
    return out


def test_poses_compose_along_parents_and_follow_what_the_base_moves() -> None:
    sparse_map = chain(4)
    steps = [se3.exp(np.array([0.1, 0.01 * n, 0.0, 0.01, 0.0, 0.02])) for n in range(4)]
    pose = sparse_map.pose(kf(3))
    assert np.allclose(pose, steps[0] @ steps[1] @ steps[2] @ steps[3], atol=1e-14)
    moved = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    sparse_map.set_pose(kf(1), moved)
    pose = sparse_map.pose(kf(3))
    assert np.allclose(pose, moved @ steps[2] @ steps[3], atol=1e-14)
    sparse_map.set_pose(kf(3), steps[0])  # a base value stands on its own
    sparse_map.set_pose(kf(1), np.eye(4))
    pose = sparse_map.pose(kf(3))
    assert np.allclose(pose, steps[0])


def test_points_hang_on_their_anchor() -> None:
    sparse_map = chain(3)
    points = sparse_map.find_landmarks(np.array([point_id(kf(1), 2), point_id(kf(2), 5)], np.int64))
    before, known = sparse_map.positions(points)
    assert known.all()
    row = sparse_map.rows[kf(1)]
    uv, T = sparse_map.keypoints.uv[points[0]], sparse_map.keyframes.T_m_k[row]
    local = 4.0 * np.array([(uv[0] - 320) / 400, (uv[1] - 240) / 410, 1.0])
    assert np.allclose(before[0], T[:3, :3] @ local + T[:3, 3], atol=1e-6)
    sparse_map.set_pose(kf(1), se3.exp(np.array([5.0, 0, 0, 0, 0, 0])) @ T)
    after, _ = sparse_map.positions(points)
    assert np.allclose(after[0], before[0] + [5.0, 0, 0], atol=1e-9)


def test_bearing_is_the_inverse_of_position() -> None:
    sparse_map = chain(3)
    points = sparse_map.live_landmarks()
    xyz, _ = sparse_map.positions(points)
    target = xyz + np.random.default_rng(0).normal(0, 0.02, xyz.shape)
    inverse, offset, ahead = sparse_map.project_into_anchor(points, target)
    assert ahead.all()
    sparse_map.set_depths(points, inverse, offset)
    assert np.allclose(sparse_map.positions(points)[0], target, atol=2e-6)


@settings(max_examples=40, deadline=None)
@given(st.permutations([(n, what) for n in range(4) for what in ("new_landmarks", "observations")]), st.data())
def test_any_order_and_any_repetition_of_sections_gives_the_same_map(
    order: list[tuple[int, str]], data: st.DataObject
) -> None:
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(3), CAMERA)
    writer = Writer(sparse_map)
    for n in data.draw(st.permutations(range(4))):
        writer.head(n)
    again = data.draw(st.lists(st.sampled_from(order), max_size=4))
    for n, what in [*order, *again]:
        getattr(writer, what)(n)
    assert by_id(sparse_map) == by_id(chain(4))


def test_a_newer_section_withdraws_what_it_no_longer_has() -> None:
    sparse_map = chain(3)
    point = point_id(kf(1), 0)
    before = sparse_map.landmarks_of(kf(2))
    sparse_map.put_observations(
        kf(2), 0, np.array([7], np.uint16), np.full((1, 2), 100, np.float32), np.zeros(1, np.float32),
        np.zeros(1, np.uint8), np.array([point], np.int64),
    )  # fmt: skip
    assert len(before) == 10
    assert len(sparse_map.landmarks_of(kf(2))) == 7
    assert not sparse_map.is_complete(kf(2))
    starts, seen = sparse_map.observations(sparse_map.find_landmarks(np.array([point, point_id(kf(1), 3)], np.int64)))
    assert np.diff(starts).tolist() == [2, 1]
    assert sparse_map.keypoint_of(seen).tolist() == [0, 7, 3]


def test_removed_observations_culled_points_and_culled_keyframes_stop_counting() -> None:
    sparse_map = chain(3)
    (root,) = sparse_map.find_landmarks(np.array([point_id(kf(0), 1)], np.int64))
    starts, seen = sparse_map.observations(slots(root))
    assert starts.tolist() == [0, 2]
    sparse_map.set_flags(seen[1:], REMOVED)
    assert sparse_map.observations(slots(root))[0].tolist() == [0, 1]
    assert root not in sparse_map.landmarks_of(kf(1))
    sparse_map.set_flags(slots(root), CULLED)
    assert root not in sparse_map.live_landmarks()
    assert root not in sparse_map.landmarks_of(kf(0))
    sparse_map.cull_keyframe(kf(2))
    assert len(sparse_map.landmarks_of(kf(2))) == 0
    assert sparse_map.pose(kf(2)) is not None


def test_fusing_moves_all_observations_and_late_observations_follow() -> None:
    sparse_map = chain(3)
    old, new = sparse_map.find_landmarks(np.array([point_id(kf(0), 4), point_id(kf(2), 0)], np.int64))
    assert not sparse_map.observed_together(old, new)
    assert sparse_map.fuse(int(new), int(old)) == [kf(2)]
    Writer(sparse_map).everything(3)  # sees the fused point under its old name
    _, seen = sparse_map.observations(slots(old))
    assert sparse_map.keyframes.id[sparse_map.keypoints.row[seen]].tolist() == [kf(0), kf(2), kf(3)]
    assert new not in sparse_map.live_landmarks()
    (older,) = sparse_map.find_landmarks(np.array([point_id(kf(1), 5)], np.int64))
    # An alias of an alias is flattened: both keyframes whose new landmarks now show another root are named.
    third = int(sparse_map.find_landmarks(np.array([point_id(kf(1), 4)], np.int64))[0])
    assert sparse_map.fuse(third, int(older)) == [kf(1)]
    assert sparse_map.fuse(int(old), int(older)) == [kf(0), kf(2)]
    assert set(sparse_map.keypoints.root[[old, new, third]].tolist()) == {int(older)}


def test_covisibility_counts_shared_points() -> None:
    sparse_map = chain(4)
    shared = sparse_map.covisibility(sparse_map.landmarks_of(kf(2)))
    assert [int(shared[sparse_map.rows[kf(n)]]) for n in range(4)] == [0, 4, 10, 4]


def test_unknown_parents_leave_no_pose_and_contradictions_are_refused() -> None:
    sparse_map = SparseMap()
    writer = Writer(sparse_map)
    writer.head(2)
    assert sparse_map.pose(kf(2)) is None
    assert sparse_map.pose(kf(9)) is None
    with pytest.raises(ValueError, match="older"):
        sparse_map.add_keyframe(kf(1), 0, kf(1), np.eye(4), 3)
    with pytest.raises(ValueError, match="at most"):
        sparse_map.add_keyframe(kf(1), 0, NO_KEYFRAME, np.eye(4), 5000)
    writer.head(0)
    writer.head(1)
    assert sparse_map.pose(kf(2)) is not None


def test_an_observation_of_an_unknown_landmark_is_kept_apart() -> None:
    sparse_map = chain(2)
    odd = np.array([point_id(kf(1), 7), point_id(kf(0), 40), point_id(kf(9), 0), -1], np.int64)
    sparse_map.add_keyframe(kf(5), 50, kf(1), np.eye(4), 4)
    sparse_map.put_observations(
        kf(5), 0, np.arange(4, dtype=np.uint16), np.zeros((4, 2), np.float32), np.zeros(4, np.float32),
        np.zeros(4, np.uint8), odd,
    )  # fmt: skip
    assert len(sparse_map.landmarks_of(kf(5))) == 0
    assert (sparse_map.keypoints.kind[sparse_map.slots_of(kf(5))] == OBSERVATION).all()


def test_memory_stays_within_its_budget() -> None:
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(3), CAMERA)
    rng = np.random.default_rng(0)
    for n in range(300):
        sparse_map.add_keyframe(kf(n), n, kf(n - 1) if n else NO_KEYFRAME, np.eye(4), 450)
        sparse_map.put_new_landmarks(
            kf(n), 0, np.arange(200, dtype=np.uint16), np.zeros((200, 2), np.float32), np.zeros(200, np.float32),
            np.zeros(200, np.uint8), np.zeros(200, np.uint8), rng.integers(0, 256, (200, 32), dtype=np.uint8),
        )  # fmt: skip
    assert sparse_map.nbytes() / 300 < 100_000


def test_descriptors_are_held_for_landmarks_alone() -> None:
    table, rng = LandmarkDescriptors(), np.random.default_rng(3)
    table.grow(50_000)
    plain = np.zeros((50_000, 32), np.uint8)
    for _ in range(60):
        slots = np.sort(rng.choice(50_000, 400, replace=False)).astype(np.int32)
        if rng.random() < 0.4:
            table.clear(slots)
            plain[slots] = 0
        else:
            plain[slots] = rng.integers(1, 256, (400, 32))
            table.put(slots, plain[slots])
    every = np.arange(50_000, dtype=np.int32)
    assert np.array_equal(table[every], plain)
    assert table._top - 1 - len(table._free) == np.count_nonzero(plain.any(axis=1))
    assert table.nbytes < plain.nbytes
    table.clear(every)
    top = table._top
    table.put(every[: top - 1], plain[: top - 1])
    assert table._top == top  # freed rows serve again


def test_a_camera_holds_for_keyframes_of_its_agent_so_far_and_later() -> None:
    sparse_map = SparseMap()
    mine, other = kf(0), keyframe_id(submap_id(4, 0, 0), 0)
    for keyframe in (mine, other):
        sparse_map.add_keyframe(keyframe, 0, NO_KEYFRAME, np.eye(4), 6)
    another = RectifiedCamera(640, 480, 500.0, 510.0, 310.0, 230.0, 0.2, True, np.eye(4))
    sparse_map.set_camera(AgentId(3), CAMERA)
    sparse_map.set_camera(AgentId(4), another)
    sparse_map.add_keyframe(kf(1), 10, mine, np.eye(4), 6)
    cameras = sparse_map.keyframes.camera
    for keyframe, camera in ((mine, CAMERA), (kf(1), CAMERA), (other, another)):
        np.testing.assert_allclose(cameras[sparse_map.rows[keyframe]][:4], [camera.fx, camera.fy, camera.cx, camera.cy])
