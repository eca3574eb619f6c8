"""Whether an IMU that was promised speaks. Pure."""

from __future__ import annotations

from kiteline_core.frame import ImuBatch


class ImuWatch:
    """Frames and their samples in; news when samples stop coming, and when they come again."""

    def __init__(self, silent_s: float) -> None:
        """silent_s: s without a sample after which it is told."""
        self._silent_ns = round(silent_s * 1e9)
        self._heard_ns: int | None = None  # of the last frame with samples; of the first frame while there were none
        self._silent = False

    def frame(self, t_ns: int, imu: ImuBatch | None) -> list[str]:
        """What is worth an event at a frame."""
        if imu is not None and len(imu.t_ns):
            was_silent, self._silent, self._heard_ns = self._silent, False, t_ns
            return ["imu: heard again"] if was_silent else []
        if self._heard_ns is None:
            self._heard_ns = t_ns
        if self._silent or t_ns - self._heard_ns < self._silent_ns:
            return []
        self._silent = True
        return [f"imu: silent for {(t_ns - self._heard_ns) * 1e-9:.1f} s, the images alone carry the pose"]
