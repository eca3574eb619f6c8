"""What data set folders have in common: small text tables, the flat YAML of sensors, stamps, TUM trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.assemble import Capture, deliver
from kiteline_hw.sensors.imu_buffer import ImuSamples, NoImu

F64 = NDArray[np.float64]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")

Yaml = dict[str, str | list[float]]


@dataclass(slots=True)
class Recording:
    """A FrameSource over a list of captures: what all folder readers return."""

    name: str
    rig: CameraRig
    captures: CaptureList
    imu: ImuCalibration | None = None
    ground_truth: Trajectory | None = None
    report: SourceReport = field(default_factory=SourceReport)

    @property
    def frame_count(self) -> int | None:
        return self.captures.count

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        self.report.skipped.clear()
        self.report.notes.clear()
        samples = self.captures.samples(self.report) if self.imu is not None else NoImu()
        return deliver(self.captures.captures(self.report), samples, self.rig, self.report, self.name)

    def close(self) -> None:
        """Nothing is held open between two images."""


class CaptureList:
    """The images of a folder, still on disk, in order of time."""

    count: int

    def captures(self, report: SourceReport) -> Iterator[Capture]:
        raise NotImplementedError

    def samples(self, report: SourceReport) -> ImuSamples:
        return NoImu()


def read_text(path: Path, what: str) -> str:
    """A small text file. Raises SourceError that names what it is for."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; expected {what}") from error


def rows(path: Path, what: str, separator: str | None = None) -> Iterator[list[str]]:
    """Cells of each line of a table that is neither empty nor a comment."""
    for line in read_text(path, what).splitlines():
        line = line.strip()
        if line and not line.startswith("#"):
            yield [cell.strip() for cell in line.split(separator)]


def seconds_to_ns(text: str) -> int:
    """Exact nanoseconds of decimal seconds ("1305031102.175304", "1.04e-1"). Raises ValueError."""
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"{text!r} is no time in seconds") from error
    if not value.is_finite():
        raise ValueError(f"{text!r} is no time in seconds")
    return int((value * 1_000_000_000).to_integral_value())


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder by name; empty when there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))


def read_yaml(path: Path, what: str) -> Yaml:
    """The flat part of YAML that sensor files use: `key: scalar`, `key: [list]` over several lines, one nesting level
    joined by dots ("T_BS.data"). OpenCV's `%YAML:1.0` head and `!!tags`, which YAML readers reject, are passed over.
    """
    text = "\n".join(line.split("#", 1)[0].rstrip() for line in read_text(path, what).splitlines())
    out: Yaml = {}
    parent = ""
    pattern = re.compile(r"^([ \t]*)([A-Za-z_][\w./-]*)[ \t]*:[ \t]*(?:!!\S+)?[ \t]*(\[[^\]]*\]|[^\n\[]*)$", re.M)
    for match in pattern.finditer(text):
        indent, key, value = match.group(1), match.group(2), match.group(3).strip()
        if not indent and not value:
            parent = key
            continue
        if not indent:
            parent = ""
        name = f"{parent}.{key}" if parent else key
        if value.startswith("["):
            try:
                out[name] = [float(cell) for cell in value[1:-1].replace("\n", " ").split(",") if cell.strip()]
            except ValueError as error:
                raise SourceError(f"{path}: {key} holds something else than numbers ({error})") from error
        else:
            out[name] = value.strip("\"'")
    return out


def yaml_numbers(table: Yaml, key: str, path: Path, count: int | None = None) -> list[float]:
    """The list under a key. Raises SourceError when it is missing or of another length."""
    value = table.get(key)
    if not isinstance(value, list) or (count is not None and len(value) != count):
        want = f"{count} numbers" if count else "a list of numbers"
        raise SourceError(f"{path}: expected {key} with {want}, found {'nothing' if value is None else value}")
    if not np.isfinite(value).all():
        raise SourceError(f"{path}: {key} is not finite: {value}")
    return value


def yaml_number(table: Yaml, key: str, path: Path, default: float | None = None) -> float:
    """The number under a key, or the default. Raises SourceError."""
    value = table.get(key)
    if value is None and default is not None:
        return default
    try:
        number = float(value) if isinstance(value, str) else float("nan")
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        raise SourceError(f"{path}: expected {key}: a number, found {'nothing' if value is None else value!r}")
    return number


