"""EuRoC's ASL folders: mav0/cam0, cam1, imu0, each with sensor.yaml and data.csv. The body frame is the IMU's."""

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
from kiteline_hw.sensors.frames import EncodedFrame, pair_by_time, pair_tolerance_ns
from kiteline_hw.sensors.images import ImageFile
from kiteline_hw.sensors.imu_buffer import ImuSamples, ImuTable
from kiteline_hw.sources.calibration import checked_baseline, checked_camera, checked_rigid, parse_lens, read_out
from kiteline_hw.sources.recording import Recording, Stamped, list_images, sorted_trajectory
from kiteline_hw.sources.text_files import (
    Yaml,
    pose_from_tum,
    read_rows,
    read_tum_poses,
    read_yaml,
    yaml_number,
    yaml_numbers,
)

F64 = NDArray[np.float64]


def open_source(folder_name: str, mono: bool, imu: bool) -> Recording:
    """Open an ASL folder (the one that holds mav0, or mav0 itself). Raises SourceError."""
    folder = Path(folder_name)
    mav = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if not (mav / "cam0").is_dir():
        raise SourceError(f"{folder}: expected EuRoC's layout, mav0/cam0/sensor.yaml and mav0/cam0/data; no cam0 there")
    left, T_s_c = _read_camera(mav / "cam0")
    # The files give cameras and ground truth in their own frame "B" (here: s); the body frame is that of the IMU.
    imu_yaml = mav / "imu0" / "sensor.yaml"
    table = read_yaml(imu_yaml, "the IMU's calibration") if (mav / "imu0").is_dir() else None
    T_s_i = _read_extrinsics(table, imu_yaml) if table is not None else np.eye(4)
    right = T_c_r = None
    images = [_list_stamped(mav / "cam0")]
    if not mono and (mav / "cam1").is_dir():
        right, T_s_r = _read_camera(mav / "cam1")
        T_c_r = checked_baseline(se3.inverse(T_s_c) @ T_s_r, f"{mav}: T_BS of cam0 and cam1")
        images.append(_list_stamped(mav / "cam1"))
    rig = CameraRig(left, right, se3.inverse(T_s_i) @ T_s_c, T_c_r)
    return Recording(
        f"euroc:{folder}", rig, len(images[0]), lambda report: _read_frames(images, report),
        _read_imu_calibration(table, imu_yaml) if imu and table is not None else None,
        _read_ground_truth(folder, mav, T_s_i), lambda report: _read_imu(mav / "imu0" / "data.csv", report),
    )  # fmt: skip


def _read_frames(images: list[Stamped], report: SourceReport) -> Iterator[EncodedFrame]:
    if len(images) == 1:
        for t, path in images[0]:
            yield EncodedFrame(t, ImageFile(path))
        return
    sides = [[(t, side, path) for t, path in listed] for side, listed in enumerate(images)]
    tolerance_ns = pair_tolerance_ns(np.array([t for t, _ in images[0]], np.int64))
    merged = heapq.merge(*sides, key=lambda item: item[0])
    for t, left, right in pair_by_time(merged, tolerance_ns, ("left image", "right image"), report):
        yield EncodedFrame(t, ImageFile(left), None if right is None else ImageFile(right))


def _read_imu(path: Path, report: SourceReport) -> ImuSamples:
    times: list[int] = []
    values: list[list[float]] = []
    for cells in read_rows(path, "IMU samples: t_ns, gyro x y z rad/s, accel x y z m/s^2", ","):
        try:
            row = [float(cell) for cell in cells[1:7]]
            if len(row) != 6:
                raise ValueError
            times.append(int(cells[0]))
            values.append(row)
        except ValueError:
            report.skip("unreadable imu line", f"{path.name}: {','.join(cells)[:60]!r}")
    table = np.array(values, np.float64).reshape(-1, 6)
    return ImuTable(np.array(times, np.int64), table[:, :3], table[:, 3:], report)


def _read_camera(folder: Path) -> tuple[CameraModel, F64]:
    """The camera and its T_BS (4,4)."""
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
    lens, coefficients = parse_lens(str(table.get("distortion_model", "none")), distortion, str(path))
    readout_s = read_out(table, height, path)
    camera = CameraModel(width, height, fx, fy, cx, cy, lens, coefficients, readout_s)
    return checked_camera(camera, str(path)), _read_extrinsics(table, path)


def _read_extrinsics(table: Yaml, path: Path) -> F64:
    return checked_rigid(np.array(yaml_numbers(table, "T_BS.data", path, 16)).reshape(4, 4), f"{path}: T_BS")


def _read_imu_calibration(table: Yaml, path: Path) -> ImuCalibration:
    d = ImuCalibration()
    return ImuCalibration(
        yaml_number(table, "gyroscope_noise_density", path, d.gyro_noise),
        yaml_number(table, "gyroscope_random_walk", path, d.gyro_walk),
        yaml_number(table, "accelerometer_noise_density", path, d.accel_noise),
        yaml_number(table, "accelerometer_random_walk", path, d.accel_walk),
        yaml_number(table, "rate_hz", path, d.rate_hz),
    )


def _list_stamped(folder: Path) -> Stamped:
    """Image files with their stamps, from data.csv or else from the file names."""
    listing = folder / "data.csv"
    out: Stamped = []
    if listing.is_file():
        for cells in read_rows(listing, "t_ns,filename a line", ","):
            if not cells[0].isdigit():
                raise SourceError(f"{listing}: expected 't_ns,filename' a line, found {','.join(cells)[:60]!r}")
            name = cells[1] if len(cells) > 1 and cells[1] else f"{cells[0]}.png"
            out.append((int(cells[0]), folder / "data" / name))
    else:
        out = [(int(path.stem), path) for path in list_images(folder / "data") if path.stem.isdigit()]
    if not out:
        raise SourceError(f"{folder}: no images: expected data.csv ('t_ns,filename' a line) and data/<t_ns>.png")
    return sorted(out)


def _read_ground_truth(folder: Path, mav: Path, T_s_i: F64) -> Trajectory | None:
    estimate = mav / "state_groundtruth_estimate0" / "data.csv"
    tum = next((d / "gt.tum" for d in (folder, mav, mav.parent) if (d / "gt.tum").is_file()), None)
    if estimate.is_file():
        poses = []
        for cells in read_rows(estimate, "ground truth", ","):
            try:
                p = [float(cell) for cell in cells[1:8]]
                poses.append((int(cells[0]), pose_from_tum(np.array([*p[:3], *p[4:7], p[3]]))))
            except (ValueError, IndexError) as error:
                raise SourceError(f"{estimate}: expected t_ns, x y z, qw qx qy qz a line ({error})") from error
    elif tum is not None:
        poses = read_tum_poses(tum)
    else:
        return None
    truth = sorted_trajectory(poses)
    return Trajectory(truth.t_ns, truth.T_w_b @ T_s_i)
