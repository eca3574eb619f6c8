"""Rigs of many kinds along one recorded path through a room: sizes, lenses, baselines, rates, depth cameras.

Their calibration is true: of a tenth of a pixel that it is off by otherwise, a short baseline makes per cents of depth.
"""

import os
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Item, Recording, items_of
from kiteline_bench.harness.run import fly_alone
from kiteline_core.arrays import F64
from kiteline_hw.sim.source import open_sim

SEED, START_S, SECONDS = 4, 20.0, 8.0
_MOST_M = 0.004  # ATE of any of them: half a pixel at 3 m, and four times the error of the usual rig
_SHORT_M, _NEAR_M = 0.4, 4.0  # m: range of a depth camera
_DEPTH_NOISE, _HOLES = 0.0075, 0.2  # 1/m: 3 cm at 2 m, growing by the square; share of the image without depth
_SMALL = {"width": 320, "height": 240, "fov_deg": 79.0}
_KEYFRAMES_HZ = 5.0  # the usual rig makes 2.4 a second; a rule that never rests makes 10
_DEPTH = {"depth": True, "imu": False, "lens": "none"}
RIGS: dict[str, dict[str, Any]] = {
    "752x480, 11 cm, 20 Hz": {},
    "320x240": _SMALL,
    "848x480, 5 cm": {"width": 848, "fov_deg": 86.0, "lens": "none", "baseline": 0.05},
    "752x480, 3 cm": {"baseline": 0.03},
    "752x480, 54 cm": {"baseline": 0.54},
    "512x512, 154 degrees": {"width": 512, "height": 512, "lens": "equidistant", "fov_deg": 154.0},
    "512x512, 190 degrees": {"width": 512, "height": 512, "lens": "equidistant", "fov_deg": 190.0},
    "5 Hz": {"rate": 5.0},
    "60 Hz, 4 s": {"rate": 60.0, "seconds": 4.0},
    "IMU at 100 Hz": {"imu_rate": 100.0},
    "IMU at 1000 Hz": {"imu_rate": 1000.0},
    "RGB-D 640x480, 30 Hz": {**_DEPTH, "width": 640, "fov_deg": 69.0, "rate": 30.0},
    "RGB-D 640x480, 30 Hz, depth at 5 Hz": {**_DEPTH, "width": 640, "fov_deg": 69.0, "rate": 30.0, "depth_every": 6},
    "RGB-D 320x240, 15 Hz": {**_DEPTH, **_SMALL, "fov_deg": 60.0, "rate": 15.0},
}  # fmt: skip


def run(bench: Bench) -> list[Bar]:
    """Every frame is tracked, the error is at most 4 mm, and keyframes are few."""
    bars, rows = [], []
    for name, options in RIGS.items():
        flight = fly_alone(_recording(bench, options))
        lost, error_mm = flight.lost, 1000.0 * flight.ate_m("o")
        bars.append(at_most(f"{name}: frames without a pose", lost, 0, ""))
        bars.append(at_most(f"{name}: ATE, agent alone", error_mm, 1000.0 * _MOST_M, "mm", 1))
        made = sum(event.startswith("keyframe") for events in flight.events for event in events)
        made_hz = made / (flight.t_ns[-1] - flight.t_ns[0]) * 1e9
        bars.append(at_most(f"{name}: keyframes a second", made_hz, _KEYFRAMES_HZ, "Hz", 1))
        rows.append((name, error_mm, made_hz, lost))
        bench.say(f"{name}: {error_mm:.1f} mm, {made_hz:.1f} keyframes a second, without a pose {lost}")
    table(bench, "ATE in mm", ("rig", "ATE", "keyframes a second", "frames without a pose"), rows)
    return bars


def _recording(bench: Bench, options: dict[str, Any]) -> Recording:
    path = bench.source("trajectories/V1_02_medium.txt")
    options = dict(options)
    every = int(options.pop("depth_every", 1))
    flight = {"seed": SEED, "seconds": SECONDS, "trajectory": path, "start": START_S, "miscalibration": 0.0, **options}
    source = open_sim("room", os.cpu_count() or 1, **flight)
    items = (measured_depth(item, k) if k % every == 0 else _without(item) for k, item in enumerate(items_of(source)))
    return Recording(source.rig, source.imu, tuple(items))


def _without(item: Item) -> Item:
    """The item without depth, as colour images are whose depth camera is slower."""
    return replace(item, frame=replace(item.frame, depth_m=None))


def measured_depth(item: Item, number: int) -> Item:
    """The item with the depth of a real camera: noise, a near and a far end, holes, millimetres."""
    true = item.frame.depth_m
    if true is None:
        return item
    rng = np.random.default_rng([number, 31])
    depth: F64 = true + _DEPTH_NOISE * true.astype(np.float64) ** 2 * rng.standard_normal(true.shape)
    coarse = rng.random((true.shape[0] // 16, true.shape[1] // 16))
    smooth = cv2.resize(coarse, (true.shape[1], true.shape[0]))
    hole = smooth < np.quantile(smooth, _HOLES)
    depth = np.where(hole | (depth < _SHORT_M) | (depth > _NEAR_M), 0.0, np.round(1000.0 * depth) / 1000.0)
    return replace(item, frame=replace(item.frame, depth_m=depth.astype(np.float32)))
