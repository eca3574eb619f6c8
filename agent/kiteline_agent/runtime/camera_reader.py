"""Reads a live camera: frames as they come, with the samples since the last one."""

from collections import deque
from typing import Protocol

from kiteline_agent.runtime.frame_reader import SAMPLES, PendingSamples
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch


class PolledCamera(Protocol):
    """What is read; kiteline_hw.ports.LiveSource is one."""

    @property
    def decode_ns(self) -> int: ...
    def poll(self, until_ns: int) -> Frame | ImuBatch | OdometryBatch | None: ...


class CameraReader(PendingSamples):
    """Frames of a camera; like FrameReader, but `next_ns` is None whenever no frame waits."""

    def __init__(self, source: PolledCamera) -> None:
        super().__init__()
        self.decode_ms: deque[float] = deque(maxlen=SAMPLES)
        self.period_ns = 0  # between the last two frames that were taken
        self._source = source
        self._frame: Frame | None = None
        self._last_ns: int | None = None
        self._decode_mark_ns = source.decode_ns

    @property
    def decode_ns(self) -> int:
        """CPU time that the camera's threads spent on decoding so far."""
        return self._source.decode_ns

    @property
    def next_ns(self) -> int | None:
        """Stamp of the frame that waits; None if none does."""
        return None if self._frame is None else self._frame.t_ns

    def poll(self, until_ns: int) -> None:
        """Await a frame until a time of the monotonic clock at most."""
        while self._frame is None:
            item = self._source.poll(until_ns)
            if item is None:
                return
            if isinstance(item, Frame):
                self._frame = item
            else:
                self.add(item)

    def take(self) -> tuple[Frame, ImuBatch | None, OdometryBatch | None]:
        """The frame that waits, and IMU samples and odometry since the last one that was taken."""
        assert self._frame is not None, "no frame waits"
        frame, self._frame = self._frame, None
        self.period_ns = 0 if self._last_ns is None else frame.t_ns - self._last_ns
        self._last_ns = frame.t_ns
        spent_ns = self._source.decode_ns
        self.decode_ms.append((spent_ns - self._decode_mark_ns) / 1e6)
        self._decode_mark_ns = spent_ns
        return frame, *self.take_all()

    def drop(self) -> None:
        """Drop the frame that waits; its samples come with the one after."""
        self._frame = None
