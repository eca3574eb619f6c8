"""The flight between two keyframes in short steps, each by images and by the IMU."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId

MAX_STEPS = 128
_NOISE_STEPS = 1_000_000.0  # codes in one m/s^2/sqrt(Hz)
_TIME = 10_000.0  # codes in 1 s
_TURN = 16_384.0  # in 1 rad: 61 microrad, a tenth of what images measure
_MOVED = 8_192.0  # in 1 m: 0.12 mm
_VELOCITY = 4_096.0  # in 1 m/s: 0.24 mm/s, a tenth of the noise of a quiet accelerometer over 0.2 s
_POSITION = 32_768.0  # in 1 m: 0.03 mm
_UNITS = np.repeat([_TIME, _TURN, _MOVED, _VELOCITY, _POSITION], [1, 3, 3, 3, 3])
_LIMITS = np.repeat([100_000, 65_536, 1 << 20, 1 << 21, 1 << 20], [1, 3, 3, 3, 3]).astype(np.int64)


@register
@dataclass(frozen=True, slots=True)
class InertialSteps(Record):
    """Motion of the body from an earlier keyframe to this one; each step is in the body's axes at its begin.

    since: the earlier keyframe. noise: of the accelerometer, m/s^2/sqrt(Hz). dt_s: (n,). turn: (n,3) rotation vector
    and moved: (n,3) m, both by images alone. velocity, position: (n,3) m/s, m that the accelerometer's samples add up
    to, its bias and gravity included, the gyro's bias taken off.
    """

    KIND = 8
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.REST

    keyframe: KeyframeId
    since: KeyframeId
    noise: float
    dt_s: F64
    turn: F64
    moved: F64
    velocity: F64
    position: F64

    def write(self, out: Writer) -> None:
        """Append the earlier keyframe, the noise and the steps as columns of integers. Raises ValueError."""
        back, n = self.keyframe - self.since, len(self.dt_s)
        if back <= 0 or not 0 < n <= MAX_STEPS:
            raise ValueError(f"found {n} steps from keyframe {self.since}: expected 1..{MAX_STEPS} from an earlier one")
        dt = np.rint(self.dt_s * _TIME) / _TIME
        rest = self.position - 0.5 * dt[:, None] * np.rint(self.velocity * _VELOCITY) / _VELOCITY
        values = np.column_stack([dt, self.turn, self.moved, self.velocity, rest])
        codes = np.rint(values * _UNITS)
        if not (np.abs(codes) <= _LIMITS).all() or not (codes[:, 0] > 0).all():
            raise ValueError("a step is too long, too fast or not finite")
        out.varint(back)
        out.varint(min(max(round(self.noise * _NOISE_STEPS), 1), 1 << 30))
        out.varint(n)
        out.columns(np.ascontiguousarray(codes.T.astype(np.int64)))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        since = KeyframeId(key.id - source.varint(MAX_KEYFRAME_ID))
        noise = source.varint(1 << 30) / _NOISE_STEPS
        n = source.varint(MAX_STEPS)
        codes = source.columns(13, n)
        if not 0 <= since < key.id or noise <= 0.0 or n == 0:
            raise WireError("inertial steps begin at an earlier keyframe, and have a noise and a length")
        if (np.abs(codes) > _LIMITS[:, None]).any() or (codes[0] <= 0).any():
            raise WireError("an inertial step is out of range")
        values = codes.T / _UNITS
        dt, velocity = values[:, 0].copy(), values[:, 7:10].copy()
        position = values[:, 10:] + 0.5 * dt[:, None] * velocity
        turn, moved = values[:, 1:4].copy(), values[:, 4:7].copy()
        return cls(KeyframeId(key.id), since, noise, dt, turn, moved, velocity, position)
