"""What earlier flights found of a rig, as options of the agent: the next flight begins with it."""

from dataclasses import dataclass, field, replace

import numpy as np

from kiteline_agent.imaging.row_alignment import TERMS as ROW_TERMS
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_core.arrays import F64
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import VIRTUAL_BASELINE_M, RectifiedCamera

_CAMERA_NUMBERS = 7
_SAME = 1e-6  # relative; machines round differently
_MAX_PX = 8.0  # of a number that the link can carry
_MAX_READOUT_S = 0.2  # longer than any camera takes


@dataclass(frozen=True, slots=True)
class KnownRigConfig:
    """What is known of a rig beyond its calibration, from `kiteline agent --rig FILE`. It holds for one calibration."""

    camera: tuple[float, ...] = ()  # width, height, fx, fy, cx, cy in px, baseline in m, rectified; (): unknown
    T_b_c: tuple[float, ...] = ()  # row-major 4x4: rectified left camera in the body, m
    rows_px: tuple[float, ...] = ()  # px; factors of 1, x, y, x y, y^2 by which the right image is too low
    rows_read: bool = False  # disparities were measured in a right image that was read there
    disparity_px: tuple[float, ...] = ()  # px; factors of 1, x, y, x^2, x y by which disparities are too large
    disparity_sigma_px: float = 0.0  # px; standard deviation, rms over the image; 0: disparity_px is a start, not known
    readout_s: tuple[
        float, ...
    ] = ()  # s from a rolling shutter's first row to the last, and its deviation; (): not found
    imu: KnownImuConfig = field(default_factory=KnownImuConfig)

    def __post_init__(self) -> None:
        sizes = {
            "camera": _CAMERA_NUMBERS, "T_b_c": 16, "rows_px": ROW_TERMS, "disparity_px": disparity_offset.TERMS,
            "readout_s": 2,
        }  # fmt: skip
        for name, size in sizes.items():
            values = getattr(self, name)
            if values and (len(values) != size or not np.isfinite(values).all()):
                raise ValueError(f"{name} has {len(values)} numbers: expected {size} finite ones, or none")
        if any(abs(v) > _MAX_PX for v in (*self.rows_px, *self.disparity_px)):
            raise ValueError(f"rows_px and disparity_px are px: expected at most {_MAX_PX:g}")
        if not 0.0 <= self.disparity_sigma_px <= _MAX_PX:
            raise ValueError(f"disparity_sigma_px is {self.disparity_sigma_px:g}: expected px from 0 to {_MAX_PX:g}")
        if any(abs(v) > _MAX_READOUT_S for v in self.readout_s) or any(sigma <= 0.0 for sigma in self.readout_s[1:]):
            raise ValueError(f"readout_s is s, and a deviation above 0: expected at most {_MAX_READOUT_S:g}")

    def is_of(self, camera: RectifiedCamera) -> bool:
        """True if it was found with the calibration that gives this rectified camera."""
        return bool(self.camera) and np.allclose(self.camera, numbers_of(camera), rtol=_SAME, atol=0.0)

    def knows_imu_of(self, camera: RectifiedCamera) -> bool:
        """True if the IMU was calibrated against this camera, mounted as this calibration says."""
        return self.is_of(camera) and bool(self.T_b_c) and np.allclose(self.T_b_c, camera.T_b_c.ravel(), atol=_SAME)

    def updated(
        self, camera: RectifiedCamera, right: "KnownRigConfig | None", imu: KnownImuConfig | None,
        readout_s: tuple[float, ...] = (),
    ) -> "KnownRigConfig | None":  # fmt: skip
        """This, with what a flight found of right camera, IMU and shutter (as `readout_s`); None if that is nothing."""
        if right is None and imu is None and not readout_s:
            return None
        if right is None:
            right = self if self.is_of(camera) else KnownRigConfig(numbers_of(camera))
            right = replace(right, T_b_c=_extrinsics_of(camera))  # with which the IMU was compared
        imu = imu or (self.imu if self.knows_imu_of(camera) else KnownImuConfig())
        return replace(right, imu=imu, readout_s=readout_s or self.readout_of(camera))

    def rectified(self) -> RectifiedCamera | None:
        """The rectified camera; None if nothing is known. One camera has no right one."""
        if not self.camera:
            return None
        width, height, fx, fy, cx, cy, baseline_m = self.camera
        T_b_c = np.array(self.T_b_c).reshape(4, 4) if self.T_b_c else np.eye(4)
        stereo = bool(self.rows_px) or baseline_m != VIRTUAL_BASELINE_M
        return RectifiedCamera(round(width), round(height), fx, fy, cx, cy, baseline_m, stereo, T_b_c)

    def readout_of(self, camera: RectifiedCamera) -> tuple[float, ...]:
        """The read-out that was found with this camera's calibration, as `readout_s`."""
        return self.readout_s if self.is_of(camera) else ()

    @property
    def rows(self) -> F64:
        """rows_px (5,), zero where nothing is known."""
        return np.array(self.rows_px or (0.0,) * ROW_TERMS)

    @property
    def disparity(self) -> F64:
        """disparity_px (5,), zero where nothing is known."""
        return np.array(self.disparity_px or (0.0,) * disparity_offset.TERMS)


def numbers_of(camera: RectifiedCamera) -> tuple[float, ...]:
    """The calibration for which a rig is known, as `KnownRigConfig.camera`."""
    c = camera
    return (float(c.width), float(c.height), c.fx, c.fy, c.cx, c.cy, c.baseline_m)


def _extrinsics_of(camera: RectifiedCamera) -> tuple[float, ...]:
    return tuple(round(float(v), 9) for v in camera.T_b_c.ravel())


def known_rig(
    camera: RectifiedCamera, rows_px: F64, disparity_px: F64, sigma_px: float | None = None, *, rows_read: bool
) -> KnownRigConfig:
    """What a flight found of the right camera, rounded to what the next one can use. sigma_px: of disparity_px."""
    rows, disparity = (tuple(round(float(v), 3) for v in values) for values in (rows_px, disparity_px))
    known = KnownRigConfig(numbers_of(camera), _extrinsics_of(camera), rows, rows_read)
    if not any(disparity):
        return known
    return replace(known, disparity_px=disparity, disparity_sigma_px=0.0 if sigma_px is None else round(sigma_px, 4))
