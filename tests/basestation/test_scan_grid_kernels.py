"""Kernels of the grid against plain references."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kiteline_basestation.grid import scan_kernels as kernels


def reference(
    x: float, y: float, first: float, step: float, ranges: NDArray[np.float64], bands: NDArray[np.uint8], size: int
) -> NDArray[np.int64]:
    """Cells (size, size) with the bands of obstacles, sampled densely on the surface in each column. ranges: (n,3)."""
    out = np.zeros((size, size), np.int64)
    for i, (lower, middle, upper) in enumerate(ranges):
        deep = abs(middle - lower) + abs(upper - middle)
        n = max(1, int(np.ceil(2.0 * (max(lower, middle, upper) * step + deep))))
        part = (np.arange(n) + 0.5) / n
        at = np.interp(part, [0.0, 0.5, 1.0], [lower, middle, upper])
        for a, r in zip(first + (i + part) * step, at, strict=True):
            out[int(np.floor(y + r * np.sin(a))), int(np.floor(x + r * np.cos(a)))] |= int(bands[i])
    return out


@given(st.integers(0, 2**31))
def test_hits_are_marked_as_in_the_reference_and_leave_no_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(2, 80, (30, 1)) * (1.0 + rng.uniform(-0.1, 0.1, (30, 3)))
    bands = rng.integers(1, 8, 30).astype(np.uint8)
    weight = rng.integers(1, 9, 30)
    first, step = float(rng.uniform(-4, 4)), 0.03
    hits, cells = np.zeros((192, 192), np.uint16), np.zeros((4000, 2), np.int32)
    found = kernels.mark_hits(96.25, 95.5, first, step, ranges, bands, weight, hits, cells)
    assert np.array_equal(hits & 255, reference(96.25, 95.5, first, step, ranges, bands, 192))
    assert found == np.count_nonzero(hits)
    slots, pool = np.full((3, 3), -1, np.int32), np.zeros((9, 4, 64, 64), np.int16)
    touched, used = np.zeros((3, 3), np.uint8), np.zeros(1, np.int64)
    for sign in (1, -1):
        kernels.draw_hits(hits, cells, found, sign, slots, np.arange(9, dtype=np.int32), used, pool, touched)
        if sign == 1:
            whole = np.zeros((3, 192, 192), np.int64)
            for r, c in np.argwhere(slots >= 0):
                whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]][1:]
            for b in range(3):
                assert np.array_equal(whole[b], np.where(hits >> b & 1, hits >> 8, 0))
    assert not pool.any()
    kernels.clear_hits(hits, cells, found)
    assert not hits.any()


def freed(
    x: float, y: float, first: float, step: float, columns: dict[str, NDArray[np.float64]], camera_band: int,
    weights: tuple[int, int, int], hits: NDArray[np.uint16],
) -> NDArray[np.int64]:  # fmt: skip
    """What `draw_free` takes from the planes (4,rows,columns): each cell asked for its column and its range."""
    rows, cells = np.indices(hits.shape)
    dx, dy = cells + 0.5 - x, rows + 0.5 - y
    distance, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    n = len(columns["begin"])
    place = np.mod(angle - first, 2.0 * np.pi) / step
    i = np.minimum(place.astype(int), n - 1)
    end = columns["end"][i]
    left = np.cos(first + i * step) * dy - np.sin(first + i * step) * dx
    right = np.sin(first + (i + 1) * step) * dx - np.cos(first + (i + 1) * step) * dy
    part = left / (left + right)
    surface = np.where(
        part < 0.5, end[..., 0] + 2.0 * part * (end[..., 1] - end[..., 0]),
        end[..., 1] + (2.0 * part - 1.0) * (end[..., 2] - end[..., 1]),
    )  # fmt: skip
    least, most = np.maximum(end.min(-1), 0.0), np.maximum(end.max(-1), 0.0)
    begun = distance >= columns["begin"][i]
    whole = begun & ((distance <= least) | ((distance <= most) & (distance <= surface)))
    below = begun & ~whole & (distance <= columns["low"][i])
    bands = np.where(whole, 7, np.where(below, columns["under"][i].astype(int), 0))
    ground = bands > 0
    if camera_band >= 0:
        bands |= np.where(distance <= columns["clear"][i], 1 << camera_band, 0)
    bands = np.where(place < n, bands & ~hits.astype(int), 0)
    seen = columns["start"][i] <= distance
    sure = distance <= np.maximum(columns["sure"][i], columns["start"][i])
    value = np.where(sure & (seen | ~ground), weights[1], weights[2])
    value = np.where(seen & (distance <= columns["near"][i]), weights[0], value)
    out = np.zeros((4, *hits.shape), np.int64)
    out[0] = np.where(bands == 7, value, 0)
    for b in range(3):
        out[1 + b] = np.where((bands != 7) & (bands >> b & 1 > 0), value, 0)
    return out


@given(st.integers(0, 2**31))
def test_free_space_is_drawn_as_in_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, step, first = 20, float(rng.uniform(0.02, 0.12)), float(rng.uniform(-7.0, 7.0))
    (x, y), camera_band = rng.uniform(20.0, 170.0, 2).tolist(), int(rng.integers(-1, 3))
    ends = rng.uniform(-10.0, 90.0, (n, 1)) * (1.0 + rng.uniform(-0.1, 0.1, (n, 3)))
    ends[rng.random(n) < 0.2] = 0.0
    start = rng.uniform(0.0, 40.0, n)
    columns = {
        "begin": start * rng.uniform(0.6, 1.0, n), "start": start, "end": ends, "low": rng.uniform(0.0, 90.0, n),
        "under": rng.integers(0, 2, n).astype(np.uint8), "clear": rng.uniform(-1.0, 100.0, n),
        "sure": rng.uniform(0.0, 80.0, n), "near": rng.uniform(10.0, 60.0, n) * (rng.random(n) < 0.9),
    }  # fmt: skip
    hits = np.where(rng.random((192, 192)) < 0.02, rng.integers(1, 8, (192, 192)), 0).astype(np.uint16)
    slots, pool = np.full((3, 3), -1, np.int32), np.zeros((9, 4, 64, 64), np.int16)
    touched, used = np.zeros((3, 3), np.uint8), np.zeros(1, np.int64)
    kernels.draw_free(
        x, y, first, step, columns["begin"], columns["start"], ends, columns["low"], columns["under"],
        columns["clear"], camera_band, columns["near"], columns["sure"], (3, 2, 1), hits, 1, slots,
        np.arange(9, dtype=np.int32), used, pool, touched,
    )  # fmt: skip
    whole = np.zeros((4, 192, 192), np.int64)
    for r, c in np.argwhere(slots >= 0):
        whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]]
    wanted = freed(x, y, first, step, columns, camera_band, (3, 2, 1), hits)
    assert np.array_equal(-whole, wanted)
    assert np.array_equal(touched > 0, wanted.any(0).reshape(3, 64, 3, 64).any((1, 3)))


def test_a_surface_that_juts_out_within_a_column_has_no_gaps() -> None:
    """Its edges are equally far: the samples follow the way there and back."""
    hits, cells = np.zeros((192, 192), np.uint16), np.zeros((400, 2), np.int32)
    ranges, bands = np.array([[70.0, 80.0, 70.0]]), np.full(1, 7, np.uint8)
    found = kernels.mark_hits(20.0, 20.0, 0.7, 0.03, ranges, bands, np.full(1, 8), hits, cells)
    marked = cells[:found]
    for part in np.linspace(0.02, 0.98, 200):
        reach, angle = np.interp(part, [0.0, 0.5, 1.0], ranges[0]), 0.7 + part * 0.03
        place = np.floor([20.0 + reach * np.sin(angle), 20.0 + reach * np.cos(angle)])
        assert np.abs(marked - place).max(1).min() <= 1


@given(st.integers(0, 2**31), st.booleans())
def test_states_are_read_as_in_the_reference(seed: int, opening: bool) -> None:
    rng = np.random.default_rng(seed)
    pool = np.repeat(rng.integers(-5, 9, (4, 1, 16, 16)), 4, 1).repeat(4, 2).repeat(4, 3).astype(np.int16)
    pool[:, 2:] = 0
    pool[:, rng.integers(4)] += rng.integers(-1, 2, (4, 64, 64)).astype(np.int16)
    slots = np.array([[-1, 1, -1], [2, 0, -1], [-1, -1, 3]], np.int32)
    whole = np.zeros((3, 192, 192), np.int64)
    for r, c in np.argwhere(slots >= 0):
        whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]][:1] + pool[slots[r, c]][1:]
    mask = sum((whole[b] >= 6).astype(int) << b for b in range(3))
    free = (whole <= -2).all(axis=0)
    shifts = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]
    beside = np.any([np.roll(mask > 0, s, (0, 1)) for s in shifts], axis=0)
    free &= ~beside | (whole <= -4).all(axis=0)
    around = [s for s in shifts if s != (0, 0)]
    neighbours = np.sum([np.roll(free, s, (0, 1)) for s in around], axis=0)
    free |= (mask == 0) & (whole <= 0).all(axis=0) & ~beside & (neighbours >= 6)
    if opening:
        eroded = np.all([np.roll(free, s, (0, 1)) for s in shifts], axis=0)
        free &= np.any([np.roll(eroded, s, (0, 1)) for s in shifts], axis=0)
    expected = np.where(mask > 0, mask, np.where(free, 0, -1))[64:128, 64:128]
    cells = np.empty((64, 64), np.int8)
    known = kernels.read_states(slots, pool, kernels.ALL, 6, 2, 4, 6, int(opening), cells)
    assert np.array_equal(cells, expected)
    assert known == np.count_nonzero(expected >= 0)
