"""Image pyramids, corners spread over the image, and binary descriptors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_agent.imaging import feature_kernels as kernels
from kiteline_agent.imaging.corner_kernels import fast_corners

U8 = NDArray[np.uint8]
Pyramid = tuple[U8, ...]

# 256 tests drawn once from a Gaussian of 1/5 of the 31 px patch (M. Calonder et al., "BRIEF", 2010, layout G II), then
# frozen: both halves of every future version must draw the same ones.
PATTERN_SEED = 20_260_101
PATTERN_REACH_PX = 10.0  # per axis, so that a turned test stays within 15 px


def _pattern() -> NDArray[np.float64]:
    # Park-Miller's generator by hand: numpy does not promise the same stream for ever.
    state, draws = PATTERN_SEED, np.empty(256 * 4 * 12)
    for i in range(draws.size):
        state = state * 48271 % 2147483647
        draws[i] = state / 2147483647
    normal = draws.reshape(256, 4, 12).sum(axis=2) - 6.0  # Irwin-Hall: a Gaussian to 1 %
    return np.asarray(np.clip(np.round(normal * 6.2), -PATTERN_REACH_PX, PATTERN_REACH_PX))


PATTERN = _pattern()


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Where new corners come from."""

    levels: int = 3  # pyramid levels searched; each halves the size
    first: int = 0  # finest of them
    cell_px: int = 32  # one new corner a cell keeps features spread; 32 px gives about 350 cells at 752x480
    fast_threshold: int = 12  # grey levels; low, since the cell keeps only its best corner
    min_score: float = 12.0  # (grey levels / px)^2; below it, sensor noise is as strong as the corner
    faint_below: int = 100  # corners, taken ones among them: with fewer, the cells left are searched for faint ones
    faint_threshold: int = 6  # grey levels of those
    faint_score: float = 2.0  # of those at least, and
    faint_noise: float = 1.5  # times the square of the noise: corners of pure noise reach 0.9
    margin_px: int = 20  # level-0 px: the lens's blind rim after rectification
    max_corners: int = 200  # a keyframe's births; what a link of 12 kB a keyframe carries


@dataclass(frozen=True, slots=True)
class Corners:
    """uv: (n,2) float64 level-0 px. octave: (n,) uint8. score: (n,) float64. Strongest first."""

    uv: NDArray[np.float64]
    octave: U8
    score: NDArray[np.float64]


def build_pyramid(image: U8, levels: int) -> Pyramid:
    """Gaussian pyramid; pixel x of level k lies at x * 2^k of level 0."""
    out = [np.ascontiguousarray(image)]
    for _ in range(levels - 1):
        out.append(np.asarray(cv2.pyrDown(out[-1]), np.uint8))
    return tuple(out)


def detect(pyramid: Pyramid, taken: NDArray[np.float64], config: DetectorConfig) -> Corners:
    """Best corners of the cells in which none of `taken` (n,2) level-0 px lies."""
    h, w = pyramid[0].shape
    rows, columns = -(-h // config.cell_px), -(-w // config.cell_px)
    occupied = np.zeros((rows, columns), np.bool_)
    kernels.occupy(taken, float(config.cell_px), occupied)
    best_score = np.zeros((rows, columns))
    best_xy = np.zeros((rows, columns, 2), np.int32)
    best_level = np.zeros((rows, columns), np.uint8)

    def search(threshold: int, min_score: float) -> None:
        for level in range(config.first, min(config.levels, len(pyramid))):
            image = pyramid[level]
            margin = max(kernels.BORDER, config.margin_px >> level)
            corners = np.empty((max(image.size // 4, 1), 2), np.int32)
            n = fast_corners(image, threshold, margin, 1 << level, float(config.cell_px), occupied, corners)
            xy, score = corners[:n], np.empty(n)
            kernels.corner_scores(image, xy, score)
            kernels.best_per_cell(
                xy, score, level, float(config.cell_px), min_score, occupied, best_score, best_xy, best_level
            )

    search(config.fast_threshold, config.min_score)
    if np.count_nonzero(occupied | (best_score > 0.0)) < config.faint_below:
        occupied |= best_score > 0.0
        noise = noise_of(pyramid[min(config.first, len(pyramid) - 1)])
        search(config.faint_threshold, max(config.faint_score, config.faint_noise * noise * noise))
    r, c = np.nonzero(best_score > 0.0)
    order = np.argsort(-best_score[r, c], kind="stable")[: config.max_corners]
    r, c = r[order], c[order]
    return Corners(best_xy[r, c].astype(np.float64), best_level[r, c], best_score[r, c])


def noise_of(image: U8) -> float:
    """Deviation of an image's noise in grey levels, by what second differences along both axes leave of its content
    (J. Immerkaer, "Fast noise variance estimation", 1996), median of every eighth row.
    """
    at = np.arange(1, image.shape[0] - 1, 8)
    bent = image[at - 1].astype(np.int32) - 2 * image[at].astype(np.int32) + image[at + 1]
    return float(np.median(np.abs(bent[:, :-2] - 2 * bent[:, 1:-1] + bent[:, 2:]))) * 1.4826 / 6.0


def describe(pyramid: Pyramid, uv: NDArray[np.float64], octave: U8) -> tuple[U8, U8]:
    """Angles (n,) in 1/256 turns and descriptors (n,32) of corners at uv (n,2) level-0 px, at least BORDER inside."""
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
        kernels.describe(pyramid[level], xy, code * (np.pi / 128.0), PATTERN, bits)
        angle_code[rows], descriptor[rows] = code.astype(np.uint8), bits
    return angle_code, descriptor
