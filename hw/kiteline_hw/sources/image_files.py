"""Plain images by a file pattern: `images:GLOB` (one camera) or `images:LEFT_GLOB,RIGHT_GLOB` (a rectified pair).

The calibration stands in camera.yaml beside the images or one folder above: fx, fy, cx, cy, width, height, optional
k1 k2 p1 p2 k3, for a pair baseline_m, and rate_hz (10 when absent) for names that are no stamps. A name of 16 or more
digits is a stamp in ns, one with a decimal point a stamp in seconds.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.assemble import Capture
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sources.tables import (
    CaptureList,
    Recording,
    Yaml,
    checked_baseline,
    checked_camera,
    read_yaml,
    seconds_to_ns,
    yaml_number,
)


def open_images(pattern: str, *, mono: bool = False, imu: bool = True) -> Recording:
    """Open images by pattern; `imu` changes nothing. Raises SourceError."""
    del imu
    patterns = pattern.split(",")
    if len(patterns) > 2:
        raise SourceError(f"images:{pattern}: expected one pattern, or two with a comma between")
    sides = [_files(p) for p in (patterns[:1] if mono else patterns)]
    if len({len(files) for files in sides}) > 1:
        raise SourceError(f"images:{pattern}: {len(sides[0])} left and {len(sides[1])} right images: expected as many")
    folder = sides[0][0].parent
    path = next((d / "camera.yaml" for d in (folder, folder.parent) if (d / "camera.yaml").is_file()), None)
    if path is None:
        raise SourceError(
            f"images:{pattern}: no calibration: expected {folder / 'camera.yaml'} with fx, fy, cx, cy, width, height"
        )
    table = read_yaml(path, "fx, fy, cx, cy, width, height")
    camera = _camera(table, path, len(sides) == 2)
    t_c_r = None
    if len(sides) == 2:
        t_c_r = np.eye(4)
        t_c_r[0, 3] = yaml_number(table, "baseline_m", path)
        checked_baseline(t_c_r, f"{path}: baseline_m")
    rig = CameraRig(camera, camera if t_c_r is not None else None, np.eye(4), t_c_r, has_body=False)
    times = _times(sides[0], yaml_number(table, "rate_hz", path, 10.0))
    return Recording(f"images:{pattern}", rig, _Images(times, sides))


class _Images(CaptureList):
    def __init__(self, times: list[int], sides: list[list[Path]]) -> None:
        self._times, self._sides = times, sides
        self.count = len(times)

    def captures(self, report: SourceReport) -> Iterator[Capture]:
        for i, t in enumerate(self._times):
            right = ImageFile(self._sides[1][i]) if len(self._sides) == 2 else None
            yield Capture(t, ImageFile(self._sides[0][i]), right)


def _files(pattern: str) -> list[Path]:
    files = sorted(Path(p) for p in glob.glob(pattern) if Path(p).is_file())
    if not files:
        raise SourceError(f"images:{pattern}: no file matches: expected a pattern such as 'flight/*.png' (in quotes)")
    return files


def _camera(table: Yaml, path: Path, pair: bool) -> CameraModel:
    fx, fy, cx, cy = (yaml_number(table, key, path) for key in ("fx", "fy", "cx", "cy"))
    width, height = (int(yaml_number(table, key, path)) for key in ("width", "height"))
    d = tuple(yaml_number(table, key, path, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if pair and any(d):
        raise SourceError(f"{path}: a pair by pattern must be rectified already: expected no k1 k2 p1 p2 k3")
    camera = CameraModel(width, height, fx, fy, cx, cy, *((Lens.RADTAN, d) if any(d) else (Lens.NONE, ())))
    return checked_camera(camera, str(path))


def _times(files: list[Path], rate_hz: float) -> list[int]:
    stems = [path.stem for path in files]
    try:
        if all(stem.isdigit() and len(stem) >= 16 for stem in stems):
            return [int(stem) for stem in stems]
        if all("." in stem for stem in stems):
            return [seconds_to_ns(stem) for stem in stems]
    except ValueError:
        pass
    if not rate_hz > 0:
        raise SourceError(f"rate_hz is {rate_hz:g}: expected images a second")
    return [round(i * 1e9 / rate_hz) for i in range(len(files))]
