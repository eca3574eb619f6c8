"""Own CPU time of functions: each is wrapped while `running`, and the time of wrapped functions inside is taken off."""

import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch


class Profiler:
    """Own CPU time of stages in ns since the last `clear`.

    stages: (function, stage), the function as "module:name" or "module:Class.name"; all of them are public.
    """

    def __init__(self, stages: Sequence[tuple[str, str]]) -> None:
        self.own_ns: dict[str, int] = {}
        self._inner_ns: list[int] = []
        self._stages = stages

    def clear(self) -> None:
        """Begin a new step."""
        self.own_ns = {}

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """The function, with its own time added to a stage."""

        def run(*args: Any, **named: Any) -> Any:
            begin_ns = time.thread_time_ns()
            self._inner_ns.append(0)
            try:
                return function(*args, **named)
            finally:
                spent_ns = time.thread_time_ns() - begin_ns
                self.own_ns[stage] = self.own_ns.get(stage, 0) + spent_ns - self._inner_ns.pop()
                if self._inner_ns:
                    self._inner_ns[-1] += spent_ns

        return run

    @contextmanager
    def running(self) -> Iterator[None]:
        """Time all stages."""
        with ExitStack() as stack:
            for path, stage in self._stages:
                owner, name = locate(path)
                stack.enter_context(patch.object(owner, name, self.timed(getattr(owner, name), stage)))
            yield


def locate(path: str) -> tuple[Any, str]:
    """The owner (module or class) and the name of a function "module:name" or "module:Class.name"."""
    module, _, rest = path.partition(":")
    owner: Any = importlib.import_module(module)
    *classes, name = rest.split(".")
    for part in classes:
        owner = getattr(owner, part)
    return owner, name
