"""Watch for missing IMU samples."""

from kiteline_core.frame import ImuBatch


class ImuWatch:
    """Reports when IMU samples stop, and when they resume."""

    def __init__(self, silent_s: float) -> None:
        """silent_s: time without a sample after which silence is reported."""
        self._silent_ns = round(silent_s * 1e9)
        self._last_ns: int | None = None  # of the last frame with samples, or of the first frame before any
        self._silent = False

    def frame(self, t_ns: int, imu: ImuBatch | None) -> list[str]:
        """Process a frame; returns the events for the log."""
        if imu is not None and len(imu.t_ns):
            was_silent, self._silent, self._last_ns = self._silent, False, t_ns
            return ["imu: samples again"] if was_silent else []
        if self._last_ns is None:
            self._last_ns = t_ns
        if self._silent or t_ns - self._last_ns < self._silent_ns:
            return []
        self._silent = True
        return [f"imu: silent for {(t_ns - self._last_ns) * 1e-9:.1f} s, the images alone carry the pose"]
