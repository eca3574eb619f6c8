"""Place recognition on images that the simulator did not make: the vocabulary was trained on simulated ones.

Each frame of a drone's real flight queries the flight's frames that are a second older and frames of a real street.
Each frame of the street queries every tenth one of it and all frames of the flight. What the index finds is compared
with what matching against every frame finds, by the number of matches. A candidate is accepted when an essential matrix
over its matches has enough inliers.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features
from kiteline_bench.harness.bars import Bar, Bench, is_true
from kiteline_bench.harness.recording import load
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.imaging import matching
from kiteline_core.places.place_index import PlaceIndex
from kiteline_hw.system.vocabulary import shipped_vocabulary

FLIGHT, STREET = "euroc_mh01_air", "kitti07_mono"
_EVERY = 5  # frames of the flight between two places: a quarter of a second
_OLD = 4  # places: a younger one is no place seen before
_NEAR_M, _NEAR_RAD = 1.0, 0.44  # distance and angle between two views of one place
_KEPT, _NEIGHBOUR = 10, 6  # of the street: frames between two in the index; most frames to the nearest of them
_TRIED = 5  # candidates a query
_ACCEPTED = 30  # inliers of an essential matrix
_STREET = 100_000  # first key of places of the street
_FOUND = 0.9  # of what matching finds


@dataclass(frozen=True, slots=True)
class _Place:
    uv: F64  # normalised image plane
    angle: U8
    descriptor: U8
    focal: float
    T_w_c: F64 | None


def run(bench: Bench) -> list[Bar]:
    """Places found among the best candidates, and foreign candidates accepted."""
    flight, street = _places(bench, FLIGHT, _EVERY), _places(bench, STREET, 1)
    of_street = {_STREET + k: street[k] for k in range(0, len(street), _KEPT)}
    known = dict(of_street)
    index = _index(known)
    in_flight, in_street, foreign = _Found(), _Found(), 0
    for k, place in enumerate(flight):
        if k >= _OLD:
            known[k - _OLD] = flight[k - _OLD]
            index.add(k - _OLD, flight[k - _OLD].descriptor)
        right = {key for key, old in known.items() if _near(place, old)}
        found = index.query(place.descriptor, limit=_TRIED).keys.tolist()
        foreign += sum(key >= _STREET and _accepted(place, known[key]) for key in found)
        if right:
            in_flight.add(found, place, known, right)
    known |= dict(enumerate(flight))
    index = _index(known)
    for k, place in enumerate(street):
        right = {key for key in of_street if abs(key - _STREET - k) <= _NEIGHBOUR}
        found = index.query(place.descriptor, limit=_TRIED).keys.tolist()
        foreign += sum(key < _STREET and _accepted(place, known[key]) for key in found)
        if k % _KEPT and right:
            in_street.add(found, place, known, right)
    return [
        in_flight.bar(f"{FLIGHT}: the place of a second ago among the {_TRIED} best"),
        in_street.bar(f"{STREET}: a neighbour among the {_TRIED} best"),
        is_true("candidates of the other recording accepted", "0", foreign == 0, f"{foreign}"),
    ]


@dataclass(slots=True)
class _Found:
    """Queries that have an answer, and how many of them the index, its first candidate, and matching answer."""

    asked: int = 0
    index: int = 0
    first: int = 0
    matching: int = 0

    def add(self, found: list[int], place: _Place, known: Mapping[int, _Place], right: set[int]) -> None:
        """Count one query. right: keys of the same place."""
        best = sorted(known, key=lambda key: (-_matches(known[key], place), key))[:_TRIED]
        self.asked += 1
        self.index += not right.isdisjoint(found)
        self.first += not right.isdisjoint(found[:1])
        self.matching += not right.isdisjoint(best)

    def bar(self, name: str) -> Bar:
        """The share found by the index, over the share found by matching."""
        share, first, most = (value / max(self.asked, 1) for value in (self.index, self.first, self.matching))
        return is_true(name, f">= {_FOUND:.0%} of what matching finds", share >= _FOUND * most,
                       f"{share:.0%} (as the first {first:.0%}) of {self.asked}; by matching {most:.0%}")  # fmt: skip


def _index(places: Mapping[int, _Place]) -> PlaceIndex:
    index = PlaceIndex(shipped_vocabulary())
    for key, place in places.items():
        index.add(key, place.descriptor)
    return index


def _places(bench: Bench, name: str, every: int) -> list[_Place]:
    bench.say(f"describing {name}")
    recording = load(bench.source(name), mono=True)
    rectifier, config = Rectifier(recording.rig), AgentConfig()
    detector = features.DetectorConfig(
        cell_px=config.relocalisation.cell_px, max_corners=config.relocalisation.max_corners
    )
    c = rectifier.camera
    out = []
    for item in recording.items[::every]:
        pyramid = features.build_pyramid(rectifier.left(item.frame.left), config.pyramid.levels)
        corners = features.detect(pyramid, np.zeros((0, 2)), detector)
        angle, descriptor = features.describe(pyramid, corners.uv, corners.octave)
        uv = (corners.uv - np.array([c.cx, c.cy])) / np.array([c.fx, c.fy])
        T_w_c = None if item.T_w_b is None else item.T_w_b @ c.T_b_c
        out.append(_Place(uv, angle, descriptor, c.fx, T_w_c))
    return out


def _near(a: _Place, b: _Place) -> bool:
    if a.T_w_c is None or b.T_w_c is None:
        return False
    T = se3.inverse(a.T_w_c) @ b.T_w_c
    return bool(np.linalg.norm(T[:3, 3]) < _NEAR_M and T[2, 2] > np.cos(_NEAR_RAD))


def _matches(old: _Place, place: _Place) -> int:
    return len(matching.match(old.descriptor, old.angle, place.descriptor, place.angle).a)


def _accepted(place: _Place, old: _Place) -> bool:
    """True if an essential matrix explains enough matches."""
    matches = matching.match(old.descriptor, old.angle, place.descriptor, place.angle)
    if len(matches.a) < _ACCEPTED:
        return False
    cv2.setRNGSeed(1)
    threshold = 1.5 / min(place.focal, old.focal)
    _, mask = cv2.findEssentialMat(
        old.uv[matches.a], place.uv[matches.b], np.eye(3), cv2.RANSAC, 0.999, threshold
    )  # fmt: skip
    return mask is not None and int(mask.sum()) >= _ACCEPTED
