"""Image pyramids, corner detection spread over the image, and binary descriptors."""

import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from kiteline_agent.imaging import feature_kernels as kernels
from kiteline_agent.imaging.corner_kernels import fast_corners
from kiteline_core.arrays import F64, I16, U8

Pyramid = tuple[U8, ...]

# 256 tests from a Gaussian of 1/5 of the 31 px patch (M. Calonder et al., "BRIEF", 2010, layout G II). They must never
# change: descriptors of all versions are compared.
PATTERN_SEED = 20_260_101
PATTERN_REACH_PX = 10.0  # per axis, so that a rotated test stays within 15 px
_FAINT_THRESHOLD = 6  # grey levels, for faint corners
_FAINT_SCORE = 2.0  # (grey levels / px)^2; least score of faint corners, and
_FAINT_NOISE = 1.5  # their least score in squared noise: corners of pure noise reach 0.9
_MARGIN_PX = 20  # px at octave 0: border without image after rectification


def _pattern() -> F64:
    # Park-Miller's generator, since numpy does not guarantee the same stream for ever.
    state, draws = PATTERN_SEED, np.empty(256 * 4 * 12)
    for i in range(draws.size):
        state = state * 48271 % 2147483647
        draws[i] = state / 2147483647
    normal = draws.reshape(256, 4, 12).sum(axis=2) - 6.0  # Irwin-Hall: a Gaussian to 1 %
    return np.asarray(np.clip(np.round(normal * 6.2), -PATTERN_REACH_PX, PATTERN_REACH_PX))


PATTERN = _pattern()


@cache
def _steered_tests() -> I16:
    """The tests at each of 256 angles, see `feature_kernels.steer`."""
    tests = np.empty((256, 2, len(PATTERN)), np.int16)
    kernels.steer(PATTERN, np.arange(256) * (np.pi / 128.0), tests)
    return tests


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Options of the corner detector."""

    levels: int = 3  # pyramid levels searched; each halves the size
    first: int = 0  # finest of them
    cell_px: int = 32  # at most one new corner per cell: 350 at 752x480; see shrink_cells
    fast_threshold: int = 12  # grey levels; low, since only the best corner of a cell is kept
    min_score: float = 12.0  # (grey levels / px)^2; weaker corners are sensor noise
    faint_below: int = 100  # corners, existing ones included: with fewer, empty cells are searched for faint corners
    max_corners: int = 200  # new landmarks of a keyframe: what fits in 12 kB
    covered: tuple[float, ...] = ()  # shares of the image: left, top, right, bottom of each part that shows the vehicle

    def __post_init__(self) -> None:
        if len(self.covered) % 4 or not all(0.0 <= share <= 1.0 for share in self.covered):
            raise ValueError("covered: expected four numbers from 0 to 1 a part: left, top, right, bottom")
        if any(left >= right or top >= bottom for left, top, right, bottom in self.covered_parts):
            raise ValueError("covered: left and top of a part are less than right and bottom")

    @property
    def covered_parts(self) -> F64:
        """Left, top, right, bottom (n,4) of the covered parts, in shares of the image."""
        return np.reshape(self.covered, (-1, 4)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Corners:
    """uv: (n,2) float64 level-0 px. octave: (n,) uint8. score: (n,) float64. Strongest first."""

    uv: F64
    octave: U8
    score: F64


def for_kernels(image: U8) -> U8:
    """The image as kernels are compiled for: contiguous, writable bytes. A copy only where it is not."""
    flags = image.flags
    if image.dtype == np.uint8 and flags.c_contiguous and flags.writeable:
        return image
    return np.require(image, np.uint8, ("C", "W"))


def build_pyramid(image: U8, levels: int) -> Pyramid:
    """Build a Gaussian pyramid; pixel x of level k is at x * 2^k of level 0."""
    out = [for_kernels(image)]
    for _ in range(levels - 1):
        out.append(np.asarray(cv2.pyrDown(out[-1]), np.uint8))
    return tuple(out)


def detect(pyramid: Pyramid, taken: F64, config: DetectorConfig) -> Corners:
    """Detect the best corners of the cells without any of `taken` (n,2) level-0 px, and outside of covered parts."""
    h, w = pyramid[0].shape
    rows, columns = -(-h // config.cell_px), -(-w // config.cell_px)
    covered = np.zeros((rows, columns), np.bool_)
    for left, top, right, bottom in config.covered_parts * [w, h, w, h] / config.cell_px:
        covered[int(top) : math.ceil(bottom), int(left) : math.ceil(right)] = True
    occupied = covered.copy()
    kernels.occupy(np.ascontiguousarray(taken), float(config.cell_px), occupied)
    best_score = np.zeros((rows, columns))
    best_xy = np.zeros((rows, columns, 2), np.int32)
    best_level = np.zeros((rows, columns), np.uint8)

    def search(threshold: int, min_score: float) -> None:
        for level in range(config.first, min(config.levels, len(pyramid))):
            image = pyramid[level]
            margin = max(kernels.BORDER, _MARGIN_PX >> level)
            corners = np.empty((max(image.size // 4, 1), 2), np.int32)
            n = fast_corners(image, threshold, margin, 1 << level, float(config.cell_px), occupied, corners)
            xy, score = corners[:n], np.empty(n)
            kernels.corner_scores(image, xy, score)
            kernels.best_per_cell(
                xy, score, level, float(config.cell_px), min_score, occupied, best_score, best_xy, best_level
            )

    search(config.fast_threshold, config.min_score)
    if np.count_nonzero((occupied | (best_score > 0.0)) & ~covered) < config.faint_below:
        occupied |= best_score > 0.0
        noise = noise_of(pyramid[min(config.first, len(pyramid) - 1)])
        search(_FAINT_THRESHOLD, max(_FAINT_SCORE, _FAINT_NOISE * noise * noise))
    r, c = np.nonzero(best_score > 0.0)
    order = np.argsort(-best_score[r, c], kind="stable")[: config.max_corners]
    r, c = r[order], c[order]
    return Corners(best_xy[r, c].astype(np.float64), best_level[r, c], best_score[r, c])


def noise_of(image: U8) -> float:
    """Standard deviation of the image noise in grey levels, from second differences of every eighth row.

    Source: J. Immerkaer, "Fast noise variance estimation", 1996.
    """
    at = np.arange(1, image.shape[0] - 1, 8)
    second = image[at - 1].astype(np.int32) - 2 * image[at].astype(np.int32) + image[at + 1]
    return float(np.median(np.abs(second[:, :-2] - 2 * second[:, 1:-1] + second[:, 2:]))) * 1.4826 / 6.0


def describe(pyramid: Pyramid, uv: F64, octave: U8) -> tuple[U8, U8]:
    """Angles (n,) in 1/256 turns and descriptors (n,32) of corners uv (n,2) level-0 px, at least BORDER inside."""
    n = len(uv)
    angle_code, descriptor = np.zeros(n, np.uint8), np.zeros((n, 32), np.uint8)
    for level in range(len(pyramid)):
        rows = np.flatnonzero(octave == level)
        if len(rows) == 0:
            continue
        xy = np.ascontiguousarray(np.round(uv[rows] / (1 << level)).astype(np.int32))
        angle = np.empty(len(rows))
        kernels.orientations(pyramid[level], xy, angle)
        code = np.round(angle * (128.0 / np.pi)).astype(np.int64) & 255
        bits = np.empty((len(rows), 32), np.uint8)
        kernels.describe(pyramid[level], xy, code, _steered_tests(), bits)
        angle_code[rows], descriptor[rows] = code.astype(np.uint8), bits
    return angle_code, descriptor
