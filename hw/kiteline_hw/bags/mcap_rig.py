"""Finds the camera rig in a recording of messages: which image topics are left, right and depth, and where they sit.

Topics are told by their type and frame_id, never by their names; names serve only to match a calibration that names no
frame, and to see that images are rectified already ("image_rect"). The extrinsics come from static transforms, else
from the projection matrices of a rectified pair. The body frame is that of the IMU, else the root of the transforms.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.bags.mcap_messages import Calibration, Transform
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.tables import checked_baseline, checked_camera, lens_of

F64 = NDArray[np.float64]

_WORLDS = ("world", "map", "odom", "earth")
_ALIGNED = 0.8  # cosine between optical axes above which two cameras can be a stereo pair


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A channel of images. count: how many messages."""

    channel: int
    topic: str
    frame_id: str
    count: int
    depth: bool
    encoded: bool


@dataclass(frozen=True, slots=True)
class _Camera:
    images: ImageTopic
    model: CameraModel
    rectified: bool  # the images are those of an ideal camera, and p says where it stands
    T_c_i: F64  # the frame of the images (turned when they are rectified) in the camera's frame
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Selection:
    """The channels that make a frame, and the rig. T_b_l: (4,4) of the frame that the left images name, in the body."""

    rig: CameraRig
    left: ImageTopic
    right: ImageTopic | None
    depth: ImageTopic | None
    imu_usable: bool
    T_b_l: F64
    notes: tuple[str, ...]


class TransformTree:
    """Static transforms, looked up between any two frames that are connected."""

    def __init__(self, transforms: Iterable[Transform]) -> None:
        self._edges: dict[str, dict[str, F64]] = {}
        self._parent: dict[str, str] = {}
        for parent, child, t in transforms:
            self._edges.setdefault(parent, {}).setdefault(child, t)
            self._edges.setdefault(child, {}).setdefault(parent, se3.inverse(t))
            self._parent.setdefault(child, parent)

    def between(self, a: str, b: str) -> F64 | None:
        """T_a_b, or None when the frames are not connected."""
        if a == b:
            return np.eye(4)
        known: dict[str, F64] = {a: np.eye(4)}
        queue = [a]
        for frame in queue:
            for other, t in self._edges.get(frame, {}).items():
                if other not in known:
                    known[other] = known[frame] @ t
                    queue.append(other)
        return known.get(b)

    def root(self, frame: str) -> str:
        """The topmost frame above a frame that is no world."""
        seen = {frame}
        while (parent := self._parent.get(frame)) is not None and parent not in seen and parent not in _WORLDS:
            frame = parent
            seen.add(frame)
        return frame


def select(
    name: str,
    images: list[ImageTopic],
    calibrations: list[tuple[str, Calibration]],
    tree: TransformTree,
    imu_frame: str | None,
    mono: bool,
) -> Selection:
    """Choose the topics and make the rig. calibrations: (topic, calibration). Raises SourceError."""
    notes: list[str] = []
    cameras = _cameras(name, images, calibrations)
    depths = [i for i in images if i.depth and i.count]
    left, right, t_c_r = cameras[0], None, None
    depth: ImageTopic | None = None
    pair = None if mono else _pair(cameras, tree)
    matched = None if mono else _with_depth(cameras, depths)
    if pair is not None:
        left, right, t_c_r = pair
    elif matched is not None:
        left, depth = matched
    elif len(cameras) > 1 and not mono:
        _explain_no_pair(name, cameras[0], cameras[1], tree)
        notes.append(f"no two cameras make a stereo pair: {left.images.topic} alone is used")
    elif depths and not mono:
        frames = ", ".join(d.frame_id for d in depths)
        notes.append(f"depth left out: its frame ({frames}) is not the camera's ({left.images.frame_id})")
    t_b_c, has_body, imu_usable = _body(left, tree, imu_frame, notes)
    model = right.model if right is not None else None
    rig = CameraRig(left.model, model, t_b_c, t_c_r, has_depth=depth is not None, has_body=has_body)
    t_b_l = t_b_c @ se3.inverse(left.T_c_i)
    return Selection(rig, left.images, right.images if right else None, depth, imu_usable, t_b_l, tuple(notes))


def _cameras(name: str, images: list[ImageTopic], calibrations: list[tuple[str, Calibration]]) -> list[_Camera]:
    eyes = [i for i in images if not i.depth and i.count]
    if not eyes:
        raise SourceError(
            f"{name}: no images: expected sensor_msgs/msg/Image, sensor_msgs/msg/CompressedImage, "
            "foxglove.CompressedImage or foxglove.RawImage"
        )
    # One topic a camera: rectified before raw, encoded before raw pixels, then the one with most images.
    eyes.sort(key=lambda i: ("rect" not in i.topic, not i.encoded, -i.count, i.topic))
    chosen: list[ImageTopic] = []
    for eye in eyes:
        if not eye.frame_id or eye.frame_id not in [c.frame_id for c in chosen]:
            chosen.append(eye)
    cameras = []
    for eye in sorted(chosen, key=lambda i: i.topic):
        found = _calibration_of(eye, calibrations, len(chosen))
        if found is not None:
            cameras.append(_camera(eye, found, name))
    if not cameras:
        topics = ", ".join(eye.topic for eye in chosen)
        raise SourceError(
            f"{name}: no calibration for {topics}: expected sensor_msgs/msg/CameraInfo or foxglove.CameraCalibration "
            "with the same frame_id"
        )
    return cameras


