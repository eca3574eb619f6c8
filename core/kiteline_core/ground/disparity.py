"""Measures the disparity image of a rectified stereo pair, stripe by stripe, so that no frame pays for all of it."""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_core.arrays import F32, F64, I16, I64, U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground import level_kernels
from kiteline_core.ground.brightness import Brightness, falloff
from kiteline_core.ground.config import GroundConfig

_ENOUGH_BF = 60.0  # px m of a half-size image: 0.4 m of error at 10 m; with more, half of the columns do
_PAD_PX = 32  # px that the images are continued to the left: far surfaces are measured there as well
_OVERLAP_ROWS = 3  # beside a stripe: matching knows what lies above and below
_STEPS = 16  # of OpenCV's disparities in a pixel
_DOUBTED = 0.1  # of the pixels, at most, whose disparities are corrected by their rows: 0.3 to 1 % in rooms
_SPECKLE_PX = 40  # px of an island that differs from all around it by more than a pixel: an error
BLOCK_PX = 7  # px; side of a matched block: smaller ones are noisier, larger ones widen obstacles
_SMALL_STEP = 1  # cost of a step of one pixel of disparity, times the block's pixels: slanted ground has many
_LARGE_STEP = 5  # cost of a larger step: an edge
_UNIQUENESS = 10  # percent by which the best cost is below the next: rejects floors without texture


