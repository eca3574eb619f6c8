"""What a calibration is worth: each finding with a level and, where it is not good, what to do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_core.wording import counted
from kiteline_lab.calibration.solve import Calibrated
from kiteline_lab.calibration.views import ENOUGH_VIEWS, Coverage

GOOD_RMS_PX = 0.5  # a sharp board gives 0.1 to 0.3
USABLE_RMS_PX = 1.5
_LENGTH_SIGMA = 0.002  # relative, of focal length and baseline: lengths are wrong by as much
_COVERED = 0.7  # of the cells
_TILT = 0.26  # sine of 15°
_NEEDED_TILTED = 3


@dataclass(frozen=True, slots=True)
class CalibrationFinding:
    """level: "good", "poor" or "bad". mend: what to do, "" if it is good."""

    level: str
    text: str
    mend: str = ""

    def line(self) -> str:
        """The finding as a line of text."""
        return f"{self.level:4}  {self.text}" + (f": {self.mend}" if self.mend else "")


def judge(result: Calibrated, coverage: Sequence[Coverage], views: int) -> list[CalibrationFinding]:
    """All findings, of the whole and of each camera."""
    out = [_of_views(views - result.left_out, result.left_out)]
    names = ("left camera: ", "right camera: ") if len(result.cameras) == 2 else ("",)
    for k, name in enumerate(names):
        out += [_of_corners(name, result.residuals[k].rms_px), _of_coverage(name, coverage[k])]
        sigma = result.focal_sigma(k)
        text = f"{name}focal length {result.cameras[k].fx:.1f} px, known to {100 * sigma:.2f} %"
        out.append(_of_length(text, sigma, "tilt the board by 20 to 45°, and show it from near and far"))
    normals = result.poses[:, :3, 2]
    for axis, how in ((0, "turned about its upright axis"), (1, "tipped forward and back")):
        tilted = int((np.abs(normals[:, axis]) > _TILT).sum())
        if tilted < _NEEDED_TILTED:
            text = f"{counted(tilted, 'view')} of the board {how}"
            out.append(CalibrationFinding("poor", text, "show a few by 20 to 45°"))
    if result.T_c_r is not None:
        baseline_m, sigma = float(np.linalg.norm(result.T_c_r[:3, 3])), result.baseline_sigma()
        turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(result.T_c_r[:3, :3]) - 1.0), -1.0, 1.0)))
        text = f"baseline {1000 * baseline_m:.2f} mm, known to {100 * sigma:.2f} %; cameras turned by {turn:.2f}°"
        out.append(_of_length(text, sigma, "show the board closer, where both cameras see it"))
        if result.T_c_r[0, 3] <= 0:
            out.append(
                CalibrationFinding("bad", "the right camera lies left of the left one", "swap the two images of SOURCE")
            )
    return out


def _of_views(used: int, left_out: int) -> CalibrationFinding:
    text = f"{used} views" + (f", {left_out} more did not fit and were left out" if left_out else "")
    if used < ENOUGH_VIEWS:
        return CalibrationFinding("poor", text, f"show the board {ENOUGH_VIEWS} times or more, each time elsewhere")
    if left_out > used // 3:
        mend = "hold the board still and flat; with a pair, check that both images are of one instant"
        return CalibrationFinding("poor", text, mend)
    return CalibrationFinding("good", text)


def _of_corners(name: str, rms_px: float) -> CalibrationFinding:
    text = f"{name}corners are {rms_px:.2f} px rms from where they should be"
    if rms_px <= GOOD_RMS_PX:
        return CalibrationFinding("good", text)
    mend = (
        "check that the board is flat, its squares as wide as told, the camera in focus and held still; "
        "try --lens equidistant for a wide lens, or --coefficients 5"
    )
    return CalibrationFinding("poor" if rms_px <= USABLE_RMS_PX else "bad", text, mend)


def _of_coverage(name: str, coverage: Coverage) -> CalibrationFinding:
    text, bare = f"{name}{100 * coverage.share:.0f} % of the image covered", coverage.bare_sides()
    if bare:
        mend = "hold the board there, partly outside if it is a ChArUco board"
        return CalibrationFinding("poor", f"{name}too few views at the {' and the '.join(bare)}", mend)
    if coverage.share < _COVERED:
        return CalibrationFinding("poor", text, "hold the board in its corners")
    return CalibrationFinding("good", text)


def _of_length(text: str, sigma: float, mend: str) -> CalibrationFinding:
    """Of a focal length or a baseline. sigma: relative."""
    return CalibrationFinding("good", text) if sigma <= _LENGTH_SIGMA else CalibrationFinding("poor", text, mend)


def overall(findings: Sequence[CalibrationFinding]) -> str:
    """The worst level."""
    return next((level for level in ("bad", "poor") if any(f.level == level for f in findings)), "good")
