"""Compiles the kernels of rooms ahead: `python -m kiteline_hw.system.kernel_compilation MODULE...`.

A MODULE has `warm()`, which runs every kernel of its room, and beside it `kernels.txt`, the kernels that `warm` calls,
with the types of their arguments. Several processes share the listed kernels out among them and compile them into
numba's cache; then `warm` loads them from there, and compiles what is missing. `--list MODULE...` writes the lists.
"""

import contextlib
import ctypes
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from kiteline_hw.system import kernel_cache
from kiteline_hw.system.computer import Computer, ComputerReader

_MOST = 3  # processes: those of a service share its limit of memory, 1 GiB
_FIRST_MIB, _NEXT_MIB = 400, 250  # MiB that the first process needs, and each further one: its own part of 300
_PR_SET_PDEATHSIG = 1  # of Linux' prctl


def main(arguments: list[str]) -> None:
    """Compile the kernels of the named modules, or write their lists."""
    if arguments[0] == "--list":
        for name in arguments[1:]:
            code = f"from {__spec__.name} import called; print(*called({name!r}), sep='\\n')"
            text = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True).stdout
            _list_of(import_module(name)).write_text(text)
        return
    modules = [import_module(name) for name in arguments]
    lines = {line for module in modules for line in listed(module)}
    with _in_turn(modules):
        kernel_cache.drop_stale()
        share_out(by_module(lines), processes(len(os.sched_getaffinity(0)), ComputerReader().read()))
        for module in modules:
            module.warm()
        if not kernel_cache.mark():
            sys.exit(1)


def processes(cores: int, computer: Computer) -> int:
    """How many processes may compile side by side: one for each core, as far as there is memory."""
    if computer.ram_mib is None or computer.ram_total_mib is None:
        return 1
    free_mib = computer.ram_total_mib - computer.ram_mib
    return max(1, min(cores, _MOST, 1 + (free_mib - _FIRST_MIB) // _NEXT_MIB))


def listed(module: ModuleType) -> list[str]:
    """Lines of a module's list; none if it has no list."""
    path = _list_of(module)
    return path.read_text().splitlines() if path.exists() else []


def _list_of(module: ModuleType) -> Path:
    return Path(module.__file__ or "").with_name("kernels.txt")


def by_module(lines: Iterable[str]) -> list[list[str]]:
    """Lines of the same module together, as their kernels call the same helpers; those with most arguments first."""
    parts: dict[str, list[str]] = {}
    for line in sorted(lines):
        parts.setdefault(line.split(":")[0], []).append(line)
    return sorted(parts.values(), key=lambda part: -sum(map(len, part)))


def share_out(parts: list[list[str]], n: int) -> None:
    """Compile the lines of each part in this process or in one of n - 1 copies of it: who is free takes the next part.

    Whatever a copy that dies leaves uncompiled stays so. Copies end with this process. At most 256 parts.
    """
    if n == 1:
        return  # `warm` compiles as fast
    todo, give = os.pipe()
    os.write(give, bytes(range(len(parts))))
    os.close(give)
    parent, copies = os.getpid(), []
    for _ in range(n - 1):
        copy = os.fork()
        if copy == 0:
            try:
                _end_with(parent)
                _work(parts, todo)
            finally:
                os._exit(0)
        copies.append(copy)
    _work(parts, todo)
    os.close(todo)
    for copy in copies:
        os.waitpid(copy, 0)


def _work(parts: list[list[str]], todo: int) -> None:
    while taken := os.read(todo, 1):
        for line in parts[taken[0]]:
            with contextlib.suppress(Exception):  # a list of another version: `warm` compiles what is missing
                compile_line(line)


def _end_with(parent: int) -> None:
    """End this process when the one that it is a copy of ends, however that ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)


def compile_line(line: str) -> None:
    """Compile the kernel of a line, or load it from the cache."""
    from numba.core import types

    name, arguments = line.split(" ", 1)
    module, kernel = name.split(":")
    getattr(import_module(module), kernel).compile(eval(arguments, dict(vars(types))))


@contextlib.contextmanager
def _in_turn(modules: list[ModuleType]) -> Iterator[None]:
    """Wait for another process that compiles: an agent and a base that start together share most kernels."""
    with contextlib.ExitStack() as stack:
        for line in listed(modules[0])[:1]:
            folder = kernel_cache.folder_of(import_module(line.split(":")[0]))
            if folder is None:
                continue  # nothing is kept
            with contextlib.suppress(OSError):
                lock = stack.enter_context(folder.joinpath("kiteline-compiling").open("wb"))
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def called(name: str) -> list[str]:
    """Lines of the kernels that `warm` of a module calls and that this process has not loaded yet."""
    from numba.core.dispatcher import Dispatcher

    lines: set[str] = set()
    dispatcher: Any = Dispatcher
    compiling, depth = dispatcher.compile, 0

    def noted(self: Any, arguments: tuple[Any, ...]) -> Any:
        nonlocal depth
        if depth == 0:  # else a kernel that another one calls
            text = repr(tuple(arguments)).replace(", False, aligned=True)", ")")
            lines.add(f"{self.py_func.__module__}:{self.py_func.__name__} {text}")
        depth += 1
        try:
            return compiling(self, arguments)
        finally:
            depth -= 1

    dispatcher.compile = noted
    try:
        import_module(name).warm()
    finally:
        dispatcher.compile = compiling
    return sorted(lines)


if __name__ == "__main__":
    main(sys.argv[1:])
