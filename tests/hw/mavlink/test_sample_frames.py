"""HIGHRES_IMU parsed without pymavlink, against pymavlink; and the sink, which parses samples together."""

import socket
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Attitude, Heartbeat, TimeSync, VehicleImu
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.mavlink.sample_frames import checksum, is_sample_frame, parse_sample_frame
from kiteline_hw.ports import SourceReport
from kiteline_hw.system.clock import MonotonicClock

VALUES = st.floats(width=32, allow_nan=False)
FIELDS = st.tuples(st.integers(0, 2**64 - 1), st.lists(VALUES, min_size=13, max_size=13), st.integers(0, 2**16 - 1),
                   st.integers(0, 255), st.integers(1, 255), st.integers(1, 255))  # fmt: skip


def frame(fields: tuple[int, list[float], int, int, int, int]) -> bytes:
    t_us, floats, updated, unit, system, component = fields
    message = common.MAVLink_highres_imu_message(t_us, *floats, updated, unit)
    return bytes(message.pack(common.MAVLink(None, system, component)))


@given(FIELDS)
def test_a_frame_is_parsed_as_by_pymavlink(fields: tuple[int, list[float], int, int, int, int]) -> None:
    data = frame(fields)
    generated = common.MAVLink(None)
    by_pymavlink = generated.parse_buffer(bytearray(data))[0]
    assert is_sample_frame(data)
    parsed = parse_sample_frame(data)
    assert parsed == (fields[4], VehicleImu.parse(by_pymavlink))


@given(st.binary(max_size=300))
def test_the_checksum_is_mavlinks(data: bytes) -> None:
    assert checksum(data) == common.x25crc(data).crc


@given(FIELDS, st.integers(1, 600), st.integers(1, 255))
def test_a_damaged_frame_is_no_sample(
    fields: tuple[int, list[float], int, int, int, int], position: int, flip: int
) -> None:
    data = bytearray(frame(fields))
    data[position % len(data)] ^= flip
    codec = MavlinkCodec()
    assert codec.receive(bytes(data), datagram=True) == []
    assert codec.receive(bytes(frame(fields)), datagram=True) == codec.receive(bytes(frame(fields)))


@given(st.binary(min_size=1, max_size=63), st.binary(min_size=4, max_size=4), st.booleans())
def test_any_payload_is_a_sample_or_nothing_but_never_with_a_wrong_checksum(
    payload: bytes, sender: bytes, right: bool
) -> None:
    body = bytes((len(payload), 0)) + sender + (105).to_bytes(3, "little") + payload
    crc = common.x25crc(body + bytes((common.MAVLink_highres_imu_message.crc_extra,))).crc ^ (0 if right else 0x100)
    data = b"\xfd" + body + crc.to_bytes(2, "little")
    assert is_sample_frame(data)
    parsed = parse_sample_frame(data)
    assert (parsed is not None) == right
    assert parsed is None or parsed[0] == sender[2]


@given(st.binary(max_size=80))
def test_other_bytes_are_no_sample(data: bytes) -> None:
    assert not is_sample_frame(b"\xfe" + data)


def test_samples_of_another_system_and_before_a_rest_of_a_frame() -> None:
    codec, other = MavlinkCodec(), MavlinkCodec(2, 1)
    codec.only_system = 1
    sample = VehicleImu(5, (0.0, 0.0, -9.75), (0.0, 0.5, 0.0))
    assert codec.receive(other.encode(sample)) == [] and codec.other_systems == 1
    ours = MavlinkCodec(1, 1)
    data = ours.encode(sample)
    assert codec.receive(data[:20]) == [] and not codec.holds_sample_alone(data)
    assert codec.receive(data[20:] + data) == [sample, sample]
    assert codec.holds_sample_alone(data) and codec.receive(data) == [sample]


def test_signed_samples_are_left_to_pymavlink() -> None:
    signer = common.MAVLink(None, 1, 1)
    signer.signing.secret_key, signer.signing.sign_outgoing, signer.signing.timestamp = bytes(32), True, 1
    data = bytes(common.MAVLink_highres_imu_message(1, *[0.0] * 13, 0x3F, 0).pack(signer))
    assert not is_sample_frame(data)


@pytest.fixture
def sink_and_peer():  # type: ignore[no-untyped-def]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        T_b_f = mounting("frd")
        imu = ControllerImu(np.ascontiguousarray(T_b_f[:3, :3]), 200.0, SourceReport())
        url = f"udp:127.0.0.1:{peer.getsockname()[1]}"
        with MavlinkPoseSink(url, T_b_f, MonotonicClock(), imu=imu) as sink:
            yield sink, peer, peer.recvfrom(2048)[1]


def test_samples_are_taken_in_order_with_their_arrival_and_answers_do_not_wait(sink_and_peer) -> None:  # type: ignore[no-untyped-def]
    sink, peer, address = sink_and_peer
    codec = MavlinkCodec(1, 1)
    peer.sendto(codec.encode(Heartbeat(2, 3)), address)
    sent_ns = time.monotonic_ns()
    for k in range(10):
        peer.sendto(codec.encode(VehicleImu(1_000_000 + k, (0.0, 0.0, -9.75), (0.25 * k, 0.0, 0.0))), address)
        if k == 5:
            peer.sendto(codec.encode(Attitude(1000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))), address)
    asked_s = time.monotonic()
    peer.sendto(codec.encode(TimeSync(0, 77)), address)
    while not any(isinstance(m, TimeSync) and m.ts1_ns == 77 for m in codec.receive(peer.recv(2048), datagram=True)):
        assert time.monotonic() - asked_s < 5.0
    answered_ns = time.monotonic_ns()
    time.sleep(0.02)
    batch = sink.take_imu(time.monotonic_ns())
    np.testing.assert_array_equal(batch.gyro[:, 0], 0.25 * np.arange(10))
    assert sent_ns < batch.t_ns[0] and np.all(np.diff(batch.t_ns) > 0) and batch.t_ns[-1] < answered_ns


def test_samples_that_nobody_takes_do_not_pile_up(sink_and_peer) -> None:  # type: ignore[no-untyped-def]
    sink, peer, address = sink_and_peer
    codec = MavlinkCodec(1, 1)
    peer.sendto(codec.encode(Heartbeat(2, 3)), address)
    for k in range(50):
        peer.sendto(codec.encode(VehicleImu(1_000_000 + 5000 * k, (0.0, 0.0, -9.75), (0.0, 0.0, 0.0))), address)
    end_s = time.monotonic() + 5.0
    while sink._samples or sink._session._messages < 51:  # parsed at a tick
        assert time.monotonic() < end_s
        time.sleep(0.01)
