"""Views of a source: with the right image, depth or IMU left out, with another IMU, or with another calibration."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import FrameSource, LiveSource, SourceError, is_live
from kiteline_hw.sources.recording import Recording


class SourceView:
    """A FrameSource that passes another one on: mono without right image and depth, imu=False without IMU."""

    def __init__(self, source: FrameSource, mono: bool, imu: bool) -> None:
        self._source, self._mono, self._passes_imu = source, mono, imu
        self.name, self.report, self.frame_count = source.name, source.report, source.frame_count
        self.rig = replace(source.rig, right=None, T_c_r=None, has_depth=False) if mono else source.rig
        self.imu = source.imu if imu else None

    @property
    def ground_truth(self) -> Trajectory | None:
        return self._source.ground_truth

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        for item in self._source:
            if isinstance(item, ImuBatch):
                if self._passes_imu:
                    yield item
            elif self._mono and isinstance(item, Frame):
                yield Frame(item.t_ns, item.left, encoded=item.encoded[:1])
            else:
                yield item

    def close(self) -> None:
        self._source.close()


class _OtherImuView(SourceView):
    def __init__(self, source: FrameSource, imu: ImuCalibration, T_b_c: F64 | None) -> None:
        super().__init__(source, mono=False, imu=False)
        self.imu = imu
        self._T_new_old: F64 | None = None  # the body frame of the source in the new one; None: it stays
        if T_b_c is not None:
            self._T_new_old = T_b_c @ se3.inverse(source.rig.T_b_c)
            self.rig = replace(source.rig, T_b_c=T_b_c, has_body=True)

    @property
    def ground_truth(self) -> Trajectory | None:
        truth = self._source.ground_truth
        if truth is None or self._T_new_old is None:
            return truth
        return Trajectory(truth.t_ns, truth.T_w_b @ self._source.rig.T_b_c @ se3.inverse(self.rig.T_b_c))

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        for item in super().__iter__():
            yield self._in_new_body(item)

    def _in_new_body(self, item: Frame | ImuBatch | OdometryBatch) -> Frame | ImuBatch | OdometryBatch:
        if self._T_new_old is not None and isinstance(item, OdometryBatch):
            return odometry.in_body(item, self._T_new_old)
        return item


class _LiveOtherImuView(_OtherImuView):
    """The same of a camera."""

    def __init__(self, source: LiveSource, imu: ImuCalibration, T_b_c: F64 | None) -> None:
        super().__init__(source, imu, T_b_c)
        self._live = source

    @property
    def decode_ns(self) -> int:
        return self._live.decode_ns

    def poll(self, until_ns: int) -> Frame | ImuBatch | OdometryBatch | None:
        while isinstance(item := self._live.poll(until_ns), ImuBatch):
            pass
        return None if item is None else self._in_new_body(item)

    def take_dropped(self) -> int:
        return self._live.take_dropped()

    def take_messages(self) -> list[str]:
        return self._live.take_messages()


def with_other_imu(source: FrameSource, imu: ImuCalibration, T_b_c: F64 | None) -> FrameSource:
    """A view whose own inertial samples are left out, because another IMU's samples replace them.

    T_b_c: (4,4) left camera in that IMU's frame, which becomes the body frame of the rig, the ground truth and the
    odometry; None: the body frame of the source stays.
    """
    return _LiveOtherImuView(source, imu, T_b_c) if is_live(source) else _OtherImuView(source, imu, T_b_c)


class CalibratedView(SourceView):
    """With the cameras, extrinsics and IMU noise that are given. Raises SourceError if they do not fit the source.

    Where the file says nothing of the body, the camera's place in it stays that of the source.
    """

    def __init__(self, source: FrameSource, given: FileCalibration) -> None:
        super().__init__(source, mono=False, imu=True)
        rig = source.rig
        self._T_old_new = np.eye(4)  # the body frame of the new rig in the source's
        if given.cameras:
            new = given.rig_of_images(source.name, 1 + (rig.right is not None), (rig.left.height, rig.left.width))
            for model, old, side in ((new.left, rig.left, "left"), (new.right, rig.right, "right")):
                _check_size(model, old, f"{given.where}: {side} camera", source.name)
            T_b_c, has_body = (new.T_b_c, True) if new.has_body else (rig.T_b_c, rig.has_body)
            if given.without_imu and isinstance(source, Recording) and source.T_s_b is not None:
                T_b_c = se3.inverse(source.T_s_b) @ T_b_c
            self.rig = replace(rig, left=new.left, right=new.right, T_c_r=new.T_c_r, T_b_c=T_b_c, has_body=has_body)
            if not rig.has_body:
                self._T_old_new = rig.T_b_c @ se3.inverse(T_b_c)
        if given.imu is not None and self.imu is not None:
            self.imu = given.imu

    @property
    def ground_truth(self) -> Trajectory | None:
        truth = self._source.ground_truth
        return truth if truth is None else Trajectory(truth.t_ns, truth.T_w_b @ self._T_old_new)


def _check_size(given: CameraModel | None, found: CameraModel | None, where: str, source: str) -> None:
    if given is not None and found is not None and (given.width, given.height) != (found.width, found.height):
        raise SourceError(
            f"{where} is calibrated at {given.width}x{given.height} px, but {source} has {found.width}x{found.height}: "
            "calibrate at the size of the images"
        )
