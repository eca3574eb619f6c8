"""Numbers, columns, ranges and scans as bytes."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.coding import packing_kernels
from kiteline_codec.coding.packing import Reader, Writer, unzigzag, varint_bytes, zigzag
from kiteline_codec.coding.scan_kernels import BANDS, FREE, FREE_FROM, MAX_CODE, OBSTACLE, code_scan
from kiteline_codec.schema import WireError
from kiteline_codec.sync import ranges
from kiteline_core.arrays import I64


@given(st.integers(0, (1 << 63) - 1), st.integers(-(1 << 62), 1 << 62))
def test_numbers(unsigned: int, signed: int) -> None:
    out = Writer()
    out.varint(unsigned)
    assert len(out) == varint_bytes(unsigned)
    out.signed(signed)
    source = Reader(out.bytes())
    assert source.varint() == unsigned
    assert source.signed(1 << 62) == signed
    source.end()
    assert unzigzag(zigzag(signed)) == signed


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "end within"),
        (b"\x80", "end within"),
        (b"\x80\x00", "shortest"),
        (b"\xff" * 10, "longer than 64"),
        (b"\x65", "at most 100"),
    ],
)
def test_bad_numbers(data: bytes, text: str) -> None:
    with pytest.raises(WireError, match=text):
        Reader(data).varint(100)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_floats_are_finite(bad: float) -> None:
    out = Writer()
    out.f64(bad)
    with pytest.raises(WireError, match="infinite"):
        Reader(out.bytes()).f64()


def read_columns_slowly(data: bytes, c: int, n: int) -> tuple[list[list[int]], int]:
    """SPEC.md, "Columns", word by word."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            b = data[at]
            at += 1
            value |= (b & 127) << shift
            shift += 7
            if b < 128:
                return value

    heads = []
    for _ in range(c):
        mode, width = data[at] >> 6, data[at] & 63
        at += 1
        first = unzigzag(varint())
        step = unzigzag(varint()) if mode else 0
        heads.append((mode, width, first, step))
    stream = int.from_bytes(data[at:], "little")
    total = 0
    columns = []
    for mode, width, first, step in heads:
        column = [first] if mode else []
        while len(column) < n:
            bits = stream & (1 << width) - 1
            stream >>= width
            total += width
            column.append(column[-1] + step + bits if mode else first + bits)
        columns.append(column)
    return columns, at + (total + 7) // 8


COLUMNS = st.integers(1, 40).flatmap(
    lambda n: st.lists(
        st.one_of(
            st.lists(st.integers(1 - (1 << 38), (1 << 38) - 1), min_size=n, max_size=n),
            st.lists(st.integers(0, 9), min_size=n, max_size=n),
            st.lists(st.integers(0, 1 << 20), min_size=n, max_size=n).map(sorted),
        ),
        min_size=1,
        max_size=6,
    )
)


@given(COLUMNS, st.binary(max_size=3))
def test_columns(columns: list[list[int]], after: bytes) -> None:
    values = np.array(columns, np.int64)
    out = Writer()
    out.u8(7)
    out.columns(values)
    end = len(out)
    out.raw(after)
    source = Reader(out.bytes(), 1)
    assert np.array_equal(source.columns(*values.shape), values)
    assert source.left == len(after)
    assert read_columns_slowly(out.bytes()[1:end], *values.shape) == (columns, end - 1)
    for cut in {1, end // 2, end - 1}:
        with pytest.raises(WireError, match="columns"):
            Reader(out.bytes()[:cut], 1).columns(*values.shape)


def test_sorted_columns_are_shorter_than_shuffled_ones() -> None:
    values = np.arange(0, 4000, 40, dtype=np.int64)
    straight, shuffled = Writer(), Writer()
    straight.columns(values[None])
    shuffled.columns(np.random.default_rng(0).permutation(values)[None])
    assert len(straight) == 3
    assert len(shuffled) >= 100 * 12 // 8


@given(st.binary(max_size=80), st.integers(1, 5), st.integers(1, 2048))
def test_any_bytes_are_columns_or_an_error(data: bytes, c: int, n: int) -> None:
    try:
        values = Reader(data).columns(c, n)
    except WireError:
        return
    assert values.shape == (c, n)
    assert np.abs(values).max() < 1 << 55


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 30), st.integers(0, 30)), max_size=20))
def test_ranges_are_sets(steps: list[tuple[bool, int, int]]) -> None:
    got = ranges.NONE
    expected: set[int] = set()
    for add, a, b in steps:
        got = ranges.add(got, a, b) if add else ranges.cut(got, a, b)
        expected = expected | set(range(a, b)) if add else expected - set(range(a, b))
        assert [i for start, stop in got for i in range(start, stop)] == sorted(expected)
        assert all(x[1] < y[0] for x, y in pairwise(got))


@given(st.integers(0, 1000), st.integers(0, 5), st.booleans())
def test_the_first_column_with_a_fault(seed: int, n: int, increasing: bool) -> None:
    rng = np.random.default_rng(seed)
    values, low, high = rng.integers(-3, 4, (3, n)), rng.integers(-3, 0, 3), rng.integers(0, 4, 3)
    wrong = np.flatnonzero(((values < low[:, None]) | (values > high[:, None])).any(axis=1))
    falls = increasing and (np.diff(values[0]) <= 0).any()
    expected = wrong[0] if len(wrong) else 3 if falls else -1
    assert packing_kernels.first_fault(values, low, high, increasing) == expected


MOST = 895


def some_columns(seed: int, n: int, smooth: int) -> I64:
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
