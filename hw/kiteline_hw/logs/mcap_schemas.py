"""The message types of our logs: Foxglove's protobuf schemas where one fits, and small ones of our own.

`kiteline.Blob` {bytes data}: opaque bytes. `kiteline.Fields` {string text, double numbers[]}: named values; text is a
JSON object {fields: plain values by name, arrays: lengths by name}, and the arrays stand in numbers, in that order.
`kiteline.Imu` {sfixed64 t_ns[], double gyro[], double accel[]}: a batch of samples. `kiteline.Odometry` {sfixed64
t_ns[], double velocity[], rate[], velocity_cov[], rate_cov[]}: a batch of odometer samples in the body frame. All are
protobuf, so that viewers that do not know them can still open the log.
"""

from typing import Any

from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    Grid_pb2,
    Log_pb2,
    PoseInFrame_pb2,
    PosesInFrame_pb2,
)
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap_protobuf.schema import build_file_descriptor_set

CompressedImage = CompressedImage_pb2.CompressedImage
CameraCalibration = CameraCalibration_pb2.CameraCalibration
FrameTransform = FrameTransform_pb2.FrameTransform
PoseInFrame = PoseInFrame_pb2.PoseInFrame
PosesInFrame = PosesInFrame_pb2.PosesInFrame
Grid = Grid_pb2.Grid
Log = Log_pb2.Log

_F = FieldDescriptorProto
_OWN = ("Blob", "Fields", "Imu", "Odometry")


def _own_messages() -> tuple[Any, ...]:
    file = FileDescriptorProto(name="kiteline.proto", package="kiteline", syntax="proto3")
    blob = file.message_type.add(name="Blob")
    blob.field.add(name="data", number=1, type=_F.TYPE_BYTES, label=_F.LABEL_OPTIONAL)
    fields = file.message_type.add(name="Fields")
    fields.field.add(name="text", number=1, type=_F.TYPE_STRING, label=_F.LABEL_OPTIONAL)
    fields.field.add(name="numbers", number=2, type=_F.TYPE_DOUBLE, label=_F.LABEL_REPEATED)
    imu = file.message_type.add(name="Imu")
    imu.field.add(name="t_ns", number=1, type=_F.TYPE_SFIXED64, label=_F.LABEL_REPEATED)
    imu.field.add(name="gyro", number=2, type=_F.TYPE_DOUBLE, label=_F.LABEL_REPEATED)
    imu.field.add(name="accel", number=3, type=_F.TYPE_DOUBLE, label=_F.LABEL_REPEATED)
    odometry = file.message_type.add(name="Odometry")
    odometry.field.add(name="t_ns", number=1, type=_F.TYPE_SFIXED64, label=_F.LABEL_REPEATED)
    for number, name in enumerate(("velocity", "rate", "velocity_cov", "rate_cov"), 2):
        odometry.field.add(name=name, number=number, type=_F.TYPE_DOUBLE, label=_F.LABEL_REPEATED)
    pool = DescriptorPool()
    pool.Add(file)
    return tuple(GetMessageClass(pool.FindMessageTypeByName(f"kiteline.{name}")) for name in _OWN)


Blob, Fields, Imu, Odometry = _own_messages()


_schema_data: dict[str, bytes] = {}
_tags: dict[tuple[Any, str], int] = {}  # first bytes of fields, by message and name


def schema_data(message_class: Any) -> bytes:
    """The FileDescriptorSet of a message class, as an MCAP schema holds it."""
    name: str = message_class.DESCRIPTOR.full_name
    if name not in _schema_data:
        _schema_data[name] = build_file_descriptor_set(message_class).SerializeToString()
    return _schema_data[name]


def bytes_field(message_class: Any, name: str, data: bytes) -> tuple[bytes, bytes]:
    """A field of bytes, text or packed numbers in protobuf's wire format, in two pieces to be appended to a message.

    The result equals setting the field, without the copies of a large image that setting and serialising would make.
    """
    tag = _tags.get((message_class, name))
    if tag is None:
        tag = _tags[message_class, name] = message_class.DESCRIPTOR.fields_by_name[name].number << 3 | 2
    head = bytearray((tag,))
    size = len(data)
    while size > 0x7F:
        head.append(size & 0x7F | 0x80)
        size >>= 7
    head.append(size)
    return bytes(head), data
