"""No kernel is compiled in flight: `warm` has run each one on the types that flights use, and the lists name them."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import kiteline_agent.runtime.warm as agent_warm
import kiteline_basestation.runtime.warm as base_warm
from kiteline_agent.config import AgentConfig
from kiteline_basestation.config import BaseConfig
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
after = []
for options in json.loads(sys.argv[2]):
    main([*sys.argv[1:2], *options, "--mode", "tracker", "--out", sys.argv[3] + str(len(after))])
    after.append(compiled())
print(json.dumps([before, after, lines + called(base)]))
"""


def test_flights_of_two_eyes_of_one_and_of_the_filter_compile_nothing(recording: Path, tmp_path: Path) -> None:
    options = json.dumps([[], ["--mono", "--no-imu"], ["--tracker", "ekf"]])
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, str(recording), options, str(tmp_path / "flight")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    before, after, lines = json.loads(done.stdout.splitlines()[-1])
    assert sum(map(len, before.values())) > 50
    assert after == [before, before, before]
    lists = {name: set(listed(importlib.import_module(name))) for name in WARMING}
    named = set().union(*lists.values())
    assert named == set(lines), "write the lists anew: make kernels"


def test_kernels_run_once_in_a_process_for_each_configuration() -> None:
    """A second flight in one process took half a second of CPU for them."""
    for warm, config in ((agent_warm.warm, AgentConfig(tracker="ekf")), (base_warm.warm, BaseConfig())):
        warm(config)
        before = warm.cache_info()
        warm(config)
        assert warm.cache_info() == before._replace(hits=before.hits + 1)
