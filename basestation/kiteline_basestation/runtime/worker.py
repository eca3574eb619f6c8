"""Runs jobs: in worker processes, or in lock-step flights in this process with modelled time."""

import contextlib
import heapq
import importlib.util
import multiprocessing
import os
import signal
import time
from collections import defaultdict, deque
from collections.abc import Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection

import cv2

from kiteline_basestation.job_kinds import KINDS, run_job
from kiteline_basestation.jobs import Job, JobDone, set_aside
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_hw.lockstep.shared_core import CoreProcess
from kiteline_hw.system.memory import return_large_arrays
from kiteline_hw.system.process import is_stopped

SAMPLES = 1 << 15  # newest CPU times that are recorded: half an hour of steps
_END_S = 0.5  # s that a worker may take to end before it is killed
_LOOK_S = 1.0  # s between two looks whether the process was stopped
_LONGEST_PAUSE_S = 60.0  # s between two starts of a process that dies before its first job
_MOST_CHARS = 300  # of an error that a job raised
_MOST_WORKERS = 4  # of 150 MiB each: more do not help one loop that feeds them
_LONG_NICE = 5  # of workers that do long jobs: the loop and local bundles come first where cores are few

CpuTimes = defaultdict[str, deque[float]]  # newest CPU times in ms, by kind of job


def cpu_times() -> CpuTimes:
    """No CPU times yet."""
    return defaultdict(lambda: deque(maxlen=SAMPLES))


def _work(pipe: Connection, nice: int) -> None:
    """Loop of a worker process: say that it is ready, then receive a job and send its result and CPU time in ms, or
    the error that it raised, until the pipe closes.
    """
    # Ctrl-C stops the base, which closes the pipe. Until here the signal was held back.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(nice)
    return_large_arrays()
    cv2.setNumThreads(1)
    warm()
    if importlib.util.find_spec("gtsam") is not None:
        warm_graphs()
    with contextlib.suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            job = pipe.recv()
            begin_ns = time.process_time_ns()
            done: JobDone | str
            try:
                done = run_job(job)
            except Exception as error:
                done = f"{type(error).__name__}: {error}"[:_MOST_CHARS]
            pipe.send((done, (time.process_time_ns() - begin_ns) / 1e6))


