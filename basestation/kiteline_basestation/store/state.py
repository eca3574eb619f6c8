"""What a base knows beyond the shared values, as JSON texts by name: how maps are joined, what proved it, what is due.

edge/N a loop that was proved; merge/N a map laid into another; votes/A/B evidence that is not enough yet; fresh/A
points to be fused; submap/S where it lies and what it is called; agent/N what is known of its disparities; base the
rest. Keyframes, submaps and points stand by their ids, for slots are numbered anew at each start.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_verification import LoopMatch
from kiteline_core.geometry import sim3
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

Json = Any


@dataclass(frozen=True, slots=True)
class Entry:
    """One text to be. mark: equal as long as the text would be the same, and cheap to compare. make: its value."""

    mark: object
    make: Callable[[], Json]


Memory = dict[str, Entry]


class Scribe:
    """Words what a mapper remembers, and only what changed since the last time."""

    def __init__(self) -> None:
        self._marks: dict[str, object] = {}

    def changes(self, memory: Memory) -> dict[str, str | None]:
        """Texts of new and changed entries; None for those that are gone."""
        out: dict[str, str | None] = dict.fromkeys(self._marks.keys() - memory.keys())
        for name in out:
            del self._marks[name]
        for name, entry in memory.items():
            if name not in self._marks or self._marks[name] != entry.mark:
                self._marks[name] = entry.mark
                out[name] = json.dumps(entry.make(), separators=(",", ":"))
        return out


def plain(value: Json) -> Entry:
    """An entry that is its own mark."""
    return Entry(value, lambda: value)


def matrix(pose: F64 | None) -> list[float] | None:
    """A pose (4,4) as 16 numbers, to the last bit."""
    return None if pose is None else [float(x) for x in pose.ravel()]


def pose_of(numbers: Sequence[float]) -> F64:
    """The opposite of `matrix`. Raises ValueError when it is no rigid motion."""
    pose = np.array(numbers, np.float64).reshape(4, 4)
    turn = pose[:3, :3]
    if not np.isfinite(pose).all() or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or np.linalg.det(turn) < 0:
        raise ValueError("no rigid motion")
    if not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError("no rigid motion")
    return pose


def similarity_of(numbers: Sequence[float]) -> F64:
    """The same of a pose with a scale. Raises ValueError when it is no similarity."""
    S = np.array(numbers, np.float64).reshape(4, 4)
    scale = sim3.scale_of(S) if np.isfinite(S).all() else 0.0
    if scale <= 0.0:
        raise ValueError("no similarity")
    pose_of((S if scale == 1.0 else sim3.rigid(S)).ravel().tolist())
    if scale != 1.0 and np.abs(S[:3, :3] @ S[:3, :3].T / scale**2 - np.eye(3)).max() > 1e-6:
        raise ValueError("no similarity")
    return S


def votes_entry(sparse_map: SparseMap, votes: Sequence[LoopMatch], points: bool) -> Entry:
    """Evidence. points: with the points that are one; without them it only says how keyframes lie to each other."""
    mark = tuple((v.new, v.old, v.inliers, v.T_old_new.tobytes(), v.scale, len(v.mine)) for v in votes)
    return Entry(mark, lambda: [_vote(sparse_map, v, points) for v in votes])


def _vote(sparse_map: SparseMap, vote: LoopMatch, points: bool) -> Json:
    pairs = [vote.mine, vote.theirs] if points else [vote.mine[:0], vote.theirs[:0]]
    return {
        "new": int(vote.new), "old": int(vote.old), "T": matrix(vote.T_old_new), "inliers": int(vote.inliers),
        "scale": float(vote.scale), "depth_m": float(vote.depth_m),
        "points": [sparse_map.landmark_ids(slots).tolist() for slots in pairs],
    }  # fmt: skip


def votes_of(sparse_map: SparseMap, value: Json) -> list[LoopMatch]:
    """The opposite of `votes_entry`; what names unknown keyframes is left out, and so are unknown points."""
    out = []
    for vote in value:
        new, old = KeyframeId(vote["new"]), KeyframeId(vote["old"])
        if sparse_map.pose(new) is None or sparse_map.pose(old) is None:
            continue
        mine, theirs = slots_of(sparse_map, *vote["points"])
        T, scale = pose_of(vote["T"]), vote.get("scale", 1.0)  # stores of protocol 2 knew no scale
        out.append(LoopMatch(new, old, T, vote["inliers"], mine, theirs, vote["depth_m"], scale))
    return out


def slots_of(sparse_map: SparseMap, a: Sequence[int], b: Sequence[int]) -> tuple[I32, I32]:
    """Slots (n,) of pairs of points of which both are known."""
    both = [sparse_map.find_landmarks(np.array(ids, np.int64)) for ids in (a, b)]
    known = (both[0] >= 0) & (both[1] >= 0)
    return both[0][known], both[1][known]


def parsed(texts: Mapping[str, str], folder: str) -> list[tuple[list[str], Json]]:
    """The texts whose names begin with FOLDER/, in order of name: the rest of the name, and the value."""
    found = sorted(name for name in texts if name.partition("/")[0] == folder)
    return [(name.split("/")[1:], json.loads(texts[name])) for name in found]
