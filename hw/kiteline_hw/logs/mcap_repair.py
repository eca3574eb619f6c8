"""Completes a log whose writer was killed: adds the index and the end that a finished file has."""

from pathlib import Path

from mcap.writer import CompressionType, Writer

from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_write import CHUNK_BYTES

BEGINS = "begins"  # metadata key of a log whose beginning was cut off; its value says where it begins
REPAIRED = "mended"  # metadata key of a repaired log; its value says what was wrong


def repair(path: Path) -> str | None:
    """Rewrite a cut file in place with all messages before the cut; returns what was wrong, or None for a whole file.

    Raises SourceError if it is no MCAP file, OSError if the disk does not take the new file; the old one then stays.
    """
    log = McapFile(path)
    if log.cut is None:
        return None
    new = path.with_name(path.name + ".new")
    try:
        _write_whole(new, log, log.cut)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)  # it takes room on a disk that may be full
    return log.cut


def _write_whole(path: Path, log: McapFile, cut: str) -> None:
    """Write all messages before the cut to a new file."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start("", "kiteline")
        for record in log.metadata:
            writer.add_metadata(record.name, {**record.metadata, REPAIRED: cut})
        schemas = {0: 0}
        for number, schema in sorted(log.schemas.items()):
            schemas[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
        channels = {
            number: writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
            for number, channel in sorted(log.channels.items())
        }
        for message in log.messages(ordered=False):
            writer.add_message(
                channels[message.channel], message.log_ns, message.data, message.publish_ns, message.sequence
            )
        writer.finish()
