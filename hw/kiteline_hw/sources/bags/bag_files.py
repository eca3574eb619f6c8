"""Files of recorded messages: which are the parts of a bag, and in which storage and compression."""

from pathlib import Path

import zstandard

from kiteline_hw.logs.log_parts import WholeLog, numbers_of_parts
from kiteline_hw.logs.mcap_file import MOST_CHUNK_BYTES, McapFile
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.bags.bag_heads import SQLITE_MAGIC, ZSTD_MAGIC, refuse_unreadable
from kiteline_hw.sources.bags.mcap_parts import McapParts, are_parts
from kiteline_hw.sources.bags.sqlite_bag import SqliteBag
from kiteline_hw.sources.mcap_messages import BadMessage

Bag = McapFile | McapParts | SqliteBag


def open_bag(path: Path) -> Bag:
    """Open an MCAP file, a log with its later parts, a SQLite bag, or the bag in a folder. Raises SourceError."""
    if path.is_dir():
        return _bag_in_folder(path)
    refuse_unreadable(path)
    with path.open("rb") as file:
        head = file.read(len(SQLITE_MAGIC))
    return SqliteBag([path]) if head == SQLITE_MAGIC else _mcap(path)


def _mcap(path: Path) -> Bag:
    """An MCAP file; if it is the first part of a kiteline log, with the later parts beside it."""
    if not numbers_of_parts(path):
        return McapFile(path)
    log = WholeLog(path)
    return McapParts(path, log.files, log.cut)


def _bag_in_folder(folder: Path) -> Bag:
    files = sorted(folder.glob("*.mcap"))
    if len(files) > 1:
        return McapParts.in_folder(folder, files)
    if files:
        return McapFile(files[0])
    parts = sorted(folder.glob("*.db3"))
    if len(parts) > 1 and not are_parts(folder, parts):
        raise SourceError(
            f"{folder}: {len(parts)} SQLite bags: name one; no metadata.yaml lists them as parts of one bag, and they "
            "are not named BAG_0, BAG_1…"
        )
    if parts:
        return SqliteBag(parts)
    refuse_unreadable(folder)
    raise SourceError(f"{folder}: no *.mcap and no *.db3 in this folder: expected a recording")


def unpacked(message: bytes) -> bytes:
    """A message of a bag that packs each message by itself (compression mode MESSAGE); others are returned as they are.

    Raises BadMessage.
    """
    if not message.startswith(ZSTD_MAGIC):  # CDR begins with its representation, 0x00
        return message
    try:
        with zstandard.ZstdDecompressor(max_window_size=MOST_CHUNK_BYTES).stream_reader(message) as stream:
            data = bytes(stream.read(MOST_CHUNK_BYTES + 1))
    except zstandard.ZstdError as error:
        raise BadMessage(f"packed message cannot be unpacked ({error})") from error
    if len(data) > MOST_CHUNK_BYTES:
        raise BadMessage(f"packed message is larger than {MOST_CHUNK_BYTES} bytes, which is the most that is read")
    return data
