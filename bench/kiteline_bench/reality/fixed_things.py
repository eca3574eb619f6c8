"""Things that stand still in images while the world moves, put into a recording: text, parts of a vehicle, dirt."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from kiteline_bench.harness.recording import Item, Recording
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry.cameras import CameraRig, Rectifier

_BASELINE_SHIFT = 0.12  # of a leg between the two images of a pair, in image widths: half a metre away or nearer
_FOCUS = 0.004  # blur of parts of the vehicle, in image widths
_LEGS = (
    ((0.08, 1.0), (0.19, 0.72), (0.215, 0.72), (0.14, 1.0)),
    ((0.92, 1.0), (0.83, 0.70), (0.805, 0.70), (0.86, 1.0)),
)  # corners in shares of the image
_MARKS = (((-30, 0), (-10, 0)), ((10, 0), (30, 0)), ((0, 10), (0, 25)), ((-90, 0), (-70, 0)), ((70, 0), (90, 0)))
_VEHICLE_GREY = 22.0
_SEEN, _CELL_PX = 0.1, 32  # opacity of what is to be found; px of a cell
_DROPS, _DROP_SIZES = 20, (0.006, 0.03)  # radii in image widths

Overlay = Callable[[U8, int, bool], U8]  # (image, number of the frame, whether it is the right one) -> image


def with_overlay(recording: Recording, overlay: Overlay) -> Recording:
    """The recording with something drawn into all its images."""

    def drawn(k: int, item: Item) -> Item:
        left, right = item.frame.left, item.frame.right
        changed = overlay(left, k, False), None if right is None else overlay(right, k, True)
        return replace(item, frame=replace(item.frame, left=changed[0], right=changed[1], encoded=()))

    return replace(recording, items=tuple(drawn(k, item) for k, item in enumerate(recording.items)))


def text(image: U8, k: int, right: bool) -> U8:
    """The text of a video link, alike in both images: modes, a clock, a battery, a crosshair, a horizon's marks."""
    del right
    h, w = image.shape
    out, scale = image.copy(), w / 752.0
    lines = (
        (f"{k // 1200:02d}:{k // 20 % 60:02d}.{k % 20 * 5:02d}", 0.02, 0.09), ("POSHOLD", 0.40, 0.09),
        (f"{15.8 - 0.002 * k:.1f}V", 0.84, 0.09), (f"ALT {1.2 + 0.01 * (k // 10):.1f}m", 0.02, 0.93),
        ("LQ 9:99", 0.42, 0.93), (f"{3 + k // 40:d}mAh", 0.80, 0.93), ("KITE 7", 0.03, 0.5), ("SAT 14", 0.85, 0.5),
    )  # fmt: skip
    for words, x, y in lines:
        for grey, thick in ((0, 5), (255, 2)):
            at = round(x * w), round(y * h)
            cv2.putText(out, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.85 * scale, grey, max(round(thick * scale), 1))
    centre = np.array([0.5 * w, 0.5 * h])
    for a, b in (
        ((-30, 0), (-10, 0)),
        ((10, 0), (30, 0)),
        ((0, 10), (0, 25)),
        ((-90, 0), (-70, 0)),
        ((70, 0), (90, 0)),
    ):
        for grey, thick in ((0, 4), (255, 2)):
            p, q = (tuple(np.round(centre + scale * np.array(end)).astype(int).tolist()) for end in (a, b))
            cv2.line(out, p, q, grey, max(round(thick * scale), 1))
    return out


def vehicle(image: U8, k: int, right: bool) -> U8:
    """Two legs at the lower corners and two propeller guards at the upper ones: dark, smooth and out of focus."""
    del k
    alpha = _vehicle_mask(image.shape, right)
    shade = _VEHICLE_GREY + 25.0 * np.linspace(1.0, 0.0, image.shape[0])[:, None]
    return np.asarray(np.clip(image * (1.0 - alpha) + alpha * shade + 0.5, 0, 255), np.uint8)


def drops(image: U8, k: int, right: bool) -> U8:
    """Twenty drops and specks on each lens: half transparent, blurred, some darker and some brighter."""
    del k
    alpha, shade = _drop_masks(image.shape, right)
    blurred = cv2.GaussianBlur(image, (0, 0), 0.01 * image.shape[1]).astype(np.float64)
    return np.asarray(np.clip(image * (1.0 - alpha) + alpha * (0.5 * blurred + shade) + 0.5, 0, 255), np.uint8)


OVERLAYS: dict[str, Overlay] = {"text": text, "vehicle": vehicle, "drops": drops}


def covered_share(rig: CameraRig, kind: str, cells: tuple[int, ...]) -> F64:
    """Share (rows, columns) of each cell of 32 px of the rectified left image that such a thing covers."""
    shape = rig.left.height, rig.left.width
    if kind == "text":
        plain = np.full(shape, 128, np.uint8)
        shown = text(plain, 0, False) != plain
    else:
        shown = (_vehicle_mask(shape, False) if kind == "vehicle" else _drop_masks(shape, False)[0]) > _SEEN
    covered = Rectifier(rig).left(np.where(shown, 255, 0).astype(np.uint8)) / 255.0
    rows, columns = (np.arange(0, size, _CELL_PX) for size in shape)
    share = np.add.reduceat(np.add.reduceat(covered, rows, 0), columns, 1) / _CELL_PX**2
    return np.asarray(share[: cells[0], : cells[1]])


_masks: dict[tuple[str, tuple[int, ...], bool], tuple[F64, F64]] = {}


def _vehicle_mask(shape: tuple[int, ...], right: bool) -> F64:
    key = "vehicle", shape, right
    if key not in _masks:
        h, w = shape
        mask = np.zeros(shape, np.uint8)
        shift = -_BASELINE_SHIFT if right else 0.0
        for leg in _LEGS:
            corners = np.array([((x + shift) * w, y * h) for x, y in leg])
            cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 255)
        for x in (0.02, 1.0):
            at = round((x + shift) * w), round(-0.12 * h)
            cv2.ellipse(mask, at, (round(0.24 * w), round(0.30 * h)), 0, 0, 360, 255, max(round(0.03 * w), 2))
        blurred = cv2.GaussianBlur(mask, (0, 0), _FOCUS * w).astype(np.float64) / 255.0
        _masks[key] = blurred, blurred
    return _masks[key][0]


def _drop_masks(shape: tuple[int, ...], right: bool) -> tuple[F64, F64]:
    key = "drops", shape, right
    if key not in _masks:
        h, w = shape
        rng = np.random.default_rng(12 if right else 11)
        alpha, shade = np.zeros(shape), np.zeros(shape)
        for _ in range(_DROPS):
            one = np.zeros(shape, np.uint8)
            radius = rng.uniform(*_DROP_SIZES) * w
            axes = round(radius), max(round(radius * rng.uniform(0.6, 1.0)), 2)
            at = round(rng.uniform(0.03, 0.97) * w), round(rng.uniform(0.03, 0.97) * h)
            cv2.ellipse(one, at, axes, rng.uniform(0, 180), 0, 360, 255, -1)
            blob = cv2.GaussianBlur(one, (0, 0), max(0.15 * radius, 1.0)).astype(np.float64) / 255.0
            strength, grey = rng.uniform(0.4, 0.7), rng.uniform(5.0, 110.0)
            shade = np.where(strength * blob > alpha, grey, shade)
            alpha = np.maximum(alpha, strength * blob)
        _masks[key] = alpha, shade
    return _masks[key]
