"""Finds the camera rig in a bag: which image topics are left, right and depth, and their extrinsics.

Topics are identified by type and frame_id. Their names are used only to match a calibration without a frame_id, and to
recognise rectified images ("image_rect"). The extrinsics come from static transforms, else from the projection matrices
of a rectified pair. The body frame is that of the IMU, else the root of the transforms.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.calibration.checks import checked_baseline, checked_camera, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.mcap_messages import CameraCalibration, Transform

_WORLD_FRAMES = ("world", "map", "odom", "earth")
_ONE_KIND = 1.1  # ratio of focal lengths: two lenses of one kind differ by less
_AS_MANY = 0.9  # share of images: cameras of one rate lose some
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
class _CameraTopic:
    images: ImageTopic
    model: CameraModel
    rectified: bool  # images of an ideal camera, whose position is in P
    T_c_i: F64  # frame of the images (rotated if they are rectified) in the camera's frame
    calibration: CameraCalibration


@dataclass(frozen=True, slots=True)
class Selection:
    """The channels that form a frame, and the rig. T_b_l: (4,4) the left images' frame_id in the body frame."""

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
        """T_a_b, or None if the frames are not connected."""
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
        """The topmost ancestor of a frame that is no world frame."""
        seen = {frame}
        while (parent := self._parent.get(frame)) is not None and parent not in seen and parent not in _WORLD_FRAMES:
            frame = parent
            seen.add(frame)
        return frame


def select_rig(
    name: str,
    images: list[ImageTopic],
    calibrations: list[tuple[str, CameraCalibration]],
    tree: TransformTree,
    imu_frame: str | None,
    *,
    mono: bool,
) -> Selection:
    """Choose the topics and build the rig. calibrations: (topic, calibration). Raises SourceError."""
    notes: list[str] = []
    cameras = _cameras(name, images, calibrations)
    depths = [i for i in images if i.depth and i.count]
    left, right, t_c_r = cameras[0], None, None
    depth: ImageTopic | None = None
    pair = None if mono else _stereo_pair(cameras, tree)
    matched = None if mono else _with_depth(cameras, depths)
    if pair is not None:
        left, right, t_c_r = pair
    elif matched is not None:
        left, depth = matched
    elif len(cameras) > 1 and not mono:
        _check_no_pair(name, cameras[0], cameras[1], tree)
        notes.append(f"no two cameras make a stereo pair: {left.images.topic} alone is used")
    elif depths and not mono:
        frames = ", ".join(d.frame_id for d in depths)
        notes.append(f"depth left out: its frame ({frames}) is not the camera's ({left.images.frame_id})")
    t_b_c, has_body, imu_usable = _body(left, tree, imu_frame, notes)
    model = right.model if right is not None else None
    rig = CameraRig(left.model, model, t_b_c, t_c_r, has_depth=depth is not None, has_body=has_body)
    t_b_l = t_b_c @ se3.inverse(left.T_c_i)
    return Selection(rig, left.images, right.images if right else None, depth, imu_usable, t_b_l, tuple(notes))


