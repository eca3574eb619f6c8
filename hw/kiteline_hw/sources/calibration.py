"""The rig of a flat camera.yaml: fx, fy, cx, cy, width, height, optional k1 k2 p1 p2 k3, for a pair baseline_m."""

from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.calibration.checks import checked_baseline, checked_camera, checked_readout
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.text_files import Yaml, yaml_number


def rig_from_yaml(table: Yaml, path: Path, *, stereo: bool, otherwise: str = "") -> CameraRig:
    """The rig of one camera, or of a rectified pair. otherwise: what to do with a pair that has lenses.

    Raises SourceError.
    """
    camera = camera_from_yaml(table, path)
    if not stereo:
        return CameraRig(camera, None, np.eye(4), None, has_body=False)
    if camera.lens is not Lens.NONE:
        raise SourceError(
            f"{path}: a pair in a camera.yaml must be rectified already: expected no k1 k2 p1 p2 k3{otherwise}"
        )
    T_c_r = np.eye(4)
    T_c_r[0, 3] = yaml_number(table, "baseline_m", path)
    return CameraRig(camera, camera, np.eye(4), checked_baseline(T_c_r, f"{path}: baseline_m"), has_body=False)


def camera_from_yaml(table: Yaml, path: Path) -> CameraModel:
    """The camera; `readout_s` is of all rows, `line_delay` (Kalibr's) of one. Raises SourceError."""
    fx, fy, cx, cy = (yaml_number(table, key, path) for key in ("fx", "fy", "cx", "cy"))
    width, height = (int(yaml_number(table, key, path)) for key in ("width", "height"))
    d = tuple(yaml_number(table, key, path, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    lens, d = (Lens.RADTAN, d) if any(d) else (Lens.NONE, ())
    readout_s = yaml_number(table, "readout_s", path, yaml_number(table, "line_delay", path, 0.0) * height)
    checked_readout(readout_s, str(path))
    return checked_camera(CameraModel(width, height, fx, fy, cx, cy, lens, d, readout_s), str(path))
