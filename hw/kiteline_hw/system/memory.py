"""Resident memory of this process, and ways to return unused memory to the system."""

import contextlib
import ctypes
import gc
from pathlib import Path

_MADV_DONTNEED = 4  # Linux, on every architecture
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt in the GNU C library
_LARGE_BYTES = 256 << 10  # from here on an array gets a mapping of its own, which costs a few microseconds
_SPARE_BYTES = 2 << 20  # of freed heap that is kept for later use
_CHANGED = ("Private_Dirty:", "Shared_Dirty:", "Anonymous:")  # lines of smaps that count pages unlike their file's


def rss_mib() -> float:
    """Resident memory of this process in MiB; 0 if the system does not report it."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024.0
    return 0.0


def release_memory() -> None:
    """Release what only the start-up needed: freed heap, and pages of libraries and their code.

    Pages are dropped only if they are backed by their file and unchanged: a page that is needed again is back within a
    quarter of a microsecond. Objects alive now are excluded from garbage collection, whose full rounds would take as
    long as three frames. Does nothing on systems without these calls.
    """
    gc.collect()
    gc.freeze()
    with contextlib.suppress(OSError, AttributeError, ValueError):
        libc = ctypes.CDLL(None, use_errno=True)
        libc.malloc_trim(0)
        for begin, end in clean_mappings(Path("/proc/self/smaps").read_text()):
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def return_large_arrays() -> None:
    """From now on return the memory of large arrays to the system as soon as they are freed.

    By default the GNU C library keeps freed blocks of up to 32 MiB for reuse (M_MMAP_THRESHOLD grows by itself). If
    array sizes grow over time, hardly any freed block fits a later array, and the holes add up. Does nothing on systems
    without this call.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, _SPARE_BYTES)


def clean_mappings(smaps: str) -> list[tuple[int, int]]:
    """Begin and end of the mappings in /proc/PID/smaps that are read-only, backed by files, and unchanged."""
    found: list[tuple[int, int]] = []
    mapping: tuple[int, int] | None = None
    for line in smaps.splitlines():
        name, _, value = line.partition(" ")
        if not name.endswith(":"):
            fields = line.split(maxsplit=5)
            begin, end = (int(text, 16) for text in name.split("-"))
            is_file = len(fields) == 6 and fields[5].startswith("/") and fields[1] in ("r-xp", "r--p")
            mapping = (begin, end) if is_file else None
        elif mapping is not None and name in _CHANGED and int(value.split()[0]) > 0:
            mapping = None  # relocated when it was loaded: its content is in no file
        elif mapping is not None and name == "VmFlags:":
            found.append(mapping)
    return found
