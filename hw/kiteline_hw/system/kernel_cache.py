"""Compiles missing kernels in a process of its own, and records on disk that all are compiled.

The compiler keeps 200 MiB that its process never returns, so it must not run in the process that flies.
"""

import contextlib
import errno
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from kiteline_hw.system.process import Parent, StopSignal, print_lines

COMPILING = "compiling kernels, once for this version: about a minute, several on a small board"
COMPILE_S = 900.0  # s that a slow board may take to compile all
_KERNELS = "_kernels"  # suffix of kernel modules
_OURS = "kiteline_"  # prefix of packages whose files may change at any time; others have versions
_IMPORT = re.compile(r"^from (\S+) import", re.MULTILINE)
_RECORD = "kiteline-compiled"  # file that lists compiled modules, beside their kernels
_POLL_S = 0.1  # s between two looks at the compiler
_SAID_S = 15.0  # s between two lines that say that it still compiles
_ROOM_BYTES = 32 << 20  # bytes that must be free: all kernels take 15 MB


def fill(modules: Sequence[str], stop: StopSignal | None = None, parent: Parent | None = None) -> bool:
    """Run `kernel_compilation` on modules unless all loaded kernels are compiled; True if they are now.

    That it takes long is told to the parent, or on stderr without one. If nothing can be written, that is said, and
    the caller compiles in its own process. stop: ends the compilation.
    """
    if filled():
        return True
    if parent is None:
        _say(COMPILING)
    else:
        parent.send_event("compiling")
    if why := _no_room():
        _say(f"compiled kernels cannot be kept ({why}): they are compiled anew, for a minute; see `kiteline doctor`")
        return False
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        compiler = subprocess.Popen(
            [sys.executable, "-m", "kiteline_hw.system.kernel_compilation", *modules],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        with compiler:
            try:
                if _ended(compiler, stop, parent) and compiler.returncode == 0:
                    mark()
            finally:
                compiler.kill()
    return filled()


def still_compiling(seconds: int) -> str:
    """The line for a user who waits."""
    return f"compiling kernels: {seconds} s so far"


def _ended(compiler: subprocess.Popen[bytes], stop: StopSignal | None, parent: Parent | None) -> bool:
    """Wait for the compiler to end; False if a signal came first. Raises TimeoutExpired."""
    for k in range(round(COMPILE_S / _POLL_S)):
        seconds = round(k * _POLL_S)
        if k > 0 and k % round(_SAID_S / _POLL_S) == 0:
            if parent is None:
                print_lines([still_compiling(seconds)])
            else:
                parent.send_event("compiling", seconds=seconds)
        with contextlib.suppress(subprocess.TimeoutExpired):
            compiler.wait(_POLL_S)
            return True
        if stop:
            return False
    raise subprocess.TimeoutExpired(compiler.args, COMPILE_S)


def filled() -> bool:
    """True if the present kernels of all loaded modules are compiled for this processor."""
    try:
        needed = _needed()
        return bool(needed) and all(lines <= _recorded(folder) for folder, lines in needed.items())
    except (OSError, ValueError):
        return False


def holds_current(folders: Iterable[Path]) -> bool:
    """True if kernels below the folders are compiled, all of them for the present modules and this processor.

    It loads no module, so one of which nothing was ever compiled is not missed.
    """
    try:
        records = [record for folder in folders for record in folder.rglob(_RECORD)]
        kept = {line.split()[0]: line for record in records for line in record.read_text().splitlines()}
        versions = _versions()
        present = {name: line for name in kept if (line := _line(name, versions))}
        return bool(present) and all(kept[name] == line for name, line in present.items())
    except (OSError, ValueError, IndexError):
        return False


def drop_stale() -> None:
    """Delete the compiled kernels of loaded modules that changed, or that import one that did: numba itself looks at a
    kernel's own file alone, and would go on with what it compiled in of others. Nobody else may compile meanwhile.
    """
    with contextlib.suppress(OSError, ValueError):
        for folder, lines in _needed().items():
            for line in lines - _recorded(folder):
                for index in folder.glob(f"{line.split()[0].rpartition('.')[2]}.*.nbi"):
                    index.unlink(missing_ok=True)


def _line(name: str, versions: str) -> str:
    """What is recorded of a module once it is compiled; "" for a module that is gone."""
    stamps: dict[str, str] = {}
    _add_stamps(name, stamps)
    if not stamps[name]:
        return ""
    digest = hashlib.blake2b(repr(sorted(stamps.items())).encode(), digest_size=8).hexdigest()
    return f"{name} {stamps[name]} {digest} {versions}"


def _add_stamps(name: str, stamps: dict[str, str]) -> None:
    """Add time and size of a module's file, and of those that it imports from: their kernels and constants are part of
    its compiled code. "" for a module that is gone.
    """
    stamps[name], path = _stamp(name)
    if path:
        for other in _imports(path, stamps[name]):
            if other not in stamps and (other.startswith(_OURS) or other.endswith(_KERNELS)):
                _add_stamps(other, stamps)


def _stamp(name: str) -> tuple[str, str]:
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return "", ""
    if spec is None or spec.origin is None:
        return "", ""
    file = os.stat(spec.origin)
    return f"{file.st_mtime_ns} {file.st_size}", spec.origin


@cache
def _imports(path: str, _stamp: str) -> tuple[str, ...]:
    return tuple(_IMPORT.findall(Path(path).read_text(encoding="utf-8")))


def _no_room() -> str:
    """Why the folders of compiled kernels do not take them; "" if they do."""
    try:
        folders = _needed()
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
            if shutil.disk_usage(folder).free < _ROOM_BYTES:
                return f"{folder}: {os.strerror(errno.ENOSPC)}"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return "" if folders else "no folder can be written"


@cache
def _say(line: str) -> None:
    """Print a line, once."""
    print_lines([line])


def mark() -> bool:
    """Record that the kernels of all loaded modules are compiled. False if this process could not keep them all."""
    from kiteline_core import kernel_files

    if kernel_files.unkept:
        return False
    with contextlib.suppress(OSError, ValueError):
        for folder, lines in _needed().items():
            folder.mkdir(parents=True, exist_ok=True)
            names = {line.split()[0] for line in lines}
            others = {line for line in _recorded(folder) if line.split()[0] not in names}
            new = folder / f"{_RECORD}.{os.getpid()}"
            new.write_text("\n".join(sorted(lines | others)) + "\n")
            os.replace(new, folder / _RECORD)
    return True


def folder_of(module: Any) -> Path | None:
    """Folder where numba keeps the compiled kernels of a module; None if it has none."""
    for value in vars(module).values():
        if folder := getattr(getattr(value, "stats", None), "cache_path", None):
            return Path(folder)
    return None


def _recorded(folder: Path) -> set[str]:
    path = folder / _RECORD
    return set(path.read_text().splitlines()) if path.exists() else set()


def compiled_for() -> tuple[str, str]:
    """Name of the CPU that numba compiles for, and its features: one name stands for several CPUs."""
    import llvmlite.binding as llvm

    return str(llvm.get_host_cpu_name()), str(llvm.get_host_cpu_features().flatten())


def _versions() -> str:
    """What compiled code depends on beside its source."""
    import numba

    machine = " ".join(compiled_for())
    compiler = hashlib.blake2b(machine.encode(), digest_size=8).hexdigest()
    return f"{platform.python_version()} {numba.__version__} {compiler}"


def _needed() -> dict[Path, set[str]]:
    """One line per module, with everything its compiled code depends on, by the folder of its compiled kernels."""
    versions = _versions()
    needed: dict[Path, set[str]] = {}
    for name, module in _modules():
        folder = folder_of(module)
        if folder is not None:
            needed.setdefault(folder, set()).add(_line(name, versions))
    return needed


def _modules() -> list[tuple[str, Any]]:
    loaded = [(name, module) for name, module in sys.modules.items() if name.endswith(_KERNELS)]
    return sorted((name, module) for name, module in loaded if getattr(module, "__file__", None))
