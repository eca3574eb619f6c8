"""A camera behind another program that writes grey PGM images to its standard output, such as ffmpeg."""

import contextlib
import fcntl
import os
import re
import select
import subprocess
import time
from collections.abc import Sequence

from kiteline_hw.cameras.camera import CameraError, Capture
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels

_PIPE_BYTES = 1 << 20  # a whole image fits, so that the program never waits for us
_FIRST_IMAGE_S = 12.0  # s until the first image: a stream begins with its next whole picture
_HEAD = re.compile(rb"P5\s(\d{1,5})\s(\d{1,5})\s255\s")
_HEAD_BYTES = 20  # bytes that a head has at most
_LAST_WORDS = 300  # characters of what the program said that an error message repeats


class PipeCamera:
    """Images from a program, which is started again when it ends.

    A pipe carries no capture times: images count from their arrival.
    """

    start_s = _FIRST_IMAGE_S

    def __init__(self, name: str, command: Sequence[str], mend: str) -> None:
        """mend: what to tell a user whose program ends."""
        self.name = name
        self._command = tuple(command)
        self._mend = mend
        self._process: subprocess.Popen[bytes] | None = None
        self._received = bytearray()
        self._words = b""
        self._speaks = True  # the program's error output is open

    def open(self) -> str:
        """Start the program. Raises CameraError."""
        try:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                start_new_session=True,
            )  # fmt: skip
        except FileNotFoundError as error:
            program = self._command[0]
            raise CameraError(f"{program} is not installed: `apt install {program}`", passing=False) from error
        except OSError as error:
            raise CameraError(f"{self._command[0]} cannot be started: {error.strerror}") from error
        for stream in (self._process.stdout, self._process.stderr):
            assert stream is not None
            os.set_blocking(stream.fileno(), False)
            _enlarge(stream.fileno())
        self._received, self._words, self._speaks = bytearray(), b"", True
        return f"{self.name}: by {os.path.basename(self._command[0])}"

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises CameraError if the program ended, BadImage."""
        process = self._process
        assert process is not None and process.stdout is not None and process.stderr is not None
        out, said = process.stdout.fileno(), process.stderr.fileno()
        end_s = time.monotonic() + timeout_s
        while (capture := self._take()) is None:
            wait_s = end_s - time.monotonic()
            ready, _, _ = select.select([out, said] if self._speaks else [out], [], [], max(0.0, wait_s))
            if said in ready:
                text = _read(said)
                self._speaks = text != b""
                self._words = (self._words + (text or b""))[-2 * _LAST_WORDS :]
            if out in ready:
                data = _read(out)
                if data == b"":
                    raise CameraError(f"camera {self.name} ended{self._last_words()}: {self._mend}")
                self._received += data or b""
            elif wait_s <= 0.0:
                return None
        return capture

    def _take(self) -> Capture | None:
        """The first whole image of what was received. Raises BadImage for anything else."""
        head = _HEAD.match(self._received)
        if head is None:
            if len(self._received) < _HEAD_BYTES:
                return None
            begin = bytes(self._received[:_HEAD_BYTES])
            next_head = self._received.find(b"P5", 1)
            del self._received[: next_head if next_head > 0 else len(self._received)]
            raise BadImage(f"starts with {begin[:8]!r}, which is no PGM")
        width, height = int(head[1]), int(head[2])
        end = head.end() + width * height
        if len(self._received) < end:
            return None
        data = bytes(memoryview(self._received)[head.end() : end])
        del self._received[:end]
        return Capture(None, None, RawPixels(width, height, "mono8", width, data))

    def close(self) -> None:
        """End the program; it may be started again."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()  # it holds nothing that a kill could damage
        process.wait()
        for stream in (process.stdout, process.stderr):
            assert stream is not None
            stream.close()

    def _last_words(self) -> str:
        lines = self._words.decode(errors="replace").strip().splitlines()
        return f" ({lines[-1].strip()[:_LAST_WORDS]})" if lines else ""


def _read(fd: int) -> bytes | None:
    """What can be read now: b"" at the end, None if there is nothing."""
    try:
        return os.read(fd, _PIPE_BYTES)
    except BlockingIOError:
        return None


def _enlarge(fd: int) -> None:
    with contextlib.suppress(OSError):
        fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
