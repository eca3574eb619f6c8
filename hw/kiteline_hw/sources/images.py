"""Plain images by a file pattern: `images:GLOB` (one camera) or `images:LEFT_GLOB,RIGHT_GLOB` (a rectified pair).

The calibration is read from camera.yaml beside the images or one folder above: fx, fy, cx, cy, width, height, optional
k1 k2 p1 p2 k3, for a pair baseline_m, and rate_hz (default 10) if the file names are no stamps. A name of 16 or more
digits is a stamp in ns, one with a decimal point a stamp in seconds.
"""

import glob
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraRig, Lens
from kiteline_hw.calibration.checks import checked_baseline
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sources.calibration import camera_from_yaml
from kiteline_hw.sources.recording import Recording, image_size
from kiteline_hw.sources.text_files import read_yaml, seconds_to_ns, yaml_number

_UNSTAMPED_HZ = 10.0  # rate of images whose names are no stamps


def open_source(pattern: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> Recording:
    """Open images by pattern; they come without an IMU. given: in place of camera.yaml. Raises SourceError."""
    del imu
    patterns = pattern.split(",")
    if len(patterns) > 2:
        raise SourceError(f"images:{pattern}: expected one pattern, or two with a comma between")
    sides = [_list_files(p) for p in (patterns[:1] if mono else patterns)]
    if len({len(files) for files in sides}) > 1:
        raise SourceError(f"images:{pattern}: {len(sides[0])} left and {len(sides[1])} right images: expected as many")
    if given is not None:
        rig = given.rig_of_images(f"images:{pattern}", len(sides), image_size(sides[0]))
        return _recording(pattern, rig, sides, _parse_times(sides[0], _UNSTAMPED_HZ))
    folder = sides[0][0].parent
    path = next((d / "camera.yaml" for d in (folder, folder.parent) if (d / "camera.yaml").is_file()), None)
    if path is None:
        raise SourceError(
            f"images:{pattern}: no calibration: expected {folder / 'camera.yaml'} with fx, fy, cx, cy, width, height, "
            "or --calibration FILE; `kiteline calibrate` makes one"
        )
    table = read_yaml(path, "fx, fy, cx, cy, width, height")
    camera = camera_from_yaml(table, path)
    right = T_c_r = None
    if len(sides) == 2:
        if camera.lens is not Lens.NONE:
            raise SourceError(f"{path}: a pair by pattern must be rectified already: expected no k1 k2 p1 p2 k3")
        right, T_c_r = camera, np.eye(4)
        T_c_r[0, 3] = yaml_number(table, "baseline_m", path)
        checked_baseline(T_c_r, f"{path}: baseline_m")
    rig = CameraRig(camera, right, np.eye(4), T_c_r, has_body=False)
    times = _parse_times(sides[0], yaml_number(table, "rate_hz", path, _UNSTAMPED_HZ))
    return _recording(pattern, rig, sides, times)


def _recording(pattern: str, rig: CameraRig, sides: list[list[Path]], times: list[int]) -> Recording:
    return Recording(f"images:{pattern}", rig, len(times), lambda report: _read_frames(times, sides))


def _read_frames(times: list[int], sides: list[list[Path]]) -> Iterator[EncodedFrame]:
    for i, t in enumerate(times):
        right = ImageFile(sides[1][i]) if len(sides) == 2 else None
        yield EncodedFrame(t, ImageFile(sides[0][i]), right)


def _list_files(pattern: str) -> list[Path]:
    files = sorted(Path(p) for p in glob.glob(pattern) if Path(p).is_file())
    if not files:
        raise SourceError(f"images:{pattern}: no file matches: expected a pattern such as 'flight/*.png' (in quotes)")
    return files


def _parse_times(files: list[Path], rate_hz: float) -> list[int]:
    """Stamps in ns from the file names, else at the given rate."""
    stems = [path.stem for path in files]
    try:
        if all(stem.isdecimal() and len(stem) >= 16 for stem in stems):
            return [int(stem) for stem in stems]
        if all("." in stem for stem in stems):
            return [seconds_to_ns(stem) for stem in stems]
    except ValueError:
        pass
    if not rate_hz > 0:
        raise SourceError(f"rate_hz is {rate_hz:g}: expected images a second")
    return [round(i * 1e9 / rate_hz) for i in range(len(files))]
