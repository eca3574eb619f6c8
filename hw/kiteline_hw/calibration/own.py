"""kiteline's own calibration file: all of a rig in one YAML, exact to the last bit."""

import json
from dataclasses import fields

from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry.cameras import CameraModel
from kiteline_hw.calibration.checks import checked_camera, checked_readout, parse_lens
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart
from kiteline_hw.calibration.kalibr import imu_numbers
from kiteline_hw.calibration.nodes import Node

HEAD = "kiteline_calibration"
_VERSION = 1
_IMU_KEYS = {field.name: field.name for field in fields(ImuCalibration)}


def is_own(node: Node) -> bool:
    """True for a calibration file of kiteline."""
    return HEAD in node.keys


def read_own(node: Node) -> FilePart:
    """The whole rig. Raises SourceError."""
    if node.get(HEAD).number() != _VERSION:
        raise node.get(HEAD).error(f"{_VERSION}: this build reads no other version")
    sides = [side for side in ("left", "right") if side in node.keys]
    if sides == ["right"]:
        raise node.get("left").error("the left camera")
    cameras = tuple(_camera(node.get(side)) for side in sides)
    T_c_r, T_b_c = (node.get(key).pose() if key in node.keys else None for key in ("T_c_r", "T_b_c"))
    imu = ImuCalibration(**imu_numbers(node.get("imu"), _IMU_KEYS)) if "imu" in node.keys else None
    topics = tuple(node.get(s).get("topic").text() if "topic" in node.get(s).keys else "" for s in sides)
    where = str(node.path)
    return FilePart(where, FileCalibration(where, cameras, T_c_r, T_b_c, imu, topics))


def texts(given: FileCalibration, comments: tuple[str, ...] = ()) -> dict[str, str]:
    """The file of a calibration: calibration.yaml. comments: lines for its head."""
    lines = [f"# {line}" for line in comments]
    lines += [f"{HEAD}: {_VERSION}"]
    for k, model in enumerate(given.cameras):
        lines += [f"{('left', 'right')[k]}:"]
        lines += [f"  {key}: {getattr(model, key)!r}" for key in ("width", "height", "fx", "fy", "cx", "cy")]
        lines += [f"  lens: {model.lens.value}", f"  distortion: {list(model.distortion)}"]
        lines += [f"  readout_s: {model.readout_s!r}"] if model.readout_s else []
        lines += [f"  topic: {json.dumps(given.topics[k])}"] if k < len(given.topics) and given.topics[k] else []
    for name, T, about in (("T_c_r", given.T_c_r, "right camera in the left one"),
                           ("T_b_c", given.T_b_c, "left camera in the body, that of the IMU")):  # fmt: skip
        if T is not None:
            lines += [f"{name}:  # {about}; x right, y down, z forward; m"]
            lines += ["  - [" + ", ".join(repr(float(v)) for v in row) + "]" for row in T]
    if given.imu is not None:
        lines += ["imu:", *(f"  {name}: {getattr(given.imu, name)!r}" for name in _IMU_KEYS)]
    return {"calibration.yaml": "\n".join(lines) + "\n"}


def _camera(table: Node) -> CameraModel:
    where = f"{table.path}: {table.key}"
    width, height = table.get("width").pixels(), table.get("height").pixels()
    fx, fy = (table.get(key).positive("a focal length in px") for key in ("fx", "fy"))
    cx, cy = (table.get(key).number("px") for key in ("cx", "cy"))
    d = table.get("distortion").numbers((), "a list of numbers") if "distortion" in table.keys else []
    lens, coefficients = parse_lens(table.get("lens").text(), d, where)
    readout_s = table.get("readout_s").number("s of all rows") if "readout_s" in table.keys else 0.0
    readout_s = checked_readout(readout_s, where)
    return checked_camera(CameraModel(width, height, fx, fy, cx, cy, lens, coefficients, readout_s), where)
