"""The number of the batch with which a correction is to be applied: the last part of its code."""

from zlib import crc32

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import Key

MAX_BATCH = (1 << 32) - 1
MAX_MEMBERS = 1 << 20


def write_batch(out: Writer, batch: int) -> None:
    """Append the number of a batch; nothing for 0, a value that waits for no other one. Raises ValueError."""
    if not 0 <= batch <= MAX_BATCH:
        raise ValueError(f"found batch {batch}, expected 0..{MAX_BATCH}")
    if batch:
        out.varint(batch)


def read_batch(source: Reader) -> int:
    """The number of a batch, 0 where nothing is left. Raises WireError."""
    if not source.left:
        return 0
    batch = source.varint(MAX_BATCH)
    if not batch:
        raise WireError("the number of a batch is above 0")
    return batch


def checksum_of_keys(keys: list[Key]) -> int:
    """CRC-32 of the keys of a batch, in order: kind, id and part, each as 8 bytes, little endian."""
    return crc32(b"".join(number.to_bytes(8, "little") for key in sorted(keys) for number in key))
