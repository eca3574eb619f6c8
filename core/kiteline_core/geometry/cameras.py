"""Camera models, and rectification computed once from calibration.

Optical frames: x right, y down, z forward. Pixel (0, 0) is the centre of the first pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F32, F64, I16, U8, U16
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import se3
from kiteline_core.order_statistics import median

GRID_STEP = 4  # px between the points of a rectification grid: interpolation errors are below 0.01 px
VIRTUAL_BASELINE_M = 0.1  # scale of coded inverse depths of cameras without a right image
_ROOM_DEPTH = 4.0  # of the landmarks in a room, in m
_MAX_SLOPE = 1.75  # x/z at the side of a rectified image, 60 degrees: more costs resolution in the middle
_MIN_COSINE = 0.8  # between an optical axis and the rectified one: beyond 37 degrees the views hardly overlap


class CalibrationError(KitelineError, ValueError):
    """A calibration that cannot be used; the text says why and what was expected."""


class Lens(Enum):
    """Distortion model of a lens."""

    NONE = "none"
    RADTAN = "radtan"  # k1 k2 p1 p2 [k3 [k4 k5 k6]], as OpenCV and EuRoC write them
    EQUIDISTANT = "equidistant"  # k1 k2 k3 k4 (Kannala-Brandt), as OpenCV's fisheye


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A pinhole camera with lens distortion. Focal lengths, centre and size in px.

    readout_s: from the first row's exposure to the last row's, of a rolling shutter whose frames are stamped at the
    middle row; 0: a global shutter.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens = Lens.NONE
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0

    def matrix(self) -> F64:
        """The 3x3 camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class CameraRig:
    """Cameras of a vehicle: a left one, optionally a right one or depth aligned with the left.

    T_b_c: (4,4) left camera in the body. T_c_r: (4,4) right camera in the left one, or None without a right camera.
    has_body: False if the source has no body frame (then T_b_c is the identity and poses are camera poses).
    """

    left: CameraModel
    right: CameraModel | None
    T_b_c: F64
    T_c_r: F64 | None
    has_depth: bool = False
    has_body: bool = True


