"""TUM RGB-D folders: rgb.txt and depth.txt list stamped images; depth is aligned with the colour image; no body."""

import heapq
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import DEPTH_TOLERANCE_NS, EncodedFrame, pair_by_time
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sources.calibration import camera_from_yaml
from kiteline_hw.sources.recording import Recording, Stamped, image_size, list_images, sorted_trajectory
from kiteline_hw.sources.text_files import listed_file, read_rows, read_tum_poses, read_yaml, seconds_to_ns, yaml_number

DEPTH_SCALE = 5000.0  # stored units a metre, as the data set's page says
_MOST_BACKWARD = 0.1  # share of stamps before that of the line above, beyond which they are no times of the images

# Intrinsics of the three cameras as the data set's page gives them, 640x480. Two are Kinects, whose colour camera
# has a rolling shutter (docs/decisions/rolling-shutter.md); nothing was measured of the third, an Xtion.
_KINECT_READOUT_S = 0.027
FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), _KINECT_READOUT_S),
    "2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), _KINECT_READOUT_S),
    "3": (535.4, 539.2, 320.1, 247.6, (), 0.0),
}


def open_source(folder_name: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> Recording:
    """Open a TUM RGB-D folder, which has no IMU; mono leaves the depth out. given: its camera. Raises SourceError."""
    del imu
    folder = Path(folder_name)
    colour = _list_stamped(folder, "rgb")
    if not colour:
        raise SourceError(f"{folder}: no images: expected TUM's layout, rgb.txt ('t filename' a line) and rgb/*.png")
    depth = [] if mono else _list_stamped(folder, "depth")
    camera, scale = _read_calibration(folder, colour, given)
    rig = CameraRig(camera, None, np.eye(4), None, has_depth=bool(depth), has_body=False)
    truth = folder / "groundtruth.txt"
    return Recording(
        f"tum:{folder}", rig, len(colour), lambda report: _read_frames(colour, depth, f"png/{scale:g}", report),
        ground_truth=sorted_trajectory(read_tum_poses(truth)) if truth.is_file() else None,
    )  # fmt: skip


def _read_frames(colour: Stamped, depth: Stamped, depth_format: str, report: SourceReport) -> Iterator[EncodedFrame]:
    if not depth:
        for t, path in colour:
            yield EncodedFrame(t, ImageFile(path))
        return
    sides = [[(t, side, path) for t, path in images] for side, images in enumerate((colour, depth))]
    merged = heapq.merge(*sides, key=lambda item: item[0])
    for t, left, of_depth in pair_by_time(merged, DEPTH_TOLERANCE_NS, ("colour image", "depth image"), report):
        yield EncodedFrame(t, ImageFile(left), depth=None if of_depth is None else ImageFile(of_depth, depth_format))


def _list_stamped(folder: Path, kind: str) -> Stamped:
    """Image files with their stamps, from KIND.txt or else from the file names."""
    listing = folder / f"{kind}.txt"
    out: Stamped = []
    try:
        if listing.is_file():
            for cells in read_rows(listing, "'t filename' a line"):
                if len(cells) < 2:
                    raise ValueError(f"{' '.join(cells)!r} is no 't filename'")
                out.append((seconds_to_ns(cells[0]), listed_file(folder, cells[1], listing)))
            _check_order(out, listing)
        else:
            out = [(seconds_to_ns(path.stem), path) for path in list_images(folder / kind)]
    except ValueError as error:
        raise SourceError(f"{listing}: {error}: expected a time in seconds and a file name a line") from error
    return sorted(out)


def _check_order(listed: Stamped, listing: Path) -> None:
    """Raise SourceError if stamps jump back and forth: sorted by them the images would be in a random order."""
    back = [k for k, (before, after) in enumerate(pairwise(listed), 2) if after[0] < before[0]]
    if len(back) > _MOST_BACKWARD * len(listed):
        raise SourceError(
            f"{listing}: {len(back)} of {len(listed)} stamps are earlier than that of the line before, first that of "
            f"{listed[back[0] - 1][1].name}: expected the time of each image since a common beginning in s, not the "
            "time since the image before"
        )


def _read_calibration(folder: Path, colour: Stamped, given: FileCalibration | None) -> tuple[CameraModel, float]:
    """The camera and the stored depth units a metre."""
    path = folder / "camera.yaml"
    if given is not None:
        scale = given.depth_scale or DEPTH_SCALE
        if path.is_file():
            scale = yaml_number(read_yaml(path, ""), "depth_scale", path, scale)
        return given.rig_of_images(str(folder), 1, image_size([image for _, image in colour])).left, _checked(
            scale, path
        )
    if path.is_file():
        table = read_yaml(path, "fx, fy, cx, cy, width, height, depth_scale")
        scale = yaml_number(table, "depth_scale", path, DEPTH_SCALE)
        return camera_from_yaml(table, path), _checked(scale, path)
    named = re.search(r"(?:freiburg|fr)([123])", folder.resolve().name)
    if image_size([path for _, path in colour]) != (480, 640) or named is None:
        raise SourceError(
            f"{folder}: no calibration: expected camera.yaml (fx, fy, cx, cy, width, height, depth_scale), or a folder "
            "named after freiburg1, freiburg2 or freiburg3 with images of 640x480 px"
        )
    fx, fy, cx, cy, d, readout_s = FREIBURG[named.group(1)]
    return CameraModel(640, 480, fx, fy, cx, cy, Lens.RADTAN if d else Lens.NONE, d, readout_s), DEPTH_SCALE


def _checked(scale: float, path: Path) -> float:
    if scale <= 0:
        raise SourceError(f"{path}: depth_scale is {scale:g}: expected the stored units a metre, such as 5000")
    return scale
