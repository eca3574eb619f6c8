"""Values of the agent from which residual codes are predicted, decoded once for each version."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError
from kiteline_codec.residuals import prediction_kernels as kernels
from kiteline_codec.schema import CameraIntrinsics, Key, KeyframeHeader, NewLandmarks, messages
from kiteline_core.arrays import F64, I32, I64
from kiteline_core.ids import MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId, agent_of_keyframe

Held = Callable[[Key], tuple[int, bytes] | None]  # version and code of a value that both sides hold

MAX_GENERATIONS = 64  # steps along parents to a landmark's keyframe: beyond, the sum of poses is too inaccurate
MASK_PARTS = 16  # parts of new landmarks that can be named
_CACHED_KEYFRAMES = 256
_NO_PART = -1


@dataclass(slots=True)
class _Keyframe:
    """Decoded values of a keyframe. parts: keys of its new landmarks that were asked for. T_k_p: (4,4) inverse of its
    header's motion. landmarks: (5, k) codes of u, v, inverse depth and octave by keypoint, and the part that they came
    with, -1 where there is none; k is the last landmark's keypoint + 1.
    """

    header_key: Key
    parts: list[Key]
    header: KeyframeHeader | None = None
    header_version: int = 0
    T_k_p: F64 | None = None
    part_versions: dict[int, int] = field(default_factory=dict)
    landmarks: I32 = field(default_factory=lambda: np.empty((5, 0), np.int32))


@dataclass(frozen=True, slots=True)
class Poses:
    """T_k_a (4,4) by keyframe a, and the versions of the headers used, in order of keyframes."""

    T_k_a: dict[int, F64]
    versions: list[int]


class Predictors:
    """Headers, new landmarks and cameras as both sides hold them."""

    def __init__(self) -> None:
        self._keyframes: OrderedDict[int, _Keyframe] = OrderedDict()
        self._cameras: dict[int, tuple[int, F64]] = {}

    def clear(self) -> None:
        """Drop what is decoded."""
        self._keyframes.clear()
        self._cameras.clear()

    def _keyframe(self, keyframe: int) -> _Keyframe:
        entry = self._keyframes.get(keyframe)
        if entry is None:
            entry = self._keyframes[keyframe] = _Keyframe(Key(KeyframeHeader.KIND, keyframe), [])
            if len(self._keyframes) > _CACHED_KEYFRAMES:
                self._keyframes.popitem(last=False)
        else:
            self._keyframes.move_to_end(keyframe)
        return entry

    def camera(self, keyframe: int, held: Held) -> tuple[int, F64] | None:
        """Version, and fx, fy, cx, cy of a keyframe's camera."""
        agent = int(agent_of_keyframe(KeyframeId(keyframe)))
        key = Key(CameraIntrinsics.KIND, agent)
        now = held(key)
        if now is None:
            return None
        if agent not in self._cameras or self._cameras[agent][0] != now[0]:
            record = messages.decode(key, now[1])
            assert isinstance(record, CameraIntrinsics)
            c = record.camera
            self._cameras[agent] = now[0], np.array([c.fx, c.fy, c.cx, c.cy])
        return self._cameras[agent]

    def _header(self, keyframe: int, held: Held, sent: KeyframeHeader | None) -> tuple[int, KeyframeHeader] | None:
        """Version, and header; of the keyframe of `sent`, that one as version 0."""
        if sent is not None and sent.keyframe == keyframe:
            return 0, sent
        entry = self._keyframe(keyframe)
        now = held(entry.header_key)
        if now is None:
            return None
        if entry.header is None or entry.header_version != now[0]:
            record = messages.decode(entry.header_key, now[1])
            assert isinstance(record, KeyframeHeader)
            entry.header, entry.header_version, entry.T_k_p = record, now[0], None
        return entry.header_version, entry.header

    def _to_parent(self, header: KeyframeHeader, sent: KeyframeHeader | None) -> F64:
        """T_k_p (4,4) of the keyframe of a header."""
        entry = None if header is sent else self._keyframe(header.keyframe)
        if entry is not None and entry.T_k_p is not None:
            return entry.T_k_p
        T_k_p = np.empty((4, 4))
        kernels.invert(np.ascontiguousarray(header.T_p_k), T_k_p)
        if entry is not None:
            entry.T_k_p = T_k_p
        return T_k_p

    def landmarks(self, keyframe: int, held: Held) -> tuple[dict[int, int], I32]:
        """Versions by part of the new landmarks that both sides hold, and codes (5, k) as in `_Keyframe`."""
        versions: dict[int, int] = {}
        entry = self._keyframe(keyframe)
        keys, decoded = entry.parts, entry.part_versions
        missing = 0
        for part in range(MASK_PARTS):
            if part == len(keys):
                keys.append(Key(NewLandmarks.KIND, keyframe, part))
            now = held(keys[part])
            if now is None:
                missing += 1
                if missing == 2:
                    break
                continue
            versions[part] = now[0]
            if decoded.get(part) != now[0]:
                entry.landmarks[4, entry.landmarks[4] == part] = _NO_PART
                values = NewLandmarks.COLUMNS.read_codes(Reader(now[1]))
                if values.shape[1]:
                    if values[0].min() < 0 or values[0].max() >= MAX_KEYPOINTS:
                        raise WireError("a keypoint is out of range")
                    entry.landmarks = _widened(entry.landmarks, int(values[0].max()) + 1)
                    entry.landmarks[:4, values[0]] = values[1:5]
                    entry.landmarks[4, values[0]] = part
                decoded[part] = now[0]
        return versions, entry.landmarks

    def poses(self, keyframe: int, wanted: set[int], held: Held, sent: KeyframeHeader | None) -> Poses:
        """Poses of the wanted keyframes in keyframe k, as far as headers connect them: along parents up from k to the
        nearest common ancestor, and down again. sent: k's header, where it goes along with the observations.
        """
        ancestors = self._ancestors(keyframe, wanted, held, sent)
        generation = {a: i for i, (a, _, _) in enumerate(ancestors)}
        poses: dict[int, F64] = {}
        versions: dict[int, int] = {}
        highest = 0
        for a in sorted(wanted):
            below: list[tuple[int, KeyframeHeader, int]] = []  # from a up to below the common ancestor
            at = a
            while at not in generation and len(below) < MAX_GENERATIONS:
                header = self._header(at, held, sent)
                if header is None or header[1].parent == NO_KEYFRAME:
                    break
                below.append((at, header[1], header[0]))
                at = int(header[1].parent)
            if at not in generation:
                continue
            T_k_a = ancestors[generation[at]][1]
            for _, header_below, _ in reversed(below):
                T = np.empty((4, 4))
                kernels.compose(T_k_a, np.ascontiguousarray(header_below.T_p_k), T)
                T_k_a = T
            poses[a] = T_k_a
            versions.update({b: version for b, _, version in below})
            highest = max(highest, generation[at])
        versions.update({b: version for b, _, version in ancestors[:highest]})
        return Poses(poses, [versions[b] for b in sorted(versions)])

    def _ancestors(
        self, keyframe: int, wanted: set[int], held: Held, sent: KeyframeHeader | None
    ) -> list[tuple[int, F64, int]]:
        """Keyframe k, its parent, and so on until all wanted are found, with T_k_a (4,4) and the header's version; 0
        for the last one, whose header is not used.
        """
        at, T_k_a = keyframe, np.eye(4)
        left = len(wanted - {at})
        ancestors: list[tuple[int, F64, int]] = []
        for _ in range(MAX_GENERATIONS):
            header = self._header(at, held, sent) if left else None
            if header is None or header[1].parent == NO_KEYFRAME:
                break
            ancestors.append((at, T_k_a, header[0]))
            T_k_parent = np.empty((4, 4))
            kernels.compose(T_k_a, self._to_parent(header[1], sent), T_k_parent)
            at, T_k_a = int(header[1].parent), T_k_parent
            left -= at in wanted
        ancestors.append((at, T_k_a, 0))
        return ancestors


def parts_at(landmarks: I32, keypoint: I64) -> set[int]:
    """The parts that the landmarks at keypoints (n,) came with; it may hold -1, for none."""
    return set(landmarks[4, keypoint[keypoint < landmarks.shape[1]]].tolist())


def _widened(landmarks: I32, width: int) -> I32:
    """The same with room for at least so many keypoints."""
    held = landmarks.shape[1]
    if width <= held:
        return landmarks
    out = np.full((len(landmarks), width), _NO_PART, np.int32)
    out[:, :held] = landmarks
    return out
