"""EuRoC's ASL folders: mav0/cam0, cam1, imu0, each with sensor.yaml and data.csv. The body frame is the IMU's.

TUM-VI's folders have the same layout without a sensor.yaml: their calibration is a Kalibr chain, camchain*.yaml beside
mav0 or in dso.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.calibration.checks import checked_baseline
from kiteline_hw.calibration.euroc import read_camera, read_imu
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.calibration.nodes import Node, read_nodes
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sensors.imu_buffer import ImuSamples, ImuTable
from kiteline_hw.sources.recording import (
    Recording,
    Stamped,
    frames_by_time,
    image_size,
    list_images,
    sorted_trajectory,
)
from kiteline_hw.sources.text_files import listed_file, nanoseconds, pose_from_tum, read_rows, read_tum_poses

_CAMERA_KEYS = (
    "T_BS (data: 16 numbers), resolution [width, height], intrinsics [fu, fv, cu, cv], distortion_model and "
    "distortion_coefficients of a camera"
)
_SAMPLES = "IMU samples: t_ns, gyro x y z rad/s, accel x y z m/s^2"
_IMU_KEYS = "T_BS (data: 16 numbers) and the noise of an IMU"


def open_source(folder_name: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> Recording:
    """Open an ASL folder (it holds mav0, or is mav0).

    given: used where no sensor.yaml is, or none that can be read. Raises SourceError.
    """
    folder = Path(folder_name)
    mav = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if not (mav / "cam0").is_dir():
        raise SourceError(f"{folder}: expected EuRoC's layout, mav0/cam0/sensor.yaml and mav0/cam0/data; no cam0 there")
    if not (mav / "cam0" / "sensor.yaml").is_file():
        given = _chain_beside(folder, mav) or given  # what is given is put over it
        if given is not None:
            return _open_given(folder, mav, given, mono, imu)
        raise SourceError(
            f"{mav / 'cam0' / 'sensor.yaml'}: no such file: expected the camera's calibration, for TUM-VI's folders "
            "camchain.yaml beside mav0 or in dso, or --calibration FILE"
        )
    try:
        return _open_by_sensor_files(folder, mav, mono, imu)
    except _UnreadableSensor:
        if given is None or not given.cameras:
            raise
        return _open_given(folder, mav, given, mono, imu)


class _UnreadableSensor(SourceError):
    """A sensor.yaml of another form."""


def _open_by_sensor_files(folder: Path, mav: Path, mono: bool, imu: bool) -> Recording:
    left, T_s_c = _read_camera(mav / "cam0")
    # The files give cameras and ground truth in their own frame "B" (here: s); the body frame is that of the IMU.
    T_s_i, noise = _read_imu_calibration(mav / "imu0")
    right = T_c_r = None
    images = [_list_stamped(mav / "cam0")]
    if not mono and (mav / "cam1").is_dir():
        right, T_s_r = _read_camera(mav / "cam1")
        T_c_r = checked_baseline(se3.inverse(T_s_c) @ T_s_r, f"{mav}: T_BS of cam0 and cam1")
        images.append(_list_stamped(mav / "cam1"))
    rig = CameraRig(left, right, se3.inverse(T_s_i) @ T_s_c, T_c_r)
    return Recording(
        f"euroc:{folder}", rig, len(images[0]), lambda report: _read_frames(images, report),
        noise if imu else None,
        _read_ground_truth(folder, mav, T_s_i), lambda report: _read_imu(mav / "imu0" / "data.csv", report),
        T_s_b=T_s_i,
    )  # fmt: skip


def _chain_beside(folder: Path, mav: Path) -> FileCalibration | None:
    """TUM-VI's calibration: a Kalibr chain, and the IMU's noise where there is a file of it."""
    for place in dict.fromkeys((folder, mav, mav.parent, folder / "dso", mav.parent / "dso")):
        chain = sorted(place.glob("camchain*.yaml"))
        if chain:
            return read_calibration(",".join(str(path) for path in (chain[0], *sorted(place.glob("imu*.yaml"))[:1])))
    return None


def _open_given(folder: Path, mav: Path, given: FileCalibration, mono: bool, imu: bool) -> Recording:
    """A folder by a calibration from elsewhere."""
    images = [_list_stamped(mav / "cam0")]
    if not mono and (mav / "cam1").is_dir():
        images.append(_list_stamped(mav / "cam1"))
    rig = given.rig_of_images(f"euroc:{folder}", len(images), image_size([path for _, path in images[0]]))
    has_imu = imu and given.known and (mav / "imu0" / "data.csv").is_file()
    if has_imu and not rig.has_body:
        raise SourceError(
            f"{given.where}: nothing says where the camera sits against the IMU: expected T_cam_imu (Kalibr), T_BS "
            "(EuRoC) or T_b_c (kiteline); with --no-imu the images alone are used"
        )
    return Recording(
        f"euroc:{folder}", rig, len(images[0]), lambda report: _read_frames(images, report),
        (given.imu or ImuCalibration()) if has_imu else None, _read_ground_truth(folder, mav, np.eye(4)),
        lambda report: _read_imu(mav / "imu0" / "data.csv", report),
    )  # fmt: skip


def _read_frames(images: list[Stamped], report: SourceReport) -> Iterator[EncodedFrame]:
    if len(images) == 1:
        for t, path in images[0]:
            yield EncodedFrame(t, ImageFile(path))
        return
    yield from frames_by_time(images[0], images[1], report)


def _read_imu(path: Path, report: SourceReport) -> ImuSamples:
    times: list[int] = []
    values: list[list[float]] = []
    unreadable = ""  # the last such line
    for cells in read_rows(path, _SAMPLES, ","):
        try:
            row = [float(cell) for cell in cells[1:7]]
            if len(row) != 6:
                raise ValueError
            times.append(nanoseconds(cells[0]))
            values.append(row)
        except ValueError:
            unreadable = repr(",".join(cells)[:60])
            report.skip("unreadable imu line", f"{path.name}: {unreadable}")
    if unreadable and not times:
        raise SourceError(
            f"{path}: not one line can be read: expected {_SAMPLES} with commas between, t_ns a whole number, found "
            f"{unreadable}; with --no-imu the images alone are used"
        )
    table = np.array(values, np.float64).reshape(-1, 6)
    return ImuTable(np.array(times, np.int64), table[:, :3], table[:, 3:], report)


def _read_camera(folder: Path) -> tuple[CameraModel, F64]:
    """The camera and its T_BS (4,4)."""
    part = _read_sensor(folder / "sensor.yaml", read_camera, _CAMERA_KEYS)
    assert part.T_s_c is not None
    return part.calibration.cameras[0], part.T_s_c


def _read_imu_calibration(folder: Path) -> tuple[F64, ImuCalibration | None]:
    """The IMU's T_BS (4,4) and noise; identity and None without an IMU."""
    if not folder.is_dir():
        return np.eye(4), None
    part = _read_sensor(folder / "sensor.yaml", read_imu, _IMU_KEYS)
    assert part.T_s_i is not None
    return part.T_s_i, part.calibration.imu


