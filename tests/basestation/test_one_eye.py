"""One eye's maps: loops take the drift of their unit of length back, and merges find how long it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.integrity import contradictions
from kiteline_basestation.jobs import BundleInputs, Job, JobDone, run_job
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.schema import Camera, Head, Record
from kiteline_core import se3, sim3
from kiteline_core.bundle import BundleResult
from kiteline_core.ids import submap_of_keyframe
from kiteline_core.pnp import align_points

F64 = NDArray[np.float64]
MakeFlight = Callable[..., Any]
STEP_NS = 250_000_000
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def in_own_unit(flight: Any, unit: float, growth: float = 0.0) -> Any:
    """The flight as one eye tells of it: lengths are unit times metres, and grow by a share with each keyframe."""
    assert not flight.camera.stereo
    for n, records in enumerate(flight.records):
        head = records[0]
        assert isinstance(head, Head)
        grown = unit * (1.0 + growth) ** max(n - 0.5, 0.0)
        records[0] = replace(head, T_p_k=sim3.stretched(head.T_p_k, grown))
    return flight


def untouched(job: Job) -> JobDone:
    """A bundle that changes nothing, so that what drifts keeps its drift until a loop takes it back."""
    assert isinstance(job.inputs, BundleInputs)
    problem = job.inputs.problem
    kept = np.ones(len(problem.camera), np.bool_)
    return JobDone(job.id, BundleResult(problem.T_c_m, problem.points, kept, 1.0, 1.0, 0, 1), 1)


def feed(
    mapper: Mapper, flights: Sequence[Any], delays: Sequence[int] = (), drift: bool = False
) -> list[Record]:  # fmt: skip
    """Fly together, one keyframe a step each; delays: steps by which each begins later. drift: local bundles do not
    help against it.
    """
    delays = delays or [0] * len(flights)
    done: tuple[JobDone, ...] = ()
    published: list[Record] = []
    for n in range(max(d + len(f.records) for d, f in zip(delays, flights)) + 70):
        arrivals = []
        for flight, delay in zip(flights, delays):
            records: list[Record] = [Camera(flight.agent, flight.camera)] if n == 0 else []
            if 0 <= n - delay < len(flight.records):
                records += flight.records[n - delay]
            arrivals.append((flight.agent, tuple(records)))
        output = mapper.step(MapperInput(tuple(arrivals), done), n * STEP_NS)
        done = tuple(untouched(job) if drift and job.kind == "bundle" else run_job(job) for job in output.jobs)
        for _, out in output.publish:
            published.extend(out)
    assert mapper.idle
    assert contradictions(mapper) == []
    return published


def placed(mapper: Mapper, flight: Any) -> F64:
    """Positions (n,3) of a flight's keyframes in the world."""
    S_w_m = mapper.placements[submap_of_keyframe(flight.keyframes[0])]
    return np.array([(S_w_m @ mapper.map.pose(k))[:3, 3] for k in flight.keyframes])


def true_places(flight: Any) -> F64:
    return np.array([T[:3, 3] for T in flight.true_T_w_k])


def error_m(found: F64, true: F64) -> tuple[float, float]:
    """RMS after the best similarity, in true metres, and the scale of that."""
    S = align_points(true, found, with_scale=True)
    assert S is not None
    return float(np.sqrt(np.mean(np.sum((se3.transform(S, found) - true) ** 2, axis=1)))), sim3.scale_of(S)
