"""Compiled kernels on disk: written by several processes at once, read without what only a compilation needs.

These functions take the place of numba's own; `kernel_compiler` installs them.
"""

import contextlib
import fcntl
import os
from typing import Any

from numba.core import caching
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys

_enable_caching = Dispatcher.enable_caching
_save_overload = caching.Cache.save_overload


def save(self: Any, key: Any, data: Any) -> None:
    """Write a compiled function to the cache, one process at a time and the index last.

    numba reads the index, adds to it and writes the code after it. Two processes that compile a function for different
    types at once would lose one of them, or find the code of one under the types of the other.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a file system without locks
            folder = os.open(self._cache_path, os.O_RDONLY)
            stack.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX)
        overloads = self._load_index()
        free = (name for k in range(1, len(overloads) + 2) if (name := self._data_name(k)) not in overloads.values())
        name = overloads.get(key) or next(free)
        self._save_data(name, data)
        self._save_index({**overloads, key: name})


unkept: list[str] = []  # why compiled code of this process is not in the cache, if it is not


def enable_caching(self: Any) -> None:
    """Keep compiled code on disk, if there is a folder that takes it; numba would refuse to make the function."""
    try:
        _enable_caching(self)
    except RuntimeError as error:
        unkept.append(str(error))


def load_overload(self: Any, signature: Any, context: Any) -> Any:
    """Load compiled code from the cache, or return None.

    numba first loads what only a compilation needs, scipy among it where it is installed: half a second of CPU and
    25 MiB in each process. A compilation loads that by itself.
    """
    rtsys.initialize(context)  # memory management, which compiled code refers to
    return self._load_overload(signature, context)


def save_overload(self: Any, signature: Any, data: Any) -> None:
    """Keep compiled code, if the disk takes it. It is in memory in either case: numba would not let it run."""
    try:
        _save_overload(self, signature, data)  # type: ignore[no-untyped-call]
    except OSError as error:
        unkept.append(error.strerror or str(error))
