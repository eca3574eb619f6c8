"""The residual picture: where corners were seen, and by how much the calibration misses them."""

import cv2
import numpy as np

from kiteline_core.arrays import U8
from kiteline_lab.calibration.solve import Calibrated, Residuals
from kiteline_lab.calibration.verdict import GOOD_RMS_PX
from kiteline_lab.calibration.views import GRID, Coverage

_LONG = 20.0  # px of a drawn line for a residual of GOOD_RMS_PX, at a width of 640
_FEW = 10  # corners of a cell that is drawn full
_GREEN, _RED, _GREY = (80, 200, 80), (60, 60, 230), (150, 150, 150)
_TEXT_ROWS = 28


def residual_picture(result: Calibrated, coverage: list[Coverage]) -> U8:
    """An image (h, w, 3), BGR: a panel for each camera, side by side."""
    panels = [_panel(r, c, k, len(coverage)) for k, (r, c) in enumerate(zip(result.residuals, coverage))]
    return np.asarray(np.concatenate(panels, axis=1), np.uint8)


def _panel(residuals: Residuals, coverage: Coverage, camera: int, cameras: int) -> U8:
    width, height = coverage.size
    scale = max(1.0, 640.0 / width)
    w, h = round(width * scale), round(height * scale)
    image = np.full((h + _TEXT_ROWS, w, 3), 24, np.uint8)
    columns, rows = GRID
    for y in range(rows):
        for x in range(columns):
            full = min(1.0, coverage.counts[y, x] / _FEW)
            colour = (int(30 + 30 * full), int(30 + 40 * full), int(70 - 40 * full))
            corner, other = (x * w // columns, y * h // rows), ((x + 1) * w // columns - 2, (y + 1) * h // rows - 2)
            cv2.rectangle(image, corner, other, colour, -1)
    longer = _LONG * w / 640.0 / GOOD_RMS_PX
    for (x, y), error in zip(residuals.px, residuals.error_px):
        start = (round(float(x * scale)), round(float(y * scale)))
        size = float(np.hypot(*error))
        end = tuple(int(v) for v in np.clip(np.array(start) + error * longer, -w, 2 * w).astype(np.int64))
        cv2.line(image, start, (end[0], end[1]), _GREEN if size <= 2.0 * GOOD_RMS_PX else _RED, 1, cv2.LINE_AA)
        cv2.circle(image, start, 1, _GREY, -1)
    name = ("left: ", "right: ")[camera] if cameras == 2 else ""
    text = f"{name}{residuals.rms_px:.2f} px rms; lines {longer / scale:.0f} x; dark red: few corners"
    cv2.rectangle(image, (0, h), (w, h + _TEXT_ROWS), (0, 0, 0), -1)
    cv2.putText(image, text, (8, h + 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA)
    return image
