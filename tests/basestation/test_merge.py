"""Maps of several agents become one where they overlap, and never where they only look alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.jobs import JobDone, run_job
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import Camera, Placement, Record
from kiteline_core import se3
from kiteline_core.ids import submap_of_keyframe

F64 = NDArray[np.float64]
MakeFlight = Callable[..., Any]
STEP_NS = 250_000_000
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def feed(mapper: Mapper, flights: Sequence[Any], delays: Sequence[int] = ()) -> list[Record]:
    """Fly together, one keyframe a step each; delays: steps by which each begins later."""
    delays = delays or [0] * len(flights)
    done: tuple[JobDone, ...] = ()
    published: list[Record] = []
    steps = max(d + len(f.records) for d, f in zip(delays, flights))
    for n in range(steps + 60):
        arrivals = []
        for flight, delay in zip(flights, delays):
            records: list[Record] = [Camera(flight.agent, flight.camera)] if n == 0 else []
            if 0 <= n - delay < len(flight.records):
                records += flight.records[n - delay]
            arrivals.append((flight.agent, tuple(records)))
        output = mapper.step(MapperInput(tuple(arrivals), done), n * STEP_NS)
        done = tuple(run_job(job) for job in output.jobs)
        for _, out in output.publish:
            published.extend(out)
    assert mapper.idle
    return published


def joint_error_m(mapper: Mapper, flights: Sequence[Any]) -> F64:
    """Errors (n,) of all keyframes in the world of the first."""
    out = []
    for flight in flights:
        T_w_m = mapper.placements[submap_of_keyframe(flight.keyframes[0])]
        for k, true in zip(flight.keyframes, flight.true_T_w_k):
            pose = mapper.map.pose(k)
            assert pose is not None
            out.append(float(np.linalg.norm((T_w_m @ pose)[:3, 3] - true[:3, 3])))
    return np.array(out)


def test_two_agents_in_one_room_get_one_map(make_flight: MakeFlight, words: Any) -> None:
    a = make_flight(keyframes=40, turns=0.8)
    b = make_flight(keyframes=40, turns=0.8, start=0.5, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper = Mapper(BaseConfig(), words)
    published = feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 1
    assert np.sqrt(np.mean(joint_error_m(mapper, [a, b]) ** 2)) < 0.02
    last = [r for r in published if isinstance(r, Placement) and r.submap == submap_of_keyframe(b.keyframes[0])][-1]
    assert np.allclose(last.T_w_m, ELSEWHERE, atol=0.03)
