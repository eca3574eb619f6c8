"""`kiteline bench scale`: a base of any size."""

from kiteline_bench.harness.bars import Run
from kiteline_bench.scale import agents, growth, sizes

PARTS: dict[str, tuple[str, Run]] = {
    "agents": ("Scale: 50 agents", agents.run),
    "map": ("Scale: a map of 20,000 keyframes", sizes.run_map),
    "growth": ("Scale: steps in maps of growing size", growth.run),
    "day": ("Scale: a day of flights", sizes.run_day),
}
