"""Kalibr's files: the camera chain, and the IMU before or after the calibration."""

import json

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.calibration.checks import checked_camera, checked_readout, names_lens, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart
from kiteline_hw.calibration.nodes import Node
from kiteline_hw.ports import SourceError

IMU_KEYS = {
    "gyro_noise": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_noise": "accelerometer_noise_density",
    "accel_walk": "accelerometer_random_walk",
    "rate_hz": "update_rate",
}


def is_chain(node: Node) -> bool:
    """True for a camera chain."""
    return "cam0" in node.keys


def is_imu(node: Node) -> bool:
    """True for an IMU, alone or under `imu0`."""
    return "imu0" in node.keys or "gyroscope_noise_density" in node.keys


def read_chain(node: Node) -> FilePart:
    """The first two cameras of a chain. Raises SourceError."""
    names = [name for name in ("cam0", "cam1") if name in node.keys]
    tables = [node.get(name) for name in names]
    cameras = tuple(_camera(table) for table in tables)
    topics = tuple(t.get("rostopic").text() if "rostopic" in t.keys else "" for t in tables)
    T_c_i = [table.get("T_cam_imu").pose() if "T_cam_imu" in table.keys else None for table in tables]
    T_c_r = None
    if len(tables) == 2:
        if "T_cn_cnm1" in tables[1].keys:
            T_c_r = se3.inverse(tables[1].get("T_cn_cnm1").pose())
        elif T_c_i[0] is not None and T_c_i[1] is not None:
            T_c_r = T_c_i[0] @ se3.inverse(T_c_i[1])
    T_b_c = None if T_c_i[0] is None else se3.inverse(T_c_i[0])
    where = str(node.path)
    return FilePart(where, FileCalibration(where, cameras, T_c_r, T_b_c, None, topics))


def read_imu(node: Node) -> FilePart:
    """Noise densities of an IMU; those that the file lacks have their default. Raises SourceError."""
    table = node.get("imu0") if "imu0" in node.keys else node
    if "T_i_b" in table.keys and not np.allclose(table.get("T_i_b").pose(), np.eye(4), atol=1e-9):
        raise table.get("T_i_b").error("the identity: the body frame is that of the first IMU")
    imu = ImuCalibration(**imu_numbers(table, IMU_KEYS))
    where = str(node.path)
    return FilePart(where, FileCalibration(where, imu=imu))


def imu_numbers(table: Node, keys: dict[str, str]) -> dict[str, float]:
    """Fields of an ImuCalibration that a table holds. keys: their names in the table, by field."""
    return {
        field: table.get(key).positive("a number above zero: a noise density or a rate in Hz")
        for field, key in keys.items()
        if key in table.keys
    }


def texts(given: FileCalibration) -> dict[str, str]:
    """The files of a calibration by name: camchain.yaml (camchain-imucam.yaml with the IMU's place), imu.yaml."""
    out: dict[str, str] = {}
    lines: list[str] = []
    for k, model in enumerate(given.cameras):
        topic = given.topics[k] if k < len(given.topics) and given.topics[k] else f"/cam{k}/image_raw"
        radtan = model.lens is not Lens.EQUIDISTANT
        d = (*model.distortion, 0.0, 0.0, 0.0, 0.0)[:4] if len(model.distortion) < 4 else model.distortion
        if radtan and any(d[4:]):
            raise SourceError(
                f"{given.where}: camera {k} has {len(d)} radial-tangential coefficients, Kalibr's form has 4: "
                "calibrate with `--coefficients 4`, or use another form"
            )
        four = _list((model.fx, model.fy, model.cx, model.cy))
        lines += [f"cam{k}:", "  camera_model: pinhole", f"  intrinsics: {four}",
                  f"  distortion_model: {'radtan' if radtan else 'equidistant'}",
                  f"  distortion_coeffs: {_list(d[:4])}",
                  f"  resolution: [{model.width}, {model.height}]", f"  rostopic: {json.dumps(topic)}"]  # fmt: skip
        if model.readout_s:
            lines.append(f"  line_delay: {model.readout_s / model.height!r}")
        if given.T_b_c is not None:
            T_b = given.T_b_c if k == 0 or given.T_c_r is None else given.T_b_c @ given.T_c_r
            lines += ["  T_cam_imu:", *_rows(se3.inverse(T_b))]
        if k == 1 and given.T_c_r is not None:
            lines += ["  T_cn_cnm1:", *_rows(se3.inverse(given.T_c_r))]
    if lines:
        out["camchain.yaml" if given.T_b_c is None else "camchain-imucam.yaml"] = "\n".join(lines) + "\n"
    if given.imu is not None:
        imu = [f"{key}: {getattr(given.imu, field)!r}" for field, key in IMU_KEYS.items()]
        out["imu.yaml"] = "\n".join([*imu, "rostopic: /imu0"]) + "\n"
    return out


def _camera(table: Node) -> CameraModel:
    where = f"{table.path}: {table.key}"
    model = table.get("camera_model").text()
    if model != "pinhole":
        raise table.get("camera_model").error("pinhole (with radtan, equidistant or no distortion)")
    fx, fy, cx, cy = table.get("intrinsics").numbers((4,), "4 numbers fx, fy, cx, cy")
    width, height = table.get("resolution").size()
    name = table.get("distortion_model").text() if "distortion_model" in table.keys else "none"
    told = "distortion_coeffs" in table.keys or names_lens(name)
    d = table.get("distortion_coeffs").numbers((), "a list of numbers") if told else []
    if name == "none" and any(d):
        raise table.get("distortion_model").error("radtan or equidistant, as there are coefficients")
    lens, coefficients = parse_lens(name, d, where)
    delay = table.get("line_delay").number("s between two rows") if "line_delay" in table.keys else 0.0
    readout_s = checked_readout(delay * height, where)
    return checked_camera(CameraModel(width, height, fx, fy, cx, cy, lens, coefficients, readout_s), where)


def _list(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"


def _rows(T: F64) -> list[str]:
    return ["  - " + _list(tuple(row)) for row in T]
