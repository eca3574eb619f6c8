"""No kernel is compiled in flight: `warm` has run each one on the types that flights use, and the lists name them."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from kiteline_hw.system.kernel_compilation import listed
from kiteline_lab.tools.doctor import WARMING

FLIGHT = """
import json, sys
from kiteline_hw.system.kernel_compilation import called
from kiteline_lab.flights.fly import main
from kiteline_lab.tools.doctor import WARMING

def compiled():
    kernels = {}
    for name, module in list(sys.modules.items()):
        if name.endswith("_kernels") and name.startswith(("kiteline_core", "kiteline_codec", "kiteline_agent")):
            for kernel, function in vars(module).items():
                if getattr(function, "signatures", None):
                    kernels[f"{name}.{kernel}"] = [str(one) for one in function.signatures]
    return kernels

codec, agent, base = WARMING
lines = called(codec) + called(agent)
before = compiled()
main(sys.argv[1:])
print(json.dumps([before, compiled(), lines + called(base)]))
"""


@pytest.mark.parametrize("options", [[], ["--mono", "--no-imu"]], ids=["stereo", "monocular"])
def test_a_flight_compiles_nothing(recording: Path, tmp_path: Path, options: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, str(recording), *options, "--mode", "tracker", "--out", str(tmp_path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    before, after, lines = json.loads(done.stdout.splitlines()[-1])
    assert sum(map(len, before.values())) > 50
    assert after == before
    lists = {name: set(listed(importlib.import_module(name))) for name in WARMING}
    named = set().union(*lists.values())
    assert named == set(lines), "write the lists anew: make kernels"
