"""Encodes the raw images of a log in a thread or process of its own, and keeps what is written after them waiting.

OpenCV encodes without Python's lock, so that tracking goes on meanwhile. Nothing is dropped: where the encoder lags,
the caller waits, or stores the image uncompressed.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage, Frame
from kiteline_hw.logs.encoder_process import EncoderProcess
from kiteline_hw.sensors.images import encode_depth, encode_image, store_image


@dataclass(frozen=True, slots=True)
class EncodingPolicy:
    """How raw images are logged. compressed: as PNG of half their size, else as stored PNG for a tenth of the CPU time.

    most_waiting: images that may wait to be encoded.
    """

    compressed: bool = True
    most_waiting: int = 12


ENCODE_ALL = EncodingPolicy()
_LOOK_EVERY = 8  # messages that wait between two looks at what the other process has ready: each look is a system call


class ImageEncoder:
    """A queue of images being encoded, and of all that follows them in the log.

    stores: where too many images wait, one more is stored at once; else the caller waits, and files are reproducible.
    stored: images that were not compressed for that reason. apart: grey images are encoded by another process.
    """

    def __init__(self, policy: EncodingPolicy) -> None:
        self.stores = False
        self.stored = 0
        self.apart = False
        self._process: EncoderProcess | None = None
        self._draining = False
        self._unlooked = 0  # messages since the last look
        self._policy = policy
        self._thread: ThreadPoolExecutor | None = None
        self._images: deque[Future[EncodedImage]] = deque()
        self._order: deque[tuple[Future[EncodedImage] | None, Callable[..., None]]] = deque()

    @property
    def waiting(self) -> bool:
        """True if something is to be written after an image that is being encoded; False for what `drain` writes."""
        return bool(self._order) and not self._draining

    def encode(self, frame: Frame) -> list[EncodedImage | Future[EncodedImage]]:
        """Encode the images of a frame: left, right, depth."""
        grey = [frame.left] if frame.right is None else [frame.left, frame.right]
        out: list[EncodedImage | Future[EncodedImage]] = []
        self._poll()
        while self._images and self._images[0].done():
            self._images.popleft()
        full = len(self._images) + len(grey) > self._policy.most_waiting
        if full and not self.stores:
            self.drain()
        for pixels in grey:
            if not self._policy.compressed or (full and self.stores):
                self.stored += full
                out.append(store_image(pixels))
            else:
                out.append(self._encode_apart(pixels) or self._submit(partial(encode_image, pixels)))
        if frame.depth_m is not None:
            out.append(self._submit(partial(encode_depth, frame.depth_m)))
        return out

    def _encode_apart(self, pixels: U8) -> Future[EncodedImage] | None:
        """Hand an image to the other process; None if there is none, or it has no room."""
        if not self.apart:
            return None
        if self._process is None:
            try:
                self._process = EncoderProcess((pixels.shape[0], pixels.shape[1]), self._policy.most_waiting)
            except OSError:
                self.apart = False
                return None
        done = self._process.submit(pixels)
        if done is not None:
            self._images.append(done)
        return done

    def _poll(self) -> None:
        if self._process is not None:
            self._process.poll()

    def _submit(self, work: Callable[[], EncodedImage]) -> Future[EncodedImage]:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "log-images")
        self._images.append(self._thread.submit(work))
        return self._images[-1]

    def then(self, image: Future[EncodedImage] | None, write: Callable[..., None]) -> None:
        """Call `write` with the image, or with None, after all that came before."""
        self._order.append((image, write))

    def drain(self, wait: bool = True) -> None:
        """Write what is ready, in order. wait: for images that are being encoded, too."""
        self._unlooked += 1
        if not wait and self._process is not None and self._unlooked < _LOOK_EVERY:
            return
        self._unlooked = 0
        self._draining = True
        self._poll()
        try:
            while self._order:
                image, write = self._order[0]
                if image is not None and not wait and not image.done():
                    return
                self._order.popleft()
                if image is not None and self._process is not None:
                    self._process.wait(image)
                write(None if image is None else image.result())
        finally:
            self._draining = False

    def close(self) -> None:
        """Write everything, and end thread and process."""
        if self._process is not None:
            self._process.hurry()
        self.drain()
        if self._process is not None:
            self._process.close()
            self._process = None
        if self._thread is not None:
            self._thread.shutdown()
            self._thread = None
