"""OpenCV's FileStorage (camera_matrix; M1, D1, M2, D2, R, T of a pair) and ROS' camera_info files, which look alike."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens, Rectifier
from kiteline_hw.calibration.checks import checked_camera, checked_rigid, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart
from kiteline_hw.calibration.nodes import Node

_FISHEYE_KEYS = ("fisheye_model", "fisheye")
_LONGEST_BASELINE_M = 5.0  # beyond it, T is in the units of some board's squares


def is_camera(node: Node) -> bool:
    """True for one camera of OpenCV's or ROS' calibration tools."""
    return "camera_matrix" in node.keys or "Camera_Matrix" in node.keys


def is_pair(node: Node) -> bool:
    """True for a pair of OpenCV's stereo calibration."""
    return {"M1", "D1", "M2", "D2"} <= node.keys


def read_camera(node: Node) -> FilePart:
    """One camera. Raises SourceError."""
    where = str(node.path)
    old = "Camera_Matrix" in node.keys
    k = node.get("Camera_Matrix" if old else "camera_matrix").matrix((3, 3), "a 3x3 camera matrix")
    ros = "distortion_model" in node.keys
    d = _coefficients(
        node.get(
            next((n for n in ("Distortion_Coefficients", "distortion") if n in node.keys), "distortion_coefficients")
        )
    )
    name = node.get("distortion_model").text() if ros else "fisheye" if _is_fisheye(node) else "opencv"
    model = _camera(k, name, d, _size(node), where)
    rectified = None
    if {"rectification_matrix", "projection_matrix"} <= node.keys:
        r = node.get("rectification_matrix").matrix((3, 3), "a 3x3 rotation")
        p = node.get("projection_matrix").matrix((3, 4), "a 3x4 matrix")
        rectified = checked_rigid(se3.from_rt(r, np.zeros(3)), f"{where}: rectification_matrix")[:3, :3], p
    return FilePart(where, FileCalibration(where, (model,), topics=("",)), rectified=rectified)


def read_pair(node: Node) -> FilePart:
    """Both cameras of a pair. Raises SourceError."""
    where = str(node.path)
    name = "fisheye" if _is_fisheye(node) else "opencv"
    size = _size(node)
    cameras = tuple(
        _camera(node.get(f"M{i}").matrix((3, 3), "a 3x3 camera matrix"), name, _coefficients(node.get(f"D{i}")), size,
                f"{where}: camera {i}")
        for i in (1, 2)
    )  # fmt: skip
    T_c_r = None
    if {"R", "T"} <= node.keys:
        r = node.get("R").matrix((3, 3), "a 3x3 rotation")
        table = node.get("T")
        t = table.matrix(None, "3 numbers in metres").ravel()
        if len(t) != 3 or not np.linalg.norm(t) < _LONGEST_BASELINE_M:
            raise table.error("3 numbers in metres (calibrate with the squares of the board in metres)")
        T_c_r = se3.inverse(checked_rigid(se3.from_rt(r, t), f"{where}: R"))
    return FilePart(where, FileCalibration(where, cameras, T_c_r, topics=("", "")))


def texts(given: FileCalibration) -> dict[str, str]:
    """OpenCV's file of a calibration: opencv.yaml."""
    fisheye = any(model.lens is Lens.EQUIDISTANT for model in given.cameras)
    first = given.cameras[0]
    lines = ["%YAML:1.0", "---", f"image_width: {first.width}", f"image_height: {first.height}",
             f"fisheye_model: {int(fisheye)}"]  # fmt: skip
    for i, model in enumerate(given.cameras, 1):
        d = np.array(model.distortion or (0.0, 0.0, 0.0, 0.0), np.float64)
        k_name, d_name = ("camera_matrix", "distortion_coefficients") if len(given.cameras) == 1 else (f"M{i}", f"D{i}")
        lines += [*_storage(k_name, model.matrix()), *_storage(d_name, d[:, None])]
    if given.T_c_r is not None and len(given.cameras) == 2:
        T_r_c = se3.inverse(given.T_c_r)
        lines += [*_storage("R", T_r_c[:3, :3]), *_storage("T", T_r_c[:3, 3:])]
    return {"opencv.yaml": "\n".join(lines) + "\n"}


def ros_texts(given: FileCalibration) -> dict[str, str]:
    """ROS' camera_info files of a calibration: left.yaml, right.yaml. P and R are those of the pair's rectification."""
    rig = given.rig()
    out: dict[str, str] = {}
    rectified = Rectifier(rig).camera
    T_l = se3.inverse(rectified.T_b_c) @ rig.T_b_c  # left camera in the rectified left one
    for k, model in enumerate(given.cameras):
        T_rect = T_l if k == 0 or rig.T_c_r is None else T_l @ rig.T_c_r
        p = np.array([[rectified.fx, 0.0, rectified.cx, 0.0], [0.0, rectified.fy, rectified.cy, 0.0], [0, 0, 1.0, 0]])
        if k == 1:
            p[0, 3] = -rectified.bf
        name = "equidistant" if model.lens is Lens.EQUIDISTANT else "plumb_bob"
        d = np.array(model.distortion or (0.0,) * 4, np.float64)
        name = "rational_polynomial" if len(d) == 8 else name
        if name == "plumb_bob" and len(d) == 4:
            d = np.append(d, 0.0)
        parts = {"camera_matrix": model.matrix(), "distortion_coefficients": d[None], "rectification_matrix":
                 T_rect[:3, :3], "projection_matrix": p}  # fmt: skip
        side = ("left", "right")[k]
        lines = [f"image_width: {model.width}", f"image_height: {model.height}", f"camera_name: {side}"]
        for key, value in parts.items():
            lines += [*_storage(key, value, tagged=False)]
            if key == "camera_matrix":
                lines.append(f"distortion_model: {name}")
        out[f"{side}.yaml"] = "\n".join(lines) + "\n"
    return out


def _camera(k: F64, name: str, d: list[float], size: tuple[int, int], where: str) -> CameraModel:
    lens, coefficients = parse_lens(name, d, where)
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    return checked_camera(CameraModel(*size, fx, fy, cx, cy, lens, coefficients), where)


def _coefficients(node: Node) -> list[float]:
    values = node.matrix(None, "a row or a column of numbers").ravel()
    d = [float(v) for v in values]
    # OpenCV writes 12 and 14 with the models of thin prisms and tilted sensors, mostly zero.
    return d[:8] if len(d) > 8 and not any(d[8:]) else d


def _size(node: Node) -> tuple[int, int]:
    pairs = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))
    for pair in pairs:
        if set(pair) <= node.keys:
            return node.get(pair[0]).pixels(), node.get(pair[1]).pixels()
    raise node.get("image_width").error("the width of the images in px, and image_height beside it: add both")


def _is_fisheye(node: Node) -> bool:
    return any(key in node.keys and node.get(key).text().lower() in ("1", "true") for key in _FISHEYE_KEYS)


def _storage(name: str, m: F64, *, tagged: bool = True) -> list[str]:
    rows, columns = m.shape
    data = ", ".join(repr(float(v)) for v in m.ravel())
    head = [f"{name}: !!opencv-matrix"] if tagged else [f"{name}:"]
    dt = ["  dt: d"] if tagged else []
    return [*head, f"  rows: {rows}", f"  cols: {columns}", *dt, f"  data: [{data}]"]
