"""When whole maps are bundled."""

import itertools

import numpy as np

from kiteline_basestation.config import BaseConfig, GraphConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.correction_jobs import CorrectionJobs
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE
from kiteline_basestation.refinement.full_bundle_schedule import FullBundleSchedule, Part
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id

MAP = submap_id(0, 0, 0)
ONE, TWO = (MAP, 0), (submap_id(1, 0, 0), 0)
CONFIG = GraphConfig(full_share=0.1)
SECOND = 1_000_000_000


def test_a_map_is_bundled_when_it_has_grown_and_no_more_often() -> None:
    whole = FullBundleSchedule(CONFIG)
    assert whole.next({}, (), 0) is None  # none has enough keyframes
    assert whole.next({ONE: 12}, (), 1) == ONE
    assert whole.next({ONE: 12}, (), 2) is None and not whole.waiting({ONE: 12})
    assert whole.next({ONE: 13}, (), 3) == ONE


def test_the_worker_rests_in_between() -> None:
    whole = FullBundleSchedule(CONFIG)
    assert whole.next({ONE: 20}, (), 0) == ONE
    whole.done(SECOND // 10, SECOND)  # a tenth of a second: a tenth of the next
    assert whole.next({ONE: 21}, (), 2 * SECOND - 1) is None
    assert whole.waiting({ONE: 21}) == [ONE]  # what is left for a quiet moment
    assert whole.next({ONE: 21}, (), 2 * SECOND) == ONE


def test_the_map_that_grew_most_is_next_unless_it_is_busy() -> None:
    sizes: dict[Part, int] = {ONE: 40, TWO: 20}
    whole = FullBundleSchedule(CONFIG)
    whole.bundled.update({ONE: 36, TWO: 15})  # a tenth and a quarter
    assert whole.next(sizes, (TWO,), 0) == ONE
    assert whole.next(sizes, (), 1) == TWO
    assert whole.next(sizes, (), 2) is None


def test_a_map_of_which_a_part_was_taken_is_bundled_anew() -> None:
    whole = FullBundleSchedule(CONFIG)
    whole.bundled[ONE] = 40
    assert whole.next({ONE: 25}, (), 0) == ONE


def test_observations_that_arrive_long_after_their_keyframes_are_bundled() -> None:
    n, rng, sparse_map = 40, np.random.default_rng(3), SparseMap()
    camera = RectifiedCamera(752, 480, 430.0, 430.0, 376.0, 240.0, 0.11, True, np.eye(4))
    sparse_map.set_camera(AgentId(0), camera)
    keyframes = [keyframe_id(MAP, k) for k in range(3)]
    jobs = CorrectionJobs(BaseConfig(), sparse_map, itertools.count(1))
    none, index = np.zeros(n, np.uint8), np.arange(n, dtype=np.uint16)
    for k, keyframe in enumerate(keyframes):
        assert jobs.jobs((), k) == [] and jobs.idle  # too few keyframes
        T_p_k = se3.from_rt(np.eye(3), np.array([0.1 * min(k, 1), 0.0, 0.0]))
        sparse_map.add_keyframe(keyframe, k, KeyframeId(keyframe - 1) if k else NO_KEYFRAME, T_p_k, n)
    uv, rho = rng.uniform(100, (600, 380), (n, 2)), np.full(n, 0.25)
    sparse_map.put_new_landmarks(
        keyframes[0], 0, index, uv.astype(np.float32), rho.astype(np.float32), none, none,
        rng.integers(0, 256, (n, 32)).astype(np.uint8),
    )  # fmt: skip
    assert jobs.jobs((), 10) == [] and jobs.idle  # nothing is seen twice
    for k, keyframe in enumerate(keyframes[1:], 1):
        seen = (uv - (0.1 * k * camera.fx * 0.25, 0.0)).astype(np.float32)
        landmarks = (keyframes[0] << 11) | np.arange(n)
        sparse_map.put_observations(keyframe, 0, index, seen, rho.astype(np.float32), none, landmarks)
    assert not jobs.idle
    (job,) = jobs.jobs((), 11)
    assert job.kind == FULL_BUNDLE.name
    arrived = sparse_map.keyframes.filled[: len(keyframes)].sum()
    assert jobs._sizes() == {ONE: len(keyframes) + arrived} == {ONE: len(keyframes) * (1 + n)}
    fewer = slice(0, n // 2)  # a part is sent again with fewer observations
    sparse_map.put_observations(
        keyframes[1], 0, index[fewer], uv[fewer].astype(np.float32), rho[fewer].astype(np.float32), none[fewer],
        (keyframes[0] << 11) | np.arange(n)[fewer],
    )  # fmt: skip
    assert jobs._sizes() == {ONE: len(keyframes) * (1 + n) - n // 2}
