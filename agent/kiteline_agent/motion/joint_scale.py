"""Scale of a map of one camera in metres, by IMU and odometer together.

Each tells metres per unit of the map with a deviation; they are weighed by these. Where they contradict each other the
IMU stands, since wheels slip for as long as they like: a bad odometer costs nothing.
"""

import numpy as np

_AGAIN = "odometer: agrees with the IMU about lengths again"
CONTRADICT, _AGREE = 3.0, 2.0  # deviations of the difference from which both contradict, and agree again

Scale = tuple[float, float]  # metres per unit of the map, and the standard deviation


class JointScale:
    """Call `fused` as often as wanted, and `watch` once a frame."""

    def __init__(self) -> None:
        self._contradicts = False

    def watch(self, by_imu: Scale, by_odometer: Scale | None) -> list[str]:
        """Compare what both tell in a frame; None: the odometer tells nothing. Returns events."""
        if by_odometer is None:
            return []
        apart, sigma = _apart(by_imu, by_odometer)
        before, self._contradicts = self._contradicts, apart > (_AGREE if self._contradicts else CONTRADICT) * sigma
        if self._contradicts == before:
            return []
        return [contradiction(by_odometer[0] / by_imu[0]) if self._contradicts else _AGAIN]

    def fused(self, by_imu: Scale, by_odometer: Scale) -> Scale:
        """What both tell together."""
        if self._contradicts:
            return by_imu
        found = np.log([by_imu[0], by_odometer[0]])
        weight = np.array([by_imu[1] / by_imu[0], by_odometer[1] / by_odometer[0]]) ** -2.0
        scale = float(np.exp(weight @ found / weight.sum()))
        return scale, scale * float(weight.sum()) ** -0.5

    def deviation(self, by_imu: Scale, by_odometer: Scale) -> float:
        """Relative deviation of lengths in the map as it is: how well the scale is known, and how far off it seems."""
        scale, sigma = self.fused(by_imu, by_odometer)
        return float(np.hypot(sigma / scale, scale - 1.0))


def _apart(a: Scale, b: Scale) -> Scale:
    """Difference of two logarithms of scales, and its deviation."""
    return abs(float(np.log(a[0] / b[0]))), float(np.hypot(a[1] / a[0], b[1] / b[0]))


def contradiction(ratio: float) -> str:
    """An event. ratio: lengths by the odometer over those by the IMU."""
    longer = "long" if ratio > 1.0 else "short"
    share = 100.0 * abs(ratio - 1.0)
    return f"odometer: lengths are {share:.0f} % too {longer} for the IMU, which alone tells the scale until both agree"
