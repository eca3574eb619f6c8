"""Grid kernels against plain Python references."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import grid_kernels as kernels
from kiteline_basestation.grid.grid import percent

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


def line(c0: int, r0: int, c1: int, r1: int) -> list[tuple[int, int]]:
    """The cells of a line, by rounding on an integer lattice: the textbook definition of Bresenham's line."""
    out = [(c0, r0)]
    c, r, error = c0, r0, abs(c1 - c0) - abs(r1 - r0)
    while (c, r) != (c1, r1):
        twice = 2 * error
        if twice > -abs(r1 - r0):
            error -= abs(r1 - r0)
            c += int(np.sign(c1 - c0))
        if twice < abs(c1 - c0):
            error += abs(c1 - c0)
            r += int(np.sign(r1 - r0))
        out.append((c, r))
    return out


def spread(pool: NDArray[np.generic], slots: NDArray[np.int32], fill: float) -> F64:
    """The pool's tiles laid out as one array."""
    out = np.full((slots.shape[0] * 64, slots.shape[1] * 64), fill)
    for r, c in np.argwhere(slots >= 0):
        out[r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]]
    return out


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_points_and_rays_as_counted_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, n, m = 192, 12, 30
    ends = rng.integers(0, size, (m, 2))
    start = rng.integers(0, size, (m, 2))
    z = rng.uniform(0, 2, (m, 2))
    ceiling = rng.uniform(0.5, 2.5, m)
    short = rng.integers(0, 2, m)
    at = rng.integers(0, size, (n, 2))
    at[: n // 2] = ends[: n // 2]
    height, weight = rng.uniform(0, 2, n), rng.integers(1, 5, n)

    hits, free, through = (np.zeros((size, size)) for _ in range(3))
    low, high = np.full((size, size), np.inf), np.full((size, size), -np.inf)
    for (c, r), h, w in zip(at, height, weight, strict=True):
        hits[r, c] += w
        low[r, c], high[r, c] = min(low[r, c], np.float32(h)), max(high[r, c], np.float32(h))
    for i in range(m):
        cells = line(*map(int, start[i]), *map(int, ends[i]))
        for k, (c, r) in enumerate(cells[: len(cells) - int(short[i])]):
            h = z[i, 0] + ((z[i, 1] - z[i, 0]) / (len(cells) - 1) if len(cells) > 1 else 0.0) * k
            if h < ceiling[i]:
                free[r, c] += 1
            through[r, c] += low[r, c] - 0.05 < h < high[r, c] + 0.05

    slots = np.full((3, 3), -1, np.int32)
    pool = [np.zeros((2 + n, 64, 64), np.uint16) for _ in range(3)]
    lows = np.full((2 + n, 64, 64), np.inf, np.float32)
    highs = np.full((2 + n, 64, 64), -np.inf, np.float32)
    used = kernels.mark_points(at[:, 0], at[:, 1], height, weight, slots, 0, pool[0], lows, highs)
    assert used == len(np.unique(at // 64, axis=0))
    done, rounds = 0, 0
    while done < m:
        done, used = kernels.cast_rays(
            start, ends, z, ceiling, short, done, slots, used, 0.05, pool[1], pool[2], lows, highs
        )
        pool = [np.concatenate([p, np.zeros((4, 64, 64), np.uint16)]) for p in pool]
        lows = np.concatenate([lows, np.full((4, 64, 64), np.inf, np.float32)])
        highs = np.concatenate([highs, np.full((4, 64, 64), -np.inf, np.float32)])
        rounds += 1
        assert rounds < 20
    assert used == np.count_nonzero(slots >= 0)
    assert np.array_equal(spread(pool[0], slots, 0), hits)
    assert np.array_equal(spread(pool[1], slots, 0), free)
    assert np.array_equal(spread(pool[2], slots, 0), through)
    assert np.array_equal(spread(lows, slots, np.inf), low)


def test_counts_stop_at_sixteen_bits() -> None:
    slots = np.full((1, 1), -1, np.int32)
    hits, free, through = (np.zeros((8, 64, 64), np.uint16) for _ in range(3))
    low, high = np.full((8, 64, 64), np.inf, np.float32), np.full((8, 64, 64), -np.inf, np.float32)
    one = np.zeros(1, np.int64)
    for _ in range(3):
        kernels.mark_points(one, one, np.zeros(1), np.array([40000]), slots, 0, hits, low, high)
    assert hits[0, 0, 0] == 65535
    n = 70000
    here = np.zeros((n, 2), np.int64)
    kernels.cast_rays(
        here, here, np.zeros((n, 2)), np.ones(n), np.zeros(n, np.int64), 0, slots, 1, 0.05, free, through, low, high
    )
    assert free[0, 0, 0] == 65535 and through[0, 0, 0] == 65535


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


@given(st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 65535))
def test_percent_is_bounded_and_moves_the_right_way(hits: int, free: int, through: int) -> None:
    config = GridConfig()

    def of(h: int, f: int, t: int) -> int:
        return int(percent(config, *(np.full((1, 1, 1), min(v, 65535), np.uint16) for v in (h, f, t)))[0, 0, 0])

    value = of(hits, free, through)
    if hits == 0 and free == 0:
        assert value == -1
    else:
        assert 0 <= value <= 100
        assert of(hits + 1, free, through) >= value
        assert of(hits, free, through + 1) <= value
    assert of(0, 1, 0) <= 35 and of(2, 0, 0) >= 65