def select_given_rig(
    name: str,
    images: list[ImageTopic],
    given: FileCalibration,
    size_of: Callable[[int], tuple[int, int]],
    tree: TransformTree,
    imu_frame: str | None,
    *,
    mono: bool,
) -> Selection:
    """The topics for a calibration from a file: those that it names, else raw images by name, left before right.

    size_of: height and width of a channel's images. Raises SourceError.
    """
    topics = {i.topic: i for i in images if i.count and not i.depth}
    named = [topics[t] for t in given.topics if t in topics]
    if len(named) < len(given.cameras):
        named = sorted(_one_a_camera(name, images, rectified_first=False), key=lambda i: i.topic)
    chosen = named[: 1 if mono else len(given.cameras)]
    left = chosen[0]
    rig = given.rig_of_images(name, len(chosen), size_of(left.channel))
    depth = None if mono or len(chosen) > 1 else next(
        (i for i in images if i.depth and i.count and i.frame_id == left.frame_id), None
    )  # fmt: skip
    notes: tuple[str, ...] = (f"images are those of {', '.join(i.topic for i in chosen)}",)
    T_b_l = tree.between(imu_frame, left.frame_id) if imu_frame is not None else None
    if rig.has_body:
        T_b_l = rig.T_b_c
    elif T_b_l is not None:
        rig = replace(rig, T_b_c=T_b_l, has_body=True)
    elif imu_frame is not None:
        notes += (f"imu left out: neither {given.where} nor a static transform says where the camera sits against it",)
    rig = replace(rig, has_depth=depth is not None)
    right = chosen[1] if len(chosen) > 1 else None
    imu_usable = imu_frame is not None and T_b_l is not None
    return Selection(rig, left, right, depth, imu_usable, rig.T_b_c if T_b_l is None else T_b_l, notes)


def _cameras(
    name: str, images: list[ImageTopic], calibrations: list[tuple[str, CameraCalibration]]
) -> list[_CameraTopic]:
    chosen = _one_a_camera(name, images, rectified_first=True)
    cameras = []
    for topic in sorted(chosen, key=lambda i: i.topic):
        found = _match_calibration(topic, calibrations, len(chosen))
        if found is not None:
            cameras.append(_camera(topic, found, name))
    if not cameras:
        names = ", ".join(topic.topic for topic in chosen)
        raise SourceError(
            f"{name}: no calibration for {names}: expected sensor_msgs/msg/CameraInfo or foxglove.CameraCalibration "
            "with the same frame_id, or --calibration FILE"
        )
    return cameras


def _one_a_camera(name: str, images: list[ImageTopic], *, rectified_first: bool) -> list[ImageTopic]:
    """One topic a camera: rectified or raw first, encoded before raw pixels, then the one with most images."""
    topics = [i for i in images if not i.depth and i.count]
    if not topics:
        raise SourceError(
            f"{name}: no images: expected sensor_msgs/msg/Image, sensor_msgs/msg/CompressedImage, "
            "foxglove.CompressedImage or foxglove.RawImage"
        )
    topics.sort(key=lambda i: (("rect" in i.topic) != rectified_first, not i.encoded, -i.count, i.topic))
    chosen: list[ImageTopic] = []
    for topic in topics:
        if not topic.frame_id or topic.frame_id not in [c.frame_id for c in chosen]:
            chosen.append(topic)
    return chosen


def _match_calibration(
    images: ImageTopic, calibrations: list[tuple[str, CameraCalibration]], n_cameras: int
) -> CameraCalibration | None:
    def common_parts(topic: str) -> int:
        a, b = images.topic.strip("/").split("/"), topic.strip("/").split("/")
        return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))

    own = images.frame_id
    ranked = sorted(calibrations, key=lambda c: (c[1].frame_id != own or not own, -common_parts(c[0])))
    if not ranked:
        return None
    topic, best = ranked[0]
    if (own and best.frame_id == own) or common_parts(topic) > 0 or (n_cameras == 1 and len(ranked) == 1):
        return best
    return None


def _camera(images: ImageTopic, c: CameraCalibration, name: str) -> _CameraTopic:
    where = f"{name}: calibration of {images.topic}"
    if "rect" in images.topic.lower() and c.p[0, 0] > 0:
        model = CameraModel(c.width, c.height, c.p[0, 0], c.p[1, 1], c.p[0, 2], c.p[1, 2])
        return _CameraTopic(images, checked_camera(_floats(model), where), True, se3.from_rt(c.r.T, np.zeros(3)), c)
    lens, d = parse_lens(c.model, list(c.d), where)
    model = CameraModel(c.width, c.height, c.k[0, 0], c.k[1, 1], c.k[0, 2], c.k[1, 2], lens, d)
    same = np.allclose(c.r, np.eye(3), atol=1e-9) and np.allclose(c.p[:, :3], c.k, rtol=1e-6)
    return _CameraTopic(images, checked_camera(_floats(model), where), lens is Lens.NONE and bool(same), np.eye(4), c)


