"""The code of a pair of images of which another machine makes a scan: one JPEG image, the right one below the left."""

import cv2
import numpy as np

from kiteline_core.arrays import U8
from kiteline_core.ground.disparity import DisparityCamera

_START, _SCAN = 0xD8, 0xDA  # markers
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # those that tell the size of an image
_BASELINE = 0xC0  # of one pass: images of others may have thousands of passes, of 17 bytes each


def encode_pair(pair: tuple[U8, U8], quality: int) -> bytes:
    """The code of two images (h,w) of the same size. quality: of JPEG, up to 100."""
    ok, data = cv2.imencode(".jpg", np.vstack(pair), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok  # there is no grey image without a code
    return data.tobytes()


def decode_pair(code: bytes, camera: DisparityCamera) -> tuple[U8, U8] | None:
    """The images (h,w) of a camera from any bytes; None where they are no code of such a pair."""
    if _size_of(code) != (2 * camera.height, camera.width):
        return None  # before OpenCV takes memory for an image of any size
    image = cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape != (2 * camera.height, camera.width):
        return None
    left, right = np.split(np.asarray(image, np.uint8), 2)
    return np.ascontiguousarray(left), np.ascontiguousarray(right)


def _size_of(code: bytes) -> tuple[int, int] | None:
    """Rows and columns of a baseline JPEG image, by the segments before its pixels; None if they do not tell one."""
    if code[:2] != bytes((0xFF, _START)):
        return None
    at, size = 2, None
    while at + 4 <= len(code) and code[at] == 0xFF:
        marker, length = code[at + 1], int.from_bytes(code[at + 2 : at + 4], "big")
        if marker == _SCAN:
            return size
        if marker in _FRAMES:
            if size is not None or marker != _BASELINE or length < 8 or at + 9 > len(code):
                return None
            size = int.from_bytes(code[at + 5 : at + 7], "big"), int.from_bytes(code[at + 7 : at + 9], "big")
        at += 2 + length
    return None
