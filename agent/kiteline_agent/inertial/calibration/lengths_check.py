"""Says where lengths by the images contradict the accelerations: a baseline, focal length or unit that is wrong."""

import numpy as np

_OFF = 0.04  # of all lengths; a bad IMU's scale is off by 0.01, lengths by a worn rig 30 m away by 0.03
_SIGNIFICANCE = 4.0  # deviations
_LEAST_TOLD = 0.1  # share of the information that the accelerations gave; from less nothing is divided


class LengthsCheck:
    """Compares the scale of the images with that of the calibration, and says once that it is another."""

    def __init__(self, prior_sigma: float) -> None:
        """prior_sigma: relative deviation of lengths by the images before the flight."""
        self._prior_sigma = prior_sigma
        self._said = False

    def note(self, scale: float, sigma: float) -> list[str]:
        """Take in metres per metre of the images, estimated about 1 with the prior. Returns what is to be said."""
        told = 1.0 - min(sigma / self._prior_sigma, 1.0) ** 2  # share of what is known that accelerations told
        if self._said or told < _LEAST_TOLD:
            return []
        off, deviation = (1.0 - scale) / told, sigma / float(np.sqrt(told))
        if abs(off) < max(_OFF, _SIGNIFICANCE * deviation):
            return []
        self._said = True
        word = "long" if off > 0.0 else "short"
        off, deviation = 100.0 * abs(off), 100.0 * deviation
        said = f"lengths are {off:.0f} % too {word} by the accelerations (deviation {deviation:.1f} %)"
        return [f"images: {said}: check the baseline, the focal length and the unit of depths"]
