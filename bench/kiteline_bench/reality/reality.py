"""The bars of real and worn recordings."""

from __future__ import annotations

from kiteline_bench.reality import cpu

PARTS = {
    "cpu": ("Reality: CPU over a yardstick", cpu.run),
}
