"""Listed kernels are shared out among processes, which neither hang nor outlive the first."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kiteline_hw.system.computer import Computer
from kiteline_hw.system.kernel_compilation import by_module, processes

# Two copies, and what stands for a compiler: it notes who took which line.
SHARED = """
import os, signal, sys, time
from pathlib import Path
from kiteline_hw.system import kernel_compilation

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background of a shell ignores it
first = os.getpid()

def noted(line):
    Path(sys.argv[1], line).write_text(str(os.getpid()))
    if line == "unknown":
        raise AttributeError(line)
    if line == "crash" and os.getpid() != first:
        os.kill(os.getpid(), signal.SIGSEGV)
    time.sleep(float(sys.argv[2]))

kernel_compilation.compile_line = noted
kernel_compilation.share_out([[line, f"{line}_2"] for line in sys.argv[3:]], 3)
"""


def shared(folder: Path, seconds: float, *lines: str) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen([sys.executable, "-c", SHARED, str(folder), str(seconds), *lines], env=environment)


def test_each_part_is_compiled_once_by_one_process(tmp_path: Path) -> None:
    lines = [f"line{k}" for k in range(12)]
    with shared(tmp_path, 0.02, "unknown", *lines) as first:
        assert first.wait(30) == 0
    taken = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert set(taken) == {"unknown", "unknown_2", *lines, *(f"{line}_2" for line in lines)}
    assert all(taken[line] == taken[f"{line}_2"] for line in lines)
    assert 1 < len(set(taken.values())) <= 3


def test_a_copy_that_dies_holds_up_nobody(tmp_path: Path) -> None:
    with shared(tmp_path, 0.05, *("crash",) * 3, *(f"line{k}" for k in range(6))) as first:
        assert first.wait(30) == 0
    assert {f"line{k}_2" for k in range(6)} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_copies_end_with_the_first_process(tmp_path: Path, how: signal.Signals) -> None:
    with shared(tmp_path, 60.0, "a", "b", "c") as first:
        deadline_s = time.monotonic() + 20.0
        while len(taken := [path.read_text() for path in tmp_path.iterdir()]) < 3 or not all(taken):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        first.send_signal(how)
        first.wait(20)
        while any(_is_running(int(pid)) for pid in taken):
            assert time.monotonic() < deadline_s + 20.0
            time.sleep(0.01)


def _is_running(pid: int) -> bool:
    try:
        return "(zombie)" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


WARM = """
import os, time
from pathlib import Path
import tiny_kernels

def warm():
    with Path(os.environ["WARMED"]).open("a") as log:
        for word in ("begin", "end"):
            log.write(f"{word}\\n")
            log.flush()
            time.sleep(0.3)
"""


@pytest.mark.parametrize("cached", [True, False])
def test_processes_compile_one_after_the_other_where_kernels_are_kept(tmp_path: Path, cached: bool) -> None:
    (tmp_path / "tiny_kernels.py").write_text(
        f"import numba\n\n@numba.njit(cache={cached})\ndef same(x):\n    return x\n"
    )
    (tmp_path / "tiny_warm.py").write_text(WARM)
    (tmp_path / "kernels.txt").write_text("tiny_kernels:same (int64,)\n")
    log, place = tmp_path / "log", tmp_path / "place"
    place.mkdir()
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]), "WARMED": str(log),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }  # fmt: skip
    command = [sys.executable, "-m", "kiteline_hw.system.kernel_compilation", "tiny_warm"]
    both = [subprocess.Popen(command, env=environment, cwd=place) for _ in range(2 if cached else 1)]
    assert [one.wait(60) for one in both] == [0] * len(both)
    assert log.read_text().split() == ["begin", "end"] * len(both)
    assert not list(place.iterdir())


@pytest.mark.parametrize(
    ("cores", "free_mib", "expected"),
    [(1, 8000, 1), (2, 8000, 2), (8, 8000, 3), (4, 350, 1), (4, 700, 2), (4, 1500, 3)],
)
def test_processes_are_as_many_as_cores_and_memory_allow(cores: int, free_mib: int, expected: int) -> None:
    assert processes(cores, Computer(0, (), 8192 - free_mib, 8192, None)) == expected
    assert processes(cores, Computer(0, (), None, None, None)) == 1


def test_lines_of_a_module_stay_together() -> None:
    lines = ["b:f (int64,)", "a:f (int64,)", "b:g (int64,)"]
    assert by_module(lines) == [["b:f (int64,)", "b:g (int64,)"], ["a:f (int64,)"]]
