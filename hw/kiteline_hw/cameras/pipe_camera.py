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
_WORDS = 300  # characters of a line of the program's errors that a message repeats
_UNFINISHED_BYTES = 8192  # of a line of its errors that is kept until it ends
_END_S = 0.5  # s that its last words are awaited
_UNKNOWN_OPTION = "Unrecognized option"
_PROGRESS = re.compile(r"\[(?:trace|debug|verbose|info|warning)\]")  # lines that are no errors
# ffmpeg says so of the pictures that it decodes. It scales them to the size of the first one without another word.
_DECODED_SIZE = re.compile(r"\[graph .*\] w:(\d+) h:(\d+) pixfmt:")
_TAG = re.compile(r"\[(?:[^\]]* @ 0x[0-9a-f]+|error|fatal|panic)\] *")  # the part of ffmpeg that speaks; its level


class PipeCamera:
    """Images from a program, which is started again when it ends.

    A pipe carries no capture times: images count from their arrival. ffmpeg has to be told `-loglevel level+verbose`:
    it names the size of what it decodes at that level alone.
    """

    start_s = _FIRST_IMAGE_S

    def __init__(self, name: str, command: Sequence[str], mend: str, older: Sequence[Sequence[str]] = ()) -> None:
        """mend: what to tell a user whose program ends. older: commands for versions that do not know an option."""
        self.name = name
        self._command = tuple(command)
        self._older = list(older)
        self._mend = mend
        self._process: subprocess.Popen[bytes] | None = None
        self._received = bytearray()
        self._unfinished = b""  # the line of its errors that has not ended yet
        self._first_words = self._last_words = ""  # lines of its errors: the first since the last image; the last
        self._size: tuple[int, int] | None = None  # width and height of the decoded pictures, px
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
        self._received, self._unfinished, self._speaks = bytearray(), b"", True
        self._first_words, self._last_words, self._size = "", "", None
        return f"{self.name}: by {os.path.basename(self._command[0])}"

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises CameraError if the program ended, BadImage.

        A program that ends because it does not know an option is started again with the older command.
        """
        process = self._process
        assert process is not None and process.stdout is not None and process.stderr is not None
        out, said = process.stdout.fileno(), process.stderr.fileno()
        end_s = time.monotonic() + timeout_s
        while (capture := self._take()) is None:
            wait_s = end_s - time.monotonic()
            ready, _, _ = select.select([out, said] if self._speaks else [out], [], [], max(0.0, wait_s))
            data = _read(out) if out in ready else None
            # A new size is named before its first picture is written, so that it is read here before that is used.
            if self._speaks:
                self._listen(said)
            if data == b"":
                words = self._words_at_end(process, said)
                if not self._older or _UNKNOWN_OPTION not in words:
                    raise CameraError(f"camera {self.name} ended{words and f' ({words})'}: {self._mend}")
                self.close()
                self._command = tuple(self._older.pop(0))
                self.open()
                return None
            self._received += data or b""
            if data is None and wait_s <= 0.0:
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
        self._first_words = ""
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

    def _listen(self, said: int) -> None:
        """Read what the program says now. Raises CameraError if its pictures have another size than before."""
        data = _read(said)
        self._speaks = data != b""
        *lines, self._unfinished = (self._unfinished + (data or b"")).split(b"\n")
        self._unfinished = self._unfinished[-_UNFINISHED_BYTES:]
        if not self._speaks:
            lines.append(self._unfinished)
        for line in lines:
            text = line.decode(errors="replace")
            if size := _DECODED_SIZE.match(text):
                self._take_size((int(size[1]), int(size[2])))
            words = _TAG.sub("", text).strip()[:_WORDS]
            if words and not _PROGRESS.search(text):
                self._first_words, self._last_words = self._first_words or words, words

    def _take_size(self, size: tuple[int, int]) -> None:
        last, self._size = self._size or size, size
        if size != last:
            raise CameraError(
                f"camera {self.name} sends {size[0]}x{size[1]} px instead of {last[0]}x{last[1]}: "
                "set it to the size of the calibration"
            )

    def _words_at_end(self, process: subprocess.Popen[bytes], said: int) -> str:
        """Why the program ended. Its first error names the cause; those after it follow from it."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        while self._speaks and select.select([said], [], [], 0.0)[0]:
            self._listen(said)
        return self._first_words or self._last_words


def _read(fd: int) -> bytes | None:
    """What can be read now: b"" at the end, None if there is nothing."""
    try:
        return os.read(fd, _PIPE_BYTES)
    except BlockingIOError:
        return None


def _enlarge(fd: int) -> None:
    with contextlib.suppress(OSError):
        fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