def _read_sensor(path: Path, read: Callable[[Node], FilePart], keys: str) -> FilePart:
    """A sensor.yaml. Raises _UnreadableSensor, which says what one holds."""
    try:
        return read(read_nodes(path))
    except SourceError as error:
        raise _UnreadableSensor(
            f"{error}; EuRoC's sensor.yaml holds {keys}; mend it, or use another calibration with --calibration FILE"
        ) from error


def _list_stamped(folder: Path) -> Stamped:
    """Image files with their stamps, from data.csv or else from the file names."""
    listing = folder / "data.csv"
    out: Stamped = []
    if listing.is_file():
        for cells in read_rows(listing, "t_ns,filename a line", ","):
            try:
                t_ns = nanoseconds(cells[0])
            except ValueError as error:
                raise SourceError(
                    f"{listing}: expected 't_ns,filename' a line, found {','.join(cells)[:60]!r}"
                ) from error
            name = cells[1] if len(cells) > 1 and cells[1] else f"{cells[0]}.png"
            out.append((t_ns, listed_file(folder / "data", name, listing)))
    else:
        for path in list_images(folder / "data"):
            with contextlib.suppress(ValueError):  # some other image
                out.append((nanoseconds(path.stem), path))
    if not out:
        raise SourceError(f"{folder}: no images: expected data.csv ('t_ns,filename' a line) and data/<t_ns>.png")
    return sorted(out)


def _read_ground_truth(folder: Path, mav: Path, T_s_i: F64) -> Trajectory | None:
    places = (mav / name / "data.csv" for name in ("state_groundtruth_estimate0", "mocap0"))
    estimate = next((path for path in places if path.is_file()), None)
    tum = next((d / "gt.tum" for d in (folder, mav, mav.parent) if (d / "gt.tum").is_file()), None)
    if estimate is not None:
        poses = []
        for cells in read_rows(estimate, "ground truth", ","):
            try:
                p = [float(cell) for cell in cells[1:8]]
                if not np.isfinite(p).all() or not any(p[3:]):
                    raise ValueError("no pose")
                poses.append((nanoseconds(cells[0]), pose_from_tum(np.array([*p[:3], *p[4:7], p[3]]))))
            except (ValueError, IndexError) as error:
                raise SourceError(f"{estimate}: expected t_ns, x y z, qw qx qy qz a line ({error})") from error
    elif tum is not None:
        poses = read_tum_poses(tum)
    else:
        return None
    truth = sorted_trajectory(poses)
    return Trajectory(truth.t_ns, truth.T_w_b @ T_s_i)
