"""The first bytes of recordings of messages, and errors for those that cannot be read. It imports nothing heavy."""

from pathlib import Path

from kiteline_hw.ports import SourceError

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG"
_VIDEO_MAGICS = ((4, b"ftyp"), (8, b"AVI "), (0, b"\x1a\x45\xdf\xa3"))  # where what stands: MP4 and MOV, AVI, Matroska
_HEAD_BYTES = 12


def refuse_unreadable(path: Path) -> None:
    """Raise SourceError, with what helps, for a ROS 1 bag, a video and a file that was packed as a whole.

    Of a folder, its files are looked at.
    """
    if path.is_dir():
        for entry in sorted(path.iterdir()):
            if entry.is_file():
                refuse_unreadable(entry)
        return
    try:
        if not path.is_file():  # to open a named pipe waits for what writes to it
            return
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return
    if head.startswith(_ROS1_MAGIC):
        raise SourceError(
            f"{path}: a bag of ROS 1: expected one of ROS 2; convert it with `pip install rosbags` and "
            f"`rosbags-convert --src {path.name} --dst FOLDER`"
        )
    if head.startswith(ZSTD_MAGIC):
        raise SourceError(f"{path}: packed as a whole: unpack it first with `zstd -d {path.name}`")
    if any(head[at:].startswith(magic) for at, magic in _VIDEO_MAGICS):
        raise SourceError(
            f"{path}: a video, which is flown as images: `mkdir images && ffmpeg -i {path.name} -vf fps=20 "
            "images/%06d.png`, a camera.yaml beside them, and images:'images/*.png?fps=20'"
        )