@dataclass(frozen=True, slots=True)
class DisparityCamera:
    """The camera of a disparity image: half the columns of the full image, or a quarter of them where that is enough.

    It has a quarter of the rows: ground and walls look the same on two rows of the half-size image, at half the cost.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    bf: float  # px m; disparity = bf / depth
    columns: int  # of the half-size image in one of these

    @staticmethod
    def of(camera: RectifiedCamera) -> "DisparityCamera":
        """That of a full-size rectified camera."""
        columns = 2 if camera.stereo and 0.5 * camera.bf > _ENOUGH_BF else 1
        scale, shift = 0.5 / columns, 0.25 * (columns - 1)
        return DisparityCamera(
            (camera.width + 1) // 2 // columns, (camera.height + 1) // 4, scale * camera.fx, 0.25 * camera.fy,
            scale * camera.cx - shift, 0.25 * camera.cy - 0.25, scale * camera.bf, columns,
        )  # fmt: skip

    def reduced(self, half: U8) -> U8:
        """A half-size image at the size of disparity images."""
        rows, columns = 2 * self.height, self.columns * self.width
        size = self.width, self.height
        return np.asarray(cv2.resize(half[:rows, :columns], size, interpolation=cv2.INTER_AREA), np.uint8)

    def disparity_of_depth(self, depth_m: F32) -> F32:
        """A disparity image, as of a pair, of full-size depth (h,w) in m, 0 unknown."""
        depth = depth_m[1::4, :: 2 * self.columns][: self.height, : self.width]
        out = np.zeros((self.height, self.width), np.float32)
        return np.divide(np.float32(self.bf), depth, out=out, where=depth > 0.0)

    def at(self, uv: F64) -> tuple[I64, I64]:
        """Rows and columns (n,) of pixels (n,2) of the full image."""
        scale, shift = 0.5 / self.columns, 0.25 * (self.columns - 1)
        column = np.clip(np.rint(scale * uv[:, 0] - shift), 0, self.width - 1).astype(np.int64)
        return np.clip(np.rint(0.25 * uv[:, 1] - 0.25), 0, self.height - 1).astype(np.int64), column


class DisparityStripes:
    """The disparity image of one pair at a time, by semi-global matching (H. Hirschmueller, 2008) in stripes.

    brightness: of the rig, as it is known by the pairs before.
    """

    def __init__(self, camera: DisparityCamera, config: GroundConfig) -> None:
        self._camera = camera
        area = BLOCK_PX**2
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=config.disparities, blockSize=BLOCK_PX,
            P1=_SMALL_STEP * area, P2=_LARGE_STEP * area, disp12MaxDiff=1, preFilterCap=31,
            uniquenessRatio=_UNIQUENESS, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        self.stripes = config.stripes
        self.brightness = Brightness()
        self._falloff = falloff(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        self._taken: tuple[U8, U8] | None = None
        self.pair: tuple[U8, U8] | None = None  # the images of the disparities, of their size, of one brightness
        self._padded: tuple[U8, U8] | None = None
        self._raw = np.empty((camera.height, camera.width + _PAD_PX), np.int16)
        self._most_px = config.disparities
        doubted = int(_DOUBTED * camera.width * camera.height)
        self._errors, self._search = np.empty((2, camera.width), np.float32), np.empty((4, camera.width), np.int16)
        self._doubted, self._better = np.empty(doubted, np.int32), np.empty(doubted, np.float32)

    def begin(self, left: U8, right: U8) -> None:
        """Take a pair, rectified and of half size (h,w)."""
        self.begin_reduced((self._camera.reduced(left), self._camera.reduced(right)))

    def begin_reduced(self, pair: tuple[U8, U8]) -> None:
        """Take a pair of the size of disparities (h,w)."""
        self._taken = pair
        self.pair = left, right = self.brightness.evened(pair, self._falloff)
        self._padded = _padded(left), _padded(right)

    def match(self, stripe: int) -> None:
        """Measure the rows of a stripe."""
        assert self._padded is not None
        h = len(self._raw)
        begin, end = h * stripe // self.stripes, h * (stripe + 1) // self.stripes
        low, high = max(begin - _OVERLAP_ROWS, 0), min(end + _OVERLAP_ROWS, h)
        found = self._matcher.compute(*(image[low:high] for image in self._padded))
        self._raw[begin:end] = np.asarray(found, np.int16)[begin - low : end - low]

    def finish(self) -> F32:
        """Disparities (h,w) in px, 0 where unknown, once all stripes were matched."""
        cv2.filterSpeckles(self._raw, -_STEPS, _SPECKLE_PX, _STEPS)
        self._padded = None
        disparity = unlocked(self._raw, _PAD_PX)
        assert self.pair is not None
        best, least, lowest, difference = self._search
        level_kernels.correct_thin_surfaces(
            *self.pair, self._most_px, disparity, self._errors, best, least, lowest, difference,
            self._doubted, self._better,
        )  # fmt: skip
        return disparity

    def learn_brightness(self, disparity: F32) -> None:
        """Learn how bright the cameras are from the last pair and its disparities (h,w), with 0 for what is masked."""
        assert self._taken is not None
        self.brightness = self.brightness.learned(self._taken, disparity, self._falloff)

    @property
    def stripe_px(self) -> int:
        """Pixels of a stripe, about."""
        return self._raw.size // self.stripes

    def measure(self, left: U8, right: U8) -> F32:
        """The disparity image of a pair, as `begin` takes it, at once."""
        self.begin(left, right)
        return self.measure_begun()

    def measure_begun(self) -> F32:
        """The disparity image of the pair that was begun, at once."""
        for stripe in range(self.stripes):
            self.match(stripe)
        return self.finish()


def _padded(image: U8) -> U8:
    return np.asarray(cv2.copyMakeBorder(image, 0, 0, _PAD_PX, 0, cv2.BORDER_REPLICATE), np.uint8)


def unlocked(raw: I16, first: int = 0) -> F32:
    """Disparities (h,w) in px of OpenCV's, in 1/16 px, from a column on; 0 where unknown.

    OpenCV's parabolas draw them to whole pixels. Its costs are nearly those of absolute differences, |t - s| at steps s
    of a surface t px off the whole pixel: the parabola through three of them has its summit at m = t / (2 - 2 t).
    Measured on rendered rooms the inverse, with the rounding of costs, is t = 2 m (1 - m): 0.13 px of error fall to
    0.02 px.
    """
    table = np.arange(-_STEPS // 2, _STEPS // 2, dtype=np.float64) / _STEPS
    table = np.where(np.abs(table) < 0.5, 2.0 * table * (1.0 - np.abs(table)), table).astype(np.float32)
    out = np.empty((raw.shape[0], raw.shape[1] - first), np.float32)
    level_kernels.unlock(raw, first, table, out)
    return out
