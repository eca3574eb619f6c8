"""EuRoC's sensor.yaml of a camera or an IMU, each with its place T_BS in a frame that all share."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.calibration.checks import checked_camera, checked_readout, checked_rigid, names_lens, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart
from kiteline_hw.calibration.kalibr import IMU_KEYS, imu_numbers
from kiteline_hw.calibration.nodes import Node

_IMU_KEYS = IMU_KEYS | {"rate_hz": "rate_hz"}


def is_sensor(node: Node) -> bool:
    """True for a sensor.yaml."""
    return "T_BS" in node.keys


def read_sensor(node: Node) -> FilePart:
    """A camera, or an IMU. Raises SourceError."""
    is_imu = "sensor_type" in node.keys and node.get("sensor_type").text().lower() == "imu"
    return read_imu(node) if is_imu or "gyroscope_noise_density" in node.keys else read_camera(node)


def read_imu(node: Node) -> FilePart:
    """An IMU; noise that the file lacks has its default. Raises SourceError."""
    imu = ImuCalibration(**imu_numbers(node, _IMU_KEYS))
    where = str(node.path)
    return FilePart(where, FileCalibration(where, imu=imu), T_s_i=_read_place(node))


def read_camera(node: Node) -> FilePart:
    """A camera. Raises SourceError."""
    where = str(node.path)
    if "camera_model" in node.keys and node.get("camera_model").text() != "pinhole":
        raise node.get("camera_model").error("pinhole")
    fx, fy, cx, cy = node.get("intrinsics").numbers((4,), "4 numbers fx, fy, cx, cy")
    width, height = node.get("resolution").size()
    name = node.get("distortion_model").text() if "distortion_model" in node.keys else ""
    d = node.get("distortion_coefficients")
    values = d.numbers((), "a list of numbers") if d.value is not None or names_lens(name) else []
    lens, coefficients = parse_lens(name, values, where)
    readout_s = 0.0
    if "readout_s" in node.keys:
        readout_s = node.get("readout_s").number("s of all rows")
    elif "line_delay" in node.keys:
        readout_s = node.get("line_delay").number("s between two rows") * height
    model = CameraModel(width, height, fx, fy, cx, cy, lens, coefficients, checked_readout(readout_s, where))
    return FilePart(
        where, FileCalibration(where, (checked_camera(model, where),), topics=("",)), T_s_c=_read_place(node)
    )


def texts(given: FileCalibration) -> dict[str, str]:
    """The files of a calibration by name: cam0/sensor.yaml, cam1/sensor.yaml, imu0/sensor.yaml."""
    T_b_c = given.rig().T_b_c
    out: dict[str, str] = {}
    for k, model in enumerate(given.cameras):
        T = T_b_c if k == 0 or given.T_c_r is None else T_b_c @ given.T_c_r
        name = "equidistant" if model.lens is Lens.EQUIDISTANT else "radial-tangential"
        d = list(model.distortion) or [0.0] * 4
        readout = f"readout_s: {model.readout_s!r}\n" if model.readout_s else ""
        out[f"cam{k}/sensor.yaml"] = (
            f"sensor_type: camera\n{_place(T)}rate_hz: 20\nresolution: [{model.width}, {model.height}]\n"
            f"camera_model: pinhole\nintrinsics: {[model.fx, model.fy, model.cx, model.cy]}\n"
            f"distortion_model: {name}\ndistortion_coefficients: {[float(v) for v in d]}\n{readout}"
        )
    if given.imu is not None:
        numbers = "".join(f"{key}: {getattr(given.imu, field)!r}\n" for field, key in _IMU_KEYS.items())
        out["imu0/sensor.yaml"] = f"sensor_type: imu\n{_place(se3.inverse(T_b_c) @ T_b_c)}{numbers}"
    return out


def _read_place(node: Node) -> F64:
    values = node.get("T_BS").get("data").numbers((16,), "16 numbers")
    return checked_rigid(np.array(values).reshape(4, 4), f"{node.path}: T_BS")


def _place(T: F64) -> str:
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: {[float(v) for v in T.ravel()]}\n"
