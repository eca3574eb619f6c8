"""The IMU of a flight controller against values by hand: frames, signs, units, clocks, and the choice of message."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from kiteline_core.frame import ImuBatch, ImuCalibration, OdometryBatch
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.mavlink import controller_imu
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Heartbeat, VehicleImu
from kiteline_hw.ports import SourceReport
from kiteline_hw.sim.flight_controller import FlightController
from kiteline_hw.sources.overrides import with_other_imu

S, MS = 1_000_000_000, 1_000_000

# A vehicle at rest that leans its nose up by 30 degrees and turns to the right: FRD feels 9.81 against the earth.
NOSE_UP = ((4.905, 0.0, -8.4957), (0.0, 0.1, 0.3))
IN_BODY = {
    "frd": ([4.905, 0.0, -8.4957], [0.0, 0.1, 0.3]),
    "flu": ([4.905, 0.0, 8.4957], [0.0, -0.1, -0.3]),  # up is felt along +z
    "rdf": ([0.0, -8.4957, 4.905], [0.1, 0.3, 0.0]),  # a camera's y points down
    "urf": ([8.4957, 0.0, 4.905], [-0.3, 0.1, 0.0]),
}


def unit(axes: str = "flu") -> ControllerImu:
    return ControllerImu(mounting(axes)[:3, :3], 200.0, SourceReport())


def stream_of(imu: ControllerImu, kind: str = "ardupilot") -> tuple[ControllerSession, FlightController]:
    stream, controller = ControllerSession(mounting("flu"), imu=imu), FlightController(kind)  # type: ignore[arg-type]
    stream.receive(controller.poll(0)[0], 0)  # its heartbeat
    return stream, controller


@pytest.mark.parametrize("axes", IN_BODY)
def test_samples_in_every_body_frame(axes: str) -> None:
    stream, controller = stream_of(unit(axes))
    data = controller.imu(1_000_000, *NOSE_UP)
    for i in range(len(data)):
        stream.receive(data[i : i + 1], 5 * S)  # byte by byte
    batch = stream.take_imu(5 * S)
    assert batch.t_ns.tolist() == [5 * S]
    np.testing.assert_allclose(batch.accel[0], IN_BODY[axes][0], atol=1e-5)
    np.testing.assert_allclose(batch.gyro[0], IN_BODY[axes][1], atol=1e-6)
    assert stream.take_imu(9 * S) is None


def packed(message: object) -> bytes:
    return bytes(message.pack(common.MAVLink(None, 1, 1)))  # type: ignore[attr-defined]


COARSE = (500, 0, -866, 0, 100, 300)  # mg and mrad/s of NOSE_UP
RAW = packed(common.MAVLink_raw_imu_message(1_000_000, *COARSE, 0, 0, 0))
SCALED = packed(common.MAVLink_scaled_imu_message(1_000, *COARSE, 0, 0, 0))


@pytest.mark.parametrize("data", [RAW, SCALED])
def test_samples_in_mg_and_mrad(data: bytes) -> None:
    stream, _ = stream_of(unit("frd"))
    stream.receive(data, 5 * S)
    batch = stream.take_imu(5 * S)
    np.testing.assert_allclose(batch.accel[0], [4.9033, 0.0, -8.4926], atol=1e-4)
    np.testing.assert_allclose(batch.gyro[0], [0.0, 0.1, 0.3], atol=1e-12)


def test_raw_counts_without_unit_are_ignored() -> None:
    stream, _ = stream_of(unit("frd"), "px4")
    stream.receive(RAW, 5 * S)
    assert stream.take_imu(9 * S) is None
    stream.receive(SCALED, 6 * S)
    assert stream.take_imu(9 * S) is not None


def test_the_finest_message_is_used_and_a_coarser_one_after_silence() -> None:
    imu, still = unit("frd"), (0.0, 0.0, 0.0)
    fine, coarse = (VehicleImu(0, (k, 0.0, -9.8), still, message=m) for k, m in ((1.0, 105), (2.0, 26)))

    def hear(m: VehicleImu, now_ns: int) -> float | None:
        imu.receive(VehicleImu(now_ns // 1000, m.accel, still, m.message, m.unit, m.component), None, now_ns)
        batch = imu.take_until(now_ns)
        return None if batch is None else float(batch.accel[0, 0])

    assert hear(coarse, S) == 2.0
    assert hear(fine, S + 5 * MS) == 1.0
    assert hear(coarse, S + 10 * MS) is None
    assert hear(VehicleImu(0, (3.0, 0.0, 0.0), still, unit=1), S + 15 * MS) is None  # a second chip
    assert hear(VehicleImu(0, (4.0, 0.0, 0.0), still, component=197), S + 20 * MS) is None  # somebody else's
    assert hear(coarse, 4 * S) == 2.0


def test_incomplete_samples_are_ignored() -> None:
    stream, _ = stream_of(unit())
    gyro_only = common.MAVLink_highres_imu_message(1, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, *(0.0,) * 7, 0x38)
    stream.receive(packed(gyro_only), S)
    assert stream.take_imu(S) is None


def test_stamps_are_converted_by_the_least_delay() -> None:
    imu = unit()
    for k, delay_ms in enumerate((30, 4, 9, 25)):
        t_ns = 100 * S + 40 * k * MS
        imu.receive(VehicleImu((t_ns - 60 * S) // 1000, *NOSE_UP), None, t_ns + delay_ms * MS)
    batch = imu.take_until(101 * S)
    late_ms = (batch.t_ns - (100 * S + 40 * MS * np.arange(4))) / MS
    np.testing.assert_allclose(late_ms, [30, 4, 4, 4], atol=0.1)


def test_late_samples_come_with_the_next_frame() -> None:
    imu = unit()
    imu.receive(VehicleImu(0, *NOSE_UP), None, S)
    imu.receive(VehicleImu(50_000, *NOSE_UP), None, S + 50 * MS)
    first = imu.take_until(S + 49 * MS)
    imu.receive(VehicleImu(45_000, *NOSE_UP), None, S + 55 * MS)  # overtaken on its way
    imu.receive(VehicleImu(60_000, *NOSE_UP), None, S + 60 * MS)
    second = imu.take_until(S + 99 * MS)
    assert first.t_ns.tolist() == [S]
    assert second.t_ns.tolist() == [S + 50 * MS, S + 60 * MS]


def test_the_buffer_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(controller_imu, "_MAX_SAMPLES", 10)
    imu = unit()
    for k in range(30):
        imu.receive(VehicleImu(k * 5000, *NOSE_UP), None, S + k * 5 * MS)
    batch = imu.take_until(9 * S)
    assert len(batch.t_ns) == 10
    imu.receive(VehicleImu(200_000, *NOSE_UP), None, S + 200 * MS)
    assert imu.take_until(9 * S) is not None


def test_the_finest_message_is_requested_first_and_then_all() -> None:
    stream, controller = ControllerSession(mounting("flu"), imu=unit()), MavlinkCodec(7, 1)
    heartbeat = controller.encode(Heartbeat(2, 12))
    asked = [
        (m.target_system, m.target_component, m.command, m.param1, m.param2)
        for t in range(4)
        for data in stream.receive(heartbeat, t * S)
        for m in common.MAVLink(None).parse_buffer(data)
    ]
    assert asked == [(7, 1, 511, number, 5000.0) for number in (105.0, 105.0, 27.0, 26.0)]
    for k in range(8):
        stream.receive(controller.encode(VehicleImu(k * 500_000, *NOSE_UP)), 4 * S + k * S // 2)
        assert stream.receive(heartbeat, 4 * S + k * S // 2) == []


class _Camera:
    """A source that knows no body, with an IMU and an odometer of its own."""

    name, imu, ground_truth, frame_count = "test", ImuCalibration(), None, None
    report = SourceReport()
    rig = CameraRig(CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), None, np.eye(4), None, has_body=False)

    def __iter__(self):  # type: ignore[no-untyped-def]
        yield ImuBatch(np.array([1]), np.zeros((1, 3)), np.zeros((1, 3)))
        cov = np.eye(3)[None] * 1e-4
        yield OdometryBatch(np.array([1]), np.array([[0.5, 0.0, 2.0]]), np.array([[0.0, 0.3, 0.0]]), cov, cov)

    def close(self) -> None: ...


def test_the_controllers_frame_becomes_the_body_frame() -> None:
    # A camera that looks ahead, 0.2 m ahead of the controller: its right is y, its down is z, its ahead is x.
    T_f_c = np.array([[0.0, 0.0, 1.0, 0.2], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    calibration = ImuCalibration(gyro_noise=1e-3)
    source = with_other_imu(_Camera(), calibration, T_f_c)
    assert source.rig.has_body and source.imu is calibration
    np.testing.assert_array_equal(source.rig.T_b_c, T_f_c)
    items = list(source)
    assert len(items) == 1 and isinstance(items[0], OdometryBatch)  # its own inertial samples are left out
    # 2 m/s ahead and 0.5 to the right; a turn to the right swings a camera at the bow by 0.06 m/s more to the right
    np.testing.assert_allclose(items[0].velocity[0], [2.0, 0.5 - 0.06, 0.0], atol=1e-5)
    np.testing.assert_allclose(items[0].rate[0], [0.0, 0.0, 0.3], atol=1e-12)
    kept = with_other_imu(_Camera(), calibration, None)
    assert not kept.rig.has_body and kept.imu is calibration
