"""The size of an encoded image, read from its first bytes: known before anything is decoded.

PNG (RFC 2083), JPEG (ITU T.81, frame headers SOF), BMP, netpbm, TIFF 6.0 (tags 256 and 257) and WebP (RFC 9649).
"""

import struct

from kiteline_core.errors import INPUT_FAULTS

_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG's frame headers
_NO_LENGTH = frozenset((0x01, *range(0xD0, 0xD9)))  # JPEG's markers without a segment
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_MOST_TAGS = 4096


def size_of(data: bytes) -> tuple[int, int] | None:
    """Width and height in px; None if the bytes do not say it."""
    try:
        return _size_of(data)
    except (ValueError, IndexError, *INPUT_FAULTS):
        return None


def _size_of(data: bytes) -> tuple[int, int] | None:
    if data[:4] == b"\x89PNG":
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" and _png_holds_its_chunks(data) else None
    if data[:2] == b"\xff\xd8":
        return _of_jpeg(data)
    if data[:2] == b"BM":
        return _of_bmp(data)
    if data[:2] in (b"P5", b"P6"):
        return _of_netpbm(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return _of_tiff(data)
    return _of_webp(data) if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else None


def _png_holds_its_chunks(data: bytes) -> bool:
    """True if no chunk claims more bytes than there are: a decoder takes up to 4 GiB of memory for one that does.

    It looks for an image also beyond an end that comes before one.
    """
    at, has_image = 8, False
    while at + 8 <= len(data):
        name = data[at + 4 : at + 8]
        if name == b"IEND":
            return has_image
        has_image |= name == b"IDAT"
        at += 12 + struct.unpack_from(">I", data, at)[0]
    return at <= len(data)


def _of_jpeg(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _NO_LENGTH:
            at += 2
        elif marker in _SOF:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        else:
            at += 2 + max(2, struct.unpack_from(">H", data, at + 2)[0])
    return None


def _of_bmp(data: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", data, 14)[0] == 12:  # OS/2's header
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)


def _of_netpbm(data: bytes) -> tuple[int, int]:
    head = b"\n".join(line.split(b"#", 1)[0] for line in data[:4096].split(b"\n"))
    width, height = (int(word) for word in head.split()[1:3])
    return width, height


def _of_tiff(data: bytes) -> tuple[int, int] | None:
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found: dict[int, int] = {}
    for entry in range(min(count, _MOST_TAGS)):
        tag, kind = struct.unpack_from(order + "HH", data, at + 2 + 12 * entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            found[tag] = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 10 + 12 * entry)[0]
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _of_webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
