"""Records to keys and codes, and back. A code holds everything of a record but its key."""

from collections import deque

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import RECORD_TYPES, Key, Record
from kiteline_core.errors import INPUT_FAULTS

_KEPT = 32  # records: all sections of a keyframe, and those that were tried
_measured: deque[tuple[Record, bytes]] = deque(
    maxlen=_KEPT
)  # records whose length was asked for last, with their codes


def key(record: Record) -> Key:
    """The name under which a record is shared."""
    return record.key()


def encode(record: Record) -> bytes:
    """The code of a record: quantised, without its key. Raises ValueError for values that have no code."""
    for known, code in tuple(_measured):
        if known is record:
            return code
    out = Writer()
    record.write(out)
    return out.bytes()


def length(record: Record) -> int:
    """Bytes of a record's code. `encode` of the very same record then returns that code; records are never changed."""
    code = encode(record)
    keep(record, code)
    return len(code)


def keep(record: Record, code: bytes) -> None:
    """Keep the code of a record for `encode` of the very same one."""
    _measured.append((record, code))


def decode(key: Key, code: bytes) -> Record:
    """The record of a key and a code; `encode` gives the same code again. Raises WireError, on any bytes."""
    record_type = RECORD_TYPES.get(key.kind)
    if record_type is None:
        raise WireError(f"kind {key.kind} is unknown; known are {sorted(RECORD_TYPES)}")
    if not 0 <= key.id <= record_type.ID.max_id or not 0 <= key.part < record_type.PARTS:
        raise WireError(f"{key} is out of range")
    source = Reader(code)
    try:
        record = record_type.read(source, key)
    except INPUT_FAULTS as error:
        raise WireError(f"the code of {key} cannot be read ({error!r})") from error
    source.end()
    return record
