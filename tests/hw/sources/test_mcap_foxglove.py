"""Recordings with Foxglove's schemas, in both encodings."""

import base64
import json
from collections.abc import MutableSequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from kiteline_core.geometry.cameras import Lens
from kiteline_hw.sources.open import open_source
from tests.hw.sources.camera_messages import START_NS, STEP_NS, T_B_L, T_L_R, D, picture, png, quaternion, read, xyz


def foxglove_messages(n: int = 5) -> list[tuple[int, str, Any]]:
    out: list[tuple[int, str, Any]] = []

    def stamp(message: Any, t_ns: int) -> Any:
        message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 10**9)
        return message

    transforms = FrameTransforms()
    for parent, child, t in (("base", "l", T_B_L), ("l", "r", T_L_R)):
        item = transforms.transforms.add(parent_frame_id=parent, child_frame_id=child)
        for name, value in xyz(t[:3, 3]).items():
            setattr(item.translation, name, value)
        for name, value in quaternion(t).items():
            setattr(item.rotation, name, value)
    out.append((START_NS, "/transforms", transforms))
    for side in "lr":
        k = np.array([[60.0, 0, 32], [0, 61, 24], [0, 0, 1]])
        calibration = CameraCalibration(frame_id=side, width=64, height=48, distortion_model="plumb_bob", D=(*D, 0.0),
                                        K=k.ravel(), P=np.hstack([k, np.zeros((3, 1))]).ravel())  # fmt: skip
        out.append((START_NS, f"/{side}/calibration", stamp(calibration, START_NS)))
    for i in range(n):
        t_ns = START_NS + i * STEP_NS
        left = CompressedImage(frame_id="l", format="png", data=png(picture(i)))
        right = RawImage(frame_id="r", width=64, height=48, encoding="mono8", step=64, data=picture(100 + i).tobytes())
        truth = PoseInFrame(frame_id="world")
        truth.pose.position.x = float(i)
        truth.pose.orientation.w = 1.0
        for topic, message in (("/l/image", left), ("/r/image", right), ("/truth", truth)):
            out.append((t_ns, topic, stamp(message, t_ns)))
    return out


def to_json(message: Any) -> Any:
    """Foxglove's JSON: stamps as sec and nsec, bytes as base64."""
    if message.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
        return {"sec": message.seconds, "nsec": message.nanos}
    out = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if isinstance(value, MutableSequence):
            value = [to_json(v) if field.message_type else v for v in value]
        elif field.message_type:
            value = to_json(value)
        elif isinstance(value, bytes):
            value = base64.b64encode(value).decode()
        out[field.name] = value
    return out


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_recordings(tmp_path: Path, encoding: str) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        for t_ns, topic, message in foxglove_messages():
            if topic not in channels:
                name = message.DESCRIPTOR.full_name
                proto = build_file_descriptor_set(type(message)).SerializeToString()
                schema = ("protobuf", proto) if encoding == "protobuf" else ("jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, encoding, writer.register_schema(name, *schema))
            data = message.SerializeToString() if encoding == "protobuf" else json.dumps(to_json(message)).encode()
            writer.add_message(channels[topic], t_ns, data, t_ns)
        writer.finish()
    source = open_source(str(tmp_path / "a.mcap"))
    frames, _ = read(source)
    assert len(frames) == 5 and source.rig.has_body and source.imu is None
    for i, frame in enumerate(frames):
        assert frame.t_ns == START_NS + i * STEP_NS and frame.right is not None
        np.testing.assert_array_equal(frame.left, picture(i))
        np.testing.assert_array_equal(frame.right, picture(100 + i))
    np.testing.assert_allclose(source.rig.T_b_c, T_B_L, atol=1e-12)
    assert source.rig.T_c_r is not None
    np.testing.assert_allclose(source.rig.T_c_r, T_L_R, atol=1e-12)
    assert source.rig.left.lens is Lens.RADTAN and source.rig.left.distortion == (*D, 0.0)
    np.testing.assert_array_equal(source.ground_truth.T_w_b[:, 0, 3], np.arange(5))
