"""The recipe of CONTRIBUTING.md: a new kind of job is one `JobKind` and one row in a table."""

from dataclasses import dataclass

import pytest

from kiteline_basestation import job_kinds
from kiteline_basestation.jobs import Job, JobKind
from kiteline_basestation.runtime.flight_summary import timings
from kiteline_basestation.runtime.worker import LockstepJobs


@dataclass(frozen=True, slots=True)
class ToyInputs:
    """Numbers to be added."""

    numbers: tuple[int, ...]


TOY = JobKind("toy", lambda inputs: sum(inputs.numbers), lambda inputs, result: 1000 * len(inputs.numbers))


def test_a_toy_job_runs_takes_modelled_time_and_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(job_kinds.KINDS, TOY.name, TOY)
    jobs = LockstepJobs()
    jobs.add([Job(7, TOY.name, ToyInputs((1, 2, 3)))], now_ns=500)
    assert jobs.done(3499) == ()
    (done,) = jobs.done(3500)  # 3000 operations at one a nanosecond
    assert (done.id, done.kind, done.result, done.cost_ops) == (7, "toy", 6, 3000)
    assert jobs.idle
    assert len(timings(jobs.cpu_ms, [], [])["toy_ms"]) == 1
