"""`kiteline log info|recover|cut|merge`: inspect and repair MCAP files, kiteline's and others.

Messages, schemas, channels and metadata are copied unchanged; attachments are dropped.
"""

import argparse
import heapq
import json
from collections.abc import Iterable, Iterator
from itertools import count, pairwise
from pathlib import Path

from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from kiteline_core.wording import counted
from kiteline_hw.logs.mcap_file import McapFile, RawMessage
from kiteline_hw.logs.mcap_repair import BEGINS, REPAIRED
from kiteline_hw.ports import SourceError
from kiteline_lab.outputs.out_file import whole_file

_LATEST_S = 1e9  # s from the start of a log: 30 years are later than any end
_LASTING = ("kiteline.Rig", "sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration")


def main(argv: list[str]) -> int:
    """Run `kiteline log`; the exit status. Raises SourceError."""
    p = argparse.ArgumentParser(prog="kiteline log", description="Inspect and repair logs (MCAP files).")
    commands = p.add_subparsers(dest="command", required=True, metavar="info|recover|cut|merge")
    info = commands.add_parser("info", help="list topics and metadata, and say whether the file is complete")
    info.add_argument("file", metavar="FILE", type=Path)
    info.add_argument("--json", action="store_true", help="as JSON")
    recover = commands.add_parser("recover", help="copy everything readable in a cut or damaged file to a complete one")
    recover.add_argument("file", metavar="FILE", type=Path)
    recover.add_argument("out", metavar="OUT", type=Path)
    cut = commands.add_parser("cut", help="copy an interval of time, with the calibration that applies to it")
    cut.add_argument("file", metavar="FILE", type=Path)
    cut.add_argument("out", metavar="OUT", type=Path)
    cut.add_argument("--from", dest="begin_s", metavar="S", type=float, default=0.0, help="seconds from the start")
    cut.add_argument("--to", dest="end_s", metavar="S", type=float, default=float("inf"), help="seconds from the start")
    merge = commands.add_parser("merge", help="merge several files into one, in order of time")
    merge.add_argument("out", metavar="OUT", type=Path)
    merge.add_argument("files", metavar="FILE", type=Path, nargs="+")
    for command in (recover, cut, merge):
        command.add_argument("--force", action="store_true", help="overwrite OUT")
    o = p.parse_args(argv)
    if o.command == "info":
        return _info(o.file, o.json)
    if o.command == "recover":
        return _recover(o.file, o.out, o.force)
    if o.command == "cut":
        return _cut(o.file, o.out, o.begin_s, o.end_s, o.force)
    return _merge(o.out, o.files, o.force)


def _info(path: Path, as_json: bool) -> int:
    file = McapFile(path)
    if file.indexed:
        for _ in file.messages(ordered=False):
            pass  # reading is the check: damaged chunks are added to file.notes
    topics = []
    span_s = (file.last_ns - file.first_ns) * 1e-9
    for number, channel in sorted(file.channels.items(), key=lambda item: item[1].topic):
        schema, messages = file.schema_of(number), file.counts.get(number, 0)
        hz = round(messages / span_s, 1) if span_s > 0 and messages > 1 else None
        name = schema.name if schema is not None else ""
        topics.append(
            {
                "topic": channel.topic,
                "messages": messages,
                "hz": hz,
                "schema": name,
                "encoding": channel.message_encoding,
            }
        )
    facts = {
        "file": str(path),
        "bytes": path.stat().st_size,
        "seconds": round(span_s, 6),
        "first_ns": file.first_ns,
        "last_ns": file.last_ns,
        "indexed": file.indexed,
        "cut": file.cut,
        "damage": file.notes,
        "metadata": {record.name: record.metadata for record in file.metadata},
        "topics": topics,
    }
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        _print(facts, topics, file)
    return 0


def _print(facts: dict[str, object], topics: list[dict[str, object]], file: McapFile) -> None:
    state = file.cut or ("whole, with index" if file.indexed else "whole, without index")
    print(f"{facts['file']}: {facts['seconds']:.1f} s, {facts['bytes']} bytes, {state}")
    for note in file.notes:
        print(f"  {note}")
    if file.cut or file.notes:
        print("  mend it with: kiteline log recover FILE OUT")
    for record in file.metadata:
        for key, text in record.metadata.items():
            value = " ".join(text.split())
            print(f"  {record.name}.{key}: {value if len(value) <= 100 else value[:97] + '...'}")
    width = max((len(str(t["topic"])) for t in topics), default=0)
    for t in topics:
        hz = f"{t['hz']:.1f} Hz" if t["hz"] is not None else ""
        print(f"  {t['topic']:{width}}  {t['messages']:>8}  {hz:>10}  {t['schema']} ({t['encoding']})")


def _recover(path: Path, out: Path, force: bool) -> int:
    file = McapFile(path)
    with whole_file(out, force=force) as part:
        written = _write(part, [file], ((0, m) for m in file.messages(ordered=False)), [""])
    print(f"{out}: {counted(written, 'message')}; {path} was {file.cut or 'whole'}")
    for note in file.notes:
        print(f"  {note}")
    return 0


