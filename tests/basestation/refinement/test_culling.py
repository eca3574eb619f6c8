"""Which landmarks and keyframes are culled: one row of keyframes before a wall, each rule at its limit."""

from collections.abc import Collection, Sequence

import numpy as np
import pytest

from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.culling import cull_redundant_keyframes, cull_weak_landmarks
from kiteline_codec.schema import CulledLandmarks
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id

CAMERA = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, True, np.eye(4))
SUBMAP = submap_id(0, 1, 0)
STEP_M = 0.1  # from a keyframe to the next
WALL_M = 2.0  # where all landmarks are


def kf(n: int) -> KeyframeId:
    return keyframe_id(SUBMAP, n)


def wall(
    x_m: Sequence[float], seen_by: Sequence[Collection[int]], octave: Sequence[int], partial: int | None = None
) -> SparseMap:
    """Landmarks at x_m of keyframe 0, observed by keyframes that move along x.

    octave: of each keyframe's keypoints. partial: a keyframe that announced one more than arrived.
    """
    sparse_map = SparseMap()
    sparse_map.set_camera(AgentId(0), CAMERA)
    for n in range(len(octave)):
        here = np.array([i for i in range(len(x_m)) if n == 0 or n in seen_by[i]], np.int64)
        T = np.eye(4) if n == 0 else se3.exp(np.array([STEP_M, 0.0, 0.0, 0.0, 0.0, 0.0]))
        sparse_map.add_keyframe(kf(n), n, kf(n - 1) if n else NO_KEYFRAME, T, len(here) + (n == partial))
        index = np.arange(len(here), dtype=np.uint16)
        uv = np.full((len(here), 2), 240.0, np.float32)
        uv[:, 0] = 320.0 + 400.0 * (np.array(x_m)[here] - n * STEP_M) / WALL_M
        depth, octaves = np.full(len(here), 1.0 / WALL_M, np.float32), np.full(len(here), octave[n], np.uint8)
        if n == 0:
            angle, descriptor = np.zeros(len(here), np.uint8), np.ones((len(here), 32), np.uint8)
            sparse_map.put_new_landmarks(kf(0), 0, index, uv, depth, octaves, angle, descriptor)
        else:
            landmarks = np.array([point_id(kf(0), int(i)) for i in here], np.int64)
            sparse_map.put_observations(kf(n), 0, index, uv, depth, octaves, landmarks)
    return sparse_map


def test_landmarks_are_culled_that_fewer_than_a_quarter_of_four_views_found() -> None:
    """Those that were in view of three keyframes alone wait, and what was culled is not culled again."""
    leaves = -1.25  # m; at a pixel of 10 in keyframe 3, and out of the image in the next
    x_m = [0.0, 0.1, 0.2, 0.3, leaves, 0.0]
    seen_by: list[set[int]] = [set(), {2}, {1, 4}, {1, 2, 3, 4}, set(), set()]
    sparse_map = wall(x_m, seen_by, [0] * 5)
    slots = sparse_map.slots_of(kf(0))
    sparse_map.set_flags(slots[5:], CULLED)
    publisher = Publisher(sparse_map)
    assert cull_weak_landmarks(sparse_map, kf(3), publisher) == 0  # younger than four keyframes
    assert cull_weak_landmarks(sparse_map, kf(4), publisher) == 1
    assert [bool(flags & CULLED) for flags in sparse_map.keypoints.flags[slots]] == [True] + 4 * [False] + [True]
    (record,) = publisher.collect()[0][1]
    assert isinstance(record, CulledLandmarks) and record.index.tolist() == [0, 5] and not record.keyframe_too


ALL = range(1, 13)
MOST = tuple(n for n in ALL if n != 12)
FEW = (1, 5, 12)  # with the first keyframe, three others than 1


@pytest.mark.parametrize(
    ("seen_by", "refined", "octave", "culled"),
    [
        pytest.param([ALL] * 20, (0, 1, 2, 3), {}, [2, 1], id="neither the first nor one of the last ten"),
        pytest.param([ALL] * 20, (), {}, [], id="no bundle has placed them"),
        pytest.param([ALL] * 15 + [MOST] * 5, (1,), {}, [1], id="shares fifteen with the new one"),
        pytest.param([ALL] * 14 + [MOST] * 6, (1,), {}, [], id="shares fourteen"),
        pytest.param([FEW] * 20, (1,), {}, [1], id="three others"),
        pytest.param([(1, 12)] * 20, (1,), {}, [], id="two others"),
        pytest.param([FEW] * 18 + [(1, 12)] * 2, (1,), {}, [1], id="nine tenths of its landmarks"),
        pytest.param([FEW] * 17 + [(1, 12)] * 3, (1,), {}, [], id="fewer than nine tenths"),
        pytest.param([FEW] * 20, (1,), {0: 1, 5: 1, 12: 1}, [1], id="an octave coarser"),
        pytest.param([FEW] * 20, (1,), {0: 1, 5: 2, 12: 1}, [], id="one two octaves coarser"),
    ],
)
def test_a_keyframe_is_culled_if_others_observe_nearly_all_that_it_does(
    seen_by: Sequence[Collection[int]], refined: Collection[int], octave: dict[int, int], culled: list[int]
) -> None:
    sparse_map = wall(np.linspace(-0.5, 1.0, 20).tolist(), seen_by, [octave.get(n, 0) for n in range(13)])
    for n in refined:
        pose = sparse_map.pose(kf(n))
        assert pose is not None
        sparse_map.set_pose(kf(n), pose)
    publisher = Publisher(sparse_map)
    assert cull_redundant_keyframes(sparse_map, kf(12), publisher) == [kf(n) for n in culled]
    told = [r.keyframe for _, records in publisher.collect() for r in records if isinstance(r, CulledLandmarks)]
    assert told == sorted(kf(n) for n in culled)
    rows = [sparse_map.rows[kf(n)] for n in range(13)]
    assert np.flatnonzero(sparse_map.keyframes.culled[rows]).tolist() == sorted(culled)


@pytest.mark.parametrize("partial", [None, 1])
def test_a_keyframe_that_has_not_arrived_whole_is_not_culled(partial: int | None) -> None:
    """What is missing may be seen by no other one."""
    sparse_map = wall(np.linspace(-0.5, 1.0, 20).tolist(), [ALL] * 20, [0] * 13, partial)
    pose = sparse_map.pose(kf(1))
    assert pose is not None
    sparse_map.set_pose(kf(1), pose)
    assert cull_redundant_keyframes(sparse_map, kf(12), Publisher(sparse_map)) == ([] if partial else [kf(1)])
