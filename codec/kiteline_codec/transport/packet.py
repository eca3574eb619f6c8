"""One packet: a header of optional fields, then values. See SPEC.md, "Packets"."""

from dataclasses import dataclass
from zlib import crc32

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema import Key, WireError

PROTOCOL_VERSION = 7
CRC_BYTES = 4
DIGEST_BYTES = 16
MASK_BITS = 64  # packets before the last one that an acknowledgement covers
MAX_HEADER_BYTES = 64  # of a packet with values, checksum included
MAX_KIND = 63
MAX_ITEM_BYTES = 40  # of an item's own header
MAX_PACKET_BYTES = 1 << 16
MAX_VERSION = (1 << 63) - 1

_FLAG_ACK = 1
_FLAG_DIGEST = 2
_FLAG_VERIFIED = 4
_FLAG_RESYNC = 8
_FLAG_RESET = 16
_FLAG_VALUES = 32
_FLAGS = 63
_FRAGMENT = 64
_REMOVED = 128
_RESIDUAL = _FRAGMENT | _REMOVED


class VersionError(WireError):
    """An undamaged packet of another protocol version."""


@dataclass(frozen=True, slots=True)
class Header:
    """The fields of a packet beside its values. A field that is None is not in the packet."""

    session: int  # of the sender, above 0
    peer: int  # session of the receiver as the sender knows it; 0: a greeting, sent while it knows none
    ack: tuple[int, int] | None = None  # last packet received, and bit i set where packet last - 1 - i was not
    digest: tuple[int, bytes] | None = None  # the sender's newest version, all of it acknowledged, and its digest
    verified: int | None = None  # the receiver's newest version whose digest the sender found equal
    resync: int | None = None  # the receiver's newest version whose digest the sender found different
    reset: int | None = None  # values of the sender up to this version are void
    values: tuple[int, int] | None = None  # number of the packet, and watermark: all versions up to it have arrived


@dataclass(frozen=True, slots=True)
class Item:
    """A value, a fragment of one, or a removal (total is None).

    residual: the data stand for the code in fewer bytes.
    """

    key: Key
    version: int
    total: int | None
    offset: int
    data: bytes
    residual: bool = False

    @property
    def whole(self) -> bool:
        """True if all bytes of the value are in this item."""
        return len(self.data) == self.total


def write_header(out: Writer, header: Header) -> None:
    """Append all of a packet before its items."""
    flags = (
        (_FLAG_ACK if header.ack is not None else 0)
        | (_FLAG_DIGEST if header.digest is not None else 0)
        | (_FLAG_VERIFIED if header.verified is not None else 0)
        | (_FLAG_RESYNC if header.resync is not None else 0)
        | (_FLAG_RESET if header.reset is not None else 0)
        | (_FLAG_VALUES if header.values is not None else 0)
    )
    out.u8(PROTOCOL_VERSION)
    out.u8(flags)
    out.varint(header.session)
    out.varint(header.peer)
    if header.ack is not None:
        out.varint(header.ack[0])
        out.varint(header.ack[1])
    if header.digest is not None:
        out.varint(header.digest[0])
        out.raw(header.digest[1])
    for number in (header.verified, header.resync, header.reset):
        if number is not None:
            out.varint(number)
    if header.values is not None:
        out.varint(header.values[0])
        out.varint(header.values[1])


def write_item(out: Writer, item: Item, last_id: int, watermark: int) -> None:
    """Append an item that follows an item of id `last_id` (0 for the first)."""
    fragment = item.total is not None and not item.whole
    form = _RESIDUAL if item.residual else (_FRAGMENT if fragment else 0) | (_REMOVED if item.total is None else 0)
    out.u8(item.key.kind | form)
    out.signed(item.key.id - last_id)
    out.varint(item.key.part)
    out.varint(item.version - watermark - 1)
    if item.total is not None:
        out.varint(len(item.data))
        if fragment:
            out.varint(item.offset)
            out.varint(item.total)
        out.raw(item.data)


def add_checksum(out: Writer) -> bytes:
    """The finished packet: what was written, and its checksum."""
    data = out.bytes()
    return data + crc32(data).to_bytes(CRC_BYTES, "little")


def parse(packet: bytes, max_value_bytes: int) -> tuple[Header, list[Item]]:
    """Header and items of a packet. Raises WireError; VersionError for another protocol version."""
    if not CRC_BYTES + 4 <= len(packet) <= MAX_PACKET_BYTES:
        raise WireError(f"a packet of {len(packet)} bytes: expected {CRC_BYTES + 4}..{MAX_PACKET_BYTES}")
    body = packet[:-CRC_BYTES]
    if crc32(body).to_bytes(CRC_BYTES, "little") != packet[-CRC_BYTES:]:
        raise WireError("the checksum is wrong")
    if body[0] != PROTOCOL_VERSION:
        raise VersionError(f"the other side speaks protocol version {body[0]}, this one {PROTOCOL_VERSION}")
    source = Reader(body, 1)
    flags = source.u8()
    if flags & ~_FLAGS:
        raise WireError(f"unknown flags {flags:#x}")
    session, peer = source.varint(), source.varint()
    if not session:
        raise WireError("session 0 does not exist")
    header = Header(
        session,
        peer,
        (source.varint(), source.varint((1 << MASK_BITS) - 1)) if flags & _FLAG_ACK else None,
        (source.varint(), source.raw(DIGEST_BYTES)) if flags & _FLAG_DIGEST else None,
        source.varint() if flags & _FLAG_VERIFIED else None,
        source.varint() if flags & _FLAG_RESYNC else None,
        source.varint() if flags & _FLAG_RESET else None,
        (source.varint(), source.varint()) if flags & _FLAG_VALUES else None,
    )
    items: list[Item] = []
    if header.values is None:
        source.end()
        return header, items
    number, watermark = header.values
    if not number:
        raise WireError("packets are numbered from 1")
    last_id = 0
    while source.left:
        item = _read_item(source, last_id, watermark, max_value_bytes)
        last_id = item.key.id
        items.append(item)
    return header, items


def _read_item(source: Reader, last_id: int, watermark: int, max_value_bytes: int) -> Item:
    tag = source.u8()
    kind = tag & MAX_KIND
    id_ = last_id + source.signed((1 << 63) - 1)
    if not 0 <= id_ < 1 << 63:
        raise WireError(f"an id is not negative and fits 63 bits, found {id_}")
    key = Key(kind, id_, source.varint(0xFFFF))
    version = watermark + 1 + source.varint()
    if version > MAX_VERSION:
        raise WireError(f"found version {version}, expected at most {MAX_VERSION}")
    if tag & _RESIDUAL == _REMOVED:
        return Item(key, version, None, 0, b"")
    length = source.varint(max_value_bytes)
    if tag & _RESIDUAL == _RESIDUAL:
        return Item(key, version, length, 0, source.raw(length), residual=True)
    if not tag & _FRAGMENT:
        return Item(key, version, length, 0, source.raw(length))
    offset, total = source.varint(max_value_bytes), source.varint(max_value_bytes)
    if not 0 < length < total or offset + length > total:
        raise WireError(f"a fragment of {length} bytes at {offset} does not fit a value of {total}")
    return Item(key, version, total, offset, source.raw(length))
