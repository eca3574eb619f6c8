"""KITTI odometry folders: calib.txt, image_0/1, image_2/3 or image_l/r, times.txt, poses.txt; rectified, no body.

calib.txt has projection matrices as rows of 12 numbers, named (`P0:` to `P3:`) or bare (left, right). A projection is
K [I | t]; the baseline is the difference of the two t along x. The components of t along y and z (millimetres between
the colour cameras) are ignored: the images were rectified so that their rows agree. Raw drives: see kitti_raw.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.wording import counted
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sources.kitti_raw import is_raw, open_raw, pairs_by_name, rig_of
from kiteline_hw.sources.recording import Recording, image_size, list_images, sorted_trajectory
from kiteline_hw.sources.text_files import read_rows, row_values, seconds_to_ns

_TIMES = "times.txt"
NOMINAL_HZ = 10  # KITTI's rate, used if there is no times.txt
PAIRS = (("image_0", "image_1", "P0", "P1"), ("image_2", "image_3", "P2", "P3"), ("image_l", "image_r", "P0", "P1"))


def open_source(folder_name: str, mono: bool, imu: bool) -> Recording:
    """Open a KITTI odometry sequence or a raw drive, which have no IMU. Raises SourceError."""
    del imu
    folder = Path(folder_name)
    if is_raw(folder):
        return open_raw(folder, mono)
    pair = next((p for p in PAIRS if list_images(folder / p[0])), None)
    if pair is None:
        raise SourceError(
            f"{folder}: no images: expected KITTI's layout, calib.txt and a left folder image_0, image_2 or image_l "
            "(with image_1, image_3 or image_r for stereo)"
        )
    lefts = list_images(folder / pair[0])
    rights = [] if mono else list_images(folder / pair[1])
    calib = folder / "calib.txt"
    p_left, p_right = _read_projections(calib, pair[2], pair[3])
    size = image_size(lefts)
    if rights and p_right is None:
        raise SourceError(f"{calib}: one row, but two image folders: expected a row for each camera")
    rig = rig_of(p_left, p_right if rights else None, size, f"{calib}: {pair[2]} and {pair[3]}")
    if rig.T_c_r is not None and rig.T_c_r[0, 3] < 0:
        raise SourceError(f"{calib}: baseline {rig.T_c_r[0, 3]:g} m: left and right row are swapped")
    times = _read_times(folder, lefts)

    def frames(report: SourceReport) -> Iterator[EncodedFrame]:
        if not (folder / _TIMES).is_file():
            report.notes.append(f"no {folder / _TIMES} (s a line): flown at {NOMINAL_HZ} images a second")
        yield from pairs_by_name(times, lefts, rights, report)

    return Recording(f"kitti:{folder}", rig, len(lefts), frames, ground_truth=_read_ground_truth(folder, lefts, times))


def _read_projections(path: Path, left: str, right: str) -> tuple[F64, F64 | None]:
    """The projection matrices (3,4) of the left and, if there is one, of the right camera."""
    named: dict[str, F64] = {}
    bare: list[F64] = []
    for cells in read_rows(path, "KITTI's projection matrices, 12 numbers a row"):
        name = cells[0].rstrip(":") if cells[0][0].isalpha() else ""
        if not name:
            bare.append(row_values(cells, path, 12).reshape(3, 4))
            continue
        try:
            named[name] = row_values(cells[1:], path, 12).reshape(3, 4)
        except SourceError:
            if name.startswith("P"):  # other rows, such as calib_time, need not be matrices
                raise
    if named:
        if left not in named:
            raise SourceError(f"{path}: expected a row '{left}:', found {', '.join(named)}")
        return named[left], named.get(right)
    if not bare:
        raise SourceError(f"{path}: empty; expected rows of 12 numbers, one a camera")
    if len(bare) == 4 and left == "P2":
        return bare[2], bare[3]
    return bare[0], bare[1] if len(bare) > 1 else None


def _row_indices(images: list[Path], row_count: int) -> list[int]:
    """The row of times.txt or poses.txt for each image: the image's number, if all are rows, else its position."""
    if all(path.stem.isdecimal() and int(path.stem) < row_count for path in images):
        return [int(path.stem) for path in images]
    return list(range(len(images)))


def _read_times(folder: Path, lefts: list[Path]) -> list[int]:
    path = folder / _TIMES
    if not path.is_file():
        numbers = [int(p.stem) for p in lefts] if all(p.stem.isdecimal() for p in lefts) else list(range(len(lefts)))
        return [number * (1_000_000_000 // NOMINAL_HZ) for number in numbers]
    try:
        times = [seconds_to_ns(cells[0]) for cells in read_rows(path, "one time in seconds a line")]
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    if len(times) < len(lefts):
        found = f"{counted(len(times), 'time')} for {counted(len(lefts), 'image')}"
        raise SourceError(f"{path}: {found}: expected one a line for each image")
    return [times[row] for row in _row_indices(lefts, len(times))]


def _read_ground_truth(folder: Path, lefts: list[Path], times: list[int]) -> Trajectory | None:
    name = f"{folder.resolve().name}.txt"
    candidates = (folder / "poses.txt", folder.parent / "poses" / name, folder.parent.parent / "poses" / name)
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        return None
    poses = [
        np.vstack([row_values(cells, path, 12).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        for cells in read_rows(path, "T_world_camera, 3x4 numbers a row")
    ]
    chosen = _row_indices(lefts, len(poses))
    return sorted_trajectory([(t, poses[row]) for t, row in zip(times, chosen, strict=True) if row < len(poses)])
