"""Frames of HIGHRES_IMU, recognised and parsed without pymavlink: two hundred come a second. Pure."""

import binascii
import struct

from kiteline_hw.mavlink.messages import HIGHRES_IMU, VehicleImu, is_complete_sample

_HEAD_BYTES, _CHECKSUM_BYTES = 10, 2
_PAYLOAD = struct.Struct("<Q13fHB")  # as in the dialect's layout; trailing zeros are not sent
_EXTRA = 93  # the dialect's checksum of the message's layout
_ID = HIGHRES_IMU.to_bytes(3, "little")
_FIRST = b"\xfd"
_MIRRORED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def is_sample_frame(data: bytes) -> bool:
    """True if the bytes look like one unsigned HIGHRES_IMU of MAVLink 2 and nothing else."""
    return (
        data[7:_HEAD_BYTES] == _ID
        and data[:1] == _FIRST
        and data[2] == 0
        and len(data) == _HEAD_BYTES + data[1] + _CHECKSUM_BYTES
        and data[1] <= _PAYLOAD.size
    )


def parse_sample_frame(frame: bytes) -> tuple[int, VehicleImu | None] | None:
    """System and message of a frame for which `is_sample_frame` holds; None if its checksum is wrong.

    The message is None if it holds no inertial sample.
    """
    end = len(frame) - _CHECKSUM_BYTES
    if checksum(frame[1:end] + bytes((_EXTRA,))) != frame[end] | frame[end + 1] << 8:
        return None
    values = _PAYLOAD.unpack(frame[_HEAD_BYTES:end].ljust(_PAYLOAD.size, b"\0"))
    system, component = frame[5], frame[6]
    if not is_complete_sample(values[14]):
        return system, None
    return system, VehicleImu(values[0], values[1:4], values[4:7], HIGHRES_IMU, values[15], component)


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX. binascii has the same polynomial for bits in the other order: bytes and result are mirrored."""
    mirrored = binascii.crc_hqx(data.translate(_MIRRORED), 0xFFFF)
    return _MIRRORED[mirrored >> 8] | _MIRRORED[mirrored & 0xFF] << 8
