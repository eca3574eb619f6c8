"""Loop closures reduce drift, and repetitive corridors close none."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, LandmarkMatchingConfig
from kiteline_basestation.exchange.sharing import SharingPolicy
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.loop_detector import LoopClosure, LoopDetector
from kiteline_basestation.merging.loop_verification import KeyframeObservations, same_unit
from kiteline_codec.schema import CameraIntrinsics, KeyframePose, Record
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from kiteline_core.places import place_kernels
from tests.basestation.feeding import WITHOUT_GRID

MakeFlight = Callable[..., Any]
STEP_NS = 250_000_000


def feed(mapper: Mapper, flights: list[Any], late: int = 0) -> tuple[list[Record], list[Job]]:
    """One keyframe of each flight a step; jobs come back `late` steps after the next one."""
    open_jobs: list[tuple[int, JobDone]] = []
    published: list[Record] = []
    jobs: list[Job] = []
    for n in range(max(len(f.records) for f in flights) + 60 + 2 * late):
        arrivals = []
        for flight in flights:
            records: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)] if n == 0 else []
            records += flight.records[n] if n < len(flight.records) else []
            arrivals.append((flight.agent, tuple(records)))
        done = tuple(d for at, d in open_jobs if at <= n)
        open_jobs = [(at, d) for at, d in open_jobs if at > n]
        output = mapper.step(MapperInput(tuple(arrivals), done), n * STEP_NS)
        for job in output.jobs:
            delay = late if job.kind in ("graph", "full") else 0
            open_jobs.append((n + 1 + delay, run_job(job)))
        jobs.extend(output.jobs)
        for _, out in output.publish:
            published.extend(out)
    return published, jobs


def errors_m(mapper: Mapper, flight: Any) -> F64:
    poses = [mapper.map.pose(k) for k in flight.keyframes]
    return np.array([np.linalg.norm(p[:3, 3] - t[:3, 3]) for p, t in zip(poses, flight.true_T_m_k) if p is not None])


@pytest.fixture(scope="module")
def around(make_flight: MakeFlight, ring: Any, words: Any) -> Any:
    """A flight around a ring, mapped: (how late large jobs come back, or -1 without loops) -> flight and mapper."""
    flight = make_flight(keyframes=54, turns=1.3, scene=ring, drift_m=0.02, seed=6, noise_px=0.75, memory=2, missed=0.3)
    flown: dict[int, Any] = {}

    def get(late: int) -> Any:
        if late not in flown:
            mapper = Mapper(WITHOUT_GRID, words if late >= 0 else None)
            flown[late] = (mapper, *feed(mapper, [flight], max(late, 0)))
        return (flight, *flown[late])

    return get


@pytest.mark.parametrize("late", [0, 6])
def test_loop_is_closed_while_keyframes_arrive(around: Any, late: int) -> None:
    flight, mapper, published, jobs = around(late)
    blind = around(-1)[1]
    assert mapper.summary()["loops"] >= 1
    assert {"graph", "full"} <= {job.kind for job in jobs}
    assert mapper.idle
    assert np.mean(errors_m(mapper, flight)[-8:]) < 0.3 * np.mean(errors_m(blind, flight)[-8:])
    last = {r.keyframe: r.T_m_k for r in published if isinstance(r, KeyframePose)}
    for keyframe in flight.keyframes[1:]:  # what was published is what the map holds
        assert np.allclose(last[keyframe], mapper.map.pose(keyframe), atol=1e-9)


@pytest.mark.parametrize(
    ("matches", "most_drift", "closed"), [(6, 1000.0, True), (1000, 1000.0, False), (6, 1.0, False)]
)
def test_many_matches_close_a_loop_that_drifted_more_than_expected(
    around: Any, words: Any, matches: int, most_drift: float, closed: bool
) -> None:
    strict = replace(BaseConfig().loops, drift_m=0.001, drift_path=0.0, drift_matches=matches, most_drift=most_drift)
    flight, blind = around(-1)[:2]
    detector = LoopDetector(strict, blind.map, words)
    closures = []
    for keyframe in flight.keyframes:
        detector.add(keyframe)
        found = detector.query(keyframe)
        closures += [found] if isinstance(found, LoopClosure) else []
    assert detector.refused > 0 and detector.verified >= detector.refused
    assert bool(closures) == closed
    true = dict(zip(flight.keyframes, flight.true_T_w_k))
    for edge in (match.edge for closure in closures for match in closure.matches):
        error = se3.inverse(true[edge.old]) @ true[edge.new] @ se3.inverse(edge.T_old_new)
        assert np.linalg.norm(error[:3, 3]) < 0.1


@pytest.mark.parametrize(
    "demand", [{}, {"min_inliers_all": 10_000}, {"min_inliers_loop": 10_000}, {"min_matched_share": 1.1}]
)
def test_how_much_a_loop_has_to_show_is_an_option(around: Any, words: Any, demand: dict[str, float]) -> None:
    flight, blind = around(-1)[:2]
    detector = LoopDetector(replace(BaseConfig().loops, drift_m=10.0, **demand), blind.map, words)  # type: ignore[arg-type]
    closed = False
    for keyframe in flight.keyframes:
        detector.add(keyframe)
        closed |= isinstance(detector.query(keyframe), LoopClosure)
    assert closed == (not demand)


def test_loop_without_drift_is_counted_and_the_same_flight_gives_the_same_map(
    make_flight: MakeFlight, words: Any
) -> None:
    flight = make_flight(keyframes=48, turns=1.2, drift_m=0.001)
    mapper, again = Mapper(WITHOUT_GRID, words), Mapper(WITHOUT_GRID, words)
    for one in (mapper, again):
        feed(one, [flight])
    assert mapper.summary()["loops"] == 1  # the second round goes on where the first was: one loop, not one a keyframe
    for keyframe in flight.keyframes:
        assert np.array_equal(mapper.map.pose(keyframe), again.map.pose(keyframe))
    short = Mapper(WITHOUT_GRID, words)
    feed(short, [make_flight(keyframes=24, turns=0.7)])
    assert short.summary()["loops"] == 0


def test_repetitive_corridor_closes_no_loop(
    make_flight: MakeFlight, corridor: Any, words: Any
) -> None:  # fmt: skip
    flight = make_flight(keyframes=40, turns=1.0, scene=corridor, seed=4)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [flight])
    summary = mapper.summary()
    assert summary["loop_matches"] > 0  # they do look alike
    assert summary["loops"] == 0 and summary["matches_refused"] > 0
    assert np.max(errors_m(mapper, flight)) < 0.3


def test_sharing_policy() -> None:
    a, b, c = AgentId(0), AgentId(1), AgentId(2)
    assert SharingPolicy("all").allows(a, c)
    assert not SharingPolicy("none").allows(a, c) and SharingPolicy("none").allows(a, a)
    chain = SharingPolicy("0 1, 1 2")
    assert chain.allows(a, b) and chain.allows(c, b) and not chain.allows(a, c)
    with pytest.raises(ValueError, match="expected"):
        SharingPolicy("0-1")


def test_loops_can_be_disabled(make_flight: MakeFlight, words: Any) -> None:
    config = replace(
        BaseConfig(), landmark_matching=LandmarkMatchingConfig(), loops=replace(BaseConfig().loops, enabled=False)
    )
    assert Mapper(config, words).merger is None


def test_a_new_keyframe_is_compared_with_all_places_once(
    make_flight: MakeFlight, words: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The comparison takes 1 ms with 20,000 places, and its scores tell how alike its neighbour is, too."""
    compared = 0
    score = place_kernels.score

    def counted(*given: Any) -> None:
        nonlocal compared
        compared += 1
        score(*given)

    monkeypatch.setattr(place_kernels, "score", counted)
    flight, mapper = make_flight(keyframes=8), Mapper(WITHOUT_GRID, words)
    feed(mapper, [flight])
    assert mapper.merger is not None
    assert 4 <= compared <= len(flight.keyframes)


