"""Gives a log whose writer was ended in mid-flight the index and the end that a finished file has."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import CompressionType, Writer

from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log import CHUNK_BYTES

MENDED = "mended"  # metadata key of a log that was finished here; its value says what was wrong


def mend(path: Path) -> str | None:
    """Rewrite a cut file in place with all messages before the cut; what was wrong, or None when it was whole.

    Raises SourceError when it is no MCAP file at all.
    """
    log = McapFile(path)
    if log.cut is None:
        return None
    young = path.with_name(path.name + ".new")
    with young.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start("", "kiteline")
        for record in log.metadata:
            writer.add_metadata(record.name, {**record.metadata, MENDED: log.cut})
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
    young.replace(path)
    return log.cut
