"""Inertial samples and poses of ROS 2 are decoded as by mcap_ros2, which reads any schema, field by field."""

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.sources.bags.ros2_samples import fast_decoder
from kiteline_hw.sources.mcap_messages import read_frame_id, read_imu, read_pose, read_stamp
from tests.hw.sources.ros2_schemas import LEAVES, ROS2

IMU, POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"


def schema(name: str, text: str = "") -> Schema:
    return Schema(id=1, name=name, encoding="ros2msg", data=((text or ROS2[name]) + LEAVES).encode())


def message(frame: str, values: list[float], order: str = "<") -> bytes:
    name = frame.encode() + b"\0"
    head = struct.pack(f"{order}iII", 1_700_000_000, 999_999_999, len(name)) + name
    head += bytes(-len(head) % 8)
    return (b"\0\1" if order == "<" else b"\0\0") + b"\0\0" + head + struct.pack(f"{order}{len(values)}d", *values)


def both(message_type: Schema, data: bytes) -> list[object]:
    slow = DecoderFactory().decoder_for("cdr", message_type)
    assert slow is not None
    return [slow(data), fast_decoder(message_type, slow)(data)]


@given(st.text(max_size=12).filter(lambda t: "\0" not in t), st.floats(-1e3, 1e3), st.sampled_from("<>"))
def test_samples_are_those_of_the_general_decoder(frame: str, first: float, order: str) -> None:
    data = message(frame, [first + i for i in range(37)], order)
    slow, fast = both(schema(IMU), data)
    assert read_imu(fast, 0) == read_imu(slow, 0)
    assert read_frame_id(fast) == read_frame_id(slow)
    data = message(frame, [first + i for i in range(7)], order)
    slow, fast = both(schema(POSE), data)
    assert (read_pose(fast) == read_pose(slow)).all()
    assert read_stamp(fast, 0) == read_stamp(slow, 0) == 1_700_000_000_999_999_999


def test_a_schema_that_differs_is_read_as_it_says() -> None:
    """Ten covariances in place of nine: the floats after them lie elsewhere."""
    text = ROS2[IMU].replace("float64[9] orientation_covariance", "float64[10] orientation_covariance")
    general = DecoderFactory().decoder_for("cdr", schema(IMU, text))
    assert fast_decoder(schema(IMU, text), general) is general
    assert read_imu(general(message("imu", [float(i) for i in range(38)])), 0)[0][1][:3] == (14.0, 15.0, 16.0)


@given(st.integers(0, 340))
def test_a_cut_message_is_refused(size: int) -> None:
    decode = fast_decoder(schema(IMU), bytes)
    whole = message("body", [1.0] * 37)
    if size < len(whole):
        try:
            assert decode(whole[:size]) == whole[:size]  # without its first bytes it is no plain CDR
        except struct.error:
            assert size >= 2


def test_messages_of_a_bag_are_decoded_alike(data_dir: Path) -> None:
    file = McapFile(data_dir / "room_flight.mcap")
    for topic, read in (("/imu", lambda m: read_imu(m, 0)), ("/ground_truth", lambda m: read_pose(m).tolist())):
        (channel,) = [c for c in file.channels.values() if c.topic == topic]
        slow = DecoderFactory().decoder_for("cdr", file.schema_of(channel.id))
        fast = fast_decoder(file.schema_of(channel.id), slow)
        assert fast is not slow
        for raw, _ in zip(file.messages((channel.id,)), range(50)):
            assert read(fast(raw.data)) == read(slow(raw.data))
            with pytest.raises(struct.error):
                fast(raw.data[:-1])
