"""The occupancy grid: what `kiteline bench grid` measures, part by part."""

from __future__ import annotations

from kiteline_bench.grid import accuracy
from kiteline_bench.harness.bars import Run

PARTS: dict[str, tuple[str, Run]] = {
    "accuracy": ("Grid: precision and recall against true occupancy", accuracy.run),
}
