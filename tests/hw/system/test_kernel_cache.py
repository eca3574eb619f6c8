"""Kernels are compiled once, by a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
print(kernel_cache.filled(), kernel_cache.fill(sys.argv[1:]))
tiny_kernels.twice(1)
print(sum(tiny_kernels.twice.stats.cache_misses.values()))
"""


def fly(folder: Path, module: str) -> list[str]:
    paths = [str(folder), *sys.path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, module], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_a_child_process_compiles_each_source_once(tmp_path: Path) -> None:
    (tmp_path / "tiny_kernels.py").write_text(KERNELS)
    (tmp_path / "tiny_warm.py").write_text(WARM)
    assert fly(tmp_path, "tiny_warm") == ["False", "True", "0"]
    assert fly(tmp_path, "no_such_module") == ["True", "True", "0"]
    (tmp_path / "tiny_kernels.py").write_text(KERNELS + "\nOTHER = 1\n")
    assert fly(tmp_path, "no_such_module") == ["False", "False", "1"]
