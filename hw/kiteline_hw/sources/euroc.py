"""EuRoC's ASL folders: mav0/cam0, cam1, imu0, each with sensor.yaml and data.csv; distorted images, body = IMU axes."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import ImuCalibration, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.assemble import Capture, pair_by_time, pair_tolerance_ns
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sensors.imu_buffer import ImuSamples, ImuTable
from kiteline_hw.sources.tables import (
    CaptureList,
    Recording,
    Yaml,
    checked_baseline,
    checked_camera,
    lens_of,
    list_images,
    pose_tum,
    read_tum,
    read_yaml,
    rigid,
    rows,
    trajectory,
    yaml_number,
    yaml_numbers,
)

F64 = NDArray[np.float64]
Stamped = list[tuple[int, Path]]


def open_euroc(folder: Path, *, mono: bool = False, imu: bool = True) -> Recording:
    """Open an ASL folder (the one that holds mav0, or mav0 itself). Raises SourceError."""
    mav = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if not (mav / "cam0").is_dir():
        raise SourceError(f"{folder}: expected EuRoC's layout, mav0/cam0/sensor.yaml and mav0/cam0/data; no cam0 there")
    left, t_s_c = _camera(mav / "cam0")
    # The body frame is that of the IMU's axes: cameras and truth, given in the frame "B" of the files, move there.
    table = read_yaml(mav / "imu0" / "sensor.yaml", "the IMU's calibration") if (mav / "imu0").is_dir() else None
    t_s_i = _extrinsics(table, mav / "imu0" / "sensor.yaml") if table is not None else np.eye(4)
    to_body = se3.inverse(t_s_i)
    right = t_c_r = None
    stereo = not mono and (mav / "cam1").is_dir()
    if stereo:
        right, t_s_r = _camera(mav / "cam1")
        t_c_r = checked_baseline(se3.inverse(t_s_c) @ t_s_r, f"{mav}: T_BS of cam0 and cam1")
    rig = CameraRig(left, right, to_body @ t_s_c, t_c_r)
    images = [_stamps(mav / "cam0")] + ([_stamps(mav / "cam1")] if stereo else [])
    captures = _EurocImages(images, mav / "imu0" / "data.csv")
    calibration = _imu(table, mav / "imu0" / "sensor.yaml") if imu and table is not None else None
    return Recording(f"euroc:{folder}", rig, captures, calibration, _truth(folder, mav, t_s_i))


class _EurocImages(CaptureList):
    def __init__(self, images: list[Stamped], imu_csv: Path) -> None:
        self._images = images
        self._imu_csv = imu_csv
        self.count = len(images[0])

    def captures(self, report: SourceReport) -> Iterator[Capture]:
        if len(self._images) == 1:
            for t, path in self._images[0]:
                yield Capture(t, ImageFile(path))
            return
        sides = [[(t, side, path) for t, path in images] for side, images in enumerate(self._images)]
        tolerance_ns = pair_tolerance_ns(np.array([t for t, _ in self._images[0]], np.int64))
        merged = heapq.merge(*sides, key=lambda item: item[0])
        for t, left, right in pair_by_time(merged, tolerance_ns, ("left image", "right image"), report):
            yield Capture(t, ImageFile(left), ImageFile(right))

    def samples(self, report: SourceReport) -> ImuSamples:
        times: list[int] = []
        values: list[list[float]] = []
        for cells in rows(self._imu_csv, "IMU samples: t_ns, gyro x y z rad/s, accel x y z m/s^2", ","):
            try:
                row = [float(cell) for cell in cells[1:7]]
                if len(row) != 6:
                    raise ValueError
                times.append(int(cells[0]))
                values.append(row)
            except ValueError:
                report.skip("unreadable imu line", f"{self._imu_csv.name}: {','.join(cells)[:60]!r}")
        table = np.array(values, np.float64).reshape(-1, 6)
        return ImuTable(np.array(times, np.int64), table[:, :3], table[:, 3:], report)


def _camera(folder: Path) -> tuple[CameraModel, F64]:
    path = folder / "sensor.yaml"
    table = read_yaml(path, "the camera's calibration (intrinsics, distortion_coefficients, T_BS)")
    model = table.get("camera_model", "pinhole")
    if model != "pinhole":
        raise SourceError(f"{path}: camera_model {model!r} is not known: expected pinhole")
    fx, fy, cx, cy = yaml_numbers(table, "intrinsics", path, 4)
    width, height = (int(n) for n in yaml_numbers(table, "resolution", path, 2))
    distortion = table.get("distortion_coefficients", [])
    if not isinstance(distortion, list):
        raise SourceError(f"{path}: expected distortion_coefficients with a list of numbers, found {distortion!r}")
    lens, coefficients = lens_of(str(table.get("distortion_model", "none")), distortion, str(path))
    camera = CameraModel(width, height, fx, fy, cx, cy, lens, coefficients)
    return checked_camera(camera, str(path)), _extrinsics(table, path)


def _extrinsics(table: Yaml, path: Path) -> F64:
    return rigid(np.array(yaml_numbers(table, "T_BS.data", path, 16)).reshape(4, 4), f"{path}: T_BS")


def _imu(table: Yaml, path: Path) -> ImuCalibration:
    d = ImuCalibration()
    return ImuCalibration(
        yaml_number(table, "gyroscope_noise_density", path, d.gyro_noise),
        yaml_number(table, "gyroscope_random_walk", path, d.gyro_walk),
        yaml_number(table, "accelerometer_noise_density", path, d.accel_noise),
        yaml_number(table, "accelerometer_random_walk", path, d.accel_walk),
        yaml_number(table, "rate_hz", path, d.rate_hz),
    )


def _stamps(folder: Path) -> Stamped:
    listing = folder / "data.csv"
    out: Stamped = []
    if listing.is_file():
        for cells in rows(listing, "t_ns,filename a line", ","):
            if not cells[0].isdigit():
                raise SourceError(f"{listing}: expected 't_ns,filename' a line, found {','.join(cells)[:60]!r}")
            name = cells[1] if len(cells) > 1 and cells[1] else f"{cells[0]}.png"
            out.append((int(cells[0]), folder / "data" / name))
    else:
        out = [(int(path.stem), path) for path in list_images(folder / "data") if path.stem.isdigit()]
    if not out:
        raise SourceError(f"{folder}: no images: expected data.csv ('t_ns,filename' a line) and data/<t_ns>.png")
    return sorted(out)


def _truth(folder: Path, mav: Path, t_s_i: F64) -> Trajectory | None:
    estimate = mav / "state_groundtruth_estimate0" / "data.csv"
    tum = next((d / "gt.tum" for d in (folder, mav, mav.parent) if (d / "gt.tum").is_file()), None)
    if estimate.is_file():
        poses = []
        for cells in rows(estimate, "ground truth", ","):
            try:
                p = [float(cell) for cell in cells[1:8]]
                poses.append((int(cells[0]), pose_tum(np.array([*p[:3], *p[4:7], p[3]]))))
            except (ValueError, IndexError) as error:
                raise SourceError(f"{estimate}: expected t_ns, x y z, qw qx qy qz a line ({error})") from error
        truth = trajectory(poses)
    elif tum is not None:
        truth = read_tum(tum)
    else:
        return None
    return Trajectory(truth.t_ns, truth.T_w_b @ t_s_i)
