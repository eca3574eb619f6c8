"""Half-size images of a rectified pair that hold more of the raw images' sides and bottom than the full-size ones.

Rectification keeps the middle of each side and cuts off what lens and extrinsics bend beyond: up to 110 px of a 752 px
wide image. Ground right before the vehicle, and what stands beside it, is seen there.
"""

from dataclasses import replace

import cv2
import numpy as np

from kiteline_core.arrays import F32, F64, I16, U8, U16, Bool
from kiteline_core.geometry.cameras import RawSide, RectifiedCamera, Rectifier, undistortion_maps
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import BLOCK_PX, DisparityCamera

Fixed = tuple[I16, U16]  # OpenCV's fastest maps

_ROWS_SEEN = 1  # of a disparity image above and below a pixel: ground in the rest of a block is alike in both images
_STEP_PX = 8  # of the full image: whole pixels of any disparity image


class WideView:
    """The view of a rig's scans: wider than the rectified images where these are cut from raw ones, else the same.

    camera: of the view, as if it had full-size images.
    """

    def __init__(self, rectifier: Rectifier, config: GroundConfig) -> None:
        self._rectifier = rectifier
        self._reach = BLOCK_PX // 2 + 1  # px of a matched block beyond its middle, and of what was interpolated
        self.camera, self._corner = rectifier.camera, np.zeros(2)
        self._maps: list[Fixed] = []  # of both cameras' half-size images; empty: those of the rectified images
        self._left_seen: Bool | None = None  # (h,w) of a disparity image: there is a raw pixel
        self._right_seen = np.zeros((0, 1), np.bool_)  # (h,1+w) the same, and a first column beyond the view
        self._rows = rectifier.right_rows  # those of the right image in its map
        self._raw_size = rectifier.camera.width, rectifier.camera.height
        if not rectifier.camera.stereo or not rectifier.remaps or not (config.wider or config.lower):
            return
        side, lower = (
            _STEP_PX * round(share * size / _STEP_PX)
            for share, size in zip((config.wider, config.lower), self._raw_size, strict=True)
        )
        self._corner = np.array([-side, lower], np.float64)
        self.camera = _moved(rectifier.camera, side, lower)
        left = self._raw_pixels(rectifier.raw_sides[0])
        self._maps, self._left_seen = [_fixed(*left)], self._seen(*left)
        h, w = self._left_seen.shape
        self._columns = np.arange(1.0, w + 1.0, dtype=np.float32)
        self._rows_at = (w + 1) * np.arange(h, dtype=np.int32)[:, None]  # where rows of the right one begin
        self._read_right()

    def at(self, uv: F64) -> F64:
        """Pixels (n,2) of this view of pixels of the rectified image; some of its upper ones lie outside."""
        return uv - self._corner

    def pair(self, left: U8, right: U8) -> tuple[U8, U8]:
        """Half-size images (h,w) of the view, from level 1 of the raw images' pyramids."""
        if not self._maps:
            return self._rectifier.halved(0, left), self._rectifier.halved(1, right)
        if self._rows is not self._rectifier.right_rows:
            self._read_right()
        both = [
            np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
            for image, maps in zip((left, right), self._maps, strict=True)
        ]
        return both[0], both[1]

    def mask(self, disparity: F32) -> F32:
        """A disparity image of the last pair with 0 for what lies beyond the border of either raw image, or at it."""
        if self._left_seen is not None:
            at = np.rint(self._columns - disparity).astype(np.int32)
            right = self._right_seen.take(np.maximum(at, 0) + self._rows_at)
            disparity *= self._left_seen & right
        return disparity

    def _raw_pixels(self, raw: RawSide) -> tuple[F32, F32]:
        """Raw pixels of level 1, x and y (h,w), of the half-size images of the view."""
        camera = self.camera
        size = (camera.width + 1) // 2, (camera.height + 1) // 2
        half = 0.5 * np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 2.0]])
        x, y = undistortion_maps(raw.lens, raw.rotation, half, size, cv2.CV_32FC1)
        return 0.5 * x.astype(np.float32), 0.5 * y.astype(np.float32)

    def _read_right(self) -> None:
        """Read the right image at its rows, as they are known now."""
        self._rows = rows = self._rectifier.right_rows
        x, y = self._raw_pixels(self._rectifier.raw_sides[1])
        if rows is not None:
            h, w = x.shape
            pixels = np.stack(np.meshgrid(2.0 * np.arange(w), 2.0 * np.arange(h)), -1).reshape(-1, 2) + self._corner
            lower = (0.5 * rows(pixels).reshape(h, w)).astype(np.float32)
            x, y = (raw + lower * np.gradient(raw, axis=0) for raw in (x, y))
        self._maps[1:] = [_fixed(x, y)]
        self._right_seen = np.pad(self._seen(x, y), ((0, 0), (1, 0)))

    def _seen(self, x: F32, y: F32) -> Bool:
        """Pixels (h,w) of a disparity image all around which a raw image has some.

        Beyond its field of view the model of a lens may fold back into the image.
        """
        width, height = ((size + 1) // 2 for size in self._raw_size)
        inside = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)
        (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
        inside &= x_u * y_v > x_v * y_u
        part = np.asarray(cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)[1])
        h, w = part.shape
        middle = np.asarray(inside & (part == part[h // 2, w // 2]), np.bool_)
        view = DisparityCamera.of(self.camera)
        rows, columns = 2 * view.height, view.columns * view.width
        small = np.asarray(middle[:rows, :columns].reshape(view.height, 2, view.width, view.columns).all((1, 3)))
        around = np.ones((2 * _ROWS_SEEN + 1, 2 * self._reach + 1), np.uint8)
        eroded = cv2.erode(np.asarray(small, np.uint8), around, borderType=cv2.BORDER_CONSTANT, borderValue=1)
        return np.asarray(eroded > 0)


def _fixed(x: F32, y: F32) -> Fixed:
    xy, rest = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return np.asarray(xy, np.int16), np.asarray(rest, np.uint16)


def _moved(camera: RectifiedCamera, side: int, lower: int) -> RectifiedCamera:
    """A camera whose image is wider by `side` px to both sides, and lies `lower` px lower."""
    return replace(camera, width=camera.width + 2 * side, cx=camera.cx + side, cy=camera.cy - lower)
