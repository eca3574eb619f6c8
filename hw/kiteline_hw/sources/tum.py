"""TUM RGB-D folders: rgb.txt and depth.txt list stamped images; depth is aligned with the colour image; no body."""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.assemble import DEPTH_TOLERANCE_NS, Capture, pair_by_time
from kiteline_hw.sensors.images import ImageFile, decode_grey
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sources.tables import (
    CaptureList,
    Recording,
    checked_camera,
    list_images,
    read_tum,
    read_yaml,
    rows,
    seconds_to_ns,
    yaml_number,
)

DEPTH_SCALE = 5000.0  # stored units a metre, as the data set's page says

# Intrinsics that the data set's page gives for its three cameras, 640x480.
FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (535.4, 539.2, 320.1, 247.6, ()),
}

Stamped = list[tuple[int, Path]]


def open_tum(folder: Path, *, mono: bool = False, imu: bool = True) -> Recording:
    """Open a TUM RGB-D folder; mono leaves the depth out; `imu` changes nothing. Raises SourceError."""
    del imu
    colour = _listing(folder, "rgb")
    if not colour:
        raise SourceError(f"{folder}: no images: expected TUM's layout, rgb.txt ('t filename' a line) and rgb/*.png")
    depth = [] if mono else _listing(folder, "depth")
    camera, scale = _calibration(folder, colour)
    rig = CameraRig(camera, None, np.eye(4), None, has_depth=bool(depth), has_body=False)
    truth = read_tum(folder / "groundtruth.txt") if (folder / "groundtruth.txt").is_file() else None
    return Recording(f"tum:{folder}", rig, _TumImages(colour, depth, f"png/{scale:g}"), None, truth)


class _TumImages(CaptureList):
    def __init__(self, colour: Stamped, depth: Stamped, depth_format: str) -> None:
        self._colour, self._depth, self._format = colour, depth, depth_format
        self.count = len(colour)

    def captures(self, report: SourceReport) -> Iterator[Capture]:
        if not self._depth:
            for t, path in self._colour:
                yield Capture(t, ImageFile(path))
            return
        sides = [[(t, side, path) for t, path in images] for side, images in enumerate((self._colour, self._depth))]
        merged = heapq.merge(*sides, key=lambda item: item[0])
        names = ("colour image", "depth image")
        for t, left, depth in pair_by_time(merged, DEPTH_TOLERANCE_NS, names, report):
            yield Capture(t, ImageFile(left), depth=ImageFile(depth, self._format))


def _listing(folder: Path, kind: str) -> Stamped:
    listing = folder / f"{kind}.txt"
    out: Stamped = []
    try:
        if listing.is_file():
            for cells in rows(listing, "'t filename' a line"):
                if len(cells) < 2:
                    raise ValueError(f"{' '.join(cells)!r} is no 't filename'")
                out.append((seconds_to_ns(cells[0]), folder / cells[1]))
        else:
            out = [(seconds_to_ns(path.stem), path) for path in list_images(folder / kind)]
    except ValueError as error:
        raise SourceError(f"{listing}: {error}: expected a time in seconds and a file name a line") from error
    return sorted(out)


def _calibration(folder: Path, colour: Stamped) -> tuple[CameraModel, float]:
    path = folder / "camera.yaml"
    if path.is_file():
        table = read_yaml(path, "fx, fy, cx, cy, width, height, depth_scale")
        fx, fy, cx, cy = (yaml_number(table, key, path) for key in ("fx", "fy", "cx", "cy"))
        width, height = (int(yaml_number(table, key, path)) for key in ("width", "height"))
        d = tuple(yaml_number(table, key, path, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
        lens, d = (Lens.RADTAN, d) if any(d) else (Lens.NONE, ())
        scale = yaml_number(table, "depth_scale", path, DEPTH_SCALE)
        if scale <= 0:
            raise SourceError(f"{path}: depth_scale is {scale:g}: expected the stored units a metre, such as 5000")
        return checked_camera(CameraModel(width, height, fx, fy, cx, cy, lens, d), str(path)), scale
    named = re.search(r"(?:freiburg|fr)([123])", folder.resolve().name)
    size = _size(colour)
    if named is None or size != (480, 640):
        raise SourceError(
            f"{folder}: no calibration: expected camera.yaml (fx, fy, cx, cy, width, height, depth_scale), or a folder "
            "named after freiburg1, freiburg2 or freiburg3 with images of 640x480 px"
        )
    fx, fy, cx, cy, d = FREIBURG[named.group(1)]
    return CameraModel(640, 480, fx, fy, cx, cy, Lens.RADTAN if d else Lens.NONE, d), DEPTH_SCALE


def _size(colour: Stamped) -> tuple[int, int]:
    for _, path in colour[:20]:
        try:
            pixels, _ = decode_grey(ImageFile(path))
        except BadImage:
            continue
        return pixels.shape[0], pixels.shape[1]
    raise SourceError(f"{colour[0][1].parent}: none of the first images can be decoded: expected PNG or JPEG files")
