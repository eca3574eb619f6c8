"""Network cameras: a real ffmpeg sends and another one receives; and programs that misbehave."""

import shutil
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.cameras.camera import CameraError
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.pipe_camera import PipeCamera
from kiteline_hw.cameras.stream import ffmpeg_command
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sources.open import open_source

CALIBRATION = "fx: 50\nfy: 50\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\n"


def program(text: str) -> PipeCamera:
    return PipeCamera("pipe", [sys.executable, "-c", "import sys, time\nout = sys.stdout.buffer\n" + text], "mend it")


def test_images_of_a_pipe_are_cut_at_their_heads() -> None:
    camera = program(
        "for k in range(3):\n out.write(b'P5\\n4 2\\n255\\n' + bytes([k] * 8)); out.flush(); time.sleep(0.01)\n"
        "out.write(b'nonsense nonsense nonsense'); out.write(b'P5\\n4 2\\n255\\n' + bytes([9] * 8)); out.flush()\n"
        "print('it is over', file=sys.stderr)"
    )
    assert camera.open().startswith("pipe: by python")
    for k in range(3):
        capture = camera.read(5.0)
        assert capture.t_ns is None
        assert np.array_equal(capture.image.grey(), np.full((2, 4), k, np.uint8))
    with pytest.raises(BadImage, match="no PGM"):
        camera.read(5.0)
    assert camera.read(5.0).image.grey()[0, 0] == 9
    with pytest.raises(CameraError, match=r"camera pipe ended \(it is over\): mend it"):
        camera.read(5.0)
    camera.close()


def test_a_silent_program_holds_nobody() -> None:
    camera = program("time.sleep(60)")
    camera.open()
    begin_s = time.monotonic()
    assert camera.read(0.05) is None
    assert time.monotonic() - begin_s < 1.0
    camera.close()
    camera.close()


def ffmpeg_of(folder: Path, monkeypatch: pytest.MonkeyPatch, known: str) -> None:
    """A model of ffmpeg on the path that knows one of the options for the rate, and refuses others as ffmpeg does."""
    path = folder / "ffmpeg"
    path.write_text(
        f"#!{sys.executable}\nimport sys, time\n"
        f"if {known!r} not in sys.argv:\n"
        " option = next(a for a in ('-fps_mode', '-vsync') if a in sys.argv)\n"
        " print(f\"Unrecognized option '{option[1:]}'.\", file=sys.stderr)\n"
        " sys.exit('Error splitting the argument list: Option not found')\n"
        "while True:\n sys.stdout.buffer.write(b'P5\\n64 48\\n255\\n' + bytes(64 * 48)); sys.stdout.flush(); "
        "time.sleep(0.05)\n"
    )
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")


@pytest.mark.parametrize("known", ["-fps_mode", "-vsync"])
def test_every_version_of_ffmpeg_gives_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: str) -> None:
    ffmpeg_of(tmp_path, monkeypatch, known)
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    source = open_source(f"stream:udp://127.0.0.1:5000?fps=20&calibration={tmp_path}/camera.yaml")
    assert isinstance(source, CameraSource)
    try:
        assert source.poll(time.monotonic_ns() + 10_000_000_000) is not None
        assert not any("ended" in line for line in source.take_messages())
    finally:
        source.close()


def test_an_option_that_no_version_knows_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg_of(tmp_path, monkeypatch, "-neither")
    camera = PipeCamera("cam", ffmpeg_command("u"), "mend it", older=[ffmpeg_command("u", "-vsync")])
    camera.open()
    assert camera.read(10.0) is None  # ended, and begun with the other option
    with pytest.raises(CameraError, match=r"ended \(Unrecognized option 'vsync'\.\): mend it"):
        camera.read(10.0)
    camera.close()


def test_the_first_error_since_an_image_is_told() -> None:
    camera = program(
        "err = lambda s: (sys.stderr.write(s + '\\n'), sys.stderr.flush())\n"
        "err('a damaged picture'); time.sleep(0.1)\n"
        "out.write(b'P5\\n4 2\\n255\\n' + bytes(8)); out.flush(); time.sleep(0.2)\n"
        "err('[tcp @ 0x5566] Connection refused'); err('Error opening input files')\n"
    )
    camera.open()
    assert camera.read(5.0) is not None
    with pytest.raises(CameraError, match=r"ended \(Connection refused\)"):
        camera.read(5.0)
    camera.close()