def _floats(m: CameraModel) -> CameraModel:
    return replace(m, fx=float(m.fx), fy=float(m.fy), cx=float(m.cx), cy=float(m.cy))


def _extrinsics(left: _CameraTopic, right: _CameraTopic, tree: TransformTree) -> F64 | None:
    """T_l_r (4,4) of the right images in the frame of the left images, or None if the bag does not hold it."""
    cl, cr = left.calibration, right.calibration
    from_p = np.eye(4)
    from_p[0, 3] = cl.p[0, 3] / cl.p[0, 0] - cr.p[0, 3] / cr.p[0, 0] if cl.p[0, 0] > 0 and cr.p[0, 0] > 0 else 0.0
    if left.rectified and right.rectified and from_p[0, 3] != 0.0:
        return from_p
    if cl.frame_id != cr.frame_id:
        t = tree.between(left.images.frame_id, right.images.frame_id)
        if t is not None:
            return se3.inverse(left.T_c_i) @ t @ right.T_c_i
    if from_p[0, 3] == 0.0:
        return None
    # P relates the rectified frames; R rotates each camera into its rectified frame.
    to_left, to_right = se3.from_rt(cl.r, np.zeros(3)), se3.from_rt(cr.r, np.zeros(3))
    return se3.inverse(left.T_c_i) @ se3.inverse(to_left) @ from_p @ to_right @ right.T_c_i


def _stereo_pair(cameras: list[_CameraTopic], tree: TransformTree) -> tuple[_CameraTopic, _CameraTopic, F64] | None:
    """Left and right camera and T_l_r of the best pair, or None.

    Two cameras of one kind, then the pair with the most images, then the one with the longest baseline: a depth camera
    has a colour camera beside its infrared pair.
    """
    pairs: list[tuple[_CameraTopic, _CameraTopic, F64]] = []
    for left in cameras:
        for right in cameras:
            if left is right or (left.model.width, left.model.height) != (right.model.width, right.model.height):
                continue
            t = _extrinsics(left, right, tree)
            if t is None or t[2, 2] < _ALIGNED or t[0, 3] <= 1e-4 or t[0, 3] < np.abs(t[1:3, 3]).max():
                continue
            pairs.append((left, right, t))
    if not pairs:
        return None
    most = max(_images(pair) for pair in pairs)

    def rank(pair: tuple[_CameraTopic, _CameraTopic, F64]) -> tuple[bool, bool, float]:
        left, right, t = pair
        ratio = left.model.fx / right.model.fx
        return 1 / _ONE_KIND < ratio < _ONE_KIND, _images(pair) >= _AS_MANY * most, float(t[0, 3])

    return max(pairs, key=rank)


def _images(pair: tuple[_CameraTopic, _CameraTopic, F64]) -> int:
    return min(pair[0].images.count, pair[1].images.count)


def _with_depth(cameras: list[_CameraTopic], depths: list[ImageTopic]) -> tuple[_CameraTopic, ImageTopic] | None:
    for camera in cameras:
        for depth in sorted(depths, key=lambda d: (not d.encoded, -d.count)):
            if depth.frame_id == camera.images.frame_id:
                return camera, depth
    return None


def _check_no_pair(name: str, left: _CameraTopic, right: _CameraTopic, tree: TransformTree) -> None:
    """Raise SourceError if only missing or zero extrinsics keep two cameras from being a stereo pair."""
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


def _body(left: _CameraTopic, tree: TransformTree, imu_frame: str | None, notes: list[str]) -> tuple[F64, bool, bool]:
    """T_b_c of the left images, whether there is a body frame, and whether the IMU can be used."""
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
