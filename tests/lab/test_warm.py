"""No kernel is compiled in flight: `warm` has run each one on the types that flights use."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FLIGHT = """
import json, sys
from kiteline_agent.runtime.warm import warm
from kiteline_codec import warm as codec_warm
from kiteline_lab.flights.fly import main

def compiled():
    kernels = {}
    for name, module in list(sys.modules.items()):
        if name.endswith("_kernels") and name.startswith(("kiteline_core", "kiteline_codec", "kiteline_agent")):
            for kernel, function in vars(module).items():
                if getattr(function, "signatures", None):
                    kernels[f"{name}.{kernel}"] = [str(one) for one in function.signatures]
    return kernels

codec_warm.warm()
warm()
before = compiled()
main(sys.argv[1:])
print(json.dumps([before, compiled()]))
"""


@pytest.mark.parametrize("options", [[], ["--mono", "--no-imu"]], ids=["stereo", "monocular"])
def test_a_flight_compiles_nothing(recording: Path, tmp_path: Path, options: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, str(recording), *options, "--mode", "tracker", "--out", str(tmp_path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    before, after = json.loads(done.stdout.splitlines()[-1])
    assert sum(map(len, before.values())) > 50
    assert after == before
