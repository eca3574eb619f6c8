"""The process that does the long work of a base."""

from __future__ import annotations

import time

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_job import GridInputs
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.runtime.flight_log import fingerprint
from kiteline_basestation.runtime.worker import Worker


def grid_job(number: int) -> Job:
    random = np.random.default_rng(number)
    points = np.column_stack([random.uniform(1.0, 4.0, (200, 2)), random.uniform(-1.0, 0.5, 200)])
    pairs = np.column_stack([np.zeros(200, np.int64), np.arange(200)])
    return Job(number, "grid", GridInputs(GridConfig(), np.zeros((1, 3)), points, pairs))


def collected(worker: Worker, number: int) -> list[JobDone]:
    done: list[JobDone] = []
    deadline_s = time.monotonic() + 60.0
    while len(done) < number:
        assert time.monotonic() < deadline_s
        done += worker.done(0)
        time.sleep(0.005)
    return done


def test_a_worker_gives_the_results_in_order_and_survives_being_killed() -> None:
    worker = Worker()
    try:
        worker.add([grid_job(1), grid_job(2)], 0)
        assert not worker.idle
        done = collected(worker, 2)
        assert [d.id for d in done] == [1, 2]
        assert [fingerprint(d) for d in done] == [fingerprint(run_job(grid_job(n))) for n in (1, 2)]
        assert len(worker.cpu_ms["grid"]) == 2
        assert worker.idle
        worker._process.kill()
        worker._process.join()
        worker.add([grid_job(3)], 0)
        assert [d.id for d in collected(worker, 1)] == [3]
        assert worker.deaths == 1
    finally:
        worker.close()


def test_fingerprints_tell_results_apart() -> None:
    assert fingerprint(run_job(grid_job(1))) != fingerprint(run_job(grid_job(2)))
