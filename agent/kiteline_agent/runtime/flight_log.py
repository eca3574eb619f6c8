"""Writes the steps of an agent to its log: inputs, then outputs. Pure: the log is handed in.

Each step begins with a /step message that counts the messages after it. Numbers are logged bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Protocol

import numpy as np

from kiteline_agent.step import Estimate, PredictedPose, StepInput, StepOutput
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch

STEP, IMU, ODOMETER, PACKETS_IN, PACKETS_OUT, ESTIMATE, PREDICTED, EVENTS = (
    "/step", "/imu", "/odometer", "/packets/in", "/packets/out", "/estimate", "/predicted", "/events",
)  # fmt: skip


_ESTIMATE = tuple(field.name for field in fields(Estimate))
_PREDICTED = tuple(field.name for field in fields(PredictedPose))


class StepLog(Protocol):
    """The part of a log that steps are written with; kiteline_hw.mcap_log.LogWriter is one."""

    def frame(self, frame: Frame) -> None: ...
    def imu(self, topic: str, t_ns: int, batch: ImuBatch) -> None: ...
    def odometer(self, topic: str, t_ns: int, batch: OdometryBatch) -> None: ...
    def blob(self, topic: str, t_ns: int, data: bytes) -> None: ...
    def json(self, topic: str, t_ns: int, value: object) -> None: ...
    def fields(self, topic: str, t_ns: int, values: Mapping[str, object]) -> None: ...
    def pose(self, topic: str, t_ns: int, frame_id: str, pose: F64) -> None: ...
    def text(self, topic: str, t_ns: int, level: str, text: str) -> None: ...


def write_step(
    log: StepLog, step_input: StepInput, output: StepOutput, now_ns: int, log_ns: int, with_images: bool = True
) -> None:
    """Write one step. now_ns: as passed to the step. log_ns: log time of the messages.

    with_images: else the frame's images are left out, and the log cannot be replayed.
    """
    frame, imu = step_input.frame, step_input.imu
    log.json(
        STEP,
        log_ns,
        {
            "now_ns": now_ns,
            "cpu_ns": step_input.cpu_ns,
            "frame_ns": None if frame is None else frame.t_ns,
            "imu": imu is not None,
            "odometer": step_input.odometry is not None,
            "predict_ns": step_input.predict_ns,
            "packets_in": len(step_input.packets),
            "packets_out": len(output.packets),
        },
    )
    if imu is not None:
        log.imu(IMU, log_ns, imu)
    if step_input.odometry is not None:
        log.odometer(ODOMETER, log_ns, step_input.odometry)
    if frame is not None and with_images:
        log.frame(frame)
    for packet in step_input.packets:
        log.blob(PACKETS_IN, log_ns, packet)
    estimate = output.estimate
    if estimate is not None:
        log.fields(ESTIMATE, log_ns, {name: getattr(estimate, name) for name in _ESTIMATE})
        if not estimate.initialising:
            log.pose("/odometry", log_ns, "odometry", estimate.T_o_b)
        pose = estimate.T_m_b if estimate.T_w_b is None else estimate.T_w_b
        if estimate.tracked and pose is not None:
            log.pose("/pose", log_ns, "submap" if estimate.T_w_b is None else "world", pose)
    if output.predicted is not None:
        log.fields(PREDICTED, log_ns, {name: getattr(output.predicted, name) for name in _PREDICTED})
    if output.events:
        log.json(EVENTS, log_ns, {"events": list(output.events)})
    for packet in output.packets:
        log.blob(PACKETS_OUT, log_ns, packet)


def estimate_to_json(estimate: Estimate) -> dict[str, Any]:
    """Every field of an estimate; matrices as their numbers in rows."""
    return _to_json(estimate, _ESTIMATE)


def predicted_to_json(predicted: PredictedPose) -> dict[str, Any]:
    """Every field of a predicted pose; matrices as their numbers in rows."""
    return _to_json(predicted, _PREDICTED)


def _to_json(value: object, names: Sequence[str]) -> dict[str, Any]:
    found = {name: getattr(value, name) for name in names}
    return {name: v.ravel().tolist() if isinstance(v, np.ndarray) else v for name, v in found.items()}


def estimate_from_json(value: Mapping[str, Any]) -> Estimate:
    """The estimate of such a record. Raises ValueError when a field is missing or of another shape."""
    known = {field.name for field in fields(Estimate)}
    if known - {"p_l_o"} != set(value) - {"p_l_o"}:  # which older logs lack
        raise ValueError(f"logged estimate has fields {sorted(value)}, expected {sorted(known)}")
    fields_of: dict[str, Any] = {name: _matrix(v) if isinstance(v, list) else v for name, v in value.items()}
    return Estimate(**fields_of)


def _matrix(numbers: Sequence[float]) -> F64:
    a = np.array(numbers, np.float64)
    side = {9: 3, 16: 4, 36: 6}.get(a.size)
    return a if side is None else a.reshape(side, side)