def _calibration_of(eye: ImageTopic, calibrations: list[tuple[str, Calibration]], eyes: int) -> Calibration | None:
    def likeness(topic: str) -> int:
        a, b = eye.topic.strip("/").split("/"), topic.strip("/").split("/")
        return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))

    ranked = sorted(calibrations, key=lambda c: (c[1].frame_id != eye.frame_id or not eye.frame_id, -likeness(c[0])))
    if not ranked:
        return None
    topic, best = ranked[0]
    if (eye.frame_id and best.frame_id == eye.frame_id) or likeness(topic) > 0 or (eyes == 1 and len(ranked) == 1):
        return best
    return None


def _camera(eye: ImageTopic, c: Calibration, name: str) -> _Camera:
    where = f"{name}: calibration of {eye.topic}"
    if "rect" in eye.topic.lower() and c.p[0, 0] > 0:
        model = CameraModel(c.width, c.height, c.p[0, 0], c.p[1, 1], c.p[0, 2], c.p[1, 2])
        return _Camera(eye, checked_camera(_floats(model), where), True, se3.from_rt(c.r.T, np.zeros(3)), c)
    lens, d = lens_of(c.model, list(c.d), where)
    model = CameraModel(c.width, c.height, c.k[0, 0], c.k[1, 1], c.k[0, 2], c.k[1, 2], lens, d)
    same = np.allclose(c.r, np.eye(3), atol=1e-9) and np.allclose(c.p[:, :3], c.k, rtol=1e-6)
    return _Camera(eye, checked_camera(_floats(model), where), lens is Lens.NONE and bool(same), np.eye(4), c)


def _floats(m: CameraModel) -> CameraModel:
    return CameraModel(m.width, m.height, float(m.fx), float(m.fy), float(m.cx), float(m.cy), m.lens, m.distortion)


def _extrinsics(left: _Camera, right: _Camera, tree: TransformTree) -> F64 | None:
    """Right images in the frame of the left images, or None when nothing says it."""
    cl, cr = left.calibration, right.calibration
    by_p = np.eye(4)
    by_p[0, 3] = cl.p[0, 3] / cl.p[0, 0] - cr.p[0, 3] / cr.p[0, 0] if cl.p[0, 0] > 0 and cr.p[0, 0] > 0 else 0.0
    if left.rectified and right.rectified and by_p[0, 3] != 0.0:
        return by_p
    if cl.frame_id != cr.frame_id:
        t = tree.between(left.images.frame_id, right.images.frame_id)
        if t is not None:
            return se3.inverse(left.T_c_i) @ t @ right.T_c_i
    if by_p[0, 3] == 0.0:
        return None
    # P speaks of rectified frames; R turns each camera into its own.
    to_left, to_right = se3.from_rt(cl.r, np.zeros(3)), se3.from_rt(cr.r, np.zeros(3))
    return se3.inverse(left.T_c_i) @ se3.inverse(to_left) @ by_p @ to_right @ right.T_c_i


def _pair(cameras: list[_Camera], tree: TransformTree) -> tuple[_Camera, _Camera, F64] | None:
    best: tuple[_Camera, _Camera, F64] | None = None
    for left in cameras:
        for right in cameras:
            if left is right or (left.model.width, left.model.height) != (right.model.width, right.model.height):
                continue
            t = _extrinsics(left, right, tree)
            if t is None or t[2, 2] < _ALIGNED or t[0, 3] <= 1e-4 or t[0, 3] < np.abs(t[1:3, 3]).max():
                continue
            if best is None or min(left.images.count, right.images.count) > min(
                best[0].images.count, best[1].images.count
            ):
                best = (left, right, t)
    return best


def _with_depth(cameras: list[_Camera], depths: list[ImageTopic]) -> tuple[_Camera, ImageTopic] | None:
    for camera in cameras:
        for depth in sorted(depths, key=lambda d: (not d.encoded, -d.count)):
            if depth.frame_id == camera.images.frame_id:
                return camera, depth
    return None


def _explain_no_pair(name: str, left: _Camera, right: _Camera, tree: TransformTree) -> None:
    """Two cameras that could be a pair but for their extrinsics are an error, not a silent single camera."""
    t = _extrinsics(left, right, tree)
    topics = f"{left.images.topic} and {right.images.topic}"
    if t is None:
        raise SourceError(
            f"{name}: {topics}: nothing says how far apart the cameras are (no baseline): expected static transforms "
            f"between the frames {left.images.frame_id!r} and {right.images.frame_id!r}, or CameraInfo whose P has it; "
            "with mono (--mono) the left camera alone can be used"
        )
    if np.linalg.norm(t[:3, 3]) < 1e-4:
        checked_baseline(t, f"{name}: {topics}")


def _body(left: _Camera, tree: TransformTree, imu_frame: str | None, notes: list[str]) -> tuple[F64, bool, bool]:
    """T_b_c of the left images, whether there is a body frame, whether the IMU can be used."""
    frame = left.images.frame_id
    if imu_frame is not None:
        t = tree.between(imu_frame, frame)
        if t is not None:
            return t @ left.T_c_i, True, True
        notes.append(f"imu left out: no static transform between its frame {imu_frame!r} and the camera's {frame!r}")
    root = tree.root(frame)
    t = tree.between(root, frame) if root != frame else None
    if t is not None:
        return t @ left.T_c_i, True, False
    return np.eye(4), False, False
