"""Monocular maps with different units of length are not matched."""

import numpy as np
import pytest

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_verification import KeyframeObservations, same_unit
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, keyframe_id, submap_id


@pytest.mark.parametrize(
    ("unit", "known", "one"), [(1.0, 40, True), (1.08, 40, True), (1.4, 40, False), (0.6, 40, False), (0.6, 5, True)]
)
def test_same_unit_compares_depths_of_both_maps(unit: float, known: int, one: bool) -> None:
    random = np.random.default_rng(0)
    keyframe = keyframe_id(submap_id(0, 0, 0), 0)
    T_w_k = se3.exp(random.normal(0.0, 1.0, 6))
    sparse_map = SparseMap()
    sparse_map.add_keyframe(keyframe, 0, NO_KEYFRAME, T_w_k, 0)
    sparse_map.keyframes.T_w_k[sparse_map.rows[keyframe]] = T_w_k
    local = random.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 6.0], (50, 3))
    n, small = np.arange(50, dtype=np.int32), np.zeros(50, np.uint8)
    mine = KeyframeObservations(
        n, n, np.zeros((50, 2)), np.full(50, -1.0), small, small, np.zeros((50, 32), np.uint8),
        se3.transform(T_w_k, local), np.arange(50) < known,
    )  # fmt: skip
    depth = unit * local[:, 2] * random.uniform(0.97, 1.03, 50)
    assert same_unit(sparse_map, keyframe, mine, n, depth) == one
