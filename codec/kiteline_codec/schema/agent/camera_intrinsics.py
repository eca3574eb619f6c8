"""Camera intrinsics of an agent."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId

_MAX_SIZE_PX = 1 << 14
_MAX_PX = 1e6  # of focal lengths and centre
_MAX_BASELINE_M = 1e3


@register
@dataclass(frozen=True, slots=True)
class CameraIntrinsics(Record):
    """The rectified camera to which an agent's keypoints refer."""

    KIND = 1
    ID = IdOf.AGENT
    PRIORITY = Priority.POSE  # keypoints cannot be used without it
    PREDICTS = True

    agent: AgentId
    camera: RectifiedCamera

    def write(self, out: Writer) -> None:
        """Append size, intrinsics and the pose in the body, exactly."""
        c = self.camera
        out.varint(c.width)
        out.varint(c.height)
        for value in (c.fx, c.fy, c.cx, c.cy, c.baseline_m):
            out.f64(value)
        out.u8(int(c.stereo))
        for value in np.asarray(c.T_b_c, np.float64)[:3].reshape(-1):
            out.f64(float(value))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        width, height = source.varint(_MAX_SIZE_PX), source.varint(_MAX_SIZE_PX)
        fx, fy, cx, cy, baseline_m = (source.f64() for _ in range(5))
        stereo = source.u8()
        T_b_c = np.eye(4)
        T_b_c[:3] = np.array([source.f64() for _ in range(12)]).reshape(3, 4)
        if not (width and height and fx > 0 and fy > 0 and baseline_m > 0 and stereo < 2):
            raise WireError("a camera has size, focal lengths and a baseline above zero")
        if not (
            min(fx, fy) >= 1.0 and max(fx, fy, abs(cx), abs(cy)) <= _MAX_PX and 1e-6 < baseline_m < _MAX_BASELINE_M
        ):
            raise WireError("a camera's focal lengths, centre or baseline are out of range")
        if np.abs(T_b_c).max() > 1e6 or np.abs(T_b_c[:3, :3] @ T_b_c[:3, :3].T - np.eye(3)).max() > 1e-3:
            raise WireError("the camera's pose in the body is no rigid motion")
        camera = RectifiedCamera(width, height, fx, fy, cx, cy, baseline_m, stereo == 1, T_b_c)
        return cls(AgentId(key.id), camera)
