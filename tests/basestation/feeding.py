"""Feeds the records of flights to a mapper; its jobs are run between two steps."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from kiteline_basestation.config import BaseConfig, GridConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.schema import CameraIntrinsics, Record
from kiteline_core.ids import AgentId, KeyframeId

STEP_NS = 250_000_000
# A base that draws no landmarks into its grid, which takes a third of its time: for tests of the map alone.
WITHOUT_GRID = replace(BaseConfig(), grid=replace(GridConfig(), made_per_step=0))
LAST_STEPS = 70  # without records: corrections of whole maps take some


def feed(
    mapper: Mapper, flights: Sequence[Any], delays: Sequence[int] = (), run: Callable[[Job], JobDone] = run_job
) -> list[Record]:  # fmt: skip
    """Fly together, one keyframe a step each, until the base is idle. Returns all that is published.

    delays: steps by which each flight begins later.
    """
    delays = delays or [0] * len(flights)
    steps = []
    for n in range(max(d + len(f.records) for d, f in zip(delays, flights)) + LAST_STEPS):
        arrivals = []
        for flight, delay in zip(flights, delays):
            records: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)] if n == 0 else []
            if 0 <= n - delay < len(flight.records):
                records += flight.records[n - delay]
            arrivals.append((flight.agent, tuple(records)))
        steps.append(tuple(arrivals))
    published = _step(mapper, steps, run)
    assert mapper.idle
    assert contradictions(mapper) == []
    return published


def feed_groups(mapper: Mapper, flight: Any, groups: Sequence[Sequence[Record]]) -> list[Record]:
    """Hand in one group of a flight's records a step, and some steps without any. Returns all that is published."""
    camera = CameraIntrinsics(flight.agent, flight.camera)
    return _step(mapper, [((flight.agent, tuple(group)),) for group in ([camera], *groups, *[[]] * 12)], run_job)


def _step(
    mapper: Mapper, steps: Sequence[tuple[tuple[AgentId, tuple[Record, ...]], ...]], run: Callable[[Job], JobDone]
) -> list[Record]:
    done: tuple[JobDone, ...] = ()
    published: list[Record] = []
    for n, arrivals in enumerate(steps):
        output = mapper.step(MapperInput(arrivals, done), n * STEP_NS)
        done = tuple(run(job) for job in output.jobs)
        published += [record for _, record in output.urgent]
        published += [record for _, records in output.publish for record in records]
    return published


def keyframes_in(records: Iterable[Any]) -> list[KeyframeId]:
    """The keyframes that records of one kind tell of."""
    return [record.keyframe for record in records]
