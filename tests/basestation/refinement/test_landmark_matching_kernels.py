"""Matching kernels against plain numpy."""

import numpy as np

from kiteline_basestation.refinement import landmark_matching_kernels as kernels
from kiteline_core.arrays import I64, U64, Bool
from kiteline_core.imaging.matching_kernels import hamming
from tests.core.helpers_from_python import from_python


def bits(a: U64, b: U64) -> I64:
    """Hamming distances (n,m) by counting unpacked bits."""
    x = np.unpackbits(a.view(np.uint8).reshape(len(a), 32), axis=1)
    y = np.unpackbits(b.view(np.uint8).reshape(len(b), 32), axis=1)
    return np.asarray((x[:, None] != y[None]).sum(axis=2), np.int64)


def described(rng: np.random.Generator, n: int) -> U64:
    return np.ascontiguousarray(rng.integers(0, 256, (n, 32), dtype=np.uint8)).view(np.uint64)


def noisy(rng: np.random.Generator, a: U64, share: float) -> U64:
    flips = np.packbits(rng.random((len(a), 256)) < share, axis=1)
    return np.ascontiguousarray(a.view(np.uint8).reshape(-1, 32) ^ flips).view(np.uint64)


def chosen(distance: I64, allowed: Bool, limit: int, ratio: float) -> list[int]:
    """The keypoint of each row that is near enough and distinct, each keypoint given to its nearest row only."""
    cost = np.where(allowed, distance, 1 << 20)
    out = [-1] * len(cost)
    owner: dict[int, int] = {}
    for i in range(len(cost)):
        order = np.argsort(cost[i], kind="stable")
        first, second = cost[i][order[0]], cost[i][order[1]]
        if first > limit or first > ratio * second:
            continue
        j = int(order[0])
        if j not in owner or first < cost[owner[j]][j]:
            if j in owner:
                out[owner[j]] = -1
            owner[j] = i
            out[i] = j
    return out


def test_hamming_counts_bits() -> None:
    rng = np.random.default_rng(0)
    a, b = described(rng, 20), described(rng, 30)
    expected, counted = bits(a, b), from_python(hamming)
    assert all(counted(a, i, b, j) == expected[i, j] for i in range(20) for j in range(30))
    assert counted(np.zeros((1, 4), np.uint64), 0, np.full((1, 4), ~np.uint64(0)), 0) == 256


def test_projected_points_find_their_keypoints() -> None:
    rng = np.random.default_rng(1)
    n = 120
    uv, octave = rng.uniform(0, 200, (n, 2)), rng.uniform(-0.5, 2.5, n)
    angle, disparity = rng.integers(0, 256, n).astype(np.uint8), rng.uniform(5, 40, n)
    descriptor = described(rng, n)
    which = rng.permutation(n)[:80]
    uv2, octave2 = uv[which] + rng.normal(0, 3, (80, 2)), np.clip(np.rint(octave[which]), 0, 2).astype(np.uint8)
    angle2 = (angle[which].astype(int) + rng.integers(-30, 31, 80)).astype(np.uint8)
    disparity2 = np.where(rng.random(80) < 0.3, -1.0, disparity[which] + rng.normal(0, 2, 80))
    descriptor2 = noisy(rng, descriptor[which], 0.1)
    best, distance = np.empty(n, np.int32), np.zeros(n, np.int32)
    kernels.match_projected(
        uv, octave, angle, disparity, descriptor, uv2, octave2, angle2, disparity2, descriptor2,
        8.0, 1.2, 24, 3.0, 60, 0.8, best, distance,
    )  # fmt: skip
    scale = np.exp2(octave2.astype(float))
    gap = np.linalg.norm(uv[:, None] - uv2[None], axis=2)
    turn = (angle2.astype(int)[None] - angle.astype(int)[:, None]) % 256
    allowed = (gap <= 8.0 * scale) & (np.abs(octave[:, None] - octave2) <= 1.2) & (np.minimum(turn, 256 - turn) <= 24)
    allowed &= (disparity2 < 0) | (np.abs(disparity[:, None] - disparity2) <= 3.0 * scale)
    assert best.tolist() == chosen(bits(descriptor, descriptor2), allowed, 60, 0.8)
    hits = best >= 0
    assert hits.sum() > 25
    assert (which[best[hits]] == np.flatnonzero(hits)).all()


def test_epipolar_matches_lie_on_their_lines() -> None:
    rng = np.random.default_rng(2)
    n = 90
    uv, octave, descriptor = rng.uniform(0, 400, (n, 2)), rng.integers(0, 3, n).astype(np.uint8), described(rng, n)
    fundamental = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # the lines are the rows
    order = rng.permutation(n)
    uv2 = uv[order] + np.stack([rng.uniform(-60, 60, n), rng.normal(0, 1.0, n)], 1)
    octave2, descriptor2 = octave[order], noisy(rng, descriptor[order], 0.08)
    best, distance = np.empty(n, np.int32), np.zeros(n, np.int32)
    kernels.match_epipolar(
        uv, octave, descriptor, uv2, octave2, descriptor2, fundamental, 1.5, 50, 0.75, best, distance
    )  # fmt: skip
    allowed = np.abs(uv[:, None, 1] - uv2[None, :, 1]) <= 1.5 * np.exp2(octave2.astype(float))
    allowed &= np.abs(octave.astype(int)[:, None] - octave2.astype(int)) <= 1
    assert best.tolist() == chosen(bits(descriptor, descriptor2), allowed, 50, 0.75)
    assert (best >= 0).sum() > 60
