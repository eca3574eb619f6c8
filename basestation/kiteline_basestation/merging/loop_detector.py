"""Detects loop closures and map merges.

Each new keyframe queries the place index, and candidates are verified geometrically (`loop_verification`). A closure is
accepted when enough keyframes agree on one correction and few or none contradict it (`loop_consistency`).
"""

from bisect import insort
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.exchange.sharing import SharingPolicy
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging import loop_consistency as consistency
from kiteline_basestation.merging.loop_consistency import MONOCULAR_DRIFT_PATH
from kiteline_basestation.merging.loop_edges import LoopMatch, correction_of, rescaled, slot_pairs
from kiteline_basestation.merging.loop_verification import (
    KeyframeObservations,
    guessed_pose,
    observations_of,
    verify_loop,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import (
    SEQUENCE_BITS,
    SUBMAP_BITS,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)
from kiteline_core.places.place_index import PlaceIndex, Vocabulary

SubmapPair = tuple[SubmapId, SubmapId]  # the smaller id first
_Frame = tuple[int, int]  # a start of an agent, whose clock compares with no other one, and a time stamp

_QUERIED = 12  # places queried for each candidate that is verified: most are of neighbouring keyframes
_SAME_VIEW_COSINE = 0.5  # of the angle between optical axes: views of one place from nearby
_CANDIDATES_SAME_MAP = 3  # most similar keyframes of the same map that are verified
_MIN_GAP = 12  # keyframes of one submap between two that are matched
_MAX_SHARED = 15  # landmarks that a candidate may share with the keyframe already
_MIN_NEIGHBOUR_RATIO = 0.03  # in one map, of the similarity to the previous keyframe: drift leaves near views
_MIN_KEYFRAMES = 3  # keyframes that agree on a correction
_RECENT_KEYFRAMES = 24  # keyframes of a submap within which matches are counted together
_AMBIGUOUS_M = 1.0  # m; similar places of one map that lie farther apart make it ambiguous
_AGAINST = 3  # agreeing keyframes needed more for each one that contradicts


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """An accepted closure. newer, older: map ids, equal for a loop within one map.

    S_older_newer: (4,4) moves the newer map in w onto the older one. matches: those that agree.
    """

    newer: SubmapId
    older: SubmapId
    S_older_newer: F64
    matches: tuple[LoopMatch, ...] = ()


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Matches show that two submaps of one map were merged wrongly."""

    submaps: SubmapPair


@dataclass(frozen=True, slots=True)
class DetectorState:
    """State of a `LoopDetector` that outlives the process; see the attributes of the same names."""

    matches: Mapping[SubmapPair, tuple[LoopMatch, ...]] = field(default_factory=dict)
    contradicted: Mapping[SubmapPair, int] = field(default_factory=dict)
    first_seen: tuple[SubmapId, ...] = ()
    kept_apart: tuple[tuple[frozenset[SubmapId], frozenset[SubmapId]], ...] = ()
    requested: tuple[SubmapPair, ...] = ()


class LoopDetector:
    """The place index over all keyframes, and the verified matches that are not sufficient yet."""

    def __init__(self, config: LoopConfig, sparse_map: SparseMap, vocabulary: Vocabulary) -> None:
        self._config = config
        self._map = sparse_map
        self._index = PlaceIndex(vocabulary)
        self._sharing = SharingPolicy(config.share)
        self._matches: dict[SubmapPair, list[LoopMatch]] = {}
        self._contradicted: dict[SubmapPair, int] = {}  # how often matches contradicted a merge of two submaps
        self._frames: dict[KeyframeId, _Frame] = {}  # of each keyframe of the index
        self._of_frame: dict[_Frame, list[KeyframeId]] = {}
        self._first_seen: dict[SubmapId, int] = {}  # order in which submaps were first seen
        self.kept_apart: list[tuple[frozenset[SubmapId], frozenset[SubmapId]]] = []  # maps that a user has split
        self.requested: set[SubmapPair] = set()  # maps that a user asked to merge: one match is sufficient
        self.verified = 0  # matches that passed geometric verification
        self.refused = 0  # of those: beyond the expected drift, of ambiguous places, or that would tilt a map

    def add(self, keyframe: KeyframeId) -> None:
        """Add a keyframe to the place index."""
        self._first_seen.setdefault(submap_of_keyframe(keyframe), len(self._first_seen))
        self._index.add(keyframe, observations_of(self._map, keyframe).descriptor)
        frame = self._frame_of(keyframe)
        if self._frames.get(keyframe) != frame:  # its header may come again, with another time
            self._leave_frame(keyframe)
            self._frames[keyframe] = frame
            insort(self._of_frame.setdefault(frame, []), keyframe)

    def remove(self, keyframe: KeyframeId) -> None:
        """Remove a keyframe from the place index."""
        self._index.remove(keyframe)
        self._leave_frame(keyframe)

    def _leave_frame(self, keyframe: KeyframeId) -> None:
        frame = self._frames.pop(keyframe, None)
        if frame is not None:
            self._of_frame[frame].remove(keyframe)
            if not self._of_frame[frame]:
                del self._of_frame[frame]

    def _frame_of(self, keyframe: KeyframeId) -> _Frame:
        return keyframe >> SEQUENCE_BITS + SUBMAP_BITS, int(self._map.keyframes.t_ns[self._map.rows[keyframe]])

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop the matches of deleted submaps."""
        gone = set(submaps)
        self._matches = {key: matches for key, matches in self._matches.items() if gone.isdisjoint(key)}
        self._contradicted = {key: count for key, count in self._contradicted.items() if gone.isdisjoint(key)}
        self._first_seen = {s: number for s, number in self._first_seen.items() if s not in gone}
        self.requested = {key for key in self.requested if gone.isdisjoint(key)}

    def oldest(self, submaps: Sequence[SubmapId]) -> SubmapId:
        """The submap that was seen first."""
        return min(submaps, key=lambda s: (self._first_seen.get(s, len(self._first_seen)), s))

    def query(self, keyframe: KeyframeId) -> LoopClosure | Contradiction | None:
        """Search all maps for the place of a keyframe. A closure is returned once."""
        found: LoopClosure | Contradiction | None = self._closure_by_agent(keyframe)
        observations = observations_of(self._map, keyframe)
        for old in self._candidates(keyframe, observations):
            match = verify_loop(self._map, keyframe, old, self._config, observations)
            if match is None:
                continue
            self.verified += 1
            found = found or self._weigh(match) or self._verify_neighbours(match)
        return found

    def contradict(self, pairs: Iterable[SubmapPair], weighed: SubmapPair) -> None:
        """The matches of these submaps made a wrong merge: more of them, and others, have to merge them again.

        weighed: submaps whose matches contradicted it, which stay to be weighed against each other.
        """
        for key in {_pair(*pair) for pair in pairs} - {weighed}:
            self._matches.pop(key, None)
            self._contradicted[key] = self._contradicted.get(key, 0) + 1

    def rescale(self, factor: Mapping[KeyframeId, float]) -> None:
        """Multiply lengths of pending matches near keyframes, in units of their submaps."""
        self._matches = {key: [rescaled(m, factor) for m in matches] for key, matches in self._matches.items()}

    def state(self) -> DetectorState:
        """State to be saved."""
        matches = {key: tuple(matches) for key, matches in self._matches.items()}
        return DetectorState(
            matches, dict(self._contradicted), tuple(self._first_seen), tuple(self.kept_apart),
            tuple(sorted(self.requested)),
        )  # fmt: skip

    def restore(self, state: DetectorState) -> None:
        """Continue from a saved state, after all keyframes were added."""
        self._matches = {key: known_matches(self._map, matches) for key, matches in state.matches.items()}
        self._contradicted = dict(state.contradicted)
        submaps = dict.fromkeys([*state.first_seen, *self._first_seen])
        self._first_seen = {s: i for i, s in enumerate(submaps)}
        self.kept_apart = list(state.kept_apart)
        self.requested = set(state.requested)

    # -- candidates --------------------------------------------------------------------------------------------------

    def _closure_by_agent(self, keyframe: KeyframeId) -> LoopClosure | None:
        """Closure by two keyframes of one frame: an agent that relocalised in an old submap made one in each."""
        sparse_map = self._map
        new = submap_of_keyframe(keyframe)
        for other in self._of_frame.get(self._frame_of(keyframe), []):
            submap = submap_of_keyframe(other)
            if sparse_map.map_id(submap) == sparse_map.map_id(new):
                continue
            if sparse_map.is_up_to_scale(new) or sparse_map.is_up_to_scale(submap):
                continue  # the scale between the submaps is unknown
            if self._contradicted.get(_pair(new, submap), 0) or self.is_kept_apart(new, submap):
                continue
            match = LoopMatch(keyframe, other, np.eye(4), self._config.min_inliers_loop, 1.0)
            return self._closure(match, [match])
        return None

    def _candidates(self, keyframe: KeyframeId, observations: KeyframeObservations) -> list[KeyframeId]:
        """The most similar keyframes, one of each neighbourhood, without those that already share landmarks."""
        sparse_map, config = self._map, self._config
        if len(observations.slots) < config.min_inliers:
            return []
        shared = sparse_map.covisibility(sparse_map.landmarks_of(keyframe))
        known = set(sparse_map.keyframes.id[np.flatnonzero(shared > _MAX_SHARED)].tolist())
        same = sparse_map.submaps[submap_of_keyframe(keyframe)]
        at = sparse_map.number_of(keyframe)
        near = same[max(0, at - _MIN_GAP) : at + _MIN_GAP + 1]
        before = [k for k in near if k < keyframe][-1:]
        scores = self._index.scores(observations.descriptor)
        usual = scores.of(before[0]) if before and keyframe in self._index else 0.0
        enough_same_map = max(config.min_likeness, _MIN_NEIGHBOUR_RATIO * usual)
        places = scores.best(known | set(near) | {keyframe}, _QUERIED * config.candidates)
        out: list[KeyframeId] = []
        taken: set[int] = set()
        left = {True: _CANDIDATES_SAME_MAP, False: config.candidates}
        map_id = sparse_map.map_id(submap_of_keyframe(keyframe))
        for key, score in zip(places.keys.tolist(), places.score.tolist()):
            old = KeyframeId(key)
            same_map = sparse_map.map_id(submap_of_keyframe(old)) == map_id
            if (
                key in taken
                or score < (enough_same_map if same_map else config.min_likeness)
                or left[same_map] == 0
                or not self._sharing.allows(agent_of_keyframe(keyframe), agent_of_keyframe(old))
                or self.is_kept_apart(submap_of_keyframe(keyframe), submap_of_keyframe(old))
            ):
                continue
            out.append(old)
            left[same_map] -= 1
            around = sparse_map.covisibility(sparse_map.landmarks_of(old))
            taken |= set(sparse_map.keyframes.id[np.flatnonzero(around > _MAX_SHARED)].tolist())
        return out

    def is_kept_apart(self, a: SubmapId, b: SubmapId) -> bool:
        """True if a user has split the maps of two submaps."""
        return any((a in x and b in y) or (b in x and a in y) for x, y in self.kept_apart)

    def stop_keeping_apart(self, a: Collection[SubmapId], b: Collection[SubmapId]) -> None:
        """Let the submaps of two maps be matched again."""
        one, other = frozenset(a), frozenset(b)
        self.kept_apart = [
            (x, y) for x, y in self.kept_apart if not ((x & one and y & other) or (x & other and y & one))
        ]

    # -- acceptance --------------------------------------------------------------------------------------------------

    def _weigh(self, match: LoopMatch) -> LoopClosure | Contradiction | None:
        """Add a match to the pending ones of its submaps, and accept or contradict if they suffice."""
        config = self._config
        new, old = submap_of_keyframe(match.new), submap_of_keyframe(match.old)
        key = _pair(new, old)
        matches = [m for m in self._matches.get(key, []) if self._is_recent(m, match)]
        matches.append(match)
        self._matches[key] = matches
        same_map = self._map.map_id(new) == self._map.map_id(old)
        if not same_map and not consistency.keeps_level(self._map, match):
            self.refused += 1
            return None
        chosen = consistency.agreeing(self._map, matches)
        supporters = {m.new for m in chosen}
        best = max(chosen, key=lambda m: (m.inliers, m.new))
        if same_map and not consistency.within_drift(self._map, match, config):
            alone = len(chosen) == len(matches)  # one that sees two places speaks for neither
            if new == old and alone and consistency.exceeds_expected_drift(self._map, chosen, config):
                self._matches[key] = []
                return self._closure(best, chosen)
            self.refused += 1
            if new == old or len(supporters) < _MIN_KEYFRAMES:
                return None
            self._contradicted[key] = self._contradicted.get(key, 0) + 1
            return Contradiction(key)
        if same_map and match.inliers < config.min_inliers_loop:
            return None
        against = {m.new for m in matches} - supporters
        needed = _MIN_KEYFRAMES * (1 + 2 * self._contradicted.get(key, 0)) + _AGAINST * len(against)
        if _pair(self._map.map_id(new), self._map.map_id(old)) in self.requested:
            needed = 1
        enough = len(supporters) >= needed if same_map else _is_supported(chosen, needed)
        if not enough or not (same_map or consistency.has_depth_relief(self._map, chosen, config)):
            return None
        if not same_map and any(self._is_ambiguous(k) for m in chosen[-_MIN_KEYFRAMES:] for k in (m.old, m.new)):
            self.refused += 1
            return None
        if same_map:
            self._matches[key] = []  # matches that merged maps stay, to be weighed against later ones
        return self._closure(best, chosen)

    def _verify_neighbours(self, match: LoopMatch) -> LoopClosure | Contradiction | None:
        """Verify the keyframes beside both matched ones too: where maps hardly overlap, few are found by the index.

        Those before the new one are matched to the old one, and those around the old one to the new one.
        """
        new, old = submap_of_keyframe(match.new), submap_of_keyframe(match.old)
        if self._map.map_id(new) == self._map.map_id(old):
            return None
        count, correction = self._config.predecessors, correction_of(self._map, match)
        same, other, at = self._map.submaps[new], self._map.submaps[old], self._map.number_of(match.old)
        before = same[max(0, self._map.number_of(match.new) - count) : self._map.number_of(match.new)]
        around = sorted(other[max(0, at - count) : at + count + 1], key=lambda k: abs(self._map.number_of(k) - at))
        back = sim3.inverse(correction)
        beside = [(k, match.old, correction) for k in reversed(before)] + [(k, match.new, back) for k in around]
        for keyframe, place, guess in beside:
            if self._map.pose(keyframe) is None:  # its parent is still to come
                continue
            if any(m.new == keyframe for m in self._matches[_pair(new, old)]):
                continue
            found = verify_loop(
                self._map, keyframe, place, self._config, guess=guessed_pose(self._map, guess, keyframe)
            )
            if found is None:
                continue
            self.verified += 1
            closure = self._weigh(found)
            if closure is not None:
                return closure
        return None

    def _closure(self, best: LoopMatch, chosen: Sequence[LoopMatch]) -> LoopClosure:
        maps = tuple(self._map.map_id(submap_of_keyframe(k)) for k in (best.new, best.old))
        metric = [m for m in maps if not self._map.is_up_to_scale(m)]
        older = metric[0] if len(metric) == 1 else self.oldest(maps)  # the only map in metres keeps its scale
        newer = maps[1] if older == maps[0] else maps[0]
        X = correction_of(self._map, best)
        return LoopClosure(newer, older, X if older == maps[1] else sim3.inverse(X), tuple(chosen))

    def _is_recent(self, match: LoopMatch, newest: LoopMatch) -> bool:
        if match.new not in self._map or match.old not in self._map:
            return False
        if submap_of_keyframe(match.new) != submap_of_keyframe(newest.new):
            return True
        between = self._map.number_of(match.new) - self._map.number_of(newest.new)
        return abs(between) <= _RECENT_KEYFRAMES

    def _is_ambiguous(self, keyframe: KeyframeId) -> bool:
        """True if the map of a keyframe shows the same place elsewhere too."""
        sparse_map, config = self._map, self._config
        T = sparse_map.world_pose(keyframe)
        assert T is not None
        observations = observations_of(sparse_map, keyframe)
        map_id = sparse_map.map_id(submap_of_keyframe(keyframe))
        share = MONOCULAR_DRIFT_PATH if sparse_map.is_up_to_scale(submap_of_keyframe(keyframe)) else config.drift_path
        tried = 0
        places = self._index.query(observations.descriptor, {keyframe}, _QUERIED * config.candidates)
        for key in places.keys.tolist():
            other = KeyframeId(key)
            T_other = sparse_map.world_pose(other)
            if sparse_map.map_id(submap_of_keyframe(other)) != map_id or T_other is None:
                continue
            limit = _AMBIGUOUS_M + share * consistency.path_length(sparse_map, other, keyframe)
            near = float(np.linalg.norm(T_other[:3, 3] - T[:3, 3])) <= limit
            if near and (T_other[:3, 2] @ T[:3, 2]) > _SAME_VIEW_COSINE:
                continue
            tried += 1
            if tried > config.candidates:
                return False
            match = verify_loop(sparse_map, keyframe, other, config, observations)
            if match is None:
                continue
            X = correction_of(sparse_map, match)
            if float(np.linalg.norm(se3.transform(X, T[None, :3, 3])[0] - T[:3, 3])) > limit:
                return True
        return False


def _is_supported(matches: Sequence[LoopMatch], needed: int) -> bool:
    """True if matches between two submaps are enough to merge them: as many as needed, with a keyframe more in both.

    Two or more of either submap: one view alone may be of an object that stands in two places, from both of which other
    views match it. Which of them were queried tells nothing but the order in which they came.
    """
    keyframes = {k for m in matches for k in (m.new, m.old)}
    fewest = min(Counter(map(submap_of_keyframe, keyframes)).values())
    return len(matches) >= needed and len(keyframes) > needed and fewest >= min(needed, 2)


def known_matches(sparse_map: SparseMap, matches: Collection[LoopMatch]) -> list[LoopMatch]:
    """Saved matches without those of unknown keyframes, and without pairs of unknown landmarks."""
    out = []
    for match in matches:
        if sparse_map.pose(match.new) is not None and sparse_map.pose(match.old) is not None:
            new, old = slot_pairs(sparse_map, match.new_landmarks, match.old_landmarks)
            ids = sparse_map.landmark_ids(new), sparse_map.landmark_ids(old)
            out.append(replace(match, new_landmarks=ids[0], old_landmarks=ids[1]))
    return out


def _pair(a: SubmapId, b: SubmapId) -> SubmapPair:
    return (min(a, b), max(a, b))
