"""Each quantiser keeps its stated error bound, and a decoded value has the same code again."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kiteline_codec.coding import quantise
from kiteline_core.geometry import se3

SLACK = 1.0 + 1e-6  # float32 storage


def test_every_pixel_code_comes_back() -> None:
    codes = np.arange(quantise.PIXEL_CODES)
    codes = np.stack([codes, codes[::-1]])
    assert np.array_equal(quantise.pixel_codes(quantise.pixels(codes)), codes)


@given(st.lists(st.tuples(*[st.floats(-64.0, 4031.875, width=32)] * 2), min_size=1, max_size=20))
def test_pixels_within_a_thirtysecond(values: list[tuple[float, float]]) -> None:
    uv = np.array(values, np.float32)
    assert np.abs(quantise.pixels(quantise.pixel_codes(uv)) - uv).max() <= SLACK / 32


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -64.1, 4032.0])
def test_pixels_without_a_code_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="pixel does not fit"):
        quantise.pixel_codes(np.array([[bad, 0.0]], np.float32))


def test_every_inverse_depth_code_comes_back_and_codes_are_ordered() -> None:
    codes = np.arange(quantise.DEPTH_CODES)
    x = quantise.inverse_depths(codes)
    assert np.array_equal(quantise.inverse_depth_codes(x), codes)
    assert x[0] == 0.0
    assert np.diff(x).min() > 0


@given(st.floats(2.0**-17, 63.875, width=32))
@example(0.01)
@example(5.0)
def test_inverse_depth_bounds(x: float) -> None:
    got = float(quantise.inverse_depths(quantise.inverse_depth_codes(np.array([x], np.float32)))[0])
    error = abs(got - float(np.float32(x)))
    assert error <= 2.0**-11 * (x + 2.0**-7) * SLACK
    if x <= 0.01:
        assert error <= 1e-5  # 0.004 px of disparity at 380 px m
    if x >= 0.2:
        assert error <= 1e-3 * x


def plain_depth_codes(x: np.ndarray) -> np.ndarray:
    """Plain numpy, as SPEC.md says it."""
    known = x > 0
    y = np.where(known, np.minimum(x, 1e6), 0.0).astype(np.float64) / quantise.DEPTH_SCALE + 1.0
    mantissa, exponent = np.frexp(y)
    codes = (exponent - 1) * 1024 + np.rint((2.0 * mantissa - 1.0) * 1024)
    return np.where(known, np.clip(codes, 1, quantise.DEPTH_CODES - 1), 0).astype(np.int64)


def test_inverse_depths_are_those_of_plain_arithmetic() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate([10.0 ** rng.uniform(-8, 3, 20_000), rng.uniform(-1, 1, 100), [np.nan, np.inf]])
    for values in (x.astype(np.float32), x, x[::3]):
        assert np.array_equal(quantise.inverse_depth_codes(values), plain_depth_codes(values))
    codes = np.arange(quantise.DEPTH_CODES)
    plain = (np.ldexp(1.0 + codes % 1024 / 1024, codes // 1024) - 1.0) * quantise.DEPTH_SCALE
    assert np.array_equal(quantise.inverse_depths(codes), plain.astype(np.float32))


def test_inverse_depth_at_its_ends() -> None:
    codes = quantise.inverse_depth_codes(np.array([0.0, -1.0, np.nan, 1e-9, 1e9, np.inf], np.float32))
    assert codes.tolist() == [0, 0, 0, 1, quantise.DEPTH_CODES - 1, quantise.DEPTH_CODES - 1]


def test_every_offset_code_comes_back() -> None:
    codes = np.arange(1 - quantise.OFFSET_CODES, quantise.OFFSET_CODES)
    codes = np.stack([codes, codes])
    assert np.array_equal(quantise.offset_codes(quantise.offsets(codes)), codes)


@given(st.floats(-127.875, 127.875, width=32))
def test_offsets_within_a_sixtyfourth(x: float) -> None:
    offset = np.array([[x, -x]], np.float32)
    assert np.abs(quantise.offsets(quantise.offset_codes(offset)) - offset).max() <= SLACK / 64


ROTATION = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: sum(c * c for c in v) > 1e-4)
ANGLE = st.one_of(st.floats(0.0, np.pi), st.floats(np.pi - 1e-5, np.pi), st.floats(0.0, 1e-4))


@given(ROTATION, ANGLE, st.tuples(*[st.floats(-1e6, 1e6)] * 3))
@example((1.0, 0.0, 0.0), np.pi, (0.0, 0.0, 0.0))
@example((1.0, -1.0, 0.0), np.pi, (0.0, 0.0, 0.0))
def test_pose_bounds(axis: tuple[float, ...], angle: float, moved: tuple[float, ...]) -> None:
    w = np.array(axis) / np.linalg.norm(axis) * angle
    pose = se3.from_rt(se3.so3_exp(w), np.array(moved))
    codes = quantise.pose_codes(pose)
    got = quantise.pose(codes)
    assert quantise.pose_codes(got) == codes
    assert np.abs(got[:3, 3] - pose[:3, 3]).max() <= 0.5e-4 + 1e-9
    assert np.linalg.norm(se3.so3_log(got[:3, :3].T @ pose[:3, :3])) <= 2e-5
    if angle < 3.0:
        assert np.linalg.norm(se3.so3_log(got[:3, :3].T @ pose[:3, :3])) <= 6.7e-6
    assert np.abs(got[:3, :3] @ got[:3, :3].T - np.eye(3)).max() < 1e-14
    assert np.linalg.det(got[:3, :3]) > 0


@given(ROTATION, ANGLE, st.tuples(*[st.floats(-1000.0, 1000.0)] * 3))
@example((1.0, 0.0, 0.0), np.pi, (0.0, 0.0, 0.0))
def test_coarse_pose_bounds(axis: tuple[float, ...], angle: float, moved: tuple[float, ...]) -> None:
    w = np.array(axis) / np.linalg.norm(axis) * angle
    pose = se3.from_rt(se3.so3_exp(w), np.array(moved))
    codes = quantise.coarse_pose_codes(pose)
    got = quantise.coarse_pose(codes)
    assert quantise.coarse_pose_codes(got) == codes
    assert np.abs(got[:3, 3] - pose[:3, 3]).max() <= 0.5 / 256 + 1e-9
    if angle < 3.0:
        assert np.linalg.norm(se3.so3_log(got[:3, :3].T @ pose[:3, :3])) <= 3.4e-3


TURN = st.integers(-quantise.ROTATION_STEPS, quantise.ROTATION_STEPS)


@given(st.tuples(TURN, TURN, TURN), st.tuples(*[st.integers(-(1 << 39), 1 << 39)] * 3))
@example((524287, 0, 0), (0, 0, 0))
@example((370727, 370727, 0), (0, 0, 0))
def test_every_pose_code_comes_back(turned: tuple[int, ...], moved: tuple[int, ...]) -> None:
    if sum(c * c for c in turned) > (1 << 38) - (1 << 12):
        with pytest.raises(ValueError, match="half a turn"):
            quantise.pose((*moved, *turned))
    else:
        assert quantise.pose_codes(quantise.pose((*moved, *turned))) == (*moved, *turned)


@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), 2.0 * np.eye(4), se3.from_rt(np.eye(3), np.full(3, 1e9))])
def test_poses_without_a_code_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected"):
        quantise.pose_codes(bad)


@given(st.floats(2.0**-16, 0.46))
def test_a_deviation_keeps_three_bits(sigma: float) -> None:
    code = quantise.deviation_code(sigma)
    assert 0 < code < quantise.DEVIATION_CODES
    assert quantise.deviation(code) == pytest.approx(sigma, rel=1.0 / 16.0)
    assert quantise.deviation_code(quantise.deviation(code)) == code


def test_every_code_of_a_deviation_has_its_own_value() -> None:
    values = [quantise.deviation(code) for code in range(quantise.DEVIATION_CODES)]
    assert np.all(np.diff(values) > 0.0) and values[0] == 0.0
    assert [quantise.deviation_code(value) for value in values] == list(range(quantise.DEVIATION_CODES))
    assert quantise.deviation_code(9.0) == quantise.DEVIATION_CODES - 1
    assert quantise.deviation_code(1e-9) == 1


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: float(np.linalg.norm(v)) > 0.01))
@example((1.0, 1e-9, 0.0))
@example((0.6, -1e-12, 0.8))
@example((0.0, 1.0, 0.0))
@example((0.0, -1.0, 0.0))
def test_direction_bounds(v: tuple[float, float, float]) -> None:
    unit = np.array(v) / np.linalg.norm(v)
    codes = quantise.direction_codes(unit)
    got = quantise.direction(*codes)
    assert abs(float(np.linalg.norm(got)) - 1.0) < 1e-12
    assert float(np.linalg.norm(got - unit)) <= 1.8e-4
    assert quantise.direction_codes(got) == codes


def test_directions_without_a_code_are_refused() -> None:
    with pytest.raises(ValueError, match="unit vector"):
        quantise.direction_codes(np.array([1.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match="unit vector"):
        quantise.direction_codes(np.full(3, np.nan))
    with pytest.raises(ValueError, match="half of the sphere"):
        quantise.direction(1, quantise.DIRECTION_STEPS, 0)


def test_every_range_code_comes_back_and_codes_are_ordered() -> None:
    codes = np.arange(quantise.RANGE_CODES)
    r = quantise.ranges(codes)
    assert np.array_equal(quantise.range_codes(r), codes)
    assert r[0] == 0.0
    assert (np.diff(r) > 0.0).all()
    assert r[-1] < 254.0


@given(st.floats(1e-6, 253.0))
def test_range_bounds(r: float) -> None:
    got = float(quantise.ranges(quantise.range_codes(np.array([r])))[0])
    assert got > 0.0
    assert abs(got - r) <= (r + 2.0) / 256.0 + 1e-12 or r < 0.0157


def test_ranges_without_a_code() -> None:
    assert quantise.range_codes(np.array([-1.0, 0.0, np.inf, 1e300])).tolist() == [0, 0] + 2 * [
        quantise.RANGE_CODES - 1
    ]
    with pytest.raises(ValueError, match="NaN"):
        quantise.range_codes(np.array([np.nan]))
