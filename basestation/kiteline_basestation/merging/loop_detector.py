"""Finds places that were seen before, in any map of any agent, and says when the evidence is enough.

Every keyframe asks the place index; what looks alike is proved by geometry (`overlap`), and each proof is a vote for
how two maps lie to each other, or for how far one has drifted. A few keyframes must say the same, none the contrary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.exchange.sharing import SharingPolicy
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_edges import depth_of, motion_of, rescaled
from kiteline_basestation.merging.loop_verification import LoopMatch, View, verify_loop, view_of
from kiteline_basestation.store.state import Memory, parsed, plain, votes_entry, votes_of
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe
from kiteline_core.places.place_index import PlaceIndex, Vocabulary

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """Enough votes. newer, older: islands (the same one: a loop). S_older_newer: (4,4) how the newer has to move, in w:
    a rigid motion where both have one unit of length.

    votes: those that agree. against: submaps of one map whose places contradict how they were joined.
    """

    newer: SubmapId
    older: SubmapId
    S_older_newer: F64
    votes: tuple[LoopMatch, ...]
    against: tuple[SubmapId, SubmapId] | None = None

    @property
    def loop(self) -> bool:
        """Whether both are one map already."""
        return self.newer == self.older


class LoopDetector:
    """The place index over all keyframes, and the votes that are open."""

    def __init__(self, config: LoopConfig, sparse_map: SparseMap, words: Vocabulary) -> None:
        self._config = config
        self._map = sparse_map
        self._index = PlaceIndex(words)
        self._sharing = SharingPolicy(config.share)
        self._votes: dict[tuple[SubmapId, SubmapId], list[LoopMatch]] = {}  # by the submaps of old and new
        self._doubts: dict[tuple[SubmapId, SubmapId], int] = {}  # how often a join of two submaps was taken back
        self._born: dict[SubmapId, int] = {}  # when the base first heard of a submap
        self.apart: list[tuple[frozenset[SubmapId], frozenset[SubmapId]]] = []  # what a person has split stays so
        self.asked: set[tuple[SubmapId, SubmapId]] = set()  # maps that a person says to overlap: one proof is enough
        self.proofs = 0  # overlaps that geometry proved
        self.refused = 0  # findings that were no drift, or of places that have twins

    def add(self, keyframe: KeyframeId) -> None:
        """Remember what a keyframe sees."""
        self._born.setdefault(submap_of_keyframe(keyframe), len(self._born))
        self._index.add(keyframe, view_of(self._map, keyframe).descriptor)

    def forget(self, keyframe: KeyframeId) -> None:
        """A keyframe is no place any more."""
        self._index.remove(keyframe)

    def eldest(self, submaps: Sequence[SubmapId]) -> SubmapId:
        """The submap that the base heard of first."""
        return min(submaps, key=lambda s: (self._born.get(s, len(self._born)), s))

    def consider(self, keyframe: KeyframeId) -> LoopClosure | None:
        """Ask where else this place was seen. A finding is told once: its votes are used up."""
        closure = self._said_by_agent(keyframe)
        view = view_of(self._map, keyframe)
        for old in self._candidates(keyframe, view):
            match = verify_loop(self._map, keyframe, old, self._config, view)
            if match is None:
                continue
            self.proofs += 1
            closure = closure or self._count(match) or self._ask_before(match)
        return closure

    def memory(self) -> Memory:
        """What a successor needs: evidence that is not enough yet, doubts, and which map is the elder."""
        out = {f"votes/{a}/{b}": votes_entry(self._map, votes, points=True) for (a, b), votes in self._votes.items()}
        out["finder"] = plain(
            {
                "doubts": [[int(a), int(b), n] for (a, b), n in self._doubts.items()],
                "born": [int(s) for s in self._born],
                "apart": [[sorted(map(int, a)), sorted(map(int, b))] for a, b in self.apart],
                "asked": sorted([int(a), int(b)] for a, b in self.asked),
            }
        )
        return out

    def recall(self, texts: Mapping[str, str]) -> None:
        """Go on from what a forerunner remembered."""
        for (a, b), votes in parsed(texts, "votes"):
            self._votes[SubmapId(int(a)), SubmapId(int(b))] = votes_of(self._map, votes)
        for _, value in parsed(texts, "finder"):
            self._doubts = {(SubmapId(a), SubmapId(b)): n for a, b, n in value["doubts"]}
            self._born = {s: i for i, s in enumerate(dict.fromkeys([*map(SubmapId, value["born"]), *self._born]))}
            self.apart = [(frozenset(map(SubmapId, a)), frozenset(map(SubmapId, b))) for a, b in value["apart"]]
            self.asked = {(SubmapId(a), SubmapId(b)) for a, b in value["asked"]}

    def rescale(self, factor: Mapping[KeyframeId, float]) -> None:
        """Lengths before keyframes, in their submaps, have been multiplied by `factor`: so are those of open votes."""
        self._votes = {key: [rescaled(v, factor) for v in votes] for key, votes in self._votes.items()}

    def _kept_apart(self, a: SubmapId, b: SubmapId) -> bool:
        return any((a in x and b in y) or (b in x and a in y) for x, y in self.apart)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _said_by_agent(self, keyframe: KeyframeId) -> LoopClosure | None:
        """An agent that found its old map again makes two keyframes of one instant, one in each submap."""
        sparse_map = self._map
        new, t_ns = submap_of_keyframe(keyframe), sparse_map.keyframes.t_ns[sparse_map.rows[keyframe]]
        for submap in sorted(sparse_map.submaps):
            if agent_of_submap(submap) != agent_of_submap(new) or sparse_map.map_id(submap) == sparse_map.map_id(new):
                continue
            for other in sparse_map.submaps[submap]:
                if sparse_map.keyframes.t_ns[sparse_map.rows[other]] != t_ns or other not in self._index:
                    continue
                if sparse_map.is_up_to_scale(new) or sparse_map.is_up_to_scale(submap):
                    continue  # how long the unit of the one is in the other, nobody says
                if self._doubts.get((min(new, submap), max(new, submap)), 0) or self._kept_apart(new, submap):
                    continue
                nothing = np.empty(0, np.int32)
                vote = LoopMatch(keyframe, other, np.eye(4), self._config.min_inliers_loop, nothing, nothing, 1.0)
                return self._closure(vote, [vote])
        return None

    def _candidates(self, keyframe: KeyframeId, view: View) -> list[KeyframeId]:
        """The places most alike, at most one of each neighbourhood, and never what is known to be one with this."""
        sparse_map, config = self._map, self._config
        if len(view.slots) < config.min_inliers:
            return []
        shared = sparse_map.covisibility(sparse_map.landmarks_of(keyframe))
        known = set(sparse_map.keyframes.id[np.flatnonzero(shared > config.max_shared)].tolist())
        same = sparse_map.submaps[submap_of_keyframe(keyframe)]
        at = same.index(keyframe)
        near = same[max(0, at - config.min_gap) : at + config.min_gap + 1]
        before = [k for k in near if k < keyframe][-1:]
        enough = config.min_likeness
        if before and keyframe in self._index and before[0] in self._index:
            enough = max(enough, config.min_of_neighbours * float(self._index.likeness(keyframe, before)[0]))
        places = self._index.query(view.descriptor, known | set(near) | {keyframe}, 12 * config.candidates)
        out: list[KeyframeId] = []
        taken: set[int] = set()
        left = {True: config.candidates_here, False: config.candidates}
        map_id = sparse_map.map_id(submap_of_keyframe(keyframe))
        for key, score in zip(places.keys.tolist(), places.score.tolist()):
            old = KeyframeId(key)
            if score < enough:
                break
            here = sparse_map.map_id(submap_of_keyframe(old)) == map_id
            if (
                key in taken
                or left[here] == 0
                or not self._sharing.allows(agent_of_keyframe(keyframe), agent_of_keyframe(old))
                or self._kept_apart(submap_of_keyframe(keyframe), submap_of_keyframe(old))
            ):
                continue
            out.append(old)
            left[here] -= 1
            around = sparse_map.covisibility(sparse_map.landmarks_of(old))
            taken |= set(sparse_map.keyframes.id[np.flatnonzero(around > config.max_shared)].tolist())
        return out

    def _count(self, vote: LoopMatch) -> LoopClosure | None:
        """Whether this vote and earlier ones are enough."""
        config = self._config
        new, old = submap_of_keyframe(vote.new), submap_of_keyframe(vote.old)
        key = (min(new, old), max(new, old))
        votes = [v for v in self._votes.get(key, []) if self._recent(v, vote)]
        votes.append(vote)
        self._votes[key] = votes
        same_map = self._map.map_id(new) == self._map.map_id(old)
        chosen = [v for v in votes if self._agree(v, vote)]
        supporters = {v.new for v in chosen}
        best = max(chosen, key=lambda v: (v.inliers, v.new))
        if same_map and not self._drift_explains(vote):
            if new == old or len(supporters) < config.votes:
                return None
            self._doubts[key] = self._doubts.get(key, 0) + 1
            return replace(self._closure(best, chosen), against=key)
        if same_map and vote.inliers < config.min_inliers_loop:
            return None
        against = {v.new for v in votes} - supporters
        needed = config.votes * (1 + 2 * self._doubts.get(key, 0)) + config.against * len(against)
        root_submaps = (self._map.map_id(key[0]), self._map.map_id(key[1]))
        if (min(root_submaps), max(root_submaps)) in self.asked:
            needed = 1
        if len(supporters) < needed or not (same_map or self._stands_out(chosen)):
            return None
        if not same_map and any(self._has_twin(v) for v in chosen[-config.votes :]):
            self.refused += 1
            return None
        if same_map:
            self._votes[key] = []  # those that joined maps stay, to be weighed against later ones
        return self._closure(best, chosen)

    def _ask_before(self, vote: LoopMatch) -> LoopClosure | None:
        """Ask keyframes just before a proved one of the same place: where maps hardly overlap, few find it alone."""
        new, old = submap_of_keyframe(vote.new), submap_of_keyframe(vote.old)
        if self._map.map_id(new) == self._map.map_id(old):
            return None
        same = self._map.submaps[new]
        at = same.index(vote.new)
        for keyframe in reversed(same[max(0, at - self._config.ask_before) : at]):
            if any(v.new == keyframe for v in self._votes[(min(new, old), max(new, old))]):
                continue
            match = verify_loop(self._map, keyframe, vote.old, self._config)
            if match is None:
                continue
            self.proofs += 1
            closure = self._count(match)
            if closure is not None:
                return closure
        return None

    def _stands_out(self, votes: list[LoopMatch]) -> bool:
        """Whether points lie off the plane that fits most of them: what is flat may hang in two places."""
        points = np.unique(np.concatenate([v.theirs for v in votes]))
        xyz, known = self._map.positions(points.astype(np.int32))
        xyz = xyz[known]
        if len(xyz) < self._config.min_inliers:
            return False
        limit = self._config.off_plane * float(np.median([depth_of(self._map, v) for v in votes]))
        inside = np.ones(len(xyz), np.bool_)
        distance = np.zeros(len(xyz))
        for _ in range(4):
            centre = xyz[inside].mean(axis=0)
            normal = np.linalg.svd(xyz[inside] - centre, full_matrices=False)[2][2]
            distance = np.abs((xyz - centre) @ normal)
            inside = distance <= max(limit, float(np.median(distance)))
        return float(np.mean(distance > limit)) >= self._config.min_off_plane

    def _closure(self, best: LoopMatch, chosen: list[LoopMatch]) -> LoopClosure:
        root_submaps = tuple(self._map.map_id(submap_of_keyframe(k)) for k in (best.new, best.old))
        metric = [i for i in root_submaps if not self._map.is_up_to_scale(i)]
        older = metric[0] if len(metric) == 1 else self.eldest(root_submaps)  # who knows the metre keeps it
        newer = root_submaps[1] if older == root_submaps[0] else root_submaps[0]
        X = motion_of(self._map, best)  # island of old from island of new
        if older != root_submaps[1]:
            X = sim3.inverse(X)
        return LoopClosure(newer, older, X, tuple(chosen))

    def _recent(self, vote: LoopMatch, newest: LoopMatch) -> bool:
        if vote.new not in self._map or vote.old not in self._map:
            return False
        if submap_of_keyframe(vote.new) != submap_of_keyframe(newest.new):
            return True
        same = self._map.submaps[submap_of_keyframe(vote.new)]
        return abs(same.index(vote.new) - same.index(newest.new)) <= self._config.memory

    def _agree(self, a: LoopMatch, b: LoopMatch) -> bool:
        """Whether two votes say the same of how two maps lie, as far as drift between them allows."""
        config = self._config
        Xa, Xb = motion_of(self._map, a), motion_of(self._map, b)
        if submap_of_keyframe(a.new) != submap_of_keyframe(b.new):
            Xa = sim3.inverse(Xa)
        if abs(np.log(sim3.scale_of(Xa) / sim3.scale_of(Xb))) > config.agree_scale:
            return False
        at_a, at_b = self._map.world_pose(a.new), self._map.world_pose(b.new)
        assert at_a is not None and at_b is not None
        spot = at_b[:3, 3]
        apart = float(np.linalg.norm(se3.transform(Xa, spot[None])[0] - se3.transform(Xb, spot[None])[0]))
        turned = _turn(Xa, Xb)
        way = float(np.linalg.norm(at_a[:3, 3] - spot)) if submap_of_keyframe(a.new) == submap_of_keyframe(b.new) else 0
        deep = max(depth_of(self._map, a), depth_of(self._map, b))
        limit = config.agree_m + config.agree_depth * deep + config.agree_path * way
        return apart <= limit and turned <= config.agree_rad

    def _drift_explains(self, vote: LoopMatch) -> bool:
        """Whether a loop's correction is what flying that far may have added up to."""
        config = self._config
        X = motion_of(self._map, vote)
        pose = self._map.world_pose(vote.new)
        assert pose is not None
        moved = float(np.linalg.norm(se3.transform(X, pose[None, :3, 3])[0] - pose[:3, 3]))
        turned = _turn(np.eye(4), X)
        way = self._way_m(vote.old, vote.new)
        explained = moved <= self._drift_m(vote, way) and turned <= config.drift_rad + config.drift_rad_m * way
        explained = explained and abs(float(np.log(sim3.scale_of(X)))) <= config.own_drift_scale
        self.refused += not explained
        return explained

    def _drift_m(self, vote: LoopMatch, way: float) -> float:
        """By how much the end of a way may be off: where the unit of length drifts, by as much as it did, too."""
        config, share = self._config, self._config.drift_path
        if any(self._map.is_up_to_scale(submap_of_keyframe(k)) for k in (vote.new, vote.old)):
            share = config.own_drift_path + abs(float(np.log(sim3.scale_of(motion_of(self._map, vote)))))
        return config.drift_m + share * way

    def _way_m(self, a: KeyframeId, b: KeyframeId) -> float:
        """Length of the way flown between two keyframes of one map."""
        total = 0.0
        same = submap_of_keyframe(a) == submap_of_keyframe(b)
        for submap in sorted({submap_of_keyframe(a), submap_of_keyframe(b)}):
            keyframes = self._map.submaps[submap]
            if same:
                keyframes = [k for k in keyframes if min(a, b) <= k <= max(a, b)]
            rows = [self._map.rows[k] for k in keyframes]
            places = self._map.keyframes.T_w_k[rows, :3, 3]
            total += float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        return total

    def _has_twin(self, vote: LoopMatch) -> bool:
        """Whether one of the two maps shows the same place elsewhere too: then nobody knows which of them it is."""
        return any(self._twin_of(k) for k in (vote.old, vote.new))

    def _twin_of(self, keyframe: KeyframeId) -> bool:
        sparse_map, config = self._map, self._config
        T = sparse_map.world_pose(keyframe)
        assert T is not None
        view = view_of(sparse_map, keyframe)
        map_id = sparse_map.map_id(submap_of_keyframe(keyframe))
        looked = 0
        for key in self._index.query(view.descriptor, {keyframe}, 12 * config.candidates).keys.tolist():
            other = KeyframeId(key)
            T_other = sparse_map.world_pose(other)
            if sparse_map.map_id(submap_of_keyframe(other)) != map_id or T_other is None:
                continue
            own = sparse_map.is_up_to_scale(submap_of_keyframe(keyframe))
            way = self._way_m(other, keyframe)
            limit = config.twin_m + (config.own_drift_path if own else config.drift_path) * way
            if float(np.linalg.norm(T_other[:3, 3] - T[:3, 3])) <= limit and (T_other[:3, 2] @ T[:3, 2]) > 0.5:
                continue  # the same place seen from near by
            looked += 1
            if looked > config.candidates:
                return False
            match = verify_loop(sparse_map, keyframe, other, config, view)
            if match is None:
                continue
            X = motion_of(sparse_map, match)
            if float(np.linalg.norm(se3.transform(X, T[None, :3, 3])[0] - T[:3, 3])) > limit:
                return True
        return False


def _turn(Sa: F64, Sb: F64) -> float:
    """Angle in rad between two similarities (4,4)."""
    return float(np.linalg.norm(se3.so3_log(se3.orthonormalise(sim3.inverse(Sa) @ Sb)[:3, :3])))
