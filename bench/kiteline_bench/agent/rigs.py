"""Rigs of many kinds along one recorded path through a room: sizes, lenses, baselines, rates, depth cameras.

Their calibration is true: of a tenth of a pixel that it is off by otherwise, a short baseline makes per cents of depth.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Item, Recording, items_of
from kiteline_bench.harness.run import fly_alone
from kiteline_hw.sim.source import open_sim

SEED, START_S, SECONDS = 4, 20.0, 8.0
_TIMES, _LEAST_M = 2.0, 0.004  # times the error of the usual rig, or m, whichever is larger: half a pixel at 3 m
_SHORT_M, _NEAR_M = 0.4, 4.0  # m: range of a depth camera
_DEPTH_NOISE, _HOLES = 0.0075, 0.2  # 1/m: 3 cm at 2 m, growing by the square; share of the image without depth
_SMALL = {"width": 320, "height": 240, "fov_deg": 79.0}
_DEPTH = {"depth": True, "imu": False, "lens": "none"}
# Name: options, and times the error of the usual rig with the reason where it is more than twice.
RIGS: dict[str, tuple[dict[str, Any], float, str]] = {
    "320x240": (_SMALL, _TIMES, ""),
    "848x480, 5 cm": ({"width": 848, "fov_deg": 86.0, "lens": "none", "baseline": 0.05}, _TIMES, ""),
    "752x480, 3 cm": ({"baseline": 0.03}, 4.0, "a quarter of the usual baseline"),
    "752x480, 54 cm": ({"baseline": 0.54}, _TIMES, ""),
    "512x512, 154 degrees": ({"width": 512, "height": 512, "lens": "equidistant", "fov_deg": 154.0}, _TIMES, ""),
    "512x512, 190 degrees": ({"width": 512, "height": 512, "lens": "equidistant", "fov_deg": 190.0}, 3.0,
                             "a third of the usual pixels a degree once rectified"),
    "5 Hz": ({"rate": 5.0}, _TIMES, ""),
    "60 Hz, 4 s": ({"rate": 60.0, "seconds": 4.0}, _TIMES, ""),
    "IMU at 100 Hz": ({"imu_rate": 100.0}, _TIMES, ""),
    "IMU at 1000 Hz": ({"imu_rate": 1000.0}, _TIMES, ""),
    "RGB-D 640x480, 30 Hz": ({**_DEPTH, "width": 640, "fov_deg": 69.0, "rate": 30.0}, _TIMES, ""),
    "RGB-D 320x240, 15 Hz": ({**_DEPTH, **_SMALL, "fov_deg": 60.0, "rate": 15.0}, _TIMES, ""),
}  # fmt: skip


def run(bench: Bench) -> list[Bar]:
    """Every frame is tracked; the error is at most 4 mm, or a multiple of the usual rig's, whichever is more."""
    usual_m = fly_alone(_recording(bench, {})).ate_m("o")
    bars, rows = [], [("752x480, 11 cm, 20 Hz", 1000.0 * usual_m, 0, "")]
    for name, (options, times, why) in RIGS.items():
        flight = fly_alone(_recording(bench, options))
        lost, error_m = flight.lost, flight.ate_m("o")
        bars.append(at_most(f"{name}: frames without a pose", lost, 0, ""))
        limit_m = max(times * usual_m, _LEAST_M)
        bars.append(at_most(f"{name}: ATE, agent alone", 1000.0 * error_m, 1000.0 * limit_m, "mm", 1))
        rows.append((name, 1000.0 * error_m, lost, why))
        bench.say(f"{name}: {1000.0 * error_m:.1f} mm, without a pose {lost}")
    table(bench, "ATE in mm", ("rig", "ATE", "frames without a pose", "why it may err more"), rows)
    return bars


def _recording(bench: Bench, options: dict[str, Any]) -> Recording:
    path = bench.source("trajectories/V1_02_medium.txt")
    flight = {"seed": SEED, "seconds": SECONDS, "trajectory": path, "start": START_S, "miscalibration": 0.0, **options}
    source = open_sim("room", os.cpu_count() or 1, **flight)
    items = tuple(_measured_depth(item, k) for k, item in enumerate(items_of(source)))
    return Recording(source.rig, source.imu, items)


def _measured_depth(item: Item, number: int) -> Item:
    """The item with the depth of a real camera: noise, a near and a far end, holes, millimetres."""
    true = item.frame.depth_m
    if true is None:
        return item
    rng = np.random.default_rng([number, 31])
    depth: NDArray[np.float64] = true + _DEPTH_NOISE * true.astype(np.float64) ** 2 * rng.standard_normal(true.shape)
    coarse = rng.random((true.shape[0] // 16, true.shape[1] // 16))
    smooth = cv2.resize(coarse, (true.shape[1], true.shape[0]))
    hole = smooth < np.quantile(smooth, _HOLES)
    depth = np.where(hole | (depth < _SHORT_M) | (depth > _NEAR_M), 0.0, np.round(1000.0 * depth) / 1000.0)
    return replace(item, frame=replace(item.frame, depth_m=depth.astype(np.float32)))
