"""A source with something left out: the right eye and depth (mono), or the inertial samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from kiteline_core.cameras import CameraRig
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_hw.ports import FrameSource, SourceReport


def reduced(source: FrameSource, mono: bool, imu: bool) -> FrameSource:
    """The source itself when nothing is left out, else a view of it."""
    return source if imu and not mono else _Reduced(source, mono, imu)


class _Reduced:
    def __init__(self, source: FrameSource, mono: bool, imu: bool) -> None:
        self._source, self._mono, self._imu = source, mono, imu

    @property
    def name(self) -> str:
        return self._source.name

    @property
    def rig(self) -> CameraRig:
        rig = self._source.rig
        return replace(rig, right=None, T_c_r=None, has_depth=False) if self._mono else rig

    @property
    def imu(self) -> ImuCalibration | None:
        return self._source.imu if self._imu else None

    @property
    def ground_truth(self) -> Trajectory | None:
        return self._source.ground_truth

    @property
    def report(self) -> SourceReport:
        return self._source.report

    @property
    def frame_count(self) -> int | None:
        return self._source.frame_count

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        for item in self._source:
            if isinstance(item, ImuBatch):
                if self._imu:
                    yield item
            elif self._mono and isinstance(item, Frame):
                yield Frame(item.t_ns, item.left, encoded=item.encoded[:1])
            else:
                yield item

    def close(self) -> None:
        self._source.close()
