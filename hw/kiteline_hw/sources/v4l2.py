"""Live cameras (Video4Linux 2): not supported yet."""

from __future__ import annotations

from kiteline_hw.ports import FrameSource, SourceError


def open_source(device: str, mono: bool, imu: bool) -> FrameSource:
    """Raises SourceError: there is no camera driver yet."""
    del mono, imu
    raise SourceError(f"v4l2:{device}: cameras cannot be opened yet: expected a recording or sim:SCENE")
