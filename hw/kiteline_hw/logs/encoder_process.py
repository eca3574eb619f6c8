"""Encodes images in a process of its own, so that a log costs the tracking process two copies of an image.

Both processes map the same memory, cut into slots of one image each. A request names a slot and its size, an answer the
slot and the length of the PNG in it. The process ends when its input does.
"""

import contextlib
import mmap
import os
import select
import signal
import struct
import subprocess
import sys
import time
from concurrent.futures import Future

import numpy as np

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage
from kiteline_hw.sensors.images import encode_image, store_image

_REQUEST, _ANSWER = struct.Struct("<III"), struct.Struct("<II")
END_S = 2.0  # s in which the process ends once its input has
_START_S = 20.0  # s that it may take to load
_SILENCE_S = 10.0  # s without an image after which it counts as hung, or stopped: one takes some milliseconds
_HEADROOM = 4096  # bytes by which a stored PNG exceeds its pixels and rows


class EncoderProcess:
    """A queue of images at another process. Not for several threads.

    What a process leaves that ends, or does not go on, is stored plain.
    """

    def __init__(self, shape: tuple[int, int], slots: int) -> None:
        """shape: height and width of the largest image. Raises OSError where no process can be started."""
        h, w = shape
        self._slot_bytes = 2 * (h * (w + 2) + _HEADROOM)
        memory = os.memfd_create("kiteline-images", os.MFD_CLOEXEC)
        try:
            os.ftruncate(memory, self._slot_bytes * slots)
            self._memory = mmap.mmap(memory, self._slot_bytes * slots)
            command = [sys.executable, "-m", __name__, str(memory), str(slots), str(self._slot_bytes)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(memory,), start_new_session=True
            )
        finally:
            os.close(memory)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._from, False)
        self._free = list(range(slots))
        self._sent: dict[int, tuple[Future[EncodedImage], tuple[int, int]]] = {}
        self._answers = b""
        self._silence_s = _SILENCE_S
        self._heard_s = time.monotonic() + _START_S  # when it last was idle, or answered
        self.alive = True

    def submit(self, pixels: U8) -> Future[EncodedImage] | None:
        """Send an image; None if all slots are taken, the image is too large, or the process has ended."""
        if not self._free:
            self.poll()
        h, w = pixels.shape
        if not self.alive or not self._free or 2 * (h * (w + 2) + _HEADROOM) > self._slot_bytes:
            return None
        slot = self._free.pop()
        if not self._sent:
            self._heard_s = max(self._heard_s, time.monotonic())
        begin = slot * self._slot_bytes
        np.frombuffer(self._memory, np.uint8, h * w, begin).reshape(h, w)[:] = pixels
        done: Future[EncodedImage] = Future()
        self._sent[slot] = done, (h, w)
        try:
            os.write(self._to, _REQUEST.pack(slot, h, w))  # smaller than a pipe: never blocks, never in part
        except OSError:
            self._give_up()
        return done

    def poll(self) -> None:
        """Take the answers that have come. Never blocks."""
        if not self._sent:
            return
        try:
            data = os.read(self._from, 4096)
        except BlockingIOError:
            if time.monotonic() - self._heard_s > self._silence_s:
                self._give_up()
            return
        except OSError:
            data = b""
        if not data:
            self._give_up()
            return
        self._heard_s = time.monotonic()
        self._answers += data
        whole = len(self._answers) // _ANSWER.size * _ANSWER.size
        for slot, length in _ANSWER.iter_unpack(self._answers[:whole]):
            done, (h, w) = self._sent.pop(slot)
            begin = slot * self._slot_bytes + h * w
            done.set_result(EncodedImage(self._memory[begin : begin + length], "png"))
            self._free.append(slot)
        self._answers = self._answers[whole:]

    def wait(self, image: Future[EncodedImage]) -> None:
        """Wait until an image is encoded; at once if it is encoded elsewhere."""
        while any(done is image for done, _ in self._sent.values()):
            select.select([self._from], [], [], 1.0)
            self.poll()

    def hurry(self) -> None:
        """No image follows: what is left may take no longer than END_S."""
        self._silence_s, self._heard_s = END_S, min(self._heard_s, time.monotonic())

    def _give_up(self) -> None:
        """The process has ended, or does not go on: store here what it left behind."""
        self._process.kill()  # else it might write there meanwhile
        self.alive = False
        sent, self._sent = self._sent, {}
        for slot, (done, (h, w)) in sent.items():
            begin = slot * self._slot_bytes
            done.set_result(store_image(np.frombuffer(self._memory, np.uint8, h * w, begin).reshape(h, w).copy()))

    def close(self) -> None:
        """End the process; what it still has is encoded here."""
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()
        if self._sent:
            self._give_up()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main(memory: int, slots: int, slot_bytes: int) -> None:
    """Encode until the input ends."""
    import cv2

    cv2.setNumThreads(1)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the log is closed by the process that writes it
    os.nice(10)  # tracking comes first; what is late is stored
    images = mmap.mmap(memory, slots * slot_bytes)
    while request := _read_request():
        slot, h, w = _REQUEST.unpack(request)
        begin = slot * slot_bytes
        pixels = np.frombuffer(images, np.uint8, h * w, begin).reshape(h, w)
        data = encode_image(pixels).data
        if len(data) > slot_bytes - h * w:
            data = store_image(pixels).data
        images[begin + h * w : begin + h * w + len(data)] = data
        os.write(1, _ANSWER.pack(slot, len(data)))


def _read_request() -> bytes:
    """The next request; empty at the end."""
    data = b""
    while len(data) < _REQUEST.size:
        more = os.read(0, _REQUEST.size - len(data))
        if not more:
            return b""
        data += more
    return data


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main(*map(int, sys.argv[1:4]))
