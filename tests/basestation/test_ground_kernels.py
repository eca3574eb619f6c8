"""The kernel of the ground's height against a plain Python reference."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kiteline_basestation.grid import ground_kernels as kernels

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


def ground_reference(count: F64, seed: int, seed_bin: int, reach: int, share: float, least: float) -> I64:
    rows, columns, bins = count.shape
    ground = {(seed // columns, seed % columns): seed_bin}
    queue = list(ground)
    while queue:
        r, c = queue.pop(0)
        for place in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
            if place in ground or not (0 <= place[0] < rows and 0 <= place[1] < columns):
                continue
            window = range(max(0, ground[r, c] - reach), min(bins - 1, ground[r, c] + reach) + 1)
            h = count[place]
            need = max(share * max(h[b] for b in window), least)
            peaks = [b for b in window if h[b] >= need and (b == window[-1] or h[b] >= h[b + 1])]
            ground[place] = peaks[0] if peaks else ground[r, c]
            queue.append(place)
    return np.array([[ground[r, c] for c in range(columns)] for r in range(rows)])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_ground_spreads_as_in_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 9, (rng.integers(1, 5), rng.integers(1, 5), 20)).astype(np.float32)
    start, start_bin, reach = int(rng.integers(count.shape[0] * count.shape[1])), int(rng.integers(20)), 3
    ground = np.zeros(count.shape[:2], np.int32)
    kernels.spread_ground(count, start, start_bin, reach, 0.25, 4.0, ground, np.zeros(ground.size, np.int32))
    assert np.array_equal(ground, ground_reference(count.astype(float), start, start_bin, reach, 0.25, 4.0))
