"""Chooses the IMU of a bag: one topic, or a gyroscope and an accelerometer whose samples are joined."""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sources.mcap_messages import ImuRow
from kiteline_hw.sources.mcap_rig import TransformTree

_LOOKED_AT = 400  # messages, some seconds: a simulated gyroscope at rest measures zeros until take-off
_GRAVITY_MESSAGES = 200  # messages from which the unit of acceleration is found: about a second


@dataclass(frozen=True, slots=True)
class ImuTopic:
    """A channel of inertial messages. count: how many. gyro, accel: whether it measures rates and accelerations.

    fault: why its messages cannot be read, or "".
    """

    channel: int
    topic: str
    frame_id: str
    count: int
    gyro: bool = False
    accel: bool = False
    fault: str = ""


@dataclass(frozen=True, slots=True)
class ImuChoice:
    """Topics of rates and of accelerations, which may be the same. R_g_a: (3,3) axes of the second in the first's."""

    gyro: ImuTopic
    accel: ImuTopic
    R_g_a: F64 | None
    note: str

    @property
    def split(self) -> bool:
        """True if rates and accelerations are on topics of their own."""
        return self.gyro.channel != self.accel.channel


def what_is_measured(topic: ImuTopic, messages: Iterable[list[ImuRow]]) -> ImuTopic:
    """The topic with `gyro` and `accel`: a sensor that is not there gives zeros, or what is no number."""
    gyro = accel = False
    for rows in islice(messages, _LOOKED_AT):
        gyro = gyro or any(_measures(row[:3]) for _, row in rows)
        accel = accel or any(_measures(row[3:]) for _, row in rows)
        if gyro and accel:
            break
    return replace(topic, gyro=gyro, accel=accel)


def accelerations_in_g(messages: Iterable[list[ImuRow]]) -> bool:
    """True if gravity measures near 1: some drivers send g although ROS demands m/s^2."""
    norms = [float(np.linalg.norm(row[3:])) for rows in islice(messages, _GRAVITY_MESSAGES) for _, row in rows]
    return bool(norms) and 0.5 < float(np.median(norms)) < 2.0


def choose_imu(
    topics: list[ImuTopic], tree: TransformTree, camera_frames: Collection[str]
) -> tuple[ImuChoice | None, tuple[str, ...]]:
    """The IMU that a transform joins to a camera, with both sensors on one topic, with the most messages; and notes.

    Without one the notes say why, if there are inertial topics.
    """
    choices = [ImuChoice(t, t, None, "") for t in topics if t.gyro and t.accel]
    accels = [t for t in topics if t.accel and not t.gyro]
    for gyro in topics:
        if accels and gyro.gyro and not gyro.accel:
            choices.append(_joined(gyro, max(accels, key=lambda a: (_common(gyro, a), a.count)), tree))

    def rank(choice: ImuChoice) -> tuple[bool, bool, int, int]:
        joined = any(tree.between(choice.gyro.frame_id, frame) is not None for frame in camera_frames)
        return joined, not choice.split, choice.gyro.count, choice.gyro.channel

    best = max(choices, key=rank, default=None)
    if best is not None:
        return best, (best.note,) if best.note else ()
    return None, tuple(_why_unusable(topic) for topic in topics)


def _joined(gyro: ImuTopic, accel: ImuTopic, tree: TransformTree) -> ImuChoice:
    T_g_a = tree.between(gyro.frame_id, accel.frame_id)
    note = f"imu: accelerations of {accel.topic} are interpolated at the stamps of {gyro.topic}"
    if T_g_a is None:
        note += f"; no transform joins {accel.frame_id!r} to {gyro.frame_id!r}: their axes are taken as parallel"
    return ImuChoice(gyro, accel, None if T_g_a is None else T_g_a[:3, :3], note)


def _common(a: ImuTopic, b: ImuTopic) -> int:
    """Number of leading parts that two names share."""
    parts = list(zip(a.topic.split("/"), b.topic.split("/"), strict=False))
    return next((i for i, (x, y) in enumerate(parts) if x != y), len(parts))


def _why_unusable(topic: ImuTopic) -> str:
    if topic.fault:
        return f"imu left out: {topic.fault}"
    if topic.gyro:
        return f"imu left out: {topic.topic} has no accelerations: record the accelerometer's topic beside it"
    if topic.accel:
        return f"imu left out: {topic.topic} has no angular velocities: record the gyroscope's topic beside it"
    return f"imu left out: {topic.topic} holds zeros only: look at the sensor's driver with `ros2 topic echo`"


def _measures(values: tuple[float, ...]) -> bool:
    return all(map(math.isfinite, values)) and any(values)