@dataclass(frozen=True, slots=True)
class RectifiedCamera:
    """An ideal pinhole; the right camera, if any, is at +baseline_m along x. T_b_c: (4,4) of the rectified left.

    Without a right camera (`stereo` False) baseline_m is VIRTUAL_BASELINE_M: disparity = fx * baseline_m / depth is
    then only a unit of inverse depth.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float
    stereo: bool
    T_b_c: F64

    @property
    def bf(self) -> float:
        """fx * baseline in px*m: disparity_px = bf / depth_m."""
        return self.fx * self.baseline_m


@dataclass(frozen=True, slots=True)
class RawSide:
    """A raw camera of a pair that is rectified. rotation: (3,3) from it to the rectified one, whose matrix is (3,3)."""

    lens: CameraModel
    rotation: F64
    matrix: F64


def virtual_bf(bf: float, rho: F64) -> float:
    """Focal length times a baseline, by which inverse depths of a map without a unit are compared in px.

    bf: of the camera. rho: (n,) inverse depths of landmarks in a keyframe, n >= 1. In a unit of its own a fixed
    baseline is a centimetre here and a metre there. By this one the median landmark has the disparity that it would
    have at a room's depth.
    """
    return bf / (_ROOM_DEPTH * median(rho))


class Rectifier:
    """Rectifies raw images. Images that are already rectified are passed through."""

    def __init__(self, rig: CameraRig) -> None:
        left = rig.left
        self._size, self._left = (left.width, left.height), left
        self._shown_left: Callable[[F64], F64] | None = None  # see correct_left
        self.readout_s = left.readout_s
        self._maps: list[tuple[I16, U16] | None] = [None, None]
        self.raw_sides: tuple[RawSide, ...] = ()  # left and right, of a pair that is remapped
        self.right_rows: Callable[[F64], F64] | None = None  # see set_right_rows
        self._depth_map: I16 | None = None
        self._halves: list[tuple[I16, U16] | None] = [None, None]
        self._told_right_grid: F32 | None = None  # that of the calibration, once rows were set
        self.blank = np.zeros((left.height, left.width), np.uint8)
        self.left_grid: F32 | None = None  # see _grid; None if the image needs no rectification
        self.right_grid: F32 | None = None
        if rig.right is None:
            if left.lens is not Lens.NONE:
                alone = RawSide(left, np.eye(3), left.matrix())
                self._maps[0], self.left_grid = _fixed_maps(alone), _grid(alone)
            self.camera = RectifiedCamera(
                left.width, left.height, left.fx, left.fy, left.cx, left.cy,
                VIRTUAL_BASELINE_M, False, rig.T_b_c.copy(),
            )  # fmt: skip
            return
        assert rig.T_c_r is not None
        if (rig.right.width, rig.right.height) != self._size:
            raise CalibrationError(
                f"left camera is {left.width}x{left.height} px, right camera {rig.right.width}x{rig.right.height}: "
                "a stereo pair needs one size"
            )
        baseline_m = float(np.linalg.norm(rig.T_c_r[:3, 3]))
        if not 1e-4 < baseline_m < 100.0:
            raise CalibrationError(f"stereo baseline is {baseline_m} m: expected the right camera beside the left one")
        if _is_rectified(rig):
            self.camera = RectifiedCamera(
                left.width, left.height, left.fx, left.fy, left.cx, left.cy, baseline_m, True, rig.T_b_c.copy()
            )
            return
        r_left, r_right, new = _stereo_rotations(rig)
        self.raw_sides = sides = RawSide(left, r_left, new), RawSide(rig.right, r_right, new)
        self._maps[0] = _fixed_maps(sides[0])
        self.left_grid, self.right_grid = _grid(sides[0]), _grid(sides[1])
        # r_left rotates points of the raw left camera into the rectified one.
        t_b_c = rig.T_b_c @ se3.from_rt(r_left.T, np.zeros(3))
        self.camera = RectifiedCamera(
            left.width,
            left.height,
            float(new[0, 0]),
            float(new[1, 1]),
            float(new[0, 2]),
            float(new[1, 2]),
            baseline_m,
            True,
            t_b_c,
        )

    @property
    def remaps(self) -> bool:
        """True if images must be remapped."""
        return self._maps[0] is not None

    def correct_left(self, shown: Callable[[F64], F64]) -> None:
        """Read the left image of a single camera where it shows what the lens should show elsewhere.

        shown: pixels (n,2) of the image that was rectified so far, for true ones (n,2). `camera` stays as it is.
        """
        width, height = self._size
        columns, rows = ((side + GRID_STEP - 1) // GRID_STEP + 1 for side in self._size)
        before = self._shown_left

        def raw_of(x: F64, y: F64) -> F32:
            at = shown(np.stack([x.ravel(), y.ravel()], axis=1))
            at = at if before is None else before(at)
            return self._raw_left(at).reshape(*x.shape, 2).astype(np.float32)

        self._shown_left = shown if before is None else lambda uv: before(shown(uv))
        grid = np.meshgrid(GRID_STEP * np.arange(columns, dtype=float), GRID_STEP * np.arange(rows, dtype=float))
        self.left_grid = np.ascontiguousarray(raw_of(*grid))
        full = raw_of(*np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)))
        fixed = cv2.convertMaps(full[..., 0], full[..., 1], cv2.CV_16SC2)
        self._maps[0] = np.asarray(fixed[0], np.int16), np.asarray(fixed[1], np.uint16)
        self._halves[0] = None

    def _raw_left(self, uv: F64) -> F64:
        """Raw pixels (n,2) of rectified ones of a single camera, by its calibration."""
        camera, lens = self.camera, self._left
        xy = (uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        if lens.lens is Lens.NONE:
            return np.asarray(xy * [lens.fx, lens.fy] + [lens.cx, lens.cy])
        none, d = np.zeros(3), np.array(lens.distortion, np.float64)
        if lens.lens is Lens.EQUIDISTANT:
            found = cv2.fisheye.projectPoints(
                np.append(xy, np.ones((len(xy), 1)), axis=1)[None], none, none, lens.matrix(), d
            )[0]
        else:
            found = cv2.projectPoints(np.append(xy, np.ones((len(xy), 1)), axis=1), none, none, lens.matrix(), d)[0]
        return np.asarray(found.reshape(-1, 2), np.float64)

    def set_right_rows(self, offset_px: Callable[[F64], F64]) -> None:
        """Read the right image lower than its calibration says, where points are read singly.

        offset_px: by how much (n,) at pixels (n,2) of the rectified image. Level 1 of its pyramid follows; a whole
        right image does not.
        """
        self.right_rows = offset_px
        columns, rows = ((side + GRID_STEP - 1) // GRID_STEP + 1 for side in self._size)
        x, y = np.meshgrid(GRID_STEP * np.arange(columns), GRID_STEP * np.arange(rows))
        pixels = np.stack([x, y], -1)
        if self._told_right_grid is None:
            self._told_right_grid = pixels.astype(np.float32) if self.right_grid is None else self.right_grid
        told = self._told_right_grid.astype(np.float64)
        offset = offset_px(pixels.reshape(-1, 2).astype(np.float64)).reshape(rows, columns, 1)
        lower = np.gradient(told, float(GRID_STEP), axis=0) * offset
        self.right_grid = np.ascontiguousarray(told + lower, np.float32)
        fixed = cv2.convertMaps(*_level_maps(self.right_grid, self._size, 1), cv2.CV_16SC2)
        self._halves[1] = (np.asarray(fixed[0], np.int16), np.asarray(fixed[1], np.uint16))

    def left_level(self, image: U8, level: int) -> U8:
        """Rectify a coarse level of a raw left image's pyramid; for few images: its maps are not kept."""
        if self.left_grid is None:
            return image
        maps = _level_maps(self.left_grid, (image.shape[1] << level, image.shape[0] << level), level)
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)

    def rectify(self, side: int, image: U8) -> U8:
        """Rectify an image (h, w) of a side (0 left, 1 right). Raises CalibrationError for a wrong size."""
        self.check_size(image)
        if side == 1:
            self._maps[1] = self._full_maps(1)
        maps = self._maps[side]
        if maps is None:
            return image
        return np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR), np.uint8)

    def halved(self, side: int, small: U8) -> U8:
        """Rectify level 1 of a raw image's pyramid, ((h+1)//2, (w+1)//2)."""
        halves = self._halves[side]
        if halves is None:
            maps = self._full_maps(side)
            if maps is None:
                return small
            x, y = cv2.convertMaps(maps[0][::2, ::2], maps[1][::2, ::2], cv2.CV_32FC1)
            fixed = cv2.convertMaps(0.5 * x, 0.5 * y, cv2.CV_16SC2)
            halves = self._halves[side] = (np.asarray(fixed[0], np.int16), np.asarray(fixed[1], np.uint16))
        return np.asarray(cv2.remap(small, halves[0], halves[1], cv2.INTER_LINEAR), np.uint8)

    def left(self, image: U8) -> U8:
        """Rectify a left image (h, w) uint8. Raises CalibrationError for a wrong size."""
        return self.rectify(0, image)

    def right(self, image: U8) -> U8:
        """Rectify a right image (h, w) uint8. Raises CalibrationError for a wrong size."""
        return self.rectify(1, image)

    def depth(self, depth_m: F32) -> F32:
        """Rectify depth (h, w) to the left camera, by nearest neighbour, so that edges are not blended."""
        if depth_m.shape != (self._size[1], self._size[0]):
            raise CalibrationError(
                f"depth is {depth_m.shape[1]}x{depth_m.shape[0]} px, calibration says {self._size[0]}x{self._size[1]}"
            )
        if self._depth_map is None:
            maps = self._maps[0]
            if maps is None:
                return depth_m
            # Fixed-point maps hold the integer pixel, and the fraction in 1/32 px (5 bits for x, 5 for y).
            whole, rest = maps[0].astype(np.int32), maps[1].astype(np.int32)
            rest_xy = np.stack([rest & 31, (rest >> 5) & 31], axis=-1)
            self._depth_map = (whole + (rest_xy >= 16)).astype(np.int16)
        return np.asarray(cv2.remap(depth_m, self._depth_map, np.empty(0), cv2.INTER_NEAREST), np.float32)

    def check_size(self, image: U8) -> None:
        """Raise CalibrationError if an image does not have the calibrated size."""
        if image.shape != (self._size[1], self._size[0]):
            raise CalibrationError(
                f"image is {image.shape[1]}x{image.shape[0]} px, calibration says {self._size[0]}x{self._size[1]}"
            )

    def _full_maps(self, side: int) -> tuple[I16, U16] | None:
        """Maps of a full image. Those of the right image are kept only once `rectify` needs them."""
        if self._maps[side] is None and side == 1 and self.raw_sides:
            return _fixed_maps(self.raw_sides[1])
        return self._maps[side]


