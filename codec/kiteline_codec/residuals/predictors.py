"""What tight forms build upon: the agent's own values, decoded once for each version."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader
from kiteline_codec.residuals import prediction_kernels as kernels
from kiteline_codec.schema import CameraIntrinsics, Key, KeyframeHeader, NewLandmarks, WireError, messages
from kiteline_core.ids import MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId, agent_of_keyframe

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

Held = Callable[[Key], tuple[int, bytes] | None]  # version and code of a value that both sides hold

MAX_GENERATIONS = 64  # steps along parents to a keyframe of birth: farther, the sum of poses says little
MASK_PARTS = 16  # parts of births that can be named
_REMEMBERED = 256  # keyframes whose values are kept decoded
_NO_PART = -1
_BIRTHS, _HEAD = NewLandmarks.KIND, KeyframeHeader.KIND


@dataclass(slots=True)
class _Keyframe:
    """births: (5, k) codes of u, v, inverse depth and octave by keypoint, and the part that they came with, -1 where
    there is none; as wide as the last birth asks.
    """

    head: KeyframeHeader | None = None
    head_version: int = 0
    part_versions: dict[int, int] = field(default_factory=dict)
    births: I32 = field(default_factory=lambda: np.empty((5, 0), np.int32))


class References:
    """Headers, births and cameras as both sides hold them, kept decoded."""

    def __init__(self) -> None:
        self._keyframes: OrderedDict[int, _Keyframe] = OrderedDict()
        self._cameras: dict[int, tuple[int, F64]] = {}
        self.told: KeyframeHeader | None = None  # a header that is used as it is, whatever is held

    def _keyframe(self, keyframe: int) -> _Keyframe:
        entry = self._keyframes.get(keyframe)
        if entry is None:
            entry = self._keyframes[keyframe] = _Keyframe()
            if len(self._keyframes) > _REMEMBERED:
                self._keyframes.popitem(last=False)
        else:
            self._keyframes.move_to_end(keyframe)
        return entry

    def camera(self, keyframe: int, held: Held) -> tuple[int, F64] | None:
        """Version, and fx, fy, cx, cy of the camera that saw a keyframe."""
        agent = int(agent_of_keyframe(KeyframeId(keyframe)))
        now = held(Key(CameraIntrinsics.KIND, agent))
        if now is None:
            return None
        if agent not in self._cameras or self._cameras[agent][0] != now[0]:
            record = messages.decode(Key(CameraIntrinsics.KIND, agent), now[1])
            assert isinstance(record, CameraIntrinsics)
            c = record.camera
            self._cameras[agent] = now[0], np.array([c.fx, c.fy, c.cx, c.cy])
        return self._cameras[agent]

    def head(self, keyframe: int, held: Held) -> tuple[int, KeyframeHeader] | None:
        """Version, and header."""
        if self.told is not None and self.told.keyframe == keyframe:
            return 0, self.told
        now = held(Key(_HEAD, keyframe))
        if now is None:
            return None
        entry = self._keyframe(keyframe)
        if entry.head is None or entry.head_version != now[0]:
            record = messages.decode(Key(KeyframeHeader.KIND, keyframe), now[1])
            assert isinstance(record, KeyframeHeader)
            entry.head, entry.head_version = record, now[0]
        return entry.head_version, entry.head

    def births(self, keyframe: int, held: Held) -> tuple[dict[int, int], I32]:
        """Versions by part of what both sides hold; codes (5, k) of u, v, inverse depth, octave, and the part, of the
        first k keypoints: beyond them there are no births.
        """
        versions: dict[int, int] = {}
        entry = self._keyframe(keyframe)
        missing = 0
        for part in range(MASK_PARTS):
            now = held(Key(_BIRTHS, keyframe, part))
            if now is None:
                missing += 1
                if missing == 2:
                    break
                continue
            versions[part] = now[0]
            if entry.part_versions.get(part) != now[0]:
                entry.births[4, entry.births[4] == part] = _NO_PART
                values = NewLandmarks.COLUMNS.read_codes(Reader(now[1]))
                if values.shape[1]:
                    if values[0].min() < 0 or values[0].max() >= MAX_KEYPOINTS:
                        raise WireError("a keypoint is out of range")
                    entry.births = _widened(entry.births, int(values[0].max()) + 1)
                    entry.births[:4, values[0]] = values[1:5]
                    entry.births[4, values[0]] = part
                entry.part_versions[part] = now[0]
        return versions, entry.births

    def poses(self, keyframe: int, wanted: set[int], held: Held) -> tuple[dict[int, F64], list[int]]:
        """T_k_a (4,4) of the wanted keyframes that are found along parents, up from keyframe k to the nearest common
        one and down again; and the versions of the headers on these ways, in order of keyframes.
        """
        above = self._above(keyframe, wanted, held)
        generation = {a: i for i, (a, _, _) in enumerate(above)}
        poses: dict[int, F64] = {}
        versions: dict[int, int] = {}
        highest = 0
        for a in sorted(wanted):
            below: list[tuple[int, KeyframeHeader, int]] = []  # from a up to below the common keyframe
            at = a
            while at not in generation and len(below) < MAX_GENERATIONS:
                head = self.head(at, held)
                if head is None or head[1].parent == NO_KEYFRAME:
                    break
                below.append((at, head[1], head[0]))
                at = int(head[1].parent)
            if at not in generation:
                continue
            T_k_a = above[generation[at]][1]
            for _, head_below, _ in reversed(below):
                T = np.empty((4, 4))
                kernels.compose(T_k_a, np.ascontiguousarray(head_below.T_p_k), T)
                T_k_a = T
            poses[a] = T_k_a
            versions.update({b: version for b, _, version in below})
            highest = max(highest, generation[at])
        versions.update({b: version for b, _, version in above[:highest]})
        return poses, [versions[b] for b in sorted(versions)]

    def _above(self, keyframe: int, wanted: set[int], held: Held) -> list[tuple[int, F64, int]]:
        """Keyframe k, its parent, and so on until all wanted were met, with T_k_a (4,4) and the version of the header;
        0 for the last one, whose header is not used.
        """
        at, T_k_a, step = keyframe, np.eye(4), np.empty((4, 4))
        left = len(wanted - {at})
        above: list[tuple[int, F64, int]] = []
        for _ in range(MAX_GENERATIONS):
            head = self.head(at, held) if left else None
            if head is None or head[1].parent == NO_KEYFRAME:
                break
            above.append((at, T_k_a, head[0]))
            kernels.invert(np.ascontiguousarray(head[1].T_p_k), step)
            T_k_p = np.empty((4, 4))
            kernels.compose(T_k_a, step, T_k_p)
            at, T_k_a = int(head[1].parent), T_k_p
            left -= at in wanted
        above.append((at, T_k_a, 0))
        return above


def parts_at(births: I32, keypoint: I64) -> set[int]:
    """The parts with which the births at keypoints (n,) came, and perhaps -1."""
    return set(births[4, keypoint[keypoint < births.shape[1]]].tolist())


def _widened(births: I32, width: int) -> I32:
    """The same with room for so many keypoints at least."""
    more = width - births.shape[1]
    return births if more <= 0 else np.pad(births, ((0, 0), (0, more)), constant_values=_NO_PART)
