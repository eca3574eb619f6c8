"""Calibrates with the lens that was asked for, or with the one that fits better."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import Lens
from kiteline_lab.calibration.solve import Calibrated, CalibrationFailed, calibrate
from kiteline_lab.calibration.views import View


def best_lens(
    points_m: F64, views: Sequence[View], sizes: Sequence[tuple[int, int]], lens: str, coefficients: int
) -> Calibrated:
    """Calibrate with a lens of that name; "auto": the one that fits better. Raises CalibrationFailed."""
    if lens != "auto":
        return calibrate(points_m, views, sizes, Lens(lens), coefficients)
    found: list[tuple[float, Calibrated]] = []
    errors: list[CalibrationFailed] = []
    for which, penalty in ((Lens.RADTAN, 1.0), (Lens.EQUIDISTANT, 1.05)):  # the lens of most cameras wins a draw
        try:
            result = calibrate(points_m, views, sizes, which, coefficients)
        except CalibrationFailed as error:
            errors.append(error)
            continue
        lost = 1.0 + result.left_out / len(views)
        found.append((penalty * lost * float(np.mean([r.rms_px for r in result.residuals])), result))
    if not found:
        raise errors[0]
    return replace(min(found, key=lambda f: f[0])[1])
