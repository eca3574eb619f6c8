"""Kernels are compiled once, by a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from kiteline_core.kernel_compiler import TRIED
from kiteline_hw.system import kernel_cache

KERNELS = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2 * x
"""
WARM = "import tiny_kernels\n\ndef warm():\n    tiny_kernels.twice(1)\n"
FLIGHT = """
import sys, tiny_kernels
from kiteline_hw.system import kernel_cache

class Parent:
    def send_event(self, event):
        print(event)

parent = Parent() if sys.argv[2] == "child" else None
print(kernel_cache.filled(), kernel_cache.fill(sys.argv[1:2], parent=parent))
tiny_kernels.twice(1)
print(sum(tiny_kernels.twice.stats.cache_misses.values()))
"""


def fly(folder: Path, module: str, kind: str = "alone") -> tuple[list[str], str]:
    paths = [str(folder), *sys.path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, module, kind], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split(), done.stderr


def test_a_child_process_compiles_each_source_once(tmp_path: Path) -> None:
    (tmp_path / "tiny_kernels.py").write_text(KERNELS)
    (tmp_path / "tiny_warm.py").write_text(WARM)
    said = kernel_cache.COMPILING + "\n"
    assert fly(tmp_path, "tiny_warm") == (["False", "True", "0"], said)
    assert fly(tmp_path, "no_such_module") == (["True", "True", "0"], "")
    (tmp_path / "tiny_kernels.py").write_text(KERNELS + "\nOTHER = 1\n")
    assert fly(tmp_path, "tiny_warm", "child") == (["compiling", "False", "True", "0"], "")  # its parent is told


CALLED = "from kiteline_core.jit import helper\n\n@helper\ndef times(x):\n    return {n} * x\n"
CALLER = (
    "from kiteline_core.jit import njit\nfrom low_kernels import times\n\n@njit\ndef both(x):\n    return times(x)\n"
)
CALL = """
import high_kernels
from kiteline_hw.system import kernel_cache
was = kernel_cache.filled()
print(was, kernel_cache.fill(["high_warm"]), high_kernels.both(10), sum(high_kernels.both.stats.cache_misses.values()))
"""


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path: Path) -> None:
    """An update of a checkout flew with the old code of helpers in all files that had not changed themselves."""
    (tmp_path / "high_kernels.py").write_text(CALLER)
    (tmp_path / "high_warm.py").write_text("import high_kernels\n\ndef warm():\n    high_kernels.both(1)\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
                   "NUMBA_CACHE_DIR": str(tmp_path / "cache")}  # fmt: skip

    def called(times: int) -> str:
        low = tmp_path / "low_kernels.py"
        if not low.exists() or low.read_text() != CALLED.format(n=times):
            low.write_text(CALLED.format(n=times))
        words = [sys.executable, "-c", CALL]
        return subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout

    assert called(2) == "False True 20 0\n"
    assert called(2) == "True True 20 0\n"
    assert called(300) == "False True 3000 0\n"


SLOW = """
import sys
from types import SimpleNamespace
from kiteline_hw.system import kernel_cache

kernel_cache._SAID_S = 0.2
kernel_cache.filled = lambda: False
kernel_cache._no_room = lambda: ""
parent = SimpleNamespace(send_event=lambda event, **values: print(event, *values)) if sys.argv[1] == "child" else None
"""


def test_a_user_who_waits_for_a_compilation_hears_of_it(tmp_path: Path) -> None:
    """A small board compiles for minutes."""
    (tmp_path / "slow_warm.py").write_text("import time\n\ntime.sleep(1.0)\n\n\ndef warm():\n    pass\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}

    def said(kind: str) -> subprocess.CompletedProcess[str]:
        code = f"{SLOW}kernel_cache.fill(['slow_warm'], parent=parent)"
        words = [sys.executable, "-c", code, kind]
        return subprocess.run(words, env=environment, capture_output=True, text=True, check=True)

    assert said("alone").stderr.splitlines()[1:3] == ["compiling kernels: 0 s so far"] * 2
    assert said("child").stdout.splitlines()[:2] == ["compiling", "compiling seconds"]


FULL = """
import errno, os, shutil, sys
import numba.core.caching as caching
from kiteline_core.jit import njit
import tiny_kernels
from kiteline_hw.system import kernel_cache

def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

if sys.argv[1] == "full":
    shutil.disk_usage = lambda _: shutil._ntuple_diskusage(1, 1, 0)
    caching._CacheLocator.ensure_cache_path = full
print(kernel_cache.fill(["no_such_module"]), tiny_kernels.twice(4), kernel_cache.mark(), kernel_cache.filled())
"""


@pytest.mark.parametrize("disk", ["full", "none"])
def test_a_disk_that_takes_no_kernels_does_not_keep_them_from_running(tmp_path: Path, disk: str) -> None:
    if not numba.__version__.startswith(TRIED):
        pytest.skip("numba does as it does")
    source = "from kiteline_core.jit import njit\n\n@njit\ndef twice(x):\n    return 2 * x\n"
    if disk == "none":  # no folder at all: neither the named one, nor one beside the source, nor the user's
        source = (
            "import numba.core.caching as c\nfor one in c.CacheImpl._locator_classes:\n"
            "    one.from_function = classmethod(lambda *_: None)\n" + source
        )
    (tmp_path / "tiny_kernels.py").write_text(source)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "-c", FULL, disk], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.stdout.split(), done.returncode) == (["False", "8", "False", "False"], 0), done.stderr
    assert done.stderr.count("compiled kernels cannot be kept") == 1