def test_an_image_that_was_scaled_from_another_size_is_refused() -> None:
    size = "'[graph 0 input from stream 0:0 @ 0x5566] [verbose] w:{} h:{} pixfmt:yuv420p tb:1/90000\\n'"
    camera = program(
        "def size(w, h):\n"
        f" sys.stderr.write({size}.format(w, h)); sys.stderr.flush()\n"
        " out.write(b'P5\\n4 2\\n255\\n' + bytes(8)); out.flush()\n"
        "size(4, 2); size(4, 2); time.sleep(0.5); size(8, 4)\n"  # equal sizes: its colours changed
        "time.sleep(60)"
    )
    camera.open()
    assert camera.read(5.0) is not None and camera.read(5.0) is not None
    with pytest.raises(CameraError, match="camera pipe sends 8x4 px instead of 4x2"):
        camera.read(5.0)
    camera.close()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_a_stream_of_a_real_ffmpeg_that_changes_its_size(tmp_path: Path) -> None:
    stream = b""
    for size in ("64x48", "128x80"):
        command = ["ffmpeg", "-nostdin", "-loglevel", "error", "-f", "lavfi", "-i", f"testsrc=size={size}:rate=20",
                   "-t", "1", "-c:v", "mpeg2video", "-g", "5", "-bf", "0", "-f", "mpegts", "-"]  # fmt: skip
        stream += subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout
    (tmp_path / "both.ts").write_bytes(stream)
    url = str(tmp_path / "both.ts")
    camera = PipeCamera("cam", ffmpeg_command(url), "", older=[ffmpeg_command(url, "-vsync")])
    camera.open()
    with pytest.raises(CameraError, match="cam sends 128x80 px instead of 64x48"):
        list(iter(partial(camera.read, 5.0), "never"))
    camera.close()


def test_a_missing_program_is_said() -> None:
    with pytest.raises(CameraError, match="no-such-program is not installed: `apt install"):
        PipeCamera("pipe", ["no-such-program"], "").open()


def test_arguments_that_are_wrong(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="expected one URL, or two"):
        open_source("stream:a,b,c")
    with pytest.raises(SourceError, match="calibration is missing"):
        open_source("stream:rtsp://camera/stream?channel=1")
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    source = open_source(f"stream:rtsp://camera/stream?channel=1?fps=30&calibration={tmp_path}/camera.yaml")
    assert source.name == "stream:rtsp://camera/stream?channel=1" and source.rig.left.width == 64
    source.close()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_udp_from_a_real_ffmpeg_that_ends_and_comes_back(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        url = f"udp://127.0.0.1:{s.getsockname()[1]}"

    def sender() -> subprocess.Popen[bytes]:
        command = ["ffmpeg", "-nostdin", "-loglevel", "error", "-re", "-f", "lavfi", "-i", "testsrc=size=64x48:rate=20",
                   "-c:v", "mpeg2video", "-g", "5", "-bf", "0", "-f", "mpegts", url + "?pkt_size=1316"]  # fmt: skip
        return subprocess.Popen(command)

    source = open_source(f"stream:{url}?fps=20&calibration={tmp_path}/camera.yaml")
    assert isinstance(source, CameraSource)
    assert source.poll(time.monotonic_ns() + 10_000_000) is None  # begins to listen
    sending = sender()
    said: list[str] = []

    def images(n: int, within_s: float = 25.0) -> None:
        end_ns = time.monotonic_ns() + round(within_s * 1e9)
        for _ in range(n):
            frame = source.poll(end_ns)
            said.extend(source.take_messages())
            assert frame.left.shape == (48, 64) and int(frame.left.max()) > 150, said

    try:
        images(20)
        sending.kill()
        sending.wait()
        end_ns = time.monotonic_ns() + 1_500_000_000
        while source.poll(end_ns) is not None:
            pass
        said.extend(source.take_messages())
        sending = sender()
        images(10)
    finally:
        sending.kill()
        sending.wait()
        source.close()
    assert sum("sends no images: check its cable" in line for line in said) == 1, said
    assert sum("images again after" in line for line in said) == 1, said
    assert sum("no capture times" in line for line in said) == 1, said
