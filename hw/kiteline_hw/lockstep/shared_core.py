"""Modelled CPU time of processes that share the cores of one computer, as a fair scheduler deals it out."""

from collections import deque

_DONE_NS = 1e-3  # ns of work below which a task counts as done: rounding


class SharedCore:
    """A computer of which `percent` of a core are available, dealt out evenly among the processes that have work.

    No process gets more than one core: with 200 % two processes run at full speed. Times must not decrease.
    """

    def __init__(self, percent: float) -> None:
        """percent: of one core, above 0. Raises ValueError."""
        if not percent > 0.0:
            raise ValueError(f"a core of which {percent:g} % are available: expected more than 0")
        self._share = percent / 100.0
        self._processes: list[CoreProcess] = []
        self._now_ns = 0.0

    def process(self) -> "CoreProcess":
        """A new process on this computer."""
        self._processes.append(CoreProcess(self))
        return self._processes[-1]

    def advance(self, now_ns: float) -> None:
        """Do what the processes can do until a time."""
        while self._now_ns < now_ns:
            working = [process for process in self._processes if process.has_work]
            if not working:
                break
            rate, least_ns = self._rate(len(working)), min(process.next_ns for process in working)
            left_ns = (now_ns - self._now_ns) * rate
            for process in working:  # exactly what one task needs: the time, which is rounded, need not move for it
                process.run(min(least_ns, left_ns))
            if left_ns <= least_ns:
                break
            self._now_ns += least_ns / rate
        self._now_ns = max(self._now_ns, now_ns)

    def free_ns(self, process: "CoreProcess") -> int:
        """When a process will have done its work if no more is added to any."""
        left = [p.work_ns for p in self._processes]
        own, at_ns = self._processes.index(process), self._now_ns
        while left[own] > _DONE_NS:
            active = [k for k, work_ns in enumerate(left) if work_ns > _DONE_NS]
            rate, least_ns = self._rate(len(active)), min(left[k] for k in active)
            for k in active:
                left[k] -= least_ns
            at_ns += least_ns / rate
        return round(at_ns)

    def _rate(self, busy: int) -> float:
        """Share of a core that each of `busy` processes gets."""
        return min(self._share / busy, 1.0) if busy else 0.0


class CoreProcess:
    """A process on a shared core: does its tasks one after the other."""

    def __init__(self, core: SharedCore) -> None:
        self._core = core
        self._tasks: deque[float] = deque()  # ns of CPU time that each still needs
        self._done = 0  # tasks so far

    def spend(self, cost_ns: int, now_ns: int) -> int:
        """Queue a task that is ready at now_ns; returns its number."""
        self._core.advance(now_ns)
        self._tasks.append(max(float(cost_ns), 1.0))
        return self._done + len(self._tasks)

    def done(self, now_ns: int) -> int:
        """Number of the last task that is done by now; 0 before the first."""
        self._core.advance(now_ns)
        return self._done

    def busy(self, now_ns: int) -> bool:
        """True if a task is not done by now."""
        self._core.advance(now_ns)
        return self.has_work

    @property
    def free_ns(self) -> int:
        """When all tasks will be done if no process gets another one."""
        return self._core.free_ns(self)

    def newest_wins(self, frame_ns: int, period_ns: int) -> bool:
        """True if a frame is dropped because the next one arrives before this process is free."""
        self._core.advance(frame_ns)
        return period_ns > 0 and self.has_work and self.free_ns >= frame_ns + period_ns

    # -- of the core -------------------------------------------------------------------------------------------------

    @property
    def has_work(self) -> bool:
        """True if a task is not done."""
        return bool(self._tasks)

    @property
    def next_ns(self) -> float:
        """CPU time that the present task still needs."""
        return self._tasks[0]

    @property
    def work_ns(self) -> float:
        """CPU time that all tasks still need."""
        return sum(self._tasks)

    def run(self, cpu_ns: float) -> None:
        """Use CPU time, no more than the present task needs."""
        if self._tasks:
            self._tasks[0] -= cpu_ns
            if self._tasks[0] <= _DONE_NS:
                self._tasks.popleft()
                self._done += 1
