"""KITTI's raw drives, synced and rectified: image_00 to image_03 with data/ and timestamps.txt, calib_cam_to_cam.txt.

The calibration is that of the day, one folder above the drive, or beside the images. OXTS is not read: 10 Hz are
too few for an IMU.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.wording import counted
from kiteline_hw.calibration.checks import checked_baseline, checked_camera
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sources.recording import Recording, frames_by_key, image_size, list_images
from kiteline_hw.sources.text_files import read_text, row_values

CALIBRATION = "calib_cam_to_cam.txt"
_PAIRS = (("00", "01"), ("02", "03"))  # grey, colour


def is_raw(folder: Path) -> bool:
    """True if a folder is a drive of the raw data."""
    return any((folder / f"image_{left}").is_dir() for left, _ in _PAIRS)


def open_raw(folder: Path, mono: bool) -> Recording:
    """Open a drive: its grey pair, else its colour pair, else a left camera. Raises SourceError."""
    images = {side: list_images(folder / f"image_{side}" / "data") for pair in _PAIRS for side in pair}
    whole = [pair for pair in _PAIRS if images[pair[0]] and images[pair[1]]]
    chosen = next(iter(whole), next((pair for pair in _PAIRS if images[pair[0]]), None))
    if chosen is None:
        raise SourceError(f"{folder}: no images: expected KITTI's raw layout, image_00/data or image_02/data")
    lefts, rights = images[chosen[0]], [] if mono else images[chosen[1]]
    calib = next((d / CALIBRATION for d in (folder, folder.resolve().parent) if (d / CALIBRATION).is_file()), None)
    if calib is None:
        raise SourceError(
            f"{folder}: no {CALIBRATION}: expected it beside the images or one folder above: unpack the calibration of "
            "the same day there"
        )
    rows = _read_rows(calib)
    p_left, size = _projection(rows, chosen[0], calib), image_size(lefts)
    _check_rectified(rows, chosen[0], size, folder, calib)
    p_right = _projection(rows, chosen[1], calib) if rights else None
    rig = rig_of(p_left, p_right, size, f"{calib}: P_rect_{chosen[0]} and P_rect_{chosen[1]}")
    times = _read_times(folder / f"image_{chosen[0]}" / "timestamps.txt", lefts)
    return Recording(
        f"kitti:{folder}", rig, len(lefts), lambda report: pairs_by_name(times, lefts, rights, report)
    )  # fmt: skip


def pairs_by_name(
    times: list[int], lefts: list[Path], rights: list[Path], report: SourceReport
) -> Iterator[EncodedFrame]:
    """Frames of images with the same name on both sides; a left image without a partner comes alone."""
    keys = [path.stem for path in lefts], [path.stem for path in rights]
    return frames_by_key(times, lefts, rights, keys, report)


def rig_of(p_left: F64, p_right: F64 | None, size: tuple[int, int], name: str) -> CameraRig:
    """The rectified cameras of projection matrices (3,4). size: height and width in px. name: of the matrices.

    Raises SourceError.
    """
    if p_right is None:
        return CameraRig(_camera(p_left, size, name), None, np.eye(4), None, has_body=False)
    T_c_r = np.eye(4)
    T_c_r[0, 3] = _offset_x_m(p_left) - _offset_x_m(p_right)
    checked_baseline(T_c_r, name)
    return CameraRig(_camera(p_left, size, name), _camera(p_right, size, name), np.eye(4), T_c_r, has_body=False)


def _camera(p: F64, size: tuple[int, int], name: str) -> CameraModel:
    camera = CameraModel(size[1], size[0], float(p[0, 0]), float(p[1, 1]), float(p[0, 2]), float(p[1, 2]))
    return checked_camera(camera, name)


def _offset_x_m(p: F64) -> float:
    """t_x of p = K [I | t]; a camera to the right of the reference has a negative one."""
    return float((p[0, 3] - p[0, 2] * p[2, 3]) / p[0, 0])


def _read_rows(path: Path) -> dict[str, list[str]]:
    """The cells of each row `name: cells`."""
    rows = (line.partition(":") for line in read_text(path, "KITTI's calibration, `name: numbers` a row").splitlines())
    return {name.strip(): cells.split() for name, colon, cells in rows if colon}


def _projection(rows: dict[str, list[str]], side: str, path: Path) -> F64:
    name = f"P_rect_{side}"
    if name not in rows:
        raise SourceError(f"{path}: expected a row '{name}:', found {', '.join(sorted(rows))[:80] or 'nothing'}")
    return row_values(rows[name], path, 12).reshape(3, 4)


def _check_rectified(rows: dict[str, list[str]], side: str, size: tuple[int, int], folder: Path, path: Path) -> None:
    """Raise SourceError for the images of an unrectified drive (`_extract`)."""
    if f"S_rect_{side}" not in rows:
        return
    width, height = row_values(rows[f"S_rect_{side}"], path, 2)
    if size != (round(height), round(width)):
        raise SourceError(
            f"{folder}: images of {size[1]}x{size[0]} px, rectified ones have {width:g}x{height:g}: expected the "
            "synced and rectified drive (…_sync), not the unrectified one (…_extract)"
        )


def _read_times(path: Path, lefts: list[Path]) -> list[int]:
    """Stamps in ns of the images, whose names are the numbers of rows such as `2011-09-26 13:02:25.594360375`."""
    lines = [line.strip() for line in read_text(path, "a date and time a line").splitlines() if line.strip()]
    if len(lines) < len(lefts):
        found = f"{counted(len(lines), 'time')} for {counted(len(lefts), 'image')}"
        raise SourceError(f"{path}: {found}: expected one a line for each image")
    numbered = all(p.stem.isdecimal() and int(p.stem) < len(lines) for p in lefts)
    return [_nanoseconds(lines[int(p.stem) if numbered else k], path) for k, p in enumerate(lefts)]


def _nanoseconds(text: str, path: Path) -> int:
    whole, _, fraction = text.partition(".")
    try:
        moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        return round(moment.timestamp()) * 1_000_000_000 + int((fraction + 9 * "0")[:9])
    except ValueError as error:
        raise SourceError(f"{path}: {text[:40]!r}: expected a time such as 2011-09-26 13:02:25.594360375") from error
