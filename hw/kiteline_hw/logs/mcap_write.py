"""Writes MCAP files in uncompressed chunks: the bytes that the mcap package writes, for a tenth of its CPU time.

A message is packed once, its data are not copied, and a chunk is written as the pieces that it was made of. Everything
that is written once a file is left to the package's records. Format: mcap.dev/spec.
"""

import struct
from collections.abc import Mapping
from typing import Protocol
from zlib import crc32

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

CHUNK_BYTES = 64 * 1024  # of a log: a cut loses one unfinished chunk at most

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK = struct.Struct("<BQQQQIIQ")  # opcode, length, first and last time, size, CRC-32, no compression, size
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, length of the rows
_CHUNK_INDEX = struct.Struct("<BQQQQQI")  # opcode, length, first and last time, place and bytes of chunk, of offsets
_OFFSET = struct.Struct("<HQ")  # channel, place of its index
_SIZES = struct.Struct("<QIQQ")  # bytes of all indices, no compression, size, size
_RECORD_BYTES = 9  # opcode and length


class ByteStream(Protocol):
    """What takes the bytes of a file."""

    def write(self, data: bytes, /) -> int: ...
    def flush(self) -> None: ...


class McapWriter:
    """One MCAP file in a stream. Messages of a chunk whose writing fails with OSError are lost and counted.

    stream: one that then ends where it ended before (`WholeFile`), so that later chunks follow it. The head of the file
    waits for the first chunk. chunk_bytes: size above which a chunk is written. lost: messages.
    """

    def __init__(self, stream: ByteStream, chunk_bytes: int, library: str) -> None:
        self.lost = 0
        self._stream = stream
        self._chunk_bytes = chunk_bytes
        self._at = 0  # bytes of the file, the waiting ones included
        self._waiting = b""  # the head, until a chunk is written behind it
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._metadata: list[records.MetadataIndex] = []
        self._chunks = 0
        self._chunk_index = bytearray()  # of the chunks: as it is written, a tenth of what its records take
        self._counts: dict[int, int] = {}  # messages by channel
        self._lost: dict[int, int] = {}  # of them
        self._first_ns: int | None = None  # of the first message
        self._span_ns = (0, 0)  # of all messages
        self._begin_chunk()
        self._put_head(_MAGIC + _packed(records.Header("", library)))

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record, before the first message. Bytes of a file name that are no UTF-8 stand as \\udcXX."""
        texts = {key: text.encode(errors="backslashreplace").decode() for key, text in data.items()}
        packed = _packed(records.Metadata(name, texts))
        self._metadata.append(records.MetadataIndex(self._at, len(packed), name))
        self._put_head(packed)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema. Returns its number."""
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._append(_packed(schema))
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel. Returns its number."""
        channel = records.Channel(
            id=len(self._channels) + 1, topic=topic, message_encoding=encoding, metadata=dict(metadata),
            schema_id=schema,
        )  # fmt: skip
        self._channels.append(channel)
        self._append(_packed(channel))
        return channel.id

    def add_message(self, channel: int, t_ns: int, pieces: tuple[bytes, ...]) -> None:
        """Add a message, logged and published at a time. pieces: of its data."""
        sequence = self._counts.get(channel, 0)
        self._counts[channel] = sequence + 1
        if self._first_ns is None:
            self._first_ns, self._span_ns = t_ns, (t_ns, t_ns)
        rows = self._rows.get(channel)
        if rows is None:
            rows = self._rows[channel] = []
        rows += (t_ns, self._size)
        self._times.append(t_ns)
        size = _MESSAGE.size - _RECORD_BYTES
        for piece in pieces:
            size += len(piece)
        self._pieces.append(_MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence, t_ns, t_ns))
        self._pieces += pieces
        self._size += size + _RECORD_BYTES
        if self._size > self._chunk_bytes:
            self._end_chunk()

    def flush(self) -> None:
        """End the chunk, and pass all to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """End the file with its index. The stream stays open."""
        try:
            self._end_chunk()
        finally:
            self._put_index()

    def _put_index(self) -> None:
        end = _packed(records.DataEnd(0))
        start = self._at + len(end)
        groups = [
            (Opcode.SCHEMA, b"".join(map(_packed, self._schemas))),
            (Opcode.CHANNEL, b"".join(map(_packed, self._channels))),
            (Opcode.STATISTICS, _packed(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, b""),
            (Opcode.METADATA_INDEX, b"".join(map(_packed, self._metadata))),
        ]
        offsets, at = b"", start
        for opcode, data in groups:
            offsets += _packed(records.SummaryOffset(opcode, at, len(data)))
            at += len(data)
        summary = b"".join(data for _, data in groups) + offsets
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
        self._put(end + summary + _packed(records.Footer(start, at, crc32(head, crc32(summary)))) + _MAGIC)

    def _statistics(self) -> records.Statistics:
        counts = {channel: n - self._lost.get(channel, 0) for channel, n in self._counts.items()}
        return records.Statistics(
            attachment_count=0, channel_count=len(self._channels), channel_message_counts=counts,
            chunk_count=self._chunks, message_count=sum(counts.values()), metadata_count=len(self._metadata),
            message_start_time=self._span_ns[0], message_end_time=self._span_ns[1], schema_count=len(self._schemas),
        )  # fmt: skip

    def _begin_chunk(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0  # of all pieces
        self._rows: dict[int, list[int]] = {}  # time and offset of each message, by channel
        self._times: list[int] = []

    def _append(self, record: bytes) -> None:
        """Add a schema or a channel to the chunk."""
        self._pieces.append(record)
        self._size += len(record)
        if self._size > self._chunk_bytes:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the chunk and its index; nothing if it holds no message."""
        if not self._times:
            return
        pieces, size, rows, times = self._pieces, self._size, self._rows, self._times
        self._begin_chunk()
        first, last = min(times), max(times)
        self._span_ns = min(first, self._span_ns[0]), max(last, self._span_ns[1])
        crc = 0
        for piece in pieces:
            crc = crc32(piece, crc)
        head = _CHUNK.pack(Opcode.CHUNK, _CHUNK.size - _RECORD_BYTES + size, first, last, size, crc, 0, size)
        begin, at, offsets, indices = self._at, self._at + len(head) + size, dict[int, int](), list[bytes]()
        for channel, numbers in rows.items():
            offsets[channel] = at
            index = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(numbers), channel, 8 * len(numbers))
            indices += (index, struct.pack(f"<{len(numbers)}Q", *numbers))
            at += len(indices[-2]) + len(indices[-1])
        try:
            self._put(b"".join((head, *pieces, *indices)))
        except OSError:
            self.lost += len(times)
            for channel, numbers in rows.items():
                self._lost[channel] = self._lost.get(channel, 0) + len(numbers) // 2
            for record in (*self._schemas, *self._channels):  # those that were in it, too
                self._append(_packed(record))
            raise
        self._chunks += 1
        chunk = len(head) + size
        self._chunk_index += _CHUNK_INDEX.pack(
            Opcode.CHUNK_INDEX, _CHUNK_INDEX.size + _OFFSET.size * len(offsets) + _SIZES.size - _RECORD_BYTES,
            first, last, begin, chunk, _OFFSET.size * len(offsets),
        )  # fmt: skip
        self._chunk_index += b"".join(map(_OFFSET.pack, offsets, offsets.values()))
        self._chunk_index += _SIZES.pack(at - begin - chunk, 0, size, size)

    def _put_head(self, data: bytes) -> None:
        self._waiting += data
        self._at += len(data)

    def _put(self, data: bytes) -> None:
        self._stream.write(self._waiting + data if self._waiting else data)
        self._waiting = b""
        self._at += len(data)


def _packed(record: records.McapRecord) -> bytes:
    """The bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
