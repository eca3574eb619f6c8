"""What the base knows of a rig: it ends with the calibration, and a worn rig's offset outlives a good one's."""

from dataclasses import replace

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import StereoAlignment
from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId

AGENT = AgentId(2)
CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 376.0, 240.0, 0.11, True, np.eye(4))
WORN, GOOD = np.array([-0.6, 0.1, -0.3, -0.5, 0.3]), np.array([0.05, 0.0, 0.02, 0.0, 0.0])


def told(sparse_map: SparseMap, offset: F64, sigma_px: float | None = None, *, good: bool = False) -> None:
    sparse_map.set_stereo_alignment(StereoAlignment(AGENT, np.full(5, 0.3), True, offset, sigma_px, good))


def begun() -> SparseMap:
    sparse_map = SparseMap()
    sparse_map.set_camera(AGENT, CAMERA)
    return sparse_map


def known(sparse_map: SparseMap) -> list[bool]:
    m = sparse_map
    return [AGENT in of for of in (m.rows_px, m.rows_read, m.known_offset_px, m.good_offset_px, m.onboard_sigma_px,
                                   m.disparity_sigma_px, m.disparity_calibrated)]  # fmt: skip


def test_nothing_of_a_rig_outlives_its_calibration() -> None:
    worn, good = begun(), begun()
    told(worn, WORN, 0.05)
    told(good, GOOD, good=True)
    for sparse_map in (worn, good):
        sparse_map.disparity_calibrated.add(AGENT)
        before = known(sparse_map)
        sparse_map.set_camera(AGENT, CAMERA)  # told once more
        assert known(sparse_map) == before and sparse_map.disparity_offset_px[AGENT].any()
        sparse_map.set_camera(AGENT, replace(CAMERA, fx=431.0))
        assert not any(known(sparse_map)) and not sparse_map.disparity_offset_px[AGENT].any()


def test_a_good_calibration_s_offset_replaces_a_worn_rig_s_only_after_a_repair() -> None:
    sparse_map = begun()
    told(sparse_map, WORN, 0.05)
    told(sparse_map, WORN + 0.2, good=True)  # it is the same rig
    assert np.array_equal(sparse_map.disparity_offset_px[AGENT], WORN)
    assert AGENT in sparse_map.onboard_sigma_px and not sparse_map.is_good_offset(AGENT)
    told(sparse_map, GOOD, good=True)
    assert np.array_equal(sparse_map.disparity_offset_px[AGENT], GOOD)
    assert AGENT not in sparse_map.onboard_sigma_px and sparse_map.is_good_offset(AGENT)
