"""The process that does the long work of a base."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from kiteline_basestation import job_kinds
from kiteline_basestation.config import BaseConfig, GraphConfig
from kiteline_basestation.grid.scan_job import SCAN
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone, JobKind, set_aside
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging.essential_graph import GraphInputs
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, LOCAL_BUNDLE
from kiteline_basestation.runtime import worker as worker_module
from kiteline_basestation.runtime.flight_log import fingerprint
from kiteline_basestation.runtime.worker import LockstepJobs, Worker, Workers
from kiteline_hw.lockstep.shared_core import SharedCore
from kiteline_hw.system.process import is_stopped
from tests.basestation.feeding import feed


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


@dataclass(frozen=True, slots=True)
class BadInputs:
    """What a job does instead of work: raise, end the process, or give its number."""

    what: str


def _bad(inputs: BadInputs) -> str:
    if inputs.what == "raise":
        raise ZeroDivisionError("no landmarks")
    if inputs.what.startswith("sleep"):
        time.sleep(float(inputs.what.removeprefix("sleep")))
    if inputs.what == "die":
        os._exit(9)
    return inputs.what


BAD = JobKind("bad", _bad, lambda inputs, result: 1)
LONG = JobKind("long", _bad, lambda inputs, result: 1, rank=2)
MIDDLE = JobKind("middle", _bad, lambda inputs, result: 1, rank=1)


def _work_with_bad_jobs(pipe: Any, nice: int) -> None:
    job_kinds.KINDS[BAD.name] = BAD
    worker_module._work(pipe, nice)


@pytest.fixture
def bad_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that know jobs which fail, and start quickly."""
    for kind in (BAD, MIDDLE, LONG):
        monkeypatch.setitem(job_kinds.KINDS, kind.name, kind)
    context = multiprocessing.get_context("fork")
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: context)
    monkeypatch.setattr(worker_module, "warm", lambda: None)
    monkeypatch.setattr(worker_module, "warm_graphs", lambda: None)


def test_a_job_that_fails_twice_is_set_aside_and_the_others_go_on(bad_jobs: None) -> None:
    worker = Worker()
    try:
        worker.add([Job(n, "bad", BadInputs(what)) for n, what in enumerate(("a", "die", "b", "raise", "c"))], 0)
        done = {d.id: d for d in collected(worker, 5)}
        assert [done[n].result for n in (0, 2, 4)] == ["a", "b", "c"]
        assert "ended with status 9" in done[1].failed and "no landmarks" in done[3].failed
        assert worker.deaths == 2 and worker.idle
        assert len(worker.notes) == 2 and all("set aside" in note for note in worker.notes)
    finally:
        worker.close()


def test_a_stopped_worker_is_replaced(bad_jobs: None) -> None:
    worker = Worker()
    try:
        worker.add([Job(1, "bad", BadInputs("a"))], 0)
        collected(worker, 1)
        os.kill(worker._process.pid or 0, signal.SIGSTOP)
        worker.add([Job(2, "bad", BadInputs("b"))], 0)
        begin_s = time.monotonic()
        assert [d.result for d in collected(worker, 1)] == ["b"]
        assert time.monotonic() - begin_s < 3.0
        assert "was stopped" in worker.notes[0]
    finally:
        worker.close()


def test_ctrl_c_does_not_reach_a_worker_that_starts(capfd: pytest.CaptureFixture[str]) -> None:
    """A terminal sends it to all processes; a worker that was loading its modules ended in a traceback."""
    worker = Worker()
    try:
        for _ in range(20):
            os.kill(worker._process.pid or 0, signal.SIGINT)
            time.sleep(0.02)
        assert worker._process.is_alive()
    finally:
        worker.close()
    assert capfd.readouterr().err == ""


