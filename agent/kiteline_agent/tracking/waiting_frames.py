"""Frames that wait while the start of a monocular map takes more CPU time than there is."""

from collections import deque

from kiteline_core.frame import Frame, ImuBatch, joined

_MOST = 64  # frames that wait, 23 MB at 752x480
_STEP_NS = 500_000_000  # longest time between two frames by which tracking catches up: an IMU bridges it


class WaitingFrames:
    """Frames in order of time, some time apart, and after them the newest one; each with the samples before it."""

    def __init__(self, apart_s: float) -> None:
        """apart_s: shortest time between two frames that wait; the newest one may follow sooner."""
        self._apart_ns = round(apart_s * 1e9)
        self._frames: deque[tuple[Frame, ImuBatch | None]] = deque()
        self._before_ns: int | None = None  # stamp of the frame before the newest one

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def span_s(self) -> float:
        """Time between the first frame that waits and the newest one."""
        return (self._frames[-1][0].t_ns - self._frames[0][0].t_ns) * 1e-9 if self._frames else 0.0

    @property
    def first_t_ns(self) -> int | None:
        """Stamp of the first frame that waits; None if none does."""
        return self._frames[0][0].t_ns if self._frames else None

    def add(self, frame: Frame, imu: ImuBatch | None) -> None:
        """The newest frame, and samples since the one before, which it replaces if that one is close to its own."""
        if self._frames:
            newest, samples = self._frames[-1]
            if self._before_ns is not None and newest.t_ns - self._before_ns < self._apart_ns:
                self._frames.pop()
                imu = _joined([samples, imu])
            else:
                self._before_ns = newest.t_ns
        if len(self._frames) == _MOST:  # they would never be caught up with: go on from the newest
            imu = _joined([*(samples for _, samples in self._frames), imu])
            self._frames.clear()
        self._frames.append((frame, imu))

    def next(self) -> tuple[Frame, ImuBatch | None]:
        """Take the first frame, and samples since the one before."""
        frame, imu = self._frames.popleft()
        if not self._frames:
            self._before_ns = frame.t_ns
        return frame, imu

    def next_to_track(self) -> tuple[Frame, ImuBatch | None]:
        """Take the last frame that tracking can follow from the one before the first, and samples since that one."""
        frame, imu = self.next()
        end_ns, samples = frame.t_ns + _STEP_NS - self._apart_ns, [imu]
        while self._frames and self._frames[0][0].t_ns <= end_ns:
            frame, imu = self.next()
            samples.append(imu)
        return frame, _joined(samples)


def _joined(batches: list[ImuBatch | None]) -> ImuBatch | None:
    return joined([batch for batch in batches if batch is not None])
