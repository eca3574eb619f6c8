"""Plain images by a file pattern: `images:GLOB` (one camera) or `images:LEFT_GLOB,RIGHT_GLOB` (a rectified pair).

The calibration is read from camera.yaml beside the images or one folder above: fx, fy, cx, cy, width, height, optional
k1 k2 p1 p2 k3, for a pair baseline_m, and rate_hz if the file names are no stamps; `?fps=` behind the patterns is the
same, and 10 the default. A name of 16 or more digits is a stamp in ns, of 16 or 13 digits one in us or ms since 1970,
with a decimal point one in seconds. Other images are in the order of the numbers in their names. Left and right images
are paired by their stamps, else by the numbers that vary in their names.
"""

import glob
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sensors.image_names import in_natural_order, pair_keys
from kiteline_hw.sources.calibration import rig_from_yaml
from kiteline_hw.sources.recording import Recording, Stamped, frames_by_key, frames_by_time, image_size
from kiteline_hw.sources.text_files import read_yaml, seconds_to_ns

_UNSTAMPED_HZ = 10.0  # rate of images whose names are no stamps
_RATE = re.compile(r"\?fps=([^?,/*]*)$")  # behind the patterns, in which ? alone stands for any character
_LEAST_HZ, _MOST_HZ = 1e-3, 1e5
_STAMP_DIGITS = 16  # of a name that is a stamp in ns, at least
_UNITS = ((15, 1_000), (12, 1_000_000))  # power of ten of a time since 1970 in us and ms (2001 to 2286); ns in the unit
_MOST_APART_NS = 10_000_000_000  # ns between two images in the median: farther apart, the unit is a smaller one


def open_source(pattern: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> Recording:
    """Open images by pattern; they come without an IMU. given: in place of camera.yaml. Raises SourceError."""
    del imu
    asked = _RATE.search(pattern)
    pattern = _RATE.sub("", pattern)
    patterns = pattern.split(",")
    if len(patterns) > 2:
        raise SourceError(f"images:{pattern}: expected one pattern, or two with a comma between")
    sides = [_list_files(p) for p in (patterns[:1] if mono else patterns)]
    folder = sides[0][0].parent
    path = next((d / "camera.yaml" for d in (folder, folder.parent) if (d / "camera.yaml").is_file()), None)
    rate_hz = None if path is None else _rate_of(read_yaml(path, "").get("rate_hz"), f"{path}: rate_hz")
    if asked is not None:
        rate_hz = _rate_of(asked[1], f"images:{pattern}: fps")
    if given is not None:
        rig = given.rig_of_images(f"images:{pattern}", len(sides), image_size(sides[0]))
        return _recording(pattern, rig, sides, rate_hz)
    if path is None:
        raise SourceError(
            f"images:{pattern}: no calibration: expected {folder / 'camera.yaml'} with fx, fy, cx, cy, width, height, "
            "or --calibration FILE; `kiteline calibrate` makes one"
        )
    table = read_yaml(path, "fx, fy, cx, cy, width, height")
    rig = rig_from_yaml(table, path, stereo=len(sides) == 2)
    return _recording(pattern, rig, sides, rate_hz)


def _rate_of(value: str | list[float] | None, where: str) -> float | None:
    """Images a second as written; None where nothing is. Raises SourceError."""
    if value is None:
        return None
    try:
        rate_hz = float(value) if isinstance(value, str) else 0.0
    except ValueError:
        rate_hz = 0.0
    if not _LEAST_HZ <= rate_hz <= _MOST_HZ:
        raise SourceError(f"{where} is {value}: expected images a second, such as 20")
    return rate_hz


def _recording(pattern: str, rig: CameraRig, sides: list[list[Path]], rate_hz: float | None) -> Recording:
    """rate_hz: of images whose names are no stamps. Raises SourceError if the names do not tell what is a pair."""
    name, lefts, rights = f"images:{pattern}", sides[0], sides[1] if len(sides) == 2 else []
    stamped = [_stamped(side) for side in sides]
    times = [t for t, _ in stamped[0]]
    if rights and all(stamped):
        return Recording(name, rig, len(lefts), lambda report: frames_by_time(stamped[0], stamped[1], report))
    untold = not times and rate_hz is None
    if not times:
        times = [round(i * 1e9 / (rate_hz or _UNSTAMPED_HZ)) for i in range(len(lefts))]
    keys = pair_keys(lefts, rights) if rights else (range(len(lefts)), ())
    if keys is None:
        raise SourceError(
            f"{name}: the numbers of left and right images do not fit each other, {_first_mismatch(lefts, rights)}: "
            "expected the two images of a pair with the same number, or with their stamps, as names"
        )

    def frames(report: SourceReport) -> Iterator[EncodedFrame]:
        if untold:
            report.notes.append(
                f"image names are no stamps: flown at {_UNSTAMPED_HZ:g} images a second; "
                f"'{name}?fps=20', or rate_hz in camera.yaml, sets another rate"
            )
        yield from frames_by_key(times, lefts, rights, keys, report)

    return Recording(name, rig, len(lefts), frames)


def _first_mismatch(lefts: list[Path], rights: list[Path]) -> str:
    """The first two names, in order, that are not the same on both sides."""
    both = zip(lefts, rights, strict=False)
    left, right = next((pair for pair in both if pair[0].name != pair[1].name), (lefts[0], rights[0]))
    return f"first {left.name} and {right.name}"


def _list_files(pattern: str) -> list[Path]:
    """Files in the order of their stamps, else of the numbers in their names."""
    files = in_natural_order([path for path in map(Path, glob.glob(pattern)) if path.is_file()])
    if not files:
        raise SourceError(f"images:{pattern}: no file matches: expected a pattern such as 'flight/*.png' (in quotes)")
    return [path for _, path in _stamped(files)] or files


def _stamped(files: list[Path]) -> Stamped:
    """Files with their stamps in ns, in order of time; empty if a name is no stamp."""
    try:
        if all(path.stem.isdecimal() for path in files):
            numbers = sorted((int(path.stem), path) for path in files)
            unit_ns = _unit_since_1970([number for number, _ in numbers])
            if unit_ns or all(len(path.stem) >= _STAMP_DIGITS for path in files):
                return [(number * (unit_ns or 1), path) for number, path in numbers]
        if all("." in path.stem for path in files):
            return sorted((seconds_to_ns(path.stem), path) for path in files)
    except ValueError:
        pass
    return []


def _unit_since_1970(numbers: list[int]) -> int:
    """ns in the unit of these increasing times since 1970, us or ms; 0 if they are none. A smaller unit since a
    computer's start can have as many digits, but then images would be minutes apart.
    """
    apart = float(np.median(np.diff(numbers))) if len(numbers) > 1 else 0.0
    for power, unit_ns in _UNITS:
        if 10**power <= numbers[0] and numbers[-1] < 10 ** (power + 1) and apart * unit_ns < _MOST_APART_NS:
            return unit_ns
    return 0
