"""Images as sources and logs hold them: encoded bytes, a file or raw pixels; decoding and encoding.

Grey images are (h, w) uint8. A depth image is 16-bit PNG whose format carries its scale: "png/5000" means that the
stored value divided by 5000 is metres, 0 unknown.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F32, U8, U16
from kiteline_core.frame import EncodedImage
from kiteline_hw.sensors.image_size import size_of
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels

DEPTH_FORMAT = "png/1000"  # millimetres: what our logs write if a source has no encoded depth

MOST_PIXELS = 1 << 25  # of an image: 33 million, which are decoded in a third of a second
_PNG_GREY_16 = b"\x10\x00"  # bits and colour type in a PNG's head
_PNG_16 = _PNG_GREY_16[:1]
_FORMATS_OF_16 = ("png", "tiff", "pnm")

_FAST_PNG = (
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG
)  # fmt: skip
_FORMATS = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg", b"BM": "bmp", b"II*\x00": "tiff", b"MM\x00*": "tiff"}


@dataclass(frozen=True, slots=True)
class ImageFile:
    """An image file. format: as in EncodedImage, or "" to detect it by the first bytes."""

    path: Path
    format: str = ""


ImageRef = ImageFile | EncodedImage | RawPixels


def detect_format(data: bytes) -> str:
    """The format of an encoded image, by its first bytes. Raises BadImage."""
    for magic, name in _FORMATS.items():
        if data.startswith(magic):
            return name
    if data[:2] == b"P5" or data[:2] == b"P6":
        return "pnm"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "webp"
    raise BadImage("empty file" if not data else f"starts with {data[:8]!r}, which is no PNG, JPEG, TIFF, BMP or PGM")


def read_encoded(ref: ImageFile | EncodedImage) -> EncodedImage:
    """The bytes of an image, and their format. Raises BadImage."""
    if isinstance(ref, EncodedImage):
        detect_format(ref.data)
        return ref
    try:
        data = ref.path.read_bytes()
    except OSError as error:
        raise BadImage(f"{ref.path.name}: {error.strerror}") from error
    try:
        return EncodedImage(data, ref.format or detect_format(data))
    except BadImage as error:
        raise BadImage(f"{ref.path.name}: {error}") from error


def decode_grey(ref: ImageRef) -> tuple[U8, EncodedImage | None]:
    """Grey pixels (h, w) uint8 and the encoded image they were decoded from (None for raw pixels). Raises BadImage."""
    if isinstance(ref, RawPixels):
        return ref.grey(), None
    image = read_encoded(ref)
    pixels = _imdecode(image, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(pixels, np.uint8), image


def decode_words(image: EncodedImage) -> U16 | None:
    """Grey values (h, w) of an image of 16 bits; None for one of 8, which is not decoded. Raises BadImage."""
    kind = detect_format(image.data)
    if kind not in _FORMATS_OF_16 or (kind == "png" and image.data[24:25] != _PNG_16):
        return None
    pixels = _imdecode(image, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(pixels, np.uint16) if pixels.dtype == np.uint16 else None


def decode_depth(ref: ImageRef) -> tuple[F32, EncodedImage | None]:
    """Depth (h, w) float32 in metres, 0 unknown, and the encoded image. Raises BadImage."""
    if isinstance(ref, RawPixels):
        return ref.metres(), None
    image = read_encoded(ref)
    if image.data[:4] == b"\x89PNG" and image.data[24:26] != _PNG_GREY_16:
        raise BadImage("depth image is no 16-bit grey PNG")
    raw = _imdecode(image, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise BadImage(f"depth image is {raw.dtype} with {raw.ndim} axes: expected 16-bit grey")
    return raw.astype(np.float32) * np.float32(1.0 / depth_scale(image.format)), image


def depth_scale(image_format: str) -> float:
    """Stored units a metre of a depth format such as "png/5000". Raises BadImage."""
    _, slash, scale = image_format.partition("/")
    try:
        value = float(scale) if slash else float("nan")
    except ValueError:
        value = float("nan")
    if not 0.0 < value < float("inf"):
        raise BadImage(f"depth format {image_format!r} names no scale: expected one like 'png/5000'")
    return value


def encode_image(pixels: U8) -> EncodedImage:
    """Encode grey pixels (h, w) uint8 as PNG.

    One filter and Huffman codes alone: for camera images smaller than zlib's fastest level, and three times as fast.
    """
    _, data = cv2.imencode(".png", pixels, _FAST_PNG)
    return EncodedImage(data.tobytes(), "png")


def store_image(pixels: U8) -> EncodedImage:
    """Grey pixels (h, w) uint8 as PNG without compression, a tenth of the CPU time of `encode_image`."""
    h, w = pixels.shape
    rows = np.zeros((h, w + 1), np.uint8)  # each row begins with the number of its filter: none
    rows[:, 1:] = pixels
    header = struct.pack(">IIBBBBB", w, h, 8, 0, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 0)), (b"IEND", b"")
    chunks = (struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
              for name, data in parts)  # fmt: skip
    return EncodedImage(b"\x89PNG\r\n\x1a\n" + b"".join(chunks), "png")


def encode_depth(depth_m: F32) -> EncodedImage:
    """Encode depth (h, w) float32 in metres as 16-bit PNG in millimetres; above 65.5 m it becomes unknown (0)."""
    units = np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) * depth_scale(DEPTH_FORMAT)
    units = np.where((units > 0.0) & (units < 65535.5), np.rint(units), 0.0).astype(np.uint16)
    _, data = cv2.imencode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return EncodedImage(data.tobytes(), DEPTH_FORMAT)


def _imdecode(image: EncodedImage, flags: int) -> NDArray[np.generic]:
    size = size_of(image.data)
    if size is None:
        raise BadImage(f"{len(image.data)} bytes of {image.format} are cut or damaged")
    if not 0 < size[0] * size[1] <= MOST_PIXELS:
        raise BadImage(f"an image with {size[0]}x{size[1]} px: expected at most {MOST_PIXELS} pixels")
    try:
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), flags)
    except cv2.error as error:
        raise BadImage(f"{len(image.data)} bytes of {image.format} cannot be decoded") from error
    if pixels is None:
        raise BadImage(f"{len(image.data)} bytes of {image.format} cannot be decoded")
    return np.asarray(pixels)
