"""What a calibration is worth: each finding with a level and, where it is not good, what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_lab.calibration.solve import Calibrated
from kiteline_lab.calibration.views import ENOUGH_VIEWS, Coverage

GOOD_RMS_PX = 0.5  # a sharp board gives 0.1 to 0.3
USABLE_RMS_PX = 1.5
_FOCAL_SIGMA = 0.002  # relative: lengths are wrong by as much
_COVERED = 0.7  # of the cells
_TILT = 0.26  # sine of 15°
_NEEDED_TILTED = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """level: "good", "poor" or "bad". mend: what to do, "" if it is good."""

    level: str
    text: str
    mend: str = ""

    def line(self) -> str:
        """The finding as a line of text."""
        return f"{self.level:4}  {self.text}" + (f": {self.mend}" if self.mend else "")


def judge(result: Calibrated, coverage: Sequence[Coverage], views: int) -> list[Finding]:
    """All findings, of the whole and of each camera."""
    out = []
    names = ("left camera: ", "right camera: ") if len(result.cameras) == 2 else ("",)
    used = views - result.left_out
    few = f"{used} views" + (f", {result.left_out} more did not fit and were left out" if result.left_out else "")
    if used < ENOUGH_VIEWS:
        out.append(Finding("poor", few, f"show the board {ENOUGH_VIEWS} times or more, each time elsewhere"))
    elif result.left_out > used // 3:
        out.append(
            Finding(
                "poor", few, "hold the board still and flat; with a pair, check that both images are of one instant"
            )
        )
    else:
        out.append(Finding("good", few))
    for k, name in enumerate(names):
        rms = result.residuals[k].rms_px
        if rms <= GOOD_RMS_PX:
            out.append(Finding("good", f"{name}corners are {rms:.2f} px rms from where they should be"))
        else:
            out.append(
                Finding(
                    "poor" if rms <= USABLE_RMS_PX else "bad",
                    f"{name}corners are {rms:.2f} px rms from where they should be",
                    "check that the board is flat, its squares as wide as told, the camera in focus and held still; "
                    "try --lens equidistant for a wide lens, or --coefficients 5",
                )
            )
        share, bare = coverage[k].share, coverage[k].bare_sides()
        if bare:
            out.append(Finding("poor", f"{name}too few views at the {' and the '.join(bare)}",
                               "hold the board there, partly outside if it is a ChArUco board"))  # fmt: skip
        elif share < _COVERED:
            out.append(
                Finding("poor", f"{name}{100 * share:.0f} % of the image covered", "hold the board in its corners")
            )
        else:
            out.append(Finding("good", f"{name}{100 * share:.0f} % of the image covered"))
        sigma = result.focal_sigma(k)
        text = f"{name}focal length {result.cameras[k].fx:.1f} px, known to {100 * sigma:.2f} %"
        mend = "tilt the board by 20 to 45°, and show it from near and far"
        out.append(Finding("good", text) if sigma <= _FOCAL_SIGMA else Finding("poor", text, mend))
    normals = result.poses[:, :3, 2]
    for axis, how in ((0, "turned about its upright axis"), (1, "tipped forward and back")):
        tilted = int((np.abs(normals[:, axis]) > _TILT).sum())
        if tilted < _NEEDED_TILTED:
            out.append(Finding("poor", f"{tilted} views of the board {how}", "show a few by 20 to 45°"))
    if result.T_c_r is not None:
        baseline_m, sigma = float(np.linalg.norm(result.T_c_r[:3, 3])), result.baseline_sigma()
        turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(result.T_c_r[:3, :3]) - 1.0), -1.0, 1.0)))
        text = f"baseline {1000 * baseline_m:.2f} mm, known to {100 * sigma:.2f} %; cameras turned by {turn:.2f}°"
        mend = "show the board closer, where both cameras see it"
        out.append(Finding("good", text) if sigma <= _FOCAL_SIGMA else Finding("poor", text, mend))
        if result.T_c_r[0, 3] <= 0:
            out.append(Finding("bad", "the right camera lies left of the left one", "swap the two images of SOURCE"))
    return out


def overall(findings: Sequence[Finding]) -> str:
    """The worst level."""
    return next((level for level in ("bad", "poor") if any(f.level == level for f in findings)), "good")
