"""Resident memory, and its return to the system."""

import subprocess
import sys
from pathlib import Path

import pytest

from kiteline_hw.system.memory import clean_mappings

MEMORY = """
import numpy as np
from kiteline_hw.system.memory import rss_mib
before = rss_mib()
block = np.ones(64 << 17)  # 64 MiB
held = rss_mib()
del block
print(before, held, rss_mib())
"""


def test_resident_memory() -> None:
    """In a process of its own: here, memory that other tests freed may be returned at any time."""
    done = subprocess.run([sys.executable, "-c", MEMORY], check=True, capture_output=True, text=True)
    before_mib, held_mib, after_mib = map(float, done.stdout.split())
    assert 60.0 < held_mib - before_mib < 70.0
    assert after_mib < before_mib + 10.0


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="the system does not report its mappings")
def test_startup_memory_is_released() -> None:
    code = (
        "import cv2, numpy as np\nfrom kiteline_hw.system.memory import release_memory, rss_mib\n"
        "image = np.arange(40000, dtype=np.uint8).reshape(200, 200)\nwanted = cv2.GaussianBlur(image, (5, 5), 1.0)\n"
        "before = rss_mib()\nrelease_memory()\nprint(before - rss_mib())\n"
        "assert (cv2.GaussianBlur(image, (5, 5), 1.0) == wanted).all()\nimport zlib, decimal\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 10.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not report resident memory")
def test_freed_arrays_are_returned_to_the_system() -> None:
    """Arrays of growing size, with small ones between them that stay alive."""
    code = (
        "import numpy as np\nfrom kiteline_hw.system.memory import return_large_arrays, rss_mib\n"
        "return_large_arrays()\nkept = []\nbefore = rss_mib()\n"
        "for k in range(60):\n"
        "    a, small = np.ones((k + 1) << 16), np.ones(3000)\n    b = np.ones((k + 1) << 15)\n"
        "    kept.append(np.ones(3000))\n    del a, small\ndel b\n"
        "print(rss_mib() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 5.0  # 1.4 MiB are still in use; of a heap left to itself some 40 MiB stay


def test_only_unchanged_pages_of_files_are_dropped() -> None:
    def mapping(first: int, mode: str, name: str, **sizes: int) -> str:
        head = f"{first:x}-{first + 0x1000:x} {mode} 00000000 fe:00 7 {name}\n"
        known = {"Rss": 4, "Shared_Dirty": 0, "Private_Dirty": 0, "Anonymous": 0, **sizes}
        return head + "".join(f"{key}: {value} kB\n" for key, value in known.items()) + "VmFlags: rd mr mw me\n"

    smaps = "".join(
        (
            mapping(0x10000, "r-xp", "/lib/code.so"),
            mapping(0x20000, "r--p", "/lib/code.so", Private_Dirty=4, Anonymous=4),
            mapping(0x30000, "rw-p", "/lib/code.so"),
            mapping(0x40000, "r-xp", ""),
            mapping(0x50000, "r-xp", "[vdso]"),
            mapping(0x60000, "r--p", "/a folder/data (1).so"),
        )
    )
    assert clean_mappings(smaps) == [(0x10000, 0x11000), (0x60000, 0x61000)]
