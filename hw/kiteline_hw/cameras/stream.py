"""`stream:URL[,URL]`: network cameras and whatever else ffmpeg opens (RTSP, UDP, TCP, HTTP)."""

import shlex

from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.cameras import live_options
from kiteline_hw.cameras.live_options import LiveOptions
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.pipe_camera import PipeCamera
from kiteline_hw.ports import SourceError

# Without these ffmpeg collects seconds of video before it shows the first image.
_NO_DELAY = ("-fflags", "nobuffer", "-flags", "low_delay", "-probesize", "500000", "-analyzeduration", "500000")


def open_source(argument: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> CameraSource:
    """Open streams; one that is away is awaited in flight. given: their calibration. Raises SourceError."""
    del imu
    text, options = _split(argument)
    urls = [url for url in text.split(",") if url]
    if not 1 <= len(urls) <= 2 or (options.side_by_side and len(urls) == 2):
        raise SourceError(f"stream:{argument}: expected one URL, or two (left,right) without side_by_side")
    stereo = (len(urls) == 2 or options.side_by_side) and not mono
    rig = live_options.read_rig("stream", options, stereo=stereo, given=given)
    cameras = [
        PipeCamera(
            url,
            ffmpeg_command(url),
            f"check its address, for instance with `ffplay {shlex.quote(url)}`",
            older=[ffmpeg_command(url, "-vsync")],
        )
        for url in (urls[:1] if mono else urls)
    ]
    return CameraSource(f"stream:{text}", rig, cameras, options.fps, options.side_by_side)


def ffmpeg_command(url: str, rate_option: str = "-fps_mode") -> list[str]:
    """ffmpeg's arguments: grey images of the stream's own size, each as it comes, none twice.

    rate_option: `-fps_mode` is known from version 5.1 on, `-vsync` before version 9.
    """
    rtsp = ["-rtsp_transport", "tcp"] if url.startswith("rtsp") else []
    return [
        "ffmpeg", "-nostdin", "-hide_banner", "-nostats", "-loglevel", "level+verbose", *_NO_DELAY, *rtsp, "-i", url,
        "-an", rate_option, "passthrough", "-f", "image2pipe", "-c:v", "pgm", "-pix_fmt", "gray", "-",
    ]  # fmt: skip


def _split(argument: str) -> tuple[str, LiveOptions]:
    """URLs and options: those behind the last question mark that begins with an option of ours."""
    url, mark, query = argument.rpartition("?")
    if mark and query.partition("=")[0] in LiveOptions.__dataclass_fields__:
        return url, live_options.parse("stream", f"?{query}")[1]
    return argument, LiveOptions()
