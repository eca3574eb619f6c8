"""Descriptor matching against plain references."""

import numpy as np

from kiteline_core.imaging import matching


def bits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamming distances (n,m) in the plain way."""
    return np.unpackbits(a[:, None] ^ b[None, :], axis=2).sum(axis=2)


def noisy(rng: np.random.Generator, descriptor: np.ndarray, flips: int) -> np.ndarray:
    """Copies with `flips` random bits turned."""
    out = np.unpackbits(descriptor, axis=1)
    for row in out:
        row[rng.permutation(256)[:flips]] ^= 1
    return np.packbits(out, axis=1)


def reference(a: np.ndarray, b: np.ndarray, allowed: np.ndarray) -> set[tuple[int, int]]:
    """One match each: in order of a, a nearer one takes it over."""
    owner: dict[int, tuple[int, int]] = {}
    distance = np.where(allowed, bits(a, b), 1 << 20)
    for i, row in enumerate(distance):
        order = np.argsort(row, kind="stable")
        first, second = int(row[order[0]]), int(row[order[1]])
        j = int(order[0])
        distinct = first <= matching._MAX_HAMMING and first <= matching._RATIO * second
        if distinct and first < owner.get(j, (1 << 20, 0))[0]:
            owner[j] = (first, i)
    return {(i, j) for j, (_, i) in owner.items()}


def test_brute_force_is_the_reference() -> None:
    rng = np.random.default_rng(0)
    b = rng.integers(0, 256, (90, 32), np.uint8)
    a = np.concatenate([noisy(rng, b[:50], 30), noisy(rng, b[:10], 40), rng.integers(0, 256, (30, 32), np.uint8)])
    angle = np.zeros(90, np.uint8)
    found = matching.match(a, angle, b, angle)
    assert set(zip(found.a.tolist(), found.b.tolist())) == reference(a, b, np.ones((90, 90), bool))
    assert len(found.a) >= 48
    assert np.array_equal(found.distance, bits(a, b)[found.a, found.b])
    assert len(np.unique(found.b)) == len(found.b)


def test_matches_that_turn_unlike_the_others_leave() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (60, 32), np.uint8)
    angle = rng.integers(0, 256, 60).astype(np.uint8)
    turned = (angle.astype(int) + 40 + rng.integers(-4, 5, 60)).astype(np.uint8)
    turned[:6] = (angle[:6].astype(int) + 150 + np.arange(6) * 11) & 255
    found = matching.match(a, angle, a, turned)
    assert set(range(6, 60)) <= set(found.a.tolist())
    assert len(found.a) <= 56


def test_guided_search_sees_exactly_its_circle() -> None:
    rng = np.random.default_rng(2)
    n = 120
    uv2 = rng.uniform((0, 0), (320, 200), (n, 2))
    b = rng.integers(0, 256, (n, 32), np.uint8)
    a = noisy(rng, b, 20)
    octave2 = rng.integers(0, 3, n).astype(np.uint8)
    uv = uv2 + rng.normal(0, 6, uv2.shape)
    radius = rng.uniform(4, 45, n)
    octave = octave2 + rng.normal(0, 0.6, n)
    found = matching.match_near(uv, radius, octave, a, uv2, octave2, b, (320, 200), 1.0)
    near = np.linalg.norm(uv[:, None] - uv2[None], axis=2) <= radius[:, None]
    near &= np.abs(octave[:, None] - octave2[None]) <= 1.0
    assert set(zip(found.a.tolist(), found.b.tolist())) == reference(a, b, near)
    assert 60 < len(found.a) < 120


def test_nothing_matches_nothing() -> None:
    none, one = np.zeros((0, 32), np.uint8), np.zeros((1, 32), np.uint8)
    angle = np.zeros(1, np.uint8)
    assert len(matching.match(none, angle[:0], one, angle).a) == 0
    assert len(matching.match(one, angle, none, angle[:0]).a) == 0
