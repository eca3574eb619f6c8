"""The process that does the long work of a base."""

from __future__ import annotations

import time

import numpy as np

from kiteline_basestation.config import GraphConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.merging.essential_graph import GraphInputs
from kiteline_basestation.runtime.flight_log import fingerprint
from kiteline_basestation.runtime.worker import Worker


def graph_job(number: int) -> Job:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.random.default_rng(number).uniform(0.0, 1.0, 3)
    sigma, edges = np.tile([0.01, 0.003], (3, 1)), np.array([[0, 1], [1, 2], [0, 2]])
    steps = np.tile(np.eye(4), (3, 1, 1))
    loop = np.arange(3) == 2
    return Job(
        number, "graph", GraphInputs(np.arange(3), poses, np.arange(3) == 0, edges, steps, sigma, loop, GraphConfig())
    )


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
        worker.add([graph_job(1), graph_job(2)], 0)
        assert not worker.idle
        done = collected(worker, 2)
        assert [d.id for d in done] == [1, 2]
        assert [fingerprint(d) for d in done] == [fingerprint(run_job(graph_job(n))) for n in (1, 2)]
        assert len(worker.cpu_ms["graph"]) == 2
        assert worker.idle
        worker._process.kill()
        worker._process.join()
        worker.add([graph_job(3)], 0)
        assert [d.id for d in collected(worker, 1)] == [3]
        assert worker.deaths == 1
    finally:
        worker.close()


def test_fingerprints_tell_results_apart() -> None:
    assert fingerprint(run_job(graph_job(1))) != fingerprint(run_job(graph_job(2)))
