"""The build of an older revision, run beside today's."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kiteline_bench.harness.bars import Bench
from kiteline_bench.system.structure import ROOMS, ROOT
from kiteline_hw.ports import SourceError

REVISION = "384637ec35adaf05e73532fa9ac33b0a977b2137"  # before the rooms were cut into sub-packages
_TIMEOUT_S = 900.0
_ATTEMPTS = 10  # to fly while kernels are compiled


@dataclass(frozen=True, slots=True)
class Build:
    """Sources of one revision, run by this interpreter. cache: of its compiled kernels."""

    root: Path
    cache: Path

    def run(self, arguments: Sequence[str]) -> None:
        """Run `python ARGUMENTS` on these sources. Raises RuntimeError with the end of its stderr."""
        rooms = os.pathsep.join(str(self.root / room) for room in ROOMS if (self.root / room).is_dir())
        environment = {**os.environ, "PYTHONPATH": rooms, "NUMBA_CACHE_DIR": str(self.cache), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *arguments], check=False, env=environment, capture_output=True, text=True,
            timeout=_TIMEOUT_S, cwd=self.root,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{' '.join(arguments[:4])}: {done.stderr[-300:]}")

    def warm(self, source: str, out: Path) -> None:
        """Compile all kernels, then fly until a flight succeeds: the older build gives up while its base compiles.

        Raises RuntimeError if none does.
        """
        with contextlib.suppress(RuntimeError):  # doctor also judges the machine
            self.run(["-m", "kiteline_cli", "doctor", "--warm"])
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(RuntimeError):  # what was compiled is kept
                self.fly([source], out)
                return
        self.fly([source], out)

    def fly(self, sources: Sequence[str], out: Path, *options: str) -> dict[str, Any]:
        """Fly as `kiteline fly` does; the report. Raises RuntimeError."""
        self.run(["-m", "kiteline_cli", "fly", *sources, "--out", str(out), *options])
        report: dict[str, Any] = json.loads((out / "report.json").read_text())
        return report


def todays_build(bench: Bench) -> Build:
    """These sources, with a cache of their own."""
    return Build(ROOT, bench.folder.resolve() / "today-cache")


def older_build(bench: Bench) -> Build:
    """The sources of REVISION, unpacked into the bench's folder. Raises SourceError without their history."""
    folder = bench.folder.resolve() / "older"
    if not folder.exists():
        bench.say(f"unpacking {REVISION[:8]}")
        archive = bench.folder.resolve() / "older.tar"
        command = ["git", "-C", str(ROOT), "archive", "-o", str(archive), REVISION]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            raise SourceError(f"{ROOT}: needs a checkout with the history of {REVISION[:8]}: {done.stderr.strip()}")
        folder.mkdir(parents=True)
        subprocess.run(["tar", "-xf", str(archive), "-C", str(folder)], check=True)
        archive.unlink()
    return Build(folder, bench.folder.resolve() / "older-cache")
