"""Content of calibration files, in one form whichever tool wrote them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.wording import counted
from kiteline_hw.calibration.checks import checked_baseline
from kiteline_hw.ports import SourceError


@dataclass(frozen=True, slots=True)
class FileCalibration:
    """A calibration read from files.

    cameras: none, the left one, or left and right. T_c_r: (4,4) right camera in the left one. T_b_c: (4,4) left camera
    in the body, which is the IMU; None: not given. topics: of the cameras in a bag, "" where not given. known: False
    for a stand-in where nothing is calibrated yet, whose size is that of the images. without_imu: T_b_c is in the frame
    that EuRoC's sensor.yaml share, and no file says where the IMU is in it. depth_scale: stored units a metre of depth
    images; None: not given.
    """

    where: str
    cameras: tuple[CameraModel, ...] = ()
    T_c_r: F64 | None = None
    T_b_c: F64 | None = None
    imu: ImuCalibration | None = None
    topics: tuple[str, ...] = ()
    known: bool = True
    without_imu: bool = False
    depth_scale: float | None = None

    def rig_of_images(self, name: str, count: int, size: tuple[int, int]) -> CameraRig:
        """The rig of a source's images: one camera or two, (height, width). Raises SourceError if they are too many."""
        if not self.known:
            h, w = size
            camera = CameraModel(w, h, float(w), float(w), 0.5 * (w - 1), 0.5 * (h - 1))
            return replace(self, cameras=(camera,) * count).rig()
        if count > len(self.cameras):
            raise SourceError(f"{self.where}: one camera, but {name} has two: expected the right one too, or --mono")
        return self.rig(mono=count == 1)

    def rig(self, mono: bool = False) -> CameraRig:
        """The rig of these cameras. Raises SourceError if there is no camera or a pair without extrinsics."""
        if not self.cameras:
            raise SourceError(f"{self.where}: holds no camera: expected one with intrinsics and size")
        T_b_c, has_body = (np.eye(4), False) if self.T_b_c is None else (self.T_b_c, True)
        if mono or len(self.cameras) == 1:
            return CameraRig(self.cameras[0], None, T_b_c, None, has_body=has_body)
        if self.T_c_r is None:
            raise SourceError(
                f"{self.where}: nothing says where the right camera sits against the left one: expected extrinsics "
                "(T_cn_cnm1, T_BS, Stereo.T_c1_c2, R and T, or the P of a rectified pair); with mono (--mono) the left "
                "camera is used"
            )
        T_c_r = checked_baseline(self.T_c_r, self.where)
        return CameraRig(self.cameras[0], self.cameras[1], T_b_c, T_c_r, has_body=has_body)


# Opens sources whose images are to be calibrated.
UNCALIBRATED = FileCalibration(
    "no calibration", (CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0),) * 2, se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0])),
    known=False,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FilePart:
    """Content of one file. T_s_c: camera in a frame that all files share; P: (3,4) of a rectified pair, with its R."""

    where: str
    calibration: FileCalibration
    T_s_c: F64 | None = None
    T_s_i: F64 | None = None
    rectified: tuple[F64, F64] | None = None  # R (3,3), P (3,4)


def joined(parts: Sequence[FilePart]) -> FileCalibration:
    """One calibration of several files: left camera first, right camera second, an IMU anywhere. Raises SourceError."""
    if len(parts) == 1:
        only = parts[0]
        given = only.calibration
        return given if only.T_s_c is None else replace(given, T_b_c=only.T_s_c, without_imu=True)
    where = ", ".join(p.where for p in parts)
    eyes = [p for p in parts if p.calibration.cameras]
    imus = [p for p in parts if p.calibration.imu is not None]
    count = sum(len(p.calibration.cameras) for p in eyes)
    if count > 2 or len(imus) > 1:
        found = f"{counted(count, 'camera')} and {counted(len(imus), 'IMU')}"
        raise SourceError(f"{where}: {found}: expected a left and a right camera, one IMU")
    imu = imus[0].calibration.imu if imus else None
    if not eyes:
        return FileCalibration(where, imu=imu)
    first = eyes[0].calibration
    T_b_c, without_imu = first.T_b_c, False
    T_s_i = next((p.T_s_i for p in imus if p.T_s_i is not None), None)
    if eyes[0].T_s_c is not None:
        without_imu = T_s_i is None
        T_b_c = eyes[0].T_s_c if T_s_i is None else se3.inverse(T_s_i) @ eyes[0].T_s_c
    if len(eyes) == 1:
        return replace(first, where=where, T_b_c=T_b_c, imu=imu, without_imu=without_imu)
    left, right = eyes
    T_c_r = _between(left, right)
    cameras, topics = (left.calibration.cameras + right.calibration.cameras), (first.topics + right.calibration.topics)
    return FileCalibration(where, cameras, T_c_r, T_b_c, imu, topics, without_imu=without_imu)


def _between(left: FilePart, right: FilePart) -> F64 | None:
    """T_c_r by two files, None if they lack it."""
    if left.T_s_c is not None and right.T_s_c is not None:
        return se3.inverse(left.T_s_c) @ right.T_s_c
    if left.rectified is None or right.rectified is None:
        return None
    return between_rectified(left.rectified, right.rectified)


def between_rectified(left: tuple[F64, F64], right: tuple[F64, F64]) -> F64 | None:
    """T_c_r (4,4) by R (3,3) and P (3,4) of both cameras of a pair; None if a P is that of no camera."""
    (r_l, p_l), (r_r, p_r) = left, right
    if not (p_l[0, 0] > 0 and p_r[0, 0] > 0):
        return None
    # P relates the rectified frames; R rotates each camera into its rectified one.
    shift = np.eye(4)
    shift[0, 3] = p_l[0, 3] / p_l[0, 0] - p_r[0, 3] / p_r[0, 0]
    zero = np.zeros(3)
    return se3.inverse(se3.from_rt(r_l, zero)) @ shift @ se3.from_rt(r_r, zero)
