"""Reads a source one frame ahead, and measures what decoding costs."""

from collections import deque
from collections.abc import Callable, Iterable

import numpy as np

from kiteline_core import odometry
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch, joined

SAMPLES = 1 << 15  # newest CPU times that are kept: half an hour of frames, of a flight that may last for days


class PendingSamples:
    """IMU samples and odometry that wait for their frame."""

    def __init__(self) -> None:
        self._imu: list[ImuBatch] = []
        self._odometry: list[OdometryBatch] = []

    def add(self, batch: ImuBatch | OdometryBatch) -> None:
        """Add samples, in order of time."""
        if isinstance(batch, ImuBatch):
            self._imu.append(batch)
        else:
            self._odometry.append(batch)

    def take_all(self) -> tuple[ImuBatch | None, OdometryBatch | None]:
        """All that wait."""
        imu, batch = joined(self._imu), odometry.joined(self._odometry)
        self._imu, self._odometry = [], []
        return imu, batch

    def take_imu(self, until_ns: int) -> ImuBatch | None:
        """IMU samples up to a time before the next frame, since those taken before; None if there are none."""
        pending = joined(self._imu)
        if pending is None:
            return None
        n = int(np.searchsorted(pending.t_ns, until_ns, "right"))
        self._imu = [_samples(pending, slice(n, None))] if n < len(pending.t_ns) else []
        return _samples(pending, slice(n)) if n else None


class FrameReader(PendingSamples):
    """Frames of a source, each with the IMU samples and odometry since the last one that was taken.

    until_ns: frames with a later stamp are left out; None: all. cpu_clock: process CPU time in ns.
    """

    def __init__(
        self, items: Iterable[Frame | ImuBatch | OdometryBatch], until_ns: int | None, cpu_clock: Callable[[], int],
    ) -> None:  # fmt: skip
        super().__init__()
        self.decode_ms: deque[float] = deque(maxlen=SAMPLES)
        self.decode_ns = 0  # process CPU spent on reading and decoding so far
        self.period_ns = 0  # between the last two frames that were read
        self._items = iter(items)
        self._until_ns = until_ns
        self._clock = cpu_clock
        self._frame: Frame | None = None
        self._advance()

    @property
    def next_ns(self) -> int | None:
        """Stamp of the next frame; None after the last."""
        return None if self._frame is None else self._frame.t_ns

    def take(self) -> tuple[Frame, ImuBatch | None, OdometryBatch | None]:
        """The next frame, and IMU samples and odometry since the last one that was taken."""
        assert self._frame is not None, "no frame is left"
        frame, samples = self._frame, self.take_all()
        self._advance()
        return frame, *samples

    def drop(self) -> None:
        """Drop the next frame; its samples come with the one after."""
        self._advance()

    def _advance(self) -> None:
        before_ns = self._clock()
        last, self._frame = self._frame, None
        for item in self._items:
            if isinstance(item, ImuBatch | OdometryBatch):
                self.add(item)
                continue
            if self._until_ns is None or item.t_ns <= self._until_ns:
                self._frame = item
            break
        spent_ns = self._clock() - before_ns
        self.decode_ns += spent_ns
        if self._frame is not None:
            self.decode_ms.append(spent_ns / 1e6)
            self.period_ns = 0 if last is None else self._frame.t_ns - last.t_ns


def _samples(batch: ImuBatch, some: slice) -> ImuBatch:
    return ImuBatch(batch.t_ns[some], batch.gyro[some], batch.accel[some])
