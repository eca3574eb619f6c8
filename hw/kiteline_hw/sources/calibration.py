"""The camera of a flat camera.yaml, and the read-out that several forms tell."""

from pathlib import Path

from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.calibration.checks import checked_camera, checked_readout
from kiteline_hw.sources.text_files import Yaml, yaml_number


def camera_from_yaml(table: Yaml, path: Path) -> CameraModel:
    """The camera of a flat camera.yaml: fx, fy, cx, cy, width, height, optional k1 k2 p1 p2 k3."""
    fx, fy, cx, cy = (yaml_number(table, key, path) for key in ("fx", "fy", "cx", "cy"))
    width, height = (int(yaml_number(table, key, path)) for key in ("width", "height"))
    d = tuple(yaml_number(table, key, path, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    lens, d = (Lens.RADTAN, d) if any(d) else (Lens.NONE, ())
    readout_s = read_out(table, height, path)
    return checked_camera(CameraModel(width, height, fx, fy, cx, cy, lens, d, readout_s), str(path))


def read_out(table: Yaml, height: int, path: Path) -> float:
    """The read-out of a rolling shutter in s: `readout_s` of all rows, or Kalibr's `line_delay` of one; 0 without."""
    told = yaml_number(table, "readout_s", path, yaml_number(table, "line_delay", path, 0.0) * height)
    return checked_readout(told, str(path))