def _cut(path: Path, out: Path, begin_s: float, end_s: float, force: bool) -> int:
    end_s = min(end_s, _LATEST_S)
    if not -_LATEST_S < begin_s < end_s:
        raise SourceError(f"nothing lies between {begin_s:g} s and {end_s:g} s: expected --from before --to")
    file = McapFile(path)
    begin_ns = file.first_ns + round(begin_s * 1e9)
    end_ns = file.first_ns + round(end_s * 1e9)
    if begin_ns > file.last_ns:
        raise SourceError(
            f"{path} ends after {(file.last_ns - file.first_ns) * 1e-9:.1f} s: nothing from {begin_s:g} s"
        )
    with whole_file(out, force=force) as part:
        stretch = ((0, m) for m in _interval(file, begin_ns, end_ns))
        begins = f"{begin_s:g} s after the start" if begin_ns > file.first_ns else ""
        written = _write(part, [file], stretch, [""], begins)
    print(f"{out}: {counted(written, 'message')}")
    return 0


def _interval(file: McapFile, begin_ns: int, end_ns: int) -> Iterator[RawMessage]:
    """Messages of an interval; first the latest calibration and static transforms from before it, at its start."""
    lasting = [c for c in file.channels if _is_lasting(file, c)]
    latest: dict[int, list[RawMessage]] = {}
    for m in file.messages(lasting):
        if m.log_ns < begin_ns:
            kept = latest.setdefault(m.channel, [])
            if "static" not in file.channels[m.channel].topic:
                kept.clear()
            kept.append(m)
    for messages in latest.values():
        for m in messages:
            yield m._replace(log_ns=begin_ns, publish_ns=begin_ns)
    for m in file.messages():
        if begin_ns <= m.log_ns <= end_ns:
            yield m


def _is_lasting(file: McapFile, channel: int) -> bool:
    schema = file.schema_of(channel)
    return "static" in file.channels[channel].topic or (schema is not None and schema.name in _LASTING)


def _merge(out: Path, paths: list[Path], force: bool) -> int:
    files = [McapFile(path) for path in paths]
    merged = heapq.merge(*map(_numbered, count(), files), key=lambda item: (item[1].log_ns, item[0]))
    with whole_file(out, force=force) as part:
        written = _write(part, files, merged, _prefixes(files))
    print(f"{out}: {counted(written, 'message')} of {counted(len(paths), 'file')}")
    return 0


def _numbered(number: int, file: McapFile) -> Iterator[tuple[int, RawMessage]]:
    for message in file.messages():
        yield number, message


def _prefixes(files: list[McapFile]) -> list[str]:
    """Prefix of the topics of each file: empty for parts of one recording, its name where files overlap in time."""
    spans = sorted((f.first_ns, f.last_ns) for f in files if f.counts)
    topics = [c.topic for f in files for c in f.channels.values()]
    overlap = any(a[1] > b[0] for a, b in pairwise(spans))
    if not overlap or len(set(topics)) == len(topics):
        return [""] * len(files)
    names = [f.path.parent.name if f.path.stem == "log" else f.path.stem for f in files]
    return [f"/{name}" if names.count(name) == 1 else f"/{name}_{i}" for i, name in enumerate(names)]


def _write(
    path: Path, files: list[McapFile], messages: Iterable[tuple[int, RawMessage]], prefixes: list[str], begins: str = ""
) -> int:
    """Write messages (number of file, message); returns the count. Equal channels of several files become one.

    What is taken from a cut file says so in its metadata, as a repaired log does: its last step may be incomplete. So
    does what `begins` later than its file (in words; "" if it does not): it cannot be replayed.
    """
    written = 0
    try:
        with path.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD)
            writer.start("", "kiteline")
            _write_metadata(writer, files, begins)
            channels = _Channels(writer, files, prefixes)
            for number, m in messages:
                writer.add_message(channels.number_of(number, m.channel), m.log_ns, m.data, m.publish_ns, m.sequence)
                written += 1
            writer.finish()
    except OSError as error:
        raise SourceError(f"{path}: cannot be written: {error.strerror}") from error
    return written


def _write_metadata(writer: Writer, files: list[McapFile], begins: str) -> None:
    first_ns = min(file.first_ns for file in files)
    for file in files:
        damage = {} if file.cut is None else {REPAIRED: file.cut}
        if begins:
            damage[BEGINS] = begins
        for record in file.metadata:
            facts = {**record.metadata, **damage}
            if file.first_ns > first_ns:
                facts.pop(BEGINS, None)  # it goes on where another part ends
            writer.add_metadata(record.name, facts)


class _Channels:
    """The channels of a new file, each added with its first message."""

    def __init__(self, writer: Writer, files: list[McapFile], prefixes: list[str]) -> None:
        self._writer, self._files, self._prefixes = writer, files, prefixes
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int, str], int] = {}
        self._known: dict[tuple[int, int], int] = {}

    def number_of(self, file: int, channel: int) -> int:
        """The number here of a file's channel."""
        if (file, channel) not in self._known:
            self._known[file, channel] = self._register(self._files[file], channel, self._prefixes[file])
        return self._known[file, channel]

    def _register(self, file: McapFile, number: int, prefix: str) -> int:
        channel = file.channels[number]
        schema = self._schema(file.schema_of(number))
        name = (prefix + channel.topic, channel.message_encoding, schema, json.dumps(channel.metadata, sort_keys=True))
        if name not in self._channels:
            self._channels[name] = self._writer.register_channel(*name[:3], channel.metadata)
        return self._channels[name]

    def _schema(self, schema: Schema | None) -> int:
        if schema is None:
            return 0
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(*key)
        return self._schemas[key]
