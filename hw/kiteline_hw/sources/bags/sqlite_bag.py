"""Reads ROS 2 bags in SQLite storage (`*.db3`, the default up to ROS 2 Humble), one file or the parts of a split bag.

Format: the tables `topics` and `messages` of rosbag2_storage_sqlite3. Older bags hold no message definitions, so
those of the messages that are used are in `ros2_definitions`.
"""

import re
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from mcap.records import Channel, Schema

from kiteline_hw.logs.mcap_file import MOST_CHUNK_BYTES, RawMessage
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.bags.ros2_definitions import definition_of

_EXPECTED = "expected a ROS 2 bag with the tables topics and messages"


class SqliteBag:
    """The messages of a bag, with the attributes and methods of McapFile. Raises SourceError if it is no bag.

    notes: damage that was found while messages were read.
    """

    cut: str | None = None

    def __init__(self, paths: list[Path]) -> None:
        """paths: the parts of one bag."""
        self.path = paths[0]
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.notes: list[str] = []
        self.first_ns, self.last_ns = 2**63, 0
        self._parts: list[tuple[int, Path, dict[int, int]]] = []  # first stamp, file, channel by its number of a topic
        for path in paths:
            self._open(path)
        self._parts.sort(key=lambda part: part[0])
        if not self._parts:
            self.first_ns = 0

    def schema_of(self, channel: int) -> Schema | None:
        """The definition of a channel's messages; None if it is not one of those that are used."""
        return self.schemas.get(self.channels[channel].schema_id)

    def messages(self, channels: Collection[int] | None = None, ordered: bool = True) -> Iterator[RawMessage]:
        """Messages of the channels (None: all) in order of log time; parts of a bag follow each other."""
        del ordered
        for _, path, numbers in self._parts:
            wanted = [topic for topic, channel in numbers.items() if channels is None or channel in channels]
            marks = ",".join("?" * len(wanted))
            # `length` reads no more than the head of a row, and one beyond SQLite's limit would end the query.
            data_or_size = f"CASE WHEN length(data) <= {MOST_CHUNK_BYTES} THEN data ELSE length(data) END"
            rows = f"SELECT topic_id, timestamp, {data_or_size} FROM messages WHERE topic_id IN ({marks})"
            rows += " ORDER BY timestamp, id"
            try:
                with closing(_connect(path)) as bag:
                    for topic, log_ns, data in bag.execute(rows, wanted):
                        if isinstance(data, bytes) and isinstance(log_ns, int):
                            yield RawMessage(numbers[topic], 0, log_ns, log_ns, data)
                        elif isinstance(data, int) and data > MOST_CHUNK_BYTES:
                            self._note(f"{path.name}: messages left out that are larger than {MOST_CHUNK_BYTES} bytes")
            except sqlite3.Error as error:
                self._note(f"{path.name}: damaged ({error})")

    def _note(self, text: str) -> None:
        self.notes += [] if text in self.notes else [text]

    def first(self, channel: int) -> RawMessage | None:
        """The first message of a channel."""
        return next(self.messages((channel,)), None)

    def _open(self, path: Path) -> None:
        numbers: dict[int, int] = {}
        try:
            with closing(_connect(path)) as bag:
                _check_tables(bag)
                topics = bag.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id").fetchall()
                for topic, name, kind, encoding in topics:
                    numbers[int(topic)] = self._channel(str(name), str(kind), str(encoding))
                spans = "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
                begin_ns = 2**63
                for topic, count, first_ns, last_ns in bag.execute(spans).fetchall():
                    if topic not in numbers:
                        continue
                    self.counts[numbers[topic]] = self.counts.get(numbers[topic], 0) + int(count)
                    begin_ns = min(begin_ns, int(first_ns))
                    self.last_ns = max(self.last_ns, int(last_ns))
        except (sqlite3.Error, TypeError, ValueError) as error:
            raise SourceError(f"{path}: {error}: {_EXPECTED}") from error
        self.first_ns = min(self.first_ns, begin_ns)
        self._parts.append((begin_ns, path, numbers))

    def _channel(self, topic: str, kind: str, encoding: str) -> int:
        """The channel of a topic, the same in all parts."""
        for number, channel in self.channels.items():
            if channel.topic == topic:
                return number
        number = len(self.channels) + 1
        text = definition_of(kind) or ""
        self.schemas[number] = Schema(id=number, name=kind, encoding="ros2msg", data=text.encode())
        self.channels[number] = Channel(
            id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=number
        )
        return number


def _check_tables(bag: sqlite3.Connection) -> None:
    """Raise ValueError unless what is read are tables whose values are stored: views may be computed without end."""
    for name in ("topics", "messages"):
        found = bag.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (name,)).fetchone()
        if found is None:
            raise ValueError(f"no table {name}")
        kind, sql = found
        plain = kind == "table" and re.match(r"CREATE\s+TABLE\b", str(sql), re.IGNORECASE)
        if not plain or bag.execute(f"SELECT 1 FROM pragma_table_xinfo('{name}') WHERE hidden").fetchone():
            raise ValueError(f"{name} is no plain table but computed")


def _connect(path: Path) -> sqlite3.Connection:
    """The file, opened to read only; `as_uri` escapes what a file name may hold."""
    # SQLite wants to write beside a file with a journal, which a folder that is read only forbids.
    journal = path.with_name(f"{path.name}-wal").exists()
    bag = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{'' if journal else '&immutable=1'}", uri=True)
    bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_CHUNK_BYTES)  # of a value; a record may name a gigabyte
    return bag