def _is_rectified(rig: CameraRig) -> bool:
    left, right = rig.left, rig.right
    assert right is not None and rig.T_c_r is not None
    return (
        left.lens is Lens.NONE
        and right.lens is Lens.NONE
        and np.allclose(left.matrix(), right.matrix(), atol=1e-6)
        and np.allclose(rig.T_c_r[:3, :3], np.eye(3), atol=1e-9)
        and np.allclose(rig.T_c_r[1:3, 3], 0.0, atol=1e-9)
        and bool(rig.T_c_r[0, 3] > 0)
    )


def undistortion_maps(
    lens: CameraModel, rotation: F64, matrix: F64, size: tuple[int, int], kind: int
) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """OpenCV's maps, of a kind of its own, from pixels of a camera matrix (3,3) and an image size to raw pixels."""
    d = np.array(lens.distortion, np.float64)
    undistort = cv2.fisheye.initUndistortRectifyMap if lens.lens is Lens.EQUIDISTANT else cv2.initUndistortRectifyMap
    x, y = undistort(lens.matrix(), d, rotation, matrix, size, kind)
    return np.asarray(x), np.asarray(y)


def _fixed_maps(raw: RawSide) -> tuple[I16, U16]:
    size = (raw.lens.width, raw.lens.height)
    xy, rest = undistortion_maps(raw.lens, raw.rotation, raw.matrix, size, cv2.CV_16SC2)
    return xy.astype(np.int16, copy=False), rest.astype(np.uint16, copy=False)


