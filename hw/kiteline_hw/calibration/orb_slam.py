"""Settings files of ORB-SLAM3 and ORB-SLAM2: keys with dots in OpenCV's FileStorage.

Read are the cameras, where the right one sits, and the IMU's place and noise. ORB-SLAM3 from version 1.0 on names
cameras Camera1 and Camera2 and transforms Stereo.T_c1_c2 and IMU.T_b_c1; before it they were Camera, Camera2, Tlr, Tbc.
"""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel
from kiteline_hw.calibration.checks import checked_camera, checked_rigid, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart, between_rectified
from kiteline_hw.calibration.kalibr import imu_numbers
from kiteline_hw.calibration.nodes import Node

_IMU_KEYS = {
    "gyro_noise": "IMU.NoiseGyro",
    "gyro_walk": "IMU.GyroWalk",
    "accel_noise": "IMU.NoiseAcc",
    "accel_walk": "IMU.AccWalk",
    "rate_hz": "IMU.Frequency",
}
_RADTAN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order
_KANNALA_BRANDT = ("k1", "k2", "k3", "k4")
_RECTIFICATION = {f"{side}.{key}" for side in ("LEFT", "RIGHT") for key in ("K", "D", "R", "P")}
_SAME_FOCAL_PX = 0.1  # P and Camera.fx are copies of one number


def is_settings(node: Node) -> bool:
    """True for a settings file of ORB-SLAM3 or ORB-SLAM2."""
    return "Camera1.fx" in node.keys or "Camera.fx" in node.keys


def read_settings(node: Node) -> FilePart:
    """Cameras and IMU. Raises SourceError.

    Images count as the camera gives them: before ORB-SLAM resizes (Camera.newWidth) or rectifies (LEFT.K …) them.
    """
    where = str(node.path)
    depth = next((node.get(key) for key in ("RGBD.DepthMapFactor", "DepthMapFactor") if key in node.keys), None)
    cameras: tuple[CameraModel, ...]
    T_c_r: F64 | None
    if _rectifies(node):
        cameras = (_raw_camera(node, "LEFT"), _raw_camera(node, "RIGHT"))
        T_c_r = between_rectified(_rectification(node, "LEFT"), _rectification(node, "RIGHT"))
    else:
        cameras, T_c_r = _cameras(node, has_depth=depth is not None)
    imu = ImuCalibration(**imu_numbers(node, _IMU_KEYS)) if node.keys & set(_IMU_KEYS.values()) else None
    T_b_c = _transform(node, ("IMU.T_b_c1", "Tbc"))
    # 1, or 0, is for depths that are in metres already when ORB-SLAM gets them.
    scale = None if depth is None else depth.number("the stored units a metre, such as 5000")
    scale = scale if scale is not None and scale > 1.0 else None
    topics = ("",) * len(cameras)
    return FilePart(where, FileCalibration(where, cameras, T_c_r, T_b_c, imu, topics, depth_scale=scale))


def _cameras(node: Node, *, has_depth: bool) -> tuple[tuple[CameraModel, ...], F64 | None]:
    """The cameras, and T_c_r (4,4) of a pair."""
    left = "Camera1" if "Camera1.fx" in node.keys else "Camera"
    first = _camera(node, left)
    if has_depth:  # a baseline beside it is that of a made-up right camera
        return (first,), None
    T_c_r = _transform(node, ("Stereo.T_c1_c2", "Tlr"))
    if "Camera2.fx" in node.keys or T_c_r is not None:
        return (first, _camera(node, "Camera2")), T_c_r
    if first.distortion or not node.keys & {"Stereo.b", "Camera.bf"}:
        return (first,), None
    T_c_r = np.eye(4)
    if "Stereo.b" in node.keys:
        T_c_r[0, 3] = node.get("Stereo.b").positive("the baseline in m")
    else:
        T_c_r[0, 3] = node.get("Camera.bf").positive("the baseline in m times fx") / first.fx
    return (first, first), T_c_r


def _camera(node: Node, name: str) -> CameraModel:
    kind = node.get("Camera.type").text() if "Camera.type" in node.keys else "PinHole"
    fx, fy = (node.get(f"{name}.{key}").positive("a focal length in px") for key in ("fx", "fy"))
    cx, cy = (node.get(f"{name}.{key}").number("px") for key in ("cx", "cy"))
    where = f"{node.path}: {name}"
    if kind == "KannalaBrandt8":
        lens, d = parse_lens(kind, [node.get(f"{name}.{key}").number() for key in _KANNALA_BRANDT], where)
    elif kind == "PinHole":
        told = [f"{name}.{key}" in node.keys for key in _RADTAN]
        count = 8 if any(told[5:]) else 5 if told[4] else 4 if any(told) else 0
        lens, d = parse_lens("radtan", [node.get(f"{name}.{key}").number() for key in _RADTAN[:count]], where)
    elif kind == "Rectified":
        lens, d = parse_lens("rectified", [], where)
    else:
        raise node.get("Camera.type").error("PinHole, KannalaBrandt8 or Rectified")
    return checked_camera(CameraModel(*_size(node, "Camera"), fx, fy, cx, cy, lens, d), where)


def _rectifies(node: Node) -> bool:
    """True if ORB-SLAM rectifies the images. Many files keep the rectification of the example that they began as."""
    if "Camera.fx" not in node.keys or not node.keys >= _RECTIFICATION:
        return False
    left, right = (node.get(f"{side}.P").matrix((3, 4), "a 3x4 matrix") for side in ("LEFT", "RIGHT"))
    apart_px = abs(float(left[0, 0]) - node.get("Camera.fx").number())
    return apart_px < _SAME_FOCAL_PX and float(right[0, 3]) != 0.0


def _raw_camera(node: Node, side: str) -> CameraModel:
    """A camera whose images ORB-SLAM rectifies before it uses them."""
    k = node.get(f"{side}.K").matrix((3, 3), "a 3x3 camera matrix")
    d = node.get(f"{side}.D").matrix(None, "a row of numbers").ravel()
    where = f"{node.path}: {side}"
    lens, coefficients = parse_lens("radtan", [float(v) for v in d], where)
    size = _size(node, side if f"{side}.width" in node.keys else "Camera")
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    return checked_camera(CameraModel(*size, fx, fy, cx, cy, lens, coefficients), where)


def _rectification(node: Node, side: str) -> tuple[F64, F64]:
    """R (3,3) and P (3,4) of one camera of a pair."""
    r = node.get(f"{side}.R").matrix((3, 3), "a 3x3 rotation")
    p = node.get(f"{side}.P").matrix((3, 4), "a 3x4 matrix")
    return checked_rigid(se3.from_rt(r, np.zeros(3)), f"{node.path}: {side}.R")[:3, :3], p


def _size(node: Node, name: str) -> tuple[int, int]:
    """Width and height in px; older files lack them."""
    for key in (f"{name}.width", f"{name}.height"):
        if key not in node.keys:
            raise node.get(key).error("the size of the images in px: add it to the file")
    return node.get(f"{name}.width").pixels(), node.get(f"{name}.height").pixels()


def _transform(node: Node, names: tuple[str, ...]) -> F64 | None:
    """The first of these transforms that the file has, of three rows or four."""
    name = next((n for n in names if n in node.keys), None)
    if name is None:
        return None
    values = node.get(name).matrix(None, "a 4x4 matrix")
    if values.shape == (3, 4):
        values = np.vstack([values, (0.0, 0.0, 0.0, 1.0)])
    if values.shape != (4, 4):
        raise node.get(name).error("a 4x4 matrix")
    return checked_rigid(values, f"{node.path}: {name}")
