"""KITTI odometry folders: calib.txt, image_0/1, image_2/3 or image_l/r, times.txt, poses.txt; rectified, no body.

calib.txt has projection matrices as rows of 12 numbers, named (`P0:`…`P3:`) or bare (left, right). A projection is
K [I | t]; the baseline is the *difference* of the two t along x. What t says along y and z (millimetres between the
colour cameras) is left alone: the images were rectified so that rows agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import Trajectory
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.assemble import Capture
from kiteline_hw.sensors.images import ImageFile, decode_grey
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sources.tables import (
    CaptureList,
    Recording,
    checked_baseline,
    checked_camera,
    list_images,
    rows,
    seconds_to_ns,
    trajectory,
)

F64 = NDArray[np.float64]

NOMINAL_HZ = 10  # KITTI's rate, used when there is no times.txt
PAIRS = (("image_0", "image_1", "P0", "P1"), ("image_2", "image_3", "P2", "P3"), ("image_l", "image_r", "P0", "P1"))


def open_kitti(folder: Path, *, mono: bool = False, imu: bool = True) -> Recording:
    """Open a KITTI odometry sequence; `imu` changes nothing, for there is none. Raises SourceError."""
    del imu
    pair = next((p for p in PAIRS if list_images(folder / p[0])), None)
    if pair is None:
        raise SourceError(
            f"{folder}: no images: expected KITTI's layout, calib.txt and a left folder image_0, image_2 or image_l "
            "(with image_1, image_3 or image_r for stereo)"
        )
    lefts = list_images(folder / pair[0])
    rights = [] if mono else list_images(folder / pair[1])
    p_left, p_right = _projections(folder / "calib.txt", pair[2], pair[3])
    height, width = _size(lefts)
    left = _camera(p_left, width, height, folder)
    right = t_c_r = None
    if rights:
        if p_right is None:
            raise SourceError(f"{folder / 'calib.txt'}: one row, but two image folders: expected a row for each camera")
        right = _camera(p_right, width, height, folder)
        t_c_r = np.eye(4)
        t_c_r[0, 3] = _offset_x(p_left) - _offset_x(p_right)
        checked_baseline(t_c_r, f"{folder / 'calib.txt'}: {pair[2]} and {pair[3]}")
        if t_c_r[0, 3] < 0:
            raise SourceError(f"{folder / 'calib.txt'}: baseline {t_c_r[0, 3]:g} m: left and right row are swapped")
    rig = CameraRig(left, right, np.eye(4), t_c_r, has_body=False)
    times = _times(folder, lefts)
    captures = _KittiImages(lefts, rights, times)
    return Recording(f"kitti:{folder}", rig, captures, None, _truth(folder, lefts, times))


class _KittiImages(CaptureList):
    def __init__(self, lefts: list[Path], rights: list[Path], times: list[int]) -> None:
        self._lefts, self._times = lefts, times
        self._rights = {path.stem: path for path in rights}
        self.count = len(lefts)

    def captures(self, report: SourceReport) -> Iterator[Capture]:
        for t, left in zip(self._times, self._lefts, strict=True):
            if not self._rights:
                yield Capture(t, ImageFile(left))
            elif left.stem in self._rights:
                yield Capture(t, ImageFile(left), ImageFile(self._rights[left.stem]))
            else:
                report.skip("missing right image", f"{left.name} has no partner")
        stems = {path.stem for path in self._lefts}
        for stem, path in self._rights.items():
            if stem not in stems:
                report.skip("missing left image", f"{path.name} has no partner")


def _projections(path: Path, left: str, right: str) -> tuple[F64, F64 | None]:
    named: dict[str, F64] = {}
    bare: list[F64] = []
    for cells in rows(path, "KITTI's projection matrices, 12 numbers a row"):
        name = cells[0].rstrip(":") if cells[0][0].isalpha() else ""
        try:
            values = np.array([float(cell) for cell in (cells[1:] if name else cells)])
        except ValueError:
            values = np.zeros(0)
        if len(values) != 12 or not np.isfinite(values).all():
            if name and not name.startswith("P"):
                continue
            raise SourceError(f"{path}: expected 12 numbers a row, found {' '.join(cells)[:60]!r}")
        if name:
            named[name] = values.reshape(3, 4)
        else:
            bare.append(values.reshape(3, 4))
    if named:
        if left not in named:
            raise SourceError(f"{path}: expected a row '{left}:', found {', '.join(named)}")
        return named[left], named.get(right)
    if not bare:
        raise SourceError(f"{path}: empty; expected rows of 12 numbers, one a camera")
    if len(bare) == 4 and left == "P2":
        return bare[2], bare[3]
    return bare[0], bare[1] if len(bare) > 1 else None


def _offset_x(p: F64) -> float:
    # p = K [I | t]: t_x = (p03 - cx * t_z) / fx; a camera that stands to the right has a negative t_x.
    return float((p[0, 3] - p[0, 2] * p[2, 3]) / p[0, 0])


def _camera(p: F64, width: int, height: int, folder: Path) -> CameraModel:
    camera = CameraModel(width, height, float(p[0, 0]), float(p[1, 1]), float(p[0, 2]), float(p[1, 2]))
    return checked_camera(camera, str(folder / "calib.txt"))


def _size(images: list[Path]) -> tuple[int, int]:
    for path in images[:20]:
        try:
            pixels, _ = decode_grey(ImageFile(path))
        except BadImage:
            continue
        return pixels.shape[0], pixels.shape[1]
    raise SourceError(f"{images[0].parent}: none of the first images can be decoded: expected PNG or JPEG files")


def _row_of(images: list[Path], rows_there: int) -> list[int]:
    """Which row of times.txt or poses.txt belongs to each image: its number, if all are rows, else its place."""
    if all(path.stem.isdigit() and int(path.stem) < rows_there for path in images):
        return [int(path.stem) for path in images]
    return list(range(len(images)))


def _times(folder: Path, lefts: list[Path]) -> list[int]:
    path = folder / "times.txt"
    if not path.is_file():
        numbers = [int(p.stem) for p in lefts] if all(p.stem.isdigit() for p in lefts) else list(range(len(lefts)))
        return [number * (1_000_000_000 // NOMINAL_HZ) for number in numbers]
    try:
        times = [seconds_to_ns(cells[0]) for cells in rows(path, "one time in seconds a line")]
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    if len(times) < len(lefts):
        raise SourceError(f"{path}: {len(times)} times for {len(lefts)} images: expected one a line for each image")
    return [times[row] for row in _row_of(lefts, len(times))]


def _truth(folder: Path, lefts: list[Path], times: list[int]) -> Trajectory | None:
    name = f"{folder.resolve().name}.txt"
    places = (folder / "poses.txt", folder.parent / "poses" / name, folder.parent.parent / "poses" / name)
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        return None
    poses: list[F64] = []
    for cells in rows(path, "T_world_camera, 3x4 numbers a row"):
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            values = np.zeros(0)
        if len(values) != 12:
            raise SourceError(f"{path}: expected 12 numbers a row, found {' '.join(cells)[:60]!r}")
        poses.append(np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]]))
    picked = _row_of(lefts, len(poses))
    return trajectory([(t, poses[row]) for t, row in zip(times, picked, strict=True) if row < len(poses)])
