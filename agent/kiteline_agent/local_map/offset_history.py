"""Disparity offsets that the agent found in turn, and how each moved its keyframes.

Poses of the base are computed with the offset that it knew then, over a thin link seconds ago. They fit a map that has
moved since only once they are moved likewise.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.geometry.disparity_offset import none, terms
from kiteline_core.ids import NO_KEYFRAME

_TOLD_M = 1e-3  # rms of keyframes: by less nothing tells which offset the base knew; poses are told to a millimetre


@dataclass(frozen=True, slots=True)
class _Change:
    """A change of the offset (5,) px, and by keyframe the twist (6,) that moved it: T_m_k = exp(twist) T_m_k."""

    offset_px: F64
    twists: Mapping[int, F64]

    def twist(self, keyframe: int, parents: Mapping[int, int]) -> F64 | None:
        """That of a keyframe, or of its nearest ancestor, to which a later one is tied; None if neither was moved."""
        while keyframe != NO_KEYFRAME:
            if (found := self.twists.get(keyframe)) is not None:
                return found
            keyframe = parents.get(keyframe, NO_KEYFRAME)
        return None


class OffsetHistory:
    """The changes of the offset so far, numbered from 0. What is said of n changes knows those before number n."""

    def __init__(self) -> None:
        self._changes: list[_Change] = []
        self._known = 0  # so many changes the base knows, at least
        self._likely = 0  # so many it knew when it told poses last

    def __len__(self) -> int:
        return len(self._changes)

    def add(self, offset_px: F64, keyframe: I64, twists: F64) -> None:
        """The offset changed by (5,) px, which moves keyframes (k,) by twists (k,6) in m, on the left."""
        moved = dict(zip(keyframe.tolist(), np.array(twists), strict=True))
        self._changes.append(_Change(np.array(offset_px), moved))

    def base_knows_all(self) -> None:
        """The map has the base's own offset now."""
        self._known = self._likely = len(self._changes)

    def known_to_base(self, told: Mapping[int, F64], held: Mapping[int, F64], parents: Mapping[int, int]) -> int:
        """How many changes the base knew when it told poses: those that fit the map best once the others move them.

        told, held: poses T_m_k (4,4) of the base and of the map, by keyframe. parents: of the map's keyframes. Without
        poses, as many as when it told some last.
        """
        n = len(self._changes)
        if self._known == n or not told:
            return self._likely
        errors = [
            float(np.mean([
                np.sum((self.moved(T, keyframe, known, parents)[:3, 3] - held[keyframe][:3, 3]) ** 2)
                for keyframe, T in told.items()
            ]))
            for known in range(self._known, n + 1)
        ]  # fmt: skip
        best = self._known + len(errors) - 1 - int(np.argmin(errors[::-1]))  # of equal ones the newest
        if errors[0] - min(errors) > _TOLD_M**2:
            self._known = best
        self._likely = best
        return best

    def moved(self, T_m_k: F64, keyframe: int, known: int, parents: Mapping[int, int]) -> F64:
        """A keyframe's pose (4,4), estimated with the first `known` changes of the offset, moved by the later ones."""
        for change in self._changes[known:]:
            twist = change.twist(keyframe, parents)
            if twist is not None:
                T_m_k = se3.exp(twist) @ T_m_k
        return T_m_k

    def disparity_px(self, bearing: F64, known: int) -> F64:
        """By how much (n,) disparities at bearings (n,2) are smaller by the changes after the first `known`."""
        change = sum((c.offset_px for c in self._changes[known:]), start=none())
        return np.asarray(terms(bearing) @ change)
