"""Kernels of the local grid against plain arithmetic."""

import numpy as np
import pytest

from kiteline_agent.scans import local_grid_kernels as kernels


def drawn(clear_m: list[float], clears: bool = True, times: int = 1) -> np.ndarray:
    """Cells after scans of columns side by side, 0.02 rad each, the first along x."""
    cells, marks, n = np.zeros((60, 60), np.int8), np.zeros((60, 60), np.int16), len(clear_m)
    for number in range(1, times + 1):
        kernels.draw_rays(
            cells, marks, number, 1.025, 1.525, 0.0, 0.02 * np.arange(n), 0.02, np.array(clear_m), np.full(n, 10.0),
            0.05, clears,
        )  # fmt: skip
    return cells


@pytest.mark.parametrize("clears", [True, False])
def test_rays_clear_what_they_pass_and_mark_what_they_hit(clears: bool) -> None:
    cells, expected = drawn([1.2], clears, times=2), np.zeros((60, 60), np.int8)
    if clears:
        expected[30, 20:43] = 2 * kernels.MISS  # up to a cell and a half before the surface
    expected[30, 44] = 2 * kernels.LONE_HIT
    assert np.array_equal(cells[:, :43], expected[:, :43])
    assert np.array_equal(cells[:, 44:], expected[:, 44:])
    assert cells[30, 43] <= 0


@pytest.mark.parametrize(("beside_m", "hit"), [(1.3, kernels.HIT), (1.5, kernels.LONE_HIT), (0.0, kernels.LONE_HIT)])
def test_a_surface_that_two_columns_see_is_told_at_once_others_when_seen_twice(beside_m: float, hit: int) -> None:
    assert drawn([1.2, beside_m])[30, 44] == hit
    assert kernels.LONE_HIT < kernels.OCCUPIED <= min(kernels.HIT, 2 * kernels.LONE_HIT)


@pytest.mark.parametrize(("gap_m", "near_m"), [(0.12, 0.4), (10.0, 0.0), (0.04, 0.0)])
def test_distances_are_those_of_plain_arithmetic(gap_m: float, near_m: float) -> None:
    rng = np.random.default_rng(5)
    own = rng.choice([-2, 0, 4], (80, 80), p=[0.6, 0.37, 0.03]).astype(np.int8)
    drawn = np.where((own != 0) | (rng.random((80, 80)) < 0.5), 3, 0).astype(np.int16)
    tiles = rng.choice([-2, 0, 4], (80, 80), p=[0.6, 0.37, 0.03]).astype(np.int8)
    at, other, out = np.array([2.1, 1.9, 0.4]), np.array([2.3, 2.2, -1.0]), np.empty(36)
    kernels.read_distances(own, drawn, 0.05, at, tiles, 0.05, other, 0.1, gap_m, near_m, 1.5, 1, out)

    def cell(cells: np.ndarray, x: float, y: float) -> int:
        i, j = int(np.floor(y / 0.05)), int(np.floor(x / 0.05))
        return int(cells[i, j]) if 0 <= i < 80 and 0 <= j < 80 else 0

    kinds = set()
    for s in range(36):
        turn = s * 2 * np.pi / 36
        states = []
        for r in 0.1 + 0.025 * np.arange(68):
            x, y = at[0] + np.cos(at[2] - turn) * r, at[1] + np.sin(at[2] - turn) * r
            value = cell(own, x, y)
            if not cell(drawn, x, y):
                value = cell(tiles, other[0] + np.cos(other[2] - turn) * r, other[1] + np.sin(other[2] - turn) * r)
            states.append((r, 1 if value >= kernels.OCCUPIED else 0 if value <= kernels.FREE else -1))
        expected, longest, gap = np.inf, 0.0, 0.0
        for k, (r, here) in enumerate(states):
            if r >= 1.5:
                break
            if here > 0:
                end = next((q for q, h in states[k + 1 :] if h <= 0 or q >= r + 0.3), r)
                expected = 0.5 * (r + end)
                break
            gap = gap + 0.025 if here < 0 else 0.0
            longest = max(longest, gap)
        expected = expected if expected < 1.5 else np.inf
        if longest > gap_m and expected > near_m:
            expected = np.nan
        assert out[s] == pytest.approx(expected, nan_ok=True, abs=1e-9), s
        kinds.add("nan" if np.isnan(expected) else "inf" if np.isinf(expected) else "finite")
    assert "finite" in kinds and ("nan" in kinds) == (gap_m < 1.0)


@pytest.mark.parametrize("seed", range(8))
def test_what_lies_left_is_told_as_what_lies_right(seed: int) -> None:
    """Rays of a sector are followed one after the other: which one first must not matter."""
    rng = np.random.default_rng(seed)
    own = rng.choice([-2, 0, 4], (20, 20), p=[0.55, 0.43, 0.02]).astype(np.int8).repeat(4, 0).repeat(4, 1)
    drawn, none = np.ones((80, 80), np.int16), np.zeros((0, 0), np.int8)
    out, mirrored, still = np.empty(36), np.empty(36), np.zeros(3)
    at = np.array([2.0123, 1.9876, 0.4])
    kernels.read_distances(own, drawn, 0.05, at, none, 0.05, still, 0.1, 0.4, 0.6, 1.9, 5, out)
    own, at = np.ascontiguousarray(own[::-1]), np.array([at[0], 4.0 - at[1], -at[2]])
    kernels.read_distances(own, drawn, 0.05, at, none, 0.05, still, 0.1, 0.4, 0.6, 1.9, 5, mirrored)
    np.testing.assert_allclose(mirrored[(-np.arange(36)) % 36], out, atol=1e-9)


@pytest.mark.parametrize(("near_m", "told"), [(1.6, False), (1.8, True)])
def test_an_obstacle_that_is_near_is_told_even_if_what_lies_before_it_is_unknown(near_m: float, told: bool) -> None:
    own, drawn, none = np.full((80, 80), -2, np.int8), np.ones((80, 80), np.int16), np.zeros((0, 0), np.int8)
    own[:, 14:34], own[:, 42:] = 0, 4  # unknown from 0.7 to 1.7 m, solid from 2.1 m
    out, still = np.empty(36), np.zeros(3)
    at = np.array([0.52, 2.02, 0.0])
    kernels.read_distances(own, drawn, 0.05, at, none, 0.05, still, 0.1, 0.5, near_m, 3.0, 5, out)
    assert np.isfinite(out[0]) == told and (not told or out[0] == pytest.approx(1.58 + 0.15, abs=0.06))


def test_evidence_is_bounded_so_that_a_few_views_turn_a_cell() -> None:
    cells = drawn([1.2, 1.2], times=30)
    assert cells.max() == kernels.MOST and cells.min() == kernels.LEAST
    assert kernels.MOST + 9 * kernels.MISS <= kernels.FREE and kernels.LEAST + 4 * kernels.HIT >= kernels.OCCUPIED
