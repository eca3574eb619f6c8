"""The occupancy grid: what `kiteline bench grid` measures, part by part."""

from kiteline_bench.grid import accuracy, costs, maps, obstacles, robust, street
from kiteline_bench.harness.bars import Run

PARTS: dict[str, tuple[str, Run]] = {
    "maps": ("Grid: corrections, time and memory on the base", maps.run),
    "costs": ("Grid: CPU, bytes and memory on the agent", costs.run),
    "street": ("Grid: a real street", street.run),
    "obstacles": ("Grid: distances to obstacles in simulated flights", obstacles.run),
    "robust": ("Grid: scans that see badly", robust.run),
    "accuracy": ("Grid: precision and recall against true occupancy", accuracy.run),
}
