"""The parts of a recording in MCAP files, read as one: of a ROS 2 bag that was split by size or duration, BAG_0.mcap,
BAG_1.mcap…, or of a kiteline log that went on in further files, LOG.mcap, LOG_1.mcap…
"""

import re
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

from mcap.records import Channel, Schema

from kiteline_hw.logs.log_parts import log_and_part
from kiteline_hw.logs.mcap_file import McapFile, RawMessage
from kiteline_hw.ports import SourceError

_OVERLAP_NS = 200_000_000  # ns; topics are written by threads of their own, so that stamps cross where a part ends
_MOST_METADATA_BYTES = 1 << 20
_MOST_PARTS = 1000  # higher numbers in names are dates or times
_NUMBERED = re.compile(r"(.*)_(\d+)")


class McapParts:
    """The messages of all parts, with the attributes and methods of McapFile."""

    def __init__(self, path: Path, parts: list[McapFile], cut: str | None) -> None:
        """path: of the recording. parts: in order. cut: where what is read ends too early or has a gap, or None."""
        self.path = path
        self.cut = cut
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self._parts: list[tuple[McapFile, dict[int, int]]] = []  # with this object's number of each channel
        for part in parts:
            numbers = {own: self._channel(part, own) for own in sorted(part.channels)}
            for own, count in part.counts.items():
                if count and own in numbers:
                    self.counts[numbers[own]] = self.counts.get(numbers[own], 0) + count
            self._parts.append((part, numbers))
        used = [part for part in parts if any(part.counts.values())]
        self.first_ns = min((part.first_ns for part in used), default=0)
        self.last_ns = max((part.last_ns for part in used), default=0)

    @classmethod
    def in_folder(cls, folder: Path, paths: list[Path]) -> "McapParts":
        """The files of a folder. Raises SourceError if they are no parts of one bag: by names, topics and times."""
        parts = [McapFile(path) for path in paths]
        if not are_parts(folder, paths) and not _are_of_log(parts):
            raise _strangers(folder, parts, "no metadata.yaml lists them, and they are not named BAG_0, BAG_1…")
        gaps = [f"{part.path.name} is {part.cut}" for part in parts if part.cut] + _missing(paths)
        used = sorted((part for part in parts if any(part.counts.values())), key=lambda part: part.first_ns)
        for before, after in pairwise(used):
            overlap_ns = before.last_ns - after.first_ns
            if overlap_ns > min(_OVERLAP_NS, (before.last_ns - before.first_ns) // 2):
                why = f"{after.path.name} begins {overlap_ns * 1e-9:.1f} s before"
                raise _strangers(folder, parts, f"{why} {before.path.name} ends")
        topics: set[tuple[str, str]] = set()
        for part in used:
            own_topics = {_topic(part, own) for own, count in part.counts.items() if count and own in part.channels}
            if topics and not own_topics & topics:
                raise _strangers(folder, parts, f"{part.path.name} shares no topic with those before it")
            topics |= own_topics
        return cls(folder, used, "; ".join(gaps) or None)

    @property
    def notes(self) -> list[str]:
        """Damaged parts of the files."""
        return [f"{part.path.name}: {note}" for part, _ in self._parts for note in part.notes]

    def schema_of(self, channel: int) -> Schema | None:
        """The schema of a channel's messages, or None."""
        return self.schemas.get(channel)

    def messages(self, channels: Collection[int] | None = None, ordered: bool = True) -> Iterator[RawMessage]:
        """Messages of the channels (None: all), part by part, as McapFile gives those of each."""
        for part, numbers in self._parts:
            wanted = [own for own, number in numbers.items() if channels is None or number in channels]
            for message in part.messages(wanted, ordered):
                yield message._replace(channel=numbers[message.channel])

    def first(self, channel: int) -> RawMessage | None:
        """The first message of a channel."""
        return next(self.messages((channel,), ordered=False), None)

    def _channel(self, part: McapFile, own: int) -> int:
        """This object's number of a channel of a part: one a topic and schema."""
        told, schema = part.channels[own], part.schema_of(own)
        for number, channel in self.channels.items():
            known = self.schemas.get(number)
            if (channel.topic, known.name if known is not None else "") == _topic(part, own):
                return number
        number = len(self.channels) + 1
        self.channels[number] = Channel(
            id=number, topic=told.topic, message_encoding=told.message_encoding, metadata=told.metadata,
            schema_id=number if schema is not None else 0,
        )  # fmt: skip
        if schema is not None:
            self.schemas[number] = Schema(id=number, name=schema.name, encoding=schema.encoding, data=schema.data)
        return number


def _topic(part: McapFile, own: int) -> tuple[str, str]:
    """Topic and name of the schema of a channel."""
    schema = part.schema_of(own)
    return part.channels[own].topic, schema.name if schema is not None else ""


def _strangers(folder: Path, parts: list[McapFile], why: str) -> SourceError:
    return SourceError(
        f"{folder}: {len(parts)} MCAP files that are no parts of one bag ({why}): name one, or join them with "
        "`kiteline log merge OUT.mcap FILES…`"
    )


def are_parts(folder: Path, paths: list[Path]) -> bool:
    """True if the names of files in a folder, or its metadata.yaml, say that they are parts of one bag."""
    return _numbered(paths) or _listed(folder, paths)


def _are_of_log(files: list[McapFile]) -> bool:
    """True if files are named as a kiteline log and its later parts, and are logs."""
    logs = {log_and_part(file.path)[0] for file in files}
    return len(logs) == 1 and all(any(m.name == "kiteline" for m in file.metadata) for file in files)


def _numbered(paths: list[Path]) -> bool:
    """True if the files are named as rosbag2 names parts."""
    found = [_NUMBERED.fullmatch(path.stem) for path in paths]
    return all(found) and len({match[1] for match in found if match}) == 1


def _missing(paths: list[Path]) -> list[str]:
    """A line on the parts that are missing between others, by the numbers in their names; the oldest may have gone."""
    named = [log_and_part(path) for path in paths]
    numbers = {number for _, number in named}
    if len(numbers) < len(paths) or len({log for log, _ in named}) > 1 or max(numbers) >= _MOST_PARTS:
        return []
    missing = sorted(set(range(min(numbers), max(numbers))) - numbers)
    if not missing:
        return []
    listed = ", ".join(map(str, missing[:5])) + (" and more" if len(missing) > 5 else "")
    return [f"of its parts, {listed} {'is' if len(missing) == 1 else 'are'} missing"]


def _listed(folder: Path, paths: list[Path]) -> bool:
    """True if the bag's metadata.yaml names all files."""
    try:
        with (folder / "metadata.yaml").open("rb") as file:
            text = file.read(_MOST_METADATA_BYTES)
    except OSError:
        return False
    return all(path.name.encode() in text for path in paths)