def test_a_large_job_does_not_wait_for_a_worker_that_was_stopped(bad_jobs: None) -> None:
    worker = Worker()
    try:
        worker.add([Job(1, "bad", BadInputs("a"))], 0)
        collected(worker, 1)
        stopped = worker._process.pid or 0
        os.kill(stopped, signal.SIGSTOP)
        while not is_stopped(stopped):
            time.sleep(0.01)
        watchdog = threading.Timer(5.0, os.kill, (stopped, signal.SIGCONT))  # lest a failure hangs
        watchdog.start()
        begin_s = time.monotonic()
        worker.add([Job(2, "bad", BadInputs("b" * 8_000_000))], 0)  # more than a pipe holds
        assert time.monotonic() - begin_s < 2.0
        watchdog.cancel()
        assert [len(d.result) for d in collected(worker, 1)] == [8_000_000]
    finally:
        worker.close()


def test_a_worker_that_cannot_start_is_tried_ever_less_often(
    bad_jobs: None, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(worker_module, "warm", lambda: os._exit(7))
    worker = Worker()
    try:
        end_s = time.monotonic() + 2.5
        while time.monotonic() < end_s:
            assert worker.done(0) == ()
            time.sleep(0.01)
        assert worker.deaths <= 3
        assert "cannot start (status 7)" in worker.notes[0]
    finally:
        worker.close()


def test_a_job_that_raises_in_lock_step_is_set_aside(bad_jobs: None) -> None:
    jobs = LockstepJobs()
    jobs.add([Job(1, "bad", BadInputs("raise")), Job(2, "bad", BadInputs("a"))], 0)
    first, second = jobs.done(10)
    assert "no landmarks" in first.failed and second.result == "a"


def test_a_mapper_forgets_jobs_that_failed_and_goes_on(words: Any, make_flight: Callable[..., Any]) -> None:
    mapper, tried = Mapper(BaseConfig(), words), 0

    def run(job: Job) -> JobDone:
        nonlocal tried
        tried += 1
        return set_aside(job, "by chance") if tried % 3 == 0 else run_job(job)

    feed(mapper, [make_flight()], run=run)
    assert mapper.jobs_failed == tried // 3 > 0
    assert mapper.counts.bundles > 0 and mapper.summary()["jobs_open"] == 0


def test_short_jobs_do_not_wait_for_long_ones_and_those_that_come_first_are_begun_first(bad_jobs: None) -> None:
    workers = Workers(2)
    try:
        workers.add([Job(1, "bad", BadInputs("a"))], 0)
        assert _collected(workers, 1) == [1]
        jobs = [Job(n, "long", BadInputs("sleep0.5")) for n in (2, 3)]
        workers.add([*jobs, Job(4, "middle", BadInputs("a")), Job(5, "bad", BadInputs("a"))], 0)
        assert not workers.idle
        assert set(_collected(workers, 2)) == {4, 5}
        workers.add([Job(6, "bad", BadInputs("a"))], 0)
        assert _collected(workers, 3) == [6, 2, 3]
        assert workers.idle
    finally:
        workers.close()


def test_one_worker_is_kept_for_local_bundles_alone() -> None:
    ranks = [kind.rank for kind in (LOCAL_BUNDLE, POSE_GRAPH, FULL_BUNDLE, SCAN)]
    assert ranks == sorted(set(ranks)) and len(ranks) == len(job_kinds.KINDS)


def test_a_worker_that_dies_does_not_hold_up_the_others(bad_jobs: None) -> None:
    workers = Workers(2)
    try:
        workers.add([Job(1, "long", BadInputs("die")), *(Job(n, "bad", BadInputs("a")) for n in (2, 3))], 0)
        assert sorted(_collected(workers, 3)) == [1, 2, 3]
        assert any("set aside" in note for note in workers.take_notes())
    finally:
        workers.close()


def _collected(workers: Workers, number: int) -> list[int]:
    done: list[int] = []
    deadline_s = time.monotonic() + 30.0
    while len(done) < number:
        assert time.monotonic() < deadline_s
        done += [job.id for job in workers.done(0)]
        time.sleep(0.005)
    return done


def test_jobs_on_a_shared_core_take_longer() -> None:
    core = SharedCore(50.0)
    other, jobs = core.process(), LockstepJobs(core.process())
    jobs.add([graph_job(1)], 0)
    cost_ns = run_job(graph_job(1)).cost_ops
    other.spend(10 * cost_ns, 0)
    assert not jobs.done(3 * cost_ns)
    assert [done.id for done in jobs.done(4 * cost_ns + 1)] == [1]
    assert jobs.idle
