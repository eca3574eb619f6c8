"""The place index against plain references: words, scores, places that come and go, and what a query costs."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core.places import place_index
from kiteline_core.places.place_index import PlaceIndex, Vocabulary
from tests.yardstick import slowness


def tree(seed: int, branching: int = 4, levels: int = 3) -> Vocabulary:
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 2**63, (place_index.nodes(branching, levels), 4)).astype(np.uint64)
    return Vocabulary(branching, levels, centres, rng.uniform(0.5, 3.0, branching**levels).astype(np.float32))


def descriptors(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(0, 256, (n, 32), np.uint8)


def plain_words(v: Vocabulary, d: np.ndarray) -> np.ndarray:
    centre = v.centres.view(np.uint8).reshape(-1, 32)
    out = []
    for row in d:
        node, base, width = 0, 0, v.branching
        for _ in range(v.levels):
            children = centre[base + node * v.branching : base + (node + 1) * v.branching]
            node = node * v.branching + int(np.unpackbits(children ^ row, axis=1).sum(axis=1).argmin())
            base, width = base + width, width * v.branching
        out.append(node)
    return np.array(out)


def plain_score(v: Vocabulary, asked: np.ndarray, place: np.ndarray) -> float:
    """Sum of weight^2 of the asked features, each by the likeness of its most similar feature of the same word."""
    asked, place = (d[v.weight[plain_words(v, d)] >= 1.0] for d in (asked, place))
    a, b = plain_words(v, asked), plain_words(v, place)
    total = 0.0
    for word, row in zip(a, asked):
        bits = [int(np.unpackbits(row[:8] ^ other[:8]).sum()) for other in place[b == word]]
        total += float(v.weight[word]) ** 2 * max((np.exp(-((n / 6.0) ** 2)) for n in bits), default=0.0)
    norms = [np.sqrt((v.weight[words].astype(np.float64) ** 2).sum()) for words in (a, b)]
    return float(total / (norms[0] * norms[1]))


def flipped(rng: np.random.Generator, d: np.ndarray, share: float) -> np.ndarray:
    """Descriptors with a share of their bits wrong, as another image of the same landmarks gives."""
    return d ^ np.packbits(rng.random((len(d), 256)) < share, axis=1)


def test_words_and_scores_are_the_reference() -> None:
    v, rng = tree(0), np.random.default_rng(1)
    base = descriptors(rng, 60)
    places = {k: np.concatenate([flipped(rng, base[:n], 0.04), descriptors(rng, 30)]) for k, n in
              ((5, 40), (900, 10), (17, 25))}  # fmt: skip
    index = PlaceIndex(v)
    for key, d in places.items():
        assert np.array_equal(v.words_of(d), plain_words(v, d))
        index.add(key, d)
    found = index.query(base)
    expected = {k: plain_score(v, base, d) for k, d in places.items()}
    assert found.keys.tolist() == sorted(expected, key=lambda k: -expected[k]) == [5, 17, 900]
    assert np.allclose(found.score, [expected[k] for k in found.keys.tolist()], rtol=1e-6)
    between = plain_score(v, places[5], places[17])
    scores = index.scores(places[5])
    assert np.allclose([scores.of(k) for k in (5, 17, 3)], [1.0, between, 0.0], rtol=1e-6)


def test_a_repeated_feature_counts_once_for_each_feature_asked() -> None:
    v, rng = tree(6), np.random.default_rng(6)
    v.weight[:] = 2.0  # no word is too frequent to count
    once, other = descriptors(rng, 1), descriptors(rng, 1)
    index = PlaceIndex(v)
    index.add(1, once)
    index.add(2, np.repeat(once, 50, axis=0))
    index.add(3, other)
    index.remove(1)
    index.add(4, once)
    assert index.scores(once).of(2) == pytest.approx(1 / np.sqrt(50))
    assert index.scores(np.repeat(once, 50, axis=0)).of(4) == pytest.approx(50 / np.sqrt(50))


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 9)), max_size=40), st.integers(0, 1000))
def test_places_come_and_go_as_if_the_index_were_new(steps: list[tuple[bool, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    v, index, held = tree(2, 3, 2), PlaceIndex(tree(2, 3, 2)), {}
    for come, key in steps:
        if come:
            held[key] = descriptors(rng, int(rng.integers(1, 30)))
            index.add(key, held[key])
        else:
            held.pop(key, None)
            index.remove(key)
    fresh = PlaceIndex(v)
    for key, d in held.items():
        fresh.add(key, d)
    asked = descriptors(rng, 25)
    a, b = index.query(asked, limit=20), fresh.query(asked, limit=20)
    assert len(index) == len(held)
    assert dict(zip(a.keys.tolist(), a.score.round(9))) == dict(zip(b.keys.tolist(), b.score.round(9)))


def test_excluded_places_and_limits() -> None:
    v, rng = tree(3), np.random.default_rng(3)
    index, d = PlaceIndex(v), descriptors(np.random.default_rng(9), 60)
    for key in range(30):
        index.add(key, np.concatenate([d[: 2 * key + 2], descriptors(rng, 60)]))
    everything = index.query(d, limit=30)
    assert len(everything.keys) == 30 and np.all(np.diff(everything.score) <= 0)
    found = index.query(d, exclude=(29, 28, 777), limit=5)
    assert found.keys.tolist() == [k for k in everything.keys.tolist() if k not in (28, 29)][:5]
    assert len(PlaceIndex(v).query(d).keys) == 0
    assert len(index.query(d[:0]).keys) == 0


def test_packing_keeps_the_tree_and_refuses_damage() -> None:
    v = tree(4)
    data = place_index.pack(v)
    back = place_index.unpack(data)
    assert np.array_equal(back.centres, v.centres) and np.abs(back.weight - v.weight).max() <= 1 / 48 + 1e-6
    assert place_index.pack(back) == data
    for bad in (b"", data[:-1], data + b"x", b"XXXX" + data[4:], data[:4] + b"\x00" + data[5:]):
        with pytest.raises(ValueError, match="words"):
            place_index.unpack(bad)


def test_a_query_among_1000_places_takes_less_than_a_millisecond_of_cpu() -> None:
    v, rng = tree(5, 10, 4), np.random.default_rng(5)
    index = PlaceIndex(v)
    for key in range(1000):
        index.add(key, descriptors(rng, 300))
    asked = [descriptors(rng, 300) for _ in range(20)]
    index.query(asked[0])
    times = []
    for d in asked:
        start = time.process_time()
        index.query(d)
        times.append(time.process_time() - start)
    assert np.median(times) < 1e-3 * slowness()
