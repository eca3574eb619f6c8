"""The table of SOURCE kinds: the parser, the layout recogniser, the help texts and the error messages read it.

It imports nothing heavy, because `kiteline --help` prints it. The module of a row has
`open_source(argument, mono, imu) -> FrameSource`.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One kind of source, written SCHEME:ARGUMENT.

    argument: what follows the colon, in capitals; DIR and FILE are paths that must exist. layout: glob patterns, one of
    which a folder of this kind matches (with a trailing slash: a sub-folder), and `shown` names them in error messages.
    given: its open_source has the given calibration as a fourth argument, as there may be no other.
    """

    scheme: str
    argument: str
    about: str
    module: str
    layout: tuple[str, ...] = ()
    shown: str = ""
    given: bool = False

    @property
    def live(self) -> bool:
        """True for a camera."""
        return self.module.startswith("kiteline_hw.cameras")


SOURCES: tuple[SourceKind, ...] = (
    SourceKind("euroc", "DIR", "EuRoC or TUM-VI folder (ASL layout), stereo and IMU",
               "kiteline_hw.sources.euroc", ("mav0/", "cam0/"), "mav0/ (EuRoC)", given=True),
    SourceKind("tum", "DIR", "TUM RGB-D folder",
               "kiteline_hw.sources.tum", ("rgb.txt", "rgb/"), "rgb.txt (TUM)", given=True),
    SourceKind("kitti", "DIR", "KITTI odometry sequence or raw drive",
               "kiteline_hw.sources.kitti", ("calib.txt", "image_[0123lr]/", "image_0[0123]/"),
               "calib.txt with image_0/ (KITTI)"),
    SourceKind("mcap", "FILE", "ROS 2 bag, Foxglove recording or kiteline log",
               "kiteline_hw.sources.mcap", ("*.mcap", "*.db3"), "*.mcap or *.db3 (ROS 2)", given=True),
    SourceKind("images", "GLOB[,GLOB]", "plain images beside a camera.yaml", "kiteline_hw.sources.images", given=True),
    SourceKind("sim", "SCENE", "simulated flight: room, hall, corridor or street", "kiteline_hw.sim.source"),
    SourceKind("v4l2", "DEV[,DEV]", "live camera, or a pair", "kiteline_hw.cameras.v4l2", given=True),
    SourceKind("picamera", "N[,N]", "camera of a Raspberry Pi, or a pair", "kiteline_hw.cameras.picamera", given=True),
    SourceKind("stream", "URL[,URL]", "network camera (RTSP, UDP, HTTP) through ffmpeg", "kiteline_hw.cameras.stream",
               given=True),
    SourceKind("ros2", "TOPIC[,TOPIC]", "live topics of ROS 2, where rclpy is", "kiteline_hw.cameras.ros2", given=True),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ForeignLayout:
    """A layout that is known but not read. marks: glob patterns, all of which a folder matches. mend: what to do."""

    name: str
    marks: tuple[str, ...]
    mend: str


FOREIGN: tuple[ForeignLayout, ...] = (
    ForeignLayout("UZH-FPV", ("left_images.txt", "imu.txt"),
                  "convert the sequence's .bag with `pip install rosbags` and `rosbags-convert --src FILE.bag --dst "
                  "FOLDER`, and fly FOLDER with --calibration camchain-imucam.yaml,imu.yaml"),
    ForeignLayout("4Seasons", ("undistorted_images/cam0",),
                  "fly images:'DIR/undistorted_images/cam0/*.png,DIR/undistorted_images/cam1/*.png' with a camera.yaml "
                  "of undistorted_calib_*.txt beside them (fx fy cx cy width height baseline_m)"),
)  # fmt: skip


def source_forms() -> str:
    """All forms of SOURCE in one line, for help texts."""
    return " ".join(f"{kind.scheme}:{kind.argument}" for kind in SOURCES) + ", or a plain path"


def source_table() -> str:
    """The forms of SOURCE with their meanings, one a line."""
    return "\n".join(f"  {f'{kind.scheme}:{kind.argument}':21}  {kind.about}" for kind in SOURCES)


def is_camera(spec: str) -> bool:
    """True if `spec` begins with the scheme of a live camera."""
    scheme, colon, _ = spec.partition(":")
    return bool(colon) and any(kind.live for kind in SOURCES if kind.scheme == scheme)


def is_source(spec: str) -> bool:
    """True if `spec` begins with the scheme of a source."""
    scheme, colon, _ = spec.partition(":")
    return bool(colon) and scheme in {kind.scheme for kind in SOURCES}