def rigid(values: F64, where: str) -> F64:
    """A checked rigid motion (4,4). Raises SourceError when the rotation is none."""
    r = values[:3, :3]
    if not np.isfinite(values).all() or not np.allclose(r @ r.T, np.eye(3), atol=1e-3) or np.linalg.det(r) < 0:
        raise SourceError(f"{where} is no rigid motion: expected a 4x4 matrix with an orthonormal rotation")
    return se3.orthonormalise(values)


def lens_of(model: str, coefficients: list[float], where: str) -> tuple[Lens, tuple[float, ...]]:
    """The lens behind the names that data sets and ROS use. Raises SourceError for one that we do not know."""
    name = model.lower().replace("-", "").replace("_", "").replace(" ", "")
    if name in ("", "none", "pinhole", "rectified", "undistorted") or not any(coefficients):
        if name in ("equidistant", "fisheye", "kannalabrandt", "kannalabrandt4", "kb4"):
            return Lens.EQUIDISTANT, (0.0, 0.0, 0.0, 0.0)
        return Lens.NONE, ()
    if name in ("radialtangential", "radtan", "plumbbob", "rationalpolynomial", "opencv", "browncornrady", "brown"):
        if len(coefficients) not in (4, 5, 8):
            raise SourceError(f"{where}: {model} has {len(coefficients)} coefficients: expected 4, 5 or 8")
        return Lens.RADTAN, tuple(coefficients)
    if name in ("equidistant", "fisheye", "kannalabrandt", "kannalabrandt4", "kb4"):
        if len(coefficients) != 4:
            raise SourceError(f"{where}: {model} has {len(coefficients)} coefficients: expected 4")
        return Lens.EQUIDISTANT, tuple(coefficients)
    raise SourceError(f"{where}: lens model {model!r} is not known: expected radial-tangential or equidistant")


def checked_camera(camera: CameraModel, where: str) -> CameraModel:
    """The camera, if its numbers can be one. Raises SourceError."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not (np.isfinite(numbers).all() and camera.fx > 0 and camera.fy > 0 and camera.width > 0 and camera.height > 0):
        raise SourceError(
            f"{where}: no usable calibration (fx {camera.fx}, fy {camera.fy}, {camera.width}x{camera.height} px)"
        )
    return camera


def checked_baseline(t_c_r: F64, where: str) -> F64:
    """T_c_r (4,4), if the right camera stands beside the left one. Raises SourceError."""
    baseline_m = float(np.linalg.norm(t_c_r[:3, 3]))
    if not 1e-4 < baseline_m < 100.0:
        raise SourceError(
            f"{where}: the baseline between left and right camera is {baseline_m:g} m: expected the extrinsics of a "
            "stereo pair; with mono (--mono) the left camera alone can be used"
        )
    return t_c_r


def read_tum(path: Path) -> Trajectory:
    """A trajectory `t x y z qx qy qz qw` with t in seconds. Raises SourceError."""
    poses: list[tuple[int, F64]] = []
    for cells in rows(path, "a trajectory, t x y z qx qy qz qw a line"):
        try:
            value = np.array([float(cell) for cell in cells[1:8]])
            if len(value) != 7 or not np.isfinite(value).all() or not value[3:].any():
                raise ValueError("8 finite numbers a line expected")
            poses.append((seconds_to_ns(cells[0]), pose_tum(value)))
        except ValueError as error:
            raise SourceError(f"{path}: {' '.join(cells)[:60]!r}: {error}") from error
    return trajectory(poses)


def pose_tum(value: F64) -> F64:
    """T (4,4) of x y z qx qy qz qw."""
    return se3.from_quaternion(value[[6, 3, 4, 5]], value[:3])


def trajectory(poses: list[tuple[int, F64]]) -> Trajectory:
    """Poses in order of time, repeated stamps dropped."""
    poses = sorted(poses, key=lambda pose: pose[0])
    kept = [pose for i, pose in enumerate(poses) if i == 0 or pose[0] > poses[i - 1][0]]
    matrices = np.array([pose[1] for pose in kept], np.float64).reshape(-1, 4, 4)
    return Trajectory(np.array([pose[0] for pose in kept], np.int64), matrices)
