"""Jobs: long work done outside the state machine, by a worker process or in modelled time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Job:
    """Work to be done elsewhere. kind: name of a `JobKind`. inputs: frozen, all that the kind's `run` needs."""

    id: int
    kind: str
    inputs: Any


class JobIds(Iterator[int]):
    """Numbers of jobs from 1 on, each once. It can be copied with a base, which itertools.count soon cannot."""

    def __init__(self) -> None:
        self._last = 0

    def __next__(self) -> int:
        self._last += 1
        return self._last


@dataclass(frozen=True, slots=True)
class JobDone:
    """Result of a job. cost_ops: arithmetic operations, at one a nanosecond on the modelled core.

    failed: why there is no result; "" if there is one. What the job was to mend then stays as it is.
    """

    id: int
    kind: str
    result: Any
    cost_ops: int
    failed: str = ""


def set_aside(job: Job, why: str) -> JobDone:
    """The end of a job that has no result."""
    return JobDone(job.id, job.kind, None, 0, why)


@dataclass(frozen=True, slots=True)
class JobKind:
    """A kind of job, defined beside the inputs that it takes.

    run: pure; the same inputs give the same result, bit for bit. cost_ops: cost of a run in arithmetic operations.
    rank: jobs of a lower one are begun first; those of rank 0 are short, and a worker is kept for them.
    """

    name: str
    run: Callable[[Any], Any]
    cost_ops: Callable[[Any, Any], int]
    rank: int = 0
