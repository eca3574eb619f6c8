"""A camera rig and its IMU as JSON, exact to the last bit: the content of a log's topic /rig."""

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.calibration.checks import checked_baseline, checked_camera, checked_readout, checked_rigid
from kiteline_hw.ports import SourceError

_WHERE = "the rig in the log"
_MOST_PX = 1 << 15  # of an image's side

LENS_NAMES = {Lens.NONE: "plumb_bob", Lens.RADTAN: "plumb_bob", Lens.EQUIDISTANT: "kannala_brandt"}  # Foxglove's names


def rig_to_json(rig: CameraRig, imu: ImuCalibration | None) -> dict[str, Any]:
    """The rig and the IMU's calibration as a JSON object."""
    return {
        "left": _camera_to_json(rig.left),
        "right": _camera_to_json(rig.right) if rig.right is not None else None,
        "T_b_c": rig.T_b_c.tolist(),
        "T_c_r": rig.T_c_r.tolist() if rig.T_c_r is not None else None,
        "has_depth": rig.has_depth,
        "has_body": rig.has_body,
        "imu": asdict(imu) if imu is not None else None,
    }


def rig_from_json(value: Mapping[str, Any]) -> tuple[CameraRig, ImuCalibration | None]:
    """The rig and the IMU's calibration from such an object. Raises SourceError."""
    try:
        T_c_r = None if value["T_c_r"] is None else checked_baseline(_rigid(value["T_c_r"], "T_c_r"), _WHERE)
        rig = CameraRig(
            _camera_from_json(value["left"]),
            _camera_from_json(value["right"]) if value["right"] is not None else None,
            _rigid(value["T_b_c"], "T_b_c"),
            T_c_r,
            bool(value["has_depth"]),
            bool(value["has_body"]),
        )
        imu = value["imu"]
        if imu is None:
            return rig, None
        known = {f.name for f in fields(ImuCalibration)}
        numbers = {k: float(v) for k, v in imu.items() if k in known}
        if not all(math.isfinite(number) for number in numbers.values()):
            raise ValueError("the IMU's calibration is not finite")
        return rig, ImuCalibration(**numbers)
    except (KeyError, TypeError, ValueError, AttributeError, *INPUT_FAULTS) as error:
        raise SourceError(f"unusable rig in the log ({error!r})") from error


def _rigid(rows: Any, name: str) -> F64:
    """A pose (4,4), as written to the last bit. Raises SourceError, TypeError or ValueError."""
    pose = np.array(rows, np.float64).reshape(4, 4)
    checked_rigid(pose, f"{_WHERE}: {name}")
    return pose


def _camera_to_json(camera: CameraModel) -> dict[str, Any]:
    return {**asdict(camera), "lens": camera.lens.value, "distortion": list(camera.distortion)}


def _camera_from_json(value: Mapping[str, Any]) -> CameraModel:
    distortion = tuple(float(d) for d in value["distortion"])
    fx, fy, cx, cy = (float(value[key]) for key in ("fx", "fy", "cx", "cy"))
    readout_s = float(value.get("readout_s", 0.0))
    size = int(value["width"]), int(value["height"])
    if max(size) > _MOST_PX:
        raise ValueError(f"images of {size[0]}x{size[1]} px")
    checked_readout(readout_s, _WHERE)
    return checked_camera(CameraModel(*size, fx, fy, cx, cy, Lens(value["lens"]), distortion, readout_s), _WHERE)