def _grid(raw: RawSide) -> F32:
    """Raw pixels (gh, gw, 2) float32 of every GRID_STEP-th rectified pixel, the far border included."""
    size = (raw.lens.width + GRID_STEP, raw.lens.height + GRID_STEP)
    x, y = undistortion_maps(raw.lens, raw.rotation, raw.matrix, size, cv2.CV_32FC1)
    return np.ascontiguousarray(np.stack([x, y], axis=-1)[::GRID_STEP, ::GRID_STEP], np.float32)


def _level_maps(grid: F32, size: tuple[int, int], level: int) -> tuple[F32, F32]:
    """Raw pixels of a pyramid's level, x and y, by a grid. size: of level 0, (w, h)."""
    step = 1 << level
    width, height = (-(-side // step) for side in size)
    x, y = np.meshgrid(np.arange(width) * (step / GRID_STEP), np.arange(height) * (step / GRID_STEP))
    raw = cv2.remap(grid, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR) / step
    return np.ascontiguousarray(raw[:, :, 0], np.float32), np.ascontiguousarray(raw[:, :, 1], np.float32)


def _stereo_rotations(rig: CameraRig) -> tuple[F64, F64, F64]:
    """Rotations raw -> rectified of both cameras and their common camera matrix (A. Fusiello et al., 2000).

    Each camera is rotated by half of their relative rotation, then x is aligned with the baseline. The focal length
    keeps the middle of each image side in view; only corners are cropped.
    """
    assert rig.right is not None and rig.T_c_r is not None
    half = se3.so3_exp(0.5 * se3.so3_log(rig.T_c_r[:3, :3]))  # from the mean orientation to the left camera
    baseline = half.T @ rig.T_c_r[:3, 3]
    if abs(baseline[0]) < abs(baseline[1]) or baseline[0] < 0:
        raise CalibrationError(
            f"the right camera lies {baseline[0]:.3g} m to the right of the left one and {baseline[1]:.3g} m below it: "
            "expected it on the right; exchange left and right, or mend the calibration (x of T_c_r is positive)"
        )
    x = baseline / np.linalg.norm(baseline)
    y = np.cross(np.array([0.0, 0.0, 1.0]), x)
    y /= np.linalg.norm(y)
    align = np.stack([x, y, np.cross(x, y)])
    r_left = align @ half.T
    r_right = align @ half.T @ rig.T_c_r[:3, :3]
    if min(r_left[2, 2], r_right[2, 2]) < _MIN_COSINE:
        raise CalibrationError("the two cameras hardly look the same way: expected the extrinsics of a stereo pair")
    sides = [_side_rays(rig.left, r_left), _side_rays(rig.right, r_right)]
    left, right = max(s[0] for s in sides), min(s[1] for s in sides)
    top, bottom = max(s[2] for s in sides), min(s[3] for s in sides)
    width, height = rig.left.width, rig.left.height
    focal = max((width - 1) / (right - left), (height - 1) / (bottom - top))
    cx = 0.5 * (width - 1) - focal * 0.5 * (left + right)
    cy = 0.5 * (height - 1) - focal * 0.5 * (top + bottom)
    return r_left, r_right, np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def _side_rays(camera: CameraModel, rotation: F64) -> tuple[float, float, float, float]:
    """x/z at the middle of the left and right side, y/z at the middle of the top and bottom side, after rotation."""
    w, h = camera.width - 1.0, camera.height - 1.0
    pixels = np.array([[[0.0, h / 2]], [[w, h / 2]], [[w / 2, 0.0]], [[w / 2, h]]])
    d = np.array(camera.distortion, np.float64)
    if camera.lens is Lens.EQUIDISTANT:
        rays = cv2.fisheye.undistortPoints(pixels, camera.matrix(), d, R=rotation)
    else:
        rays = cv2.undistortPoints(pixels, camera.matrix(), d, R=rotation)
    x, y = rays.reshape(4, 2).T
    # Beyond 180 degrees there is no such point; well below it the rectified image is mostly stretched corners.
    left, top = (v if -_MAX_SLOPE < v < 0 else -_MAX_SLOPE for v in (float(x[0]), float(y[2])))
    right, bottom = (v if 0 < v < _MAX_SLOPE else _MAX_SLOPE for v in (float(x[1]), float(y[3])))
    return left, right, top, bottom
