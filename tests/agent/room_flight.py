"""A rendered flight that many tests fly: whole, or its first seconds."""

import hashlib
from dataclasses import dataclass, replace

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.source import START_NS, open_sim


@dataclass(frozen=True)
class RoomFlight:
    """A flight at 20 Hz with all samples of its IMU and odometer. truth: (n,4,4) T_w_b at the n frames."""

    rig: CameraRig
    imu: ImuCalibration
    frames: list[Frame]
    samples: ImuBatch
    driven: OdometryBatch
    truth: F64

    def first(self, seconds: float) -> "RoomFlight":
        """The first seconds of the flight."""
        frames = self.frames[: round(seconds * 1e9) // SimConfig().frame_ns]
        felt, driven = (batch.t_ns <= frames[-1].t_ns for batch in (self.samples, self.driven))
        s = self.samples
        return replace(
            self, frames=frames, samples=ImuBatch(s.t_ns[felt], s.gyro[felt], s.accel[felt]),
            driven=odometry.chosen(self.driven, driven), truth=self.truth[: len(frames)],
        )  # fmt: skip


def digest(flight: RoomFlight) -> str:
    """Of all images, samples and poses: a test that changes them would change what later tests fly."""
    found = hashlib.blake2b()
    arrays = [view for frame in flight.frames for view in (frame.left, frame.right)]
    arrays += [flight.samples.t_ns, flight.samples.gyro, flight.samples.accel, flight.truth]
    arrays += [flight.driven.t_ns, flight.driven.velocity, flight.driven.rate]
    for array in arrays:
        found.update(np.ascontiguousarray(array))
    return found.hexdigest()


def render() -> RoomFlight:
    """6.5 s in full motion along the room's own course, at half the usual size."""
    source = open_sim("room", seconds=6.5, seed=5, scale=0.5, texture_bits=9, rest=0.0, odometry=50.0)
    truth, driven = source.ground_truth, source.odometry()
    assert driven is not None
    assert source.imu is not None
    frames = [item for item in source if isinstance(item, Frame)]
    assert frames[0].t_ns == START_NS
    return RoomFlight(source.rig, source.imu, frames, source.imu_samples(), driven, truth.T_w_b)
