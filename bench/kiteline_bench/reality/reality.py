"""The bars of real and worn recordings."""

from __future__ import annotations

from kiteline_bench.reality import cpu, euroc

PARTS = {
    "euroc": ("Reality: one eye and a real IMU", euroc.run),
    "cpu": ("Reality: CPU over a yardstick", cpu.run),
}
