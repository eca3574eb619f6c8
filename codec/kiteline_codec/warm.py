"""Compiles all kernels of the codec before the first packet, by sharing three small keyframes."""

import numpy as np

from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import (
    CameraIntrinsics,
    GridTile,
    KeyframeHeader,
    KeyframeScan,
    NewLandmarks,
    Observations,
    RefinedLandmarks,
)
from kiteline_codec.schema.base.grid_tile import TILE_CELLS
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, AgentId, keyframe_id, submap_id

_TICK_NS = 50_000_000
_TICKS = 10  # enough for greetings, values and acknowledgements


def warm() -> None:
    """Run every kernel once, on the types that flights use."""
    n = 40
    first, second, third = (keyframe_id(submap_id(0, 0, 0), k) for k in range(3))
    index = np.arange(n, dtype=np.uint16)
    uv = np.linspace(20.0, 400.0, 2 * n, dtype=np.float32).reshape(n, 2)
    depth = np.linspace(0.1, 1.0, n, dtype=np.float32)
    zeros = np.zeros(n, np.uint8)
    landmark = (first << KEYPOINT_BITS) + np.arange(n, dtype=np.int64)
    camera = RectifiedCamera(752, 480, 450.0, 450.0, 376.0, 240.0, 0.1, True, np.eye(4))
    agent, base = coded_channel(1), coded_channel(1)
    agent.put(CameraIntrinsics(AgentId(0), camera))
    for tick in range(_TICKS):
        if tick == 2:
            agent.put(KeyframeHeader(first, 0, NO_KEYFRAME, np.eye(4), n))
            agent.put(NewLandmarks(first, 0, index, uv, depth, zeros, zeros, np.zeros((n, 32), np.uint8)))
        if tick == 4:
            agent.put(KeyframeHeader(second, _TICK_NS, first, np.eye(4), n))
            agent.put(NewLandmarks(second, 0, index, uv, depth, zeros, zeros, np.zeros((n, 32), np.uint8)))
            agent.put(Observations(second, 0, index + np.uint16(n), uv + 1.0, depth, zeros, landmark))
            base.put(GridTile(0, 0, 0, 0.05, np.full((TILE_CELLS, TILE_CELLS), 1, np.int8)))
            base.put(RefinedLandmarks(first, index, depth, np.zeros((n, 2), np.float32)))
        if tick == 6:  # landmarks of two keyframes
            both = np.where(np.arange(n) < n // 2, landmark, landmark + ((second - first) << KEYPOINT_BITS))
            ranges = np.full(4, 2.0)
            scan = ColumnScan(
                np.array([0.0, -1.0, 0.0]), 0.0, 0.1, ranges, ranges, ranges, zeros[:4] + np.uint8(7), ranges, 1.0
            )
            agent.put(KeyframeScan(second, scan, zeros))
            agent.put(KeyframeHeader(third, 2 * _TICK_NS, second, np.eye(4), n))
            agent.put(Observations(third, 0, index, uv + 1.0, depth, zeros, both))
        base.receive(agent.poll(tick * _TICK_NS), tick * _TICK_NS)
        agent.receive(base.poll(tick * _TICK_NS), tick * _TICK_NS)
