"""Runs jobs: in a worker process, or in lock-step flights in this process with modelled time."""

from __future__ import annotations

import contextlib
import importlib.util
import multiprocessing
import signal
import time
from collections import defaultdict, deque
from collections.abc import Sequence
from multiprocessing.connection import Connection

import cv2

from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_hw.system.memory import return_large_arrays

SAMPLES = 1 << 15  # newest CPU times that are recorded: half an hour of steps
_END_S = 0.5  # s that a worker may take to end before it is killed


def _work(pipe: Connection) -> None:
    """Loop of the worker process: receive a job, send its result and CPU time in ms, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the base, which closes the pipe
    return_large_arrays()
    cv2.setNumThreads(1)
    warm()
    if importlib.util.find_spec("gtsam") is not None:
        warm_graphs()
    with contextlib.suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            begin_ns = time.process_time_ns()
            done = run_job(job)
            pipe.send((done, (time.process_time_ns() - begin_ns) / 1e6))


class Worker:
    """A worker process that runs jobs in order. If it dies, it is started again with the same job."""

    def __init__(self) -> None:
        self.cpu_ms: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=SAMPLES))
        self.deaths = 0
        self._queue: deque[Job] = deque()
        self._running: Job | None = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), name="kiteline-worker", daemon=True)
        self._process.start()
        theirs.close()  # so that each side notices when the other ends

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Queue jobs."""
        self._queue.extend(jobs)
        self._start_next()

    def done(self, now_ns: int) -> tuple[JobDone, ...]:
        """Jobs finished since the last call. Never blocks."""
        results = []
        try:
            while self._pipe.poll():
                result, cpu_ms = self._pipe.recv()
                if self._running is not None:
                    self.cpu_ms[self._running.kind].append(cpu_ms)
                self._running = None
                results.append(result)
                self._start_next()
        except (EOFError, OSError):
            self._replace()
        return tuple(results)

    @property
    def idle(self) -> bool:
        """True if no job is running or waiting."""
        return self._running is None and not self._queue

    def _start_next(self) -> None:
        if self._running is None and self._queue:
            self._running = self._queue.popleft()
            try:
                self._pipe.send(self._running)
            except OSError:
                self._replace()

    def _replace(self) -> None:
        self.deaths += 1
        self.close()
        if self._running is not None:
            self._queue.appendleft(self._running)
            self._running = None
        self._start()
        self._start_next()

    def close(self) -> None:
        """End the worker process, also during a job."""
        self._pipe.close()
        self._process.join(0.0 if self._running is not None else _END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


class LockstepJobs:
    """A worker in modelled time: a job starts when the worker is free and is done after its modelled cost."""

    def __init__(self) -> None:
        self.cpu_ms: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=SAMPLES))
        self._waiting: list[tuple[int, JobDone]] = []
        self._free_ns = 0

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Run jobs now; `done` returns their results later."""
        for job in jobs:
            begin_ns = time.process_time_ns()
            done = run_job(job)
            self.cpu_ms[job.kind].append((time.process_time_ns() - begin_ns) / 1e6)
            self._free_ns = max(now_ns, self._free_ns) + done.cost_ops
            self._waiting.append((self._free_ns, done))

    def done(self, now_ns: int) -> tuple[JobDone, ...]:
        """Jobs done by now, in order."""
        done = tuple(result for end_ns, result in self._waiting if end_ns <= now_ns)
        self._waiting = self._waiting[len(done) :]
        return done

    @property
    def idle(self) -> bool:
        """True if no job is running."""
        return not self._waiting
