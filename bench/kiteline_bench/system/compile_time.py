"""CPU time to compile each room's numba kernels from an empty cache, and how long a start waits for them.

Usage: python -m kiteline_bench.system.compile_time [ROOM...]
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

# Modules that run every kernel of a room. The agent's and the base's flights run the codec's kernels too.
WARM_MODULES = {
    "agent": ("kiteline_codec.warm", "kiteline_agent.runtime.warm"),
    "codec": ("kiteline_codec.warm",),
    "base": ("kiteline_basestation.runtime.warm",),
}


@dataclass(frozen=True, slots=True)
class CompileTime:
    """CPU seconds by kernel ("module.name", excluding the kernels that it calls) and number of compiled signatures."""

    seconds: dict[str, float]
    signatures: dict[str, int]

    @property
    def total_s(self) -> float:
        """CPU seconds of all kernels."""
        return sum(self.seconds.values())


def measure(room: str) -> CompileTime:
    """Compile the kernels of a room ("agent", "codec", "base") in a new process with an empty cache.

    Raises subprocess.CalledProcessError if that process fails.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, "-m", "kiteline_bench.system.compile_time", "--child", room]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    seconds, signatures = json.loads(done.stdout.splitlines()[-1])
    return CompileTime(seconds, signatures)


def waiting_s(modules: Sequence[str], cores: int) -> float:
    """Seconds until a start with an empty cache has the kernels of modules, on so many of the cores.

    Raises subprocess.CalledProcessError.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, "-m", "kiteline_hw.system.kernel_compilation", *modules]
        begin_s = time.monotonic()
        subprocess.run(command, env=environment, check=True, preexec_fn=lambda: _use(cores))
        return time.monotonic() - begin_s


def _use(cores: int) -> None:
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


def _compile_here(room: str) -> None:
    """Print kernel times as a line of JSON. Compilations nest: the time of a callee is subtracted from its caller's."""
    from numba.core import event

    seconds: dict[str, float] = defaultdict(float)
    signatures: dict[str, int] = defaultdict(int)
    running: list[list[Any]] = []  # name, CPU seconds at the start, CPU seconds of callees

    class Listener(event.Listener):
        def on_start(self, data: Any) -> None:
            function = data.data["dispatcher"].py_func
            running.append([f"{function.__module__}.{function.__name__}", time.process_time(), 0.0])

        def on_end(self, data: Any) -> None:
            name, start_s, callees_s = running.pop()
            spent_s = time.process_time() - start_s
            seconds[name] += spent_s - callees_s
            signatures[name] += 1
            if running:
                running[-1][2] += spent_s

    with event.install_listener("numba:compile", Listener()):
        for module in WARM_MODULES[room]:
            import_module(module).warm()
    print(json.dumps([seconds, signatures]))


def main(arguments: list[str]) -> None:
    """Print a table for each room, slowest kernel first."""
    if arguments[:1] == ["--child"]:
        _compile_here(arguments[1])
        return
    for room in arguments or list(WARM_MODULES):
        result = measure(room)
        print(f"{room}: {result.total_s:.1f} s CPU, {len(result.seconds)} functions")
        for name, spent_s in sorted(result.seconds.items(), key=lambda item: -item[1]):
            print(f"{spent_s:8.2f} s  {result.signatures[name]:2d} x  {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
