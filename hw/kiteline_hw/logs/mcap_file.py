"""Reads the records of an MCAP file, also of a cut one: by its index, else by scanning it from the front.

A cut file yields all messages before the cut, also those of the chunk that was cut. A damaged chunk is skipped and
noted. Memory holds one chunk, or the chunks that overlap in time if messages are read in order. Format: mcap.dev/spec.
"""

import heapq
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Metadata, Schema

from kiteline_core.errors import INPUT_FAULTS
from kiteline_hw.ports import SourceError

MAGIC = b"\x89MCAP0\r\n"
_RUN_BYTES = 1 << 20  # bytes; messages outside of chunks are read in runs of this size
MOST_CHUNK_BYTES = 1 << 26  # of a chunk, packed and unpacked, and of a message outside of one; writers take 1 MB
_MOST_DEFINITION_BYTES = 1 << 24  # of a schema, channel or metadata record
_MOST_HELD_BYTES = 1 << 30  # of messages that wait for others whose chunks overlap theirs in time
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")


class RawMessage(NamedTuple):
    """A message as stored in the file."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class _Span:
    """A chunk, or a run of messages outside of chunks: position, range of log times, and channels (None: unknown)."""

    offset: int
    length: int
    first_ns: int
    last_ns: int
    chunk: bool
    channels: frozenset[int] | None


class McapFile:
    """An MCAP file, open only while it is read. Raises SourceError if it is none.

    cut: where a cut file ends, or None. notes: damaged parts.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}  # messages by channel
        self.metadata: list[Metadata] = []
        self.cut: str | None = None
        self.notes: list[str] = []
        self.indexed = False
        self.first_ns = self.last_ns = 0
        self._spans: list[_Span] = []
        if path.is_dir():
            first = min((file.name for file in path.glob("*.mcap")), key=len, default=None)
            below = [str(file) for file in sorted(path.glob("*/*.mcap"))[:2]]
            none = f"it has none; below it are {' and '.join(below)}" if below else "it has none"
            hint = f"such as {path / first}; later parts of a log are read with its first" if first else none
            raise SourceError(f"{path}: a folder: expected one of its *.mcap files, {hint}")
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
                if head != MAGIC:
                    raise SourceError(f"{path}: no MCAP file: starts with {head!r}" if head else f"{path}: empty file")
                self._size = path.stat().st_size
                if not self._read_index(file):
                    self._scan(file)
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror}") from error
        used = [span for span in self._spans if span.last_ns]
        if used:
            self.first_ns = min(span.first_ns for span in used)
            self.last_ns = max(span.last_ns for span in used)

    def schema_of(self, channel: int) -> Schema | None:
        """The schema of a channel's messages, or None."""
        return self.schemas.get(self.channels[channel].schema_id)

    def messages(self, channels: Collection[int] | None = None, ordered: bool = True) -> Iterator[RawMessage]:
        """Messages of the channels (None: all), in order of log time, or (ordered=False) in file order."""
        wanted = None if channels is None else frozenset(channels)
        spans = [s for s in self._spans if wanted is None or s.channels is None or s.channels & wanted]
        with self.path.open("rb") as file:
            if ordered:
                yield from self._merged(file, spans, wanted)
            else:
                for span in spans:
                    yield from self._span_messages(file, span, wanted)

    def _merged(self, file: BinaryIO, spans: list[_Span], wanted: frozenset[int] | None) -> Iterator[RawMessage]:
        heap: list[tuple[int, int, RawMessage]] = []
        order = held_bytes = 0
        for span in sorted(spans, key=lambda s: (s.first_ns, s.offset)):
            while heap and heap[0][0] < span.first_ns:
                message = heapq.heappop(heap)[2]
                held_bytes -= len(message.data)
                yield message
            for message in self._span_messages(file, span, wanted):
                heapq.heappush(heap, (message.log_ns, order, message))
                order += 1
                held_bytes += len(message.data)
            if held_bytes > _MOST_HELD_BYTES:
                raise SourceError(f"{self.path}: more than {_MOST_HELD_BYTES} bytes of messages overlap in time")
        while heap:
            yield heapq.heappop(heap)[2]

    def first(self, channel: int) -> RawMessage | None:
        """The first message of a channel in the file."""
        return next(self.messages((channel,), ordered=False), None)

    def _read_index(self, file: BinaryIO) -> bool:
        """Find spans, schemas and channels from the index; False if there is no complete one."""
        try:
            file.seek(0)
            reader = SeekingReader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes or not summary.channels:
                return False
            self.metadata = list(reader.iter_metadata())
        except (McapError, ValueError, KeyError, OSError, *INPUT_FAULTS):
            return False
        if sum(summary.statistics.channel_message_counts.values()) and not summary.schemas:
            return False
        self.schemas, self.channels = dict(summary.schemas), dict(summary.channels)
        self.counts = dict(summary.statistics.channel_message_counts)
        for index in sorted(summary.chunk_indexes, key=lambda i: i.chunk_start_offset):
            if index.chunk_start_offset + index.chunk_length > self._size:
                return False
            channels = frozenset(index.message_index_offsets) or None
            where = (index.chunk_start_offset, index.chunk_length, index.message_start_time, index.message_end_time)
            self._spans.append(_Span(*where, True, channels))
        self.indexed = True
        return True

    def _scan(self, file: BinaryIO) -> None:
        """Find spans, schemas and channels from the front up to the end or the cut."""
        self._spans, self.metadata = [], []
        offset = len(MAGIC)
        run_start, run_times, run_channels = 0, [0, 0], set[int]()

        def end_run() -> None:
            nonlocal run_start, run_times, run_channels
            if run_start:
                length = offset - run_start
                self._spans.append(_Span(run_start, length, run_times[0], run_times[1], False, frozenset(run_channels)))
            run_start, run_times, run_channels = 0, [0, 0], set()

        while True:
            file.seek(offset)
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self.cut = f"cut after {self._size} bytes, without the end that a finished file has"
                break
            opcode, length = _RECORD.unpack(head)
            end = offset + _RECORD.size + length
            if opcode == Opcode.MESSAGE and end <= self._size and _MESSAGE.size <= length <= MOST_CHUNK_BYTES:
                channel, _, log_ns, _ = _MESSAGE.unpack(file.read(_MESSAGE.size))
                if not run_start:
                    run_start, run_times = offset, [log_ns, log_ns]
                run_times = [min(run_times[0], log_ns), max(run_times[1], log_ns)]
                run_channels.add(channel)
                self.counts[channel] = self.counts.get(channel, 0) + 1
                offset = end
                if offset - run_start > _RUN_BYTES:
                    end_run()
                continue
            end_run()
            if opcode == Opcode.MESSAGE and end <= self._size and length > MOST_CHUNK_BYTES:
                self._note(f"message of {length} bytes at byte {offset} left out, expected at most {MOST_CHUNK_BYTES}")
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                file.seek(-len(MAGIC), os.SEEK_END)
                if file.read() != MAGIC:
                    self.cut = f"cut after {self._size} bytes, inside its index: no message is lost"
                break
            if opcode == 0 or (opcode > Opcode.DATA_END and opcode < 0x80):
                self.cut = f"damaged at byte {offset} of {self._size}"
                break
            if opcode == Opcode.CHUNK:
                self._add_chunk(file, offset, min(end, self._size) - offset)
            if end > self._size:
                self.cut = f"cut after {self._size} bytes, inside a record that needs {end - self._size} more"
                break
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA) and length <= _MOST_DEFINITION_BYTES:
                self._read_definition(opcode, file.read(length))
            offset = end
        end_run()

    def _add_chunk(self, file: BinaryIO, offset: int, length: int) -> None:
        span = _Span(offset, length, 0, 0, True, None)
        channels: set[int] = set()
        first_ns, last_ns = 2**64, 0
        for message in self._span_messages(file, span, None):
            channels.add(message.channel)
            self.counts[message.channel] = self.counts.get(message.channel, 0) + 1
            first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
        if channels:
            self._spans.append(_Span(offset, length, first_ns, last_ns, True, frozenset(channels)))

    def _read_definition(self, opcode: int, body: bytes) -> None:
        """Read a schema, channel or metadata record."""
        try:
            stream = ReadDataStream(BytesIO(body))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.METADATA:
                self.metadata.append(Metadata.read(stream))
            else:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
        except (McapError, ValueError, *INPUT_FAULTS) as error:
            self._note(f"unreadable schema, channel or metadata ({error})")

    def _span_messages(self, file: BinaryIO, span: _Span, wanted: frozenset[int] | None) -> Iterator[RawMessage]:
        if span.length > MOST_CHUNK_BYTES + _RUN_BYTES:
            self._note(f"chunk of {span.length} bytes at byte {span.offset}, expected at most {MOST_CHUNK_BYTES}")
            return
        file.seek(span.offset)
        body = file.read(span.length)
        if span.chunk:
            body = self._decompress(body, span.offset)
        at, size = 0, len(body)
        while at + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(body, at)
            at += _RECORD.size
            if at + length > size:
                return
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    self._note(f"damaged message near byte {span.offset}")
                    return
                channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(body, at)
                if (wanted is None or channel in wanted) and channel in self.channels:
                    data = body[at + _MESSAGE.size : at + length]
                    yield RawMessage(channel, sequence, log_ns, publish_ns, data)
            elif opcode == 0:
                self._note(f"damaged chunk at byte {span.offset}")
                return
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and not self.indexed:
                self._read_definition(opcode, body[at : at + length])
            at += length

    def _decompress(self, record: bytes, offset: int) -> bytes:
        """The records in a chunk; only those before the cut of a cut chunk, and none of a damaged one."""
        try:
            _, _, size, crc, name_length = _CHUNK.unpack_from(record, _RECORD.size)
            at = _RECORD.size + _CHUNK.size
            compression = record[at : at + name_length].decode()
            (stored,) = struct.unpack_from("<Q", record, at + name_length)
            packed = record[at + name_length + 8 :][:stored]
            whole = len(packed) == stored
            if size > MOST_CHUNK_BYTES:
                raise ValueError(f"{size} bytes, expected at most {MOST_CHUNK_BYTES}")
            if compression == "":
                body = packed
            elif compression == "zstd":
                with zstandard.ZstdDecompressor(max_window_size=MOST_CHUNK_BYTES).stream_reader(packed) as stream:
                    body = stream.read(size)
            elif compression == "lz4":
                body = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
            else:
                raise ValueError(f"unknown compression {compression!r}")
        except (ValueError, RuntimeError, zstandard.ZstdError, *INPUT_FAULTS) as error:
            self._note(f"damaged chunk at byte {offset} ({error})")
            return b""
        if whole and crc and zlib.crc32(body) != crc:
            self._note(f"damaged chunk at byte {offset} (checksum differs)")
            return b""
        return body

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)
