"""Columns of scans as decisions: what is written is read, and any bytes are refused or read."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kiteline_codec.coding.scan_kernels import BANDS, FREE, FREE_FROM, MAX_CODE, OBSTACLE, code_scan

MOST = 895


def some_columns(seed: int, n: int, smooth: int) -> NDArray[np.int64]:
    """Rows (5,n): ranges that walk by up to `smooth`, none in places, and masks that hold for a while."""
    rng = np.random.default_rng(seed)
    walk = np.clip(np.cumsum(rng.integers(-smooth, smooth + 1, (4, n)), 1) + rng.integers(1, MOST, (4, 1)), 1, MOST)
    walk[FREE_FROM] = np.clip(walk[FREE_FROM], 0, 447)
    out = np.vstack([walk * (rng.random((4, n)) < 0.8), np.repeat(rng.integers(0, 256, n // 4 + 1), 4)[:n]])
    out[OBSTACLE] = np.where(out[BANDS] > 0, walk[OBSTACLE], 0)
    out[FREE] = np.where((rng.random(n) < 0.5) & (out[OBSTACLE] > 0), out[OBSTACLE], out[FREE])
    out[FREE_FROM] *= out[FREE] > 0
    return out.astype(np.int64)


@given(st.integers(0, 1 << 30), st.integers(1, 128), st.sampled_from([0, 1, 3, 20, 900]), st.integers(0, 200))
def test_what_is_written_is_read(seed: int, n: int, smooth: int, m: int) -> None:
    columns, labels = some_columns(seed, n, smooth), np.random.default_rng(seed).integers(0, 3, m).astype(np.uint8)
    data = np.zeros(MAX_CODE, np.uint8)
    size = code_scan(columns.copy(), labels.copy(), MOST, False, data)
    read, read_labels = np.full((5, n), -7, np.int64), np.full(m, 9, np.uint8)
    assert code_scan(read, read_labels, MOST, True, data[:size].copy()) == 0
    assert np.array_equal(read, columns)
    assert np.array_equal(read_labels, labels)


@given(st.binary(max_size=400), st.integers(1, 128), st.integers(0, 300))
def test_any_bytes_are_refused_or_numbers_in_range(raw: bytes, n: int, m: int) -> None:
    columns, labels = np.zeros((5, n), np.int64), np.zeros(m, np.uint8)
    found = code_scan(columns, labels, MOST, True, np.frombuffer(bytearray(raw), np.uint8))
    assert found == -1 or (columns.min() >= 0 and columns[:4].max() <= MOST and columns[BANDS].max() <= 255)
    assert labels.max(initial=0) <= 2


def test_the_worst_scan_fits() -> None:
    """Ranges that jump from end to end, and masks and labels that always change."""
    n, m = 128, 2048
    jump = np.where(np.arange(n) % 2, 1, MOST)
    columns = np.stack([jump, jump[::-1], np.where(jump > 1, 447, 0), np.where(jump > 1, 1, 700), 1 + 254 * (jump > 1)])
    labels = (2 * np.arange(m) % 3).astype(np.uint8)
    data = np.zeros(MAX_CODE, np.uint8)
    assert 0 < code_scan(columns.astype(np.int64), labels, MOST, False, data) < MAX_CODE // 4


def test_a_wall_costs_a_few_bits_a_column() -> None:
    azimuth = np.linspace(-0.7, 0.7, 64)
    wall = np.rint(128 * np.log2(2.0 / np.cos(azimuth) + 2.0)).astype(np.int64)
    columns = np.stack([wall, wall, np.full(64, 20), wall, np.full(64, 7)]).astype(np.int64)
    data = np.zeros(MAX_CODE, np.uint8)
    assert code_scan(columns, np.zeros(0, np.uint8), MOST, False, data) < 40