@pytest.mark.parametrize(
    ("unit", "known", "one"), [(1.0, 40, True), (1.08, 40, True), (1.4, 40, False), (0.6, 40, False), (0.6, 5, True)]
)
def test_same_unit_compares_depths_of_both_maps(unit: float, known: int, one: bool) -> None:
    random = np.random.default_rng(0)
    keyframe = keyframe_id(submap_id(0, 0, 0), 0)
    T_w_k = se3.exp(random.normal(0.0, 1.0, 6))
    sparse_map = SparseMap()
    sparse_map.add_keyframe(keyframe, 0, NO_KEYFRAME, T_w_k, 0)
    sparse_map.keyframes.T_w_k[sparse_map.rows[keyframe]] = T_w_k
    local = random.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 6.0], (50, 3))
    n, small = np.arange(50, dtype=np.int32), np.zeros(50, np.uint8)
    mine = KeyframeObservations(
        n, n, np.zeros((50, 2)), np.full(50, -1.0), small, small, np.zeros((50, 32), np.uint8),
        se3.transform(T_w_k, local), np.arange(50) < known,
    )  # fmt: skip
    depth = unit * local[:, 2] * random.uniform(0.97, 1.03, 50)
    assert same_unit(sparse_map, keyframe, mine, n, depth) == one