class Worker:
    """A worker process that runs jobs in order; if it dies, or was stopped, another one takes its place.

    A job that raises or ends the process is tried once more, then set aside: the other jobs go on. notes: lines about
    what happened, for the user.
    """

    def __init__(self, cpu_ms: CpuTimes | None = None, nice: int = 0) -> None:
        """cpu_ms: where CPU times go, by kind of job. nice: by how much other processes come before it."""
        self.cpu_ms = cpu_times() if cpu_ms is None else cpu_ms
        self.deaths = 0
        self._nice = nice
        self.notes: list[str] = []
        self._queue: deque[Job] = deque()
        self._running: Job | None = None
        self._failed_once: set[int] = set()  # jobs that are tried for the second time
        self._aside: list[JobDone] = []
        self._idle_deaths = 0  # in a row, without a job done in between
        self._start_s = 0.0  # when the next process may start, if there is none
        self._looked_s = 0.0
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, self._nice), name="kiteline-worker", daemon=True)
        resource_tracker.ensure_running()  # else `start` does it, and lets all signals through
        held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # it inherits that: its modules take a second
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
        self._ready = self._away = False
        theirs.close()  # so that each side notices when the other ends

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Queue jobs."""
        self._queue.extend(jobs)
        self._start_next()

    def done(self, now_ns: int) -> tuple[JobDone, ...]:
        """Jobs finished or set aside since the last call. Never blocks."""
        results = []
        now_s = time.monotonic()
        if self._away:
            if now_s < self._start_s:
                return self._taken_aside()
            self._start()
        try:
            while self._pipe.poll():
                message = self._pipe.recv()
                if message is None:
                    self._ready = True
                else:
                    results += self._finished(*message)
                self._start_next()
        except (EOFError, OSError):
            self._replace(now_s)
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            if is_stopped(self._process.pid):
                self._replace_stopped(now_s)
        return (*results, *self._taken_aside())

    @property
    def idle(self) -> bool:
        """True if no job is running or waiting."""
        return self._running is None and not self._queue and not self._aside

    @property
    def free(self) -> bool:
        """True if it would begin with a job at once."""
        return self._ready and self.idle

    def take_notes(self) -> list[str]:
        """What happened since the last call."""
        notes, self.notes = self.notes, []
        return notes

    def _finished(self, done: JobDone | str, cpu_ms: float) -> list[JobDone]:
        """Take in what became of the running job."""
        job, self._running = self._running, None
        self._idle_deaths = 0
        if job is None:
            return []
        if isinstance(done, str):
            self._try_again(job, done)
            return []
        self.cpu_ms[job.kind].append(cpu_ms)
        self._failed_once.discard(job.id)
        return [done]

    def _try_again(self, job: Job, why: str) -> None:
        """Queue a job that failed once more, or set it aside."""
        if job.id not in self._failed_once:
            self._failed_once.add(job.id)
            self._queue.appendleft(job)
            return
        self._failed_once.discard(job.id)
        self.notes.append(f"job {job.id} ({job.kind}) failed twice and was set aside: {why}")
        self._aside.append(set_aside(job, why))

    def _taken_aside(self) -> tuple[JobDone, ...]:
        aside, self._aside = self._aside, []
        return tuple(aside)

    def _start_next(self) -> None:
        if self._ready and self._running is None and self._queue:
            if is_stopped(self._process.pid):  # it would not read the job, and sending it would wait
                self._replace_stopped(time.monotonic())
                return
            self._running = self._queue.popleft()
            try:
                self._pipe.send(self._running)
            except OSError:
                self._replace(time.monotonic())

    def _replace_stopped(self, now_s: float) -> None:
        self.notes.append("the worker process was stopped; another one takes its place")
        self._replace(now_s, is_fault=False)

    def _replace(self, now_s: float, *, is_fault: bool = True) -> None:
        """End the process and start another: at once, or later if it did nothing between two deaths."""
        self.deaths += 1
        self.close()
        job, self._running = self._running, None
        if job is not None and is_fault:
            self._try_again(job, f"the worker process ended with status {self._process.exitcode}")
        elif job is not None:
            self._queue.appendleft(job)
        elif is_fault and not self._ready:
            self._idle_deaths += 1
            self.notes.append(f"the worker process cannot start (status {self._process.exitcode}); it is tried again")
        if self._idle_deaths:
            self._ready, self._away = False, True
            self._start_s = now_s + min(_LONGEST_PAUSE_S, 2.0 ** (self._idle_deaths - 1))
        else:
            self._start()

    def close(self) -> None:
        """End the worker process, also during a job."""
        self.let_end()
        self.end_by(time.monotonic() + _END_S)

    def let_end(self) -> None:
        """Tell the process that nothing more comes."""
        self._pipe.close()

    def end_by(self, deadline_s: float) -> None:
        """Wait for the process until a time of the monotonic clock, but not for a job; then kill it."""
        self._process.join(0.0 if self._running is not None else max(0.0, deadline_s - time.monotonic()))
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


class Workers:
    """Several worker processes: jobs wait for the next free one, those of kinds that come first before others.

    The first worker does jobs of the most urgent kind alone, so that none of them waits for a long one. Results are
    given as they come; the base logs that order.
    """

    def __init__(self, count: int = 0) -> None:
        """count: of processes; 0: as many as the machine has cores beside the base's own, two to four."""
        self.cpu_ms = cpu_times()
        cores = len(os.sched_getaffinity(0))
        self._workers = [
            Worker(self.cpu_ms, nice=_LONG_NICE if n else 0)
            for n in range(count or min(max(cores - 1, 2), _MOST_WORKERS))
        ]
        self._waiting: list[tuple[int, int, Job]] = []  # rank of its kind, order of arrival, job
        self._count = 0

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Queue jobs."""
        for job in jobs:
            self._count += 1
            heapq.heappush(self._waiting, (KINDS[job.kind].rank, self._count, job))
        self._hand_out(now_ns)

    def done(self, now_ns: int) -> tuple[JobDone, ...]:
        """Jobs finished or set aside since the last call. Never blocks."""
        results = tuple(done for worker in self._workers for done in worker.done(now_ns))
        self._hand_out(now_ns)
        return results

    def _hand_out(self, now_ns: int) -> None:
        for n, worker in enumerate(self._workers):
            if self._waiting and worker.free and (n or len(self._workers) == 1 or self._waiting[0][0] == 0):
                worker.add([heapq.heappop(self._waiting)[2]], now_ns)

    @property
    def idle(self) -> bool:
        """True if no job is running or waiting."""
        return not self._waiting and all(worker.idle for worker in self._workers)

    def take_notes(self) -> list[str]:
        """What happened since the last call."""
        return [note for worker in self._workers for note in worker.take_notes()]

    def close(self) -> None:
        """End the worker processes, also during a job."""
        for worker in self._workers:
            worker.let_end()
        deadline_s = time.monotonic() + _END_S
        for worker in self._workers:
            worker.end_by(deadline_s)


class LockstepJobs:
    """A worker in modelled time: a job starts when the worker is free and is done after its modelled cost."""

    def __init__(self, process: CoreProcess | None = None) -> None:
        """process: of the worker on a shared core; None: it has a core of its own."""
        self.cpu_ms = cpu_times()
        self._process = process
        self._waiting: list[tuple[int, JobDone]] = []  # with the time at which it is done, or the number of its task
        self._free_ns = 0

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Run jobs now; `done` returns their results later."""
        for job in jobs:
            begin_ns = time.process_time_ns()
            try:
                done = run_job(job)
            except Exception as error:
                done = set_aside(job, f"{type(error).__name__}: {error}"[:_MOST_CHARS])
            self.cpu_ms[job.kind].append((time.process_time_ns() - begin_ns) / 1e6)
            if self._process is not None:
                self._waiting.append((self._process.spend(done.cost_ops, now_ns), done))
                continue
            self._free_ns = max(now_ns, self._free_ns) + done.cost_ops
            self._waiting.append((self._free_ns, done))

    def done(self, now_ns: int) -> tuple[JobDone, ...]:
        """Jobs done by now, in order."""
        limit = now_ns if self._process is None else self._process.done(now_ns)
        done = tuple(result for end, result in self._waiting if end <= limit)
        self._waiting = self._waiting[len(done) :]
        return done

    @property
    def idle(self) -> bool:
        """True if no job is running."""
        return not self._waiting
