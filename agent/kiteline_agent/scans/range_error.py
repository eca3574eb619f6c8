"""How much ranges of scans deviate, and what they are once more is known of the rig's disparities."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.disparity_offset import TERMS, terms
from kiteline_core.ground.column_scan import ColumnScan, level_rotation

_LEAST_CHANGE_PX, _LEAST_CHANGE = 0.05, 0.2  # of the offset, and in the logarithm of the deviation
_LEAST_FORWARD = 0.1  # of a column's direction along the optical axis: farther to the side nothing is in the image


@dataclass(frozen=True, slots=True)
class RangeError:
    """Errors of ranges, in px of the full image. bf: px m. sigma_px: noise of a surface's disparity.

    offset_px: (5,) error that all disparities have in common (`disparity_offset`), as it is known now; cov_px: (5,5) of
    it.
    """

    bf: float
    sigma_px: float
    offset_px: F64
    cov_px: F64

    @staticmethod
    def of_noise(bf: float, sigma_px: float) -> "RangeError":
        """That of a camera whose disparities have noise alone."""
        return RangeError(bf, sigma_px, np.zeros(TERMS), np.zeros((TERMS, TERMS)))

    @property
    def common_px(self) -> float:
        """Deviation of what disparities in the middle of the image have in common."""
        return float(np.sqrt(self.cov_px[0, 0]))

    def moved(self, other: "RangeError") -> bool:
        """True if the offset is not that of the other one."""
        return bool(np.abs(self.offset_px - other.offset_px).max() > _LEAST_CHANGE_PX)

    def differs(self, other: "RangeError") -> bool:
        """True if ranges drawn by the other one have to be drawn anew."""
        mine, theirs = (float(np.hypot(e.sigma_px, e.common_px)) for e in (self, other))
        return self.moved(other) or abs(float(np.log(mine / theirs))) > _LEAST_CHANGE

    def ranges(self, scan: ColumnScan, made_with_px: F64, sigma_m: float) -> tuple[F64, F64]:
        """clear_m (n,) of a scan that was made with an offset (5,), by the one known now.

        And the range (n,) up to which a surface's deviation is below sigma_m.
        """
        azimuth = scan.azimuths_rad
        towards = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(scan))]) @ level_rotation(scan.up_c).T
        ahead = np.maximum(towards[:, 2], _LEAST_FORWARD)
        at = terms(towards[:, :2] / ahead[:, None])
        seen = scan.clear_m > 0.0
        disparity = np.divide(self.bf, scan.clear_m * ahead, out=np.zeros(len(scan)), where=seen)
        disparity += at @ (made_with_px - self.offset_px)
        beyond = seen & (disparity <= 0.0)
        clear = np.divide(self.bf, disparity * ahead, out=np.zeros(len(scan)), where=seen & (disparity > 0.0))
        clear[beyond] = np.inf
        sigma = np.sqrt(self.sigma_px**2 + np.einsum("ni,ij,nj->n", at, self.cov_px, at))
        return clear, np.sqrt(sigma_m * self.bf / (ahead * sigma))
