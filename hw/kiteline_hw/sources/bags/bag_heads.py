"""The first bytes of recordings of messages, and errors for those that cannot be read. It imports nothing heavy."""

from pathlib import Path

from kiteline_hw.ports import SourceError

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG"


def refuse_unreadable(path: Path) -> None:
    """Raise SourceError, with what helps, for a ROS 1 bag and for a file that was packed as a whole.

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
            head = file.read(len(_ROS1_MAGIC))
    except OSError:
        return
    if head == _ROS1_MAGIC:
        raise SourceError(
            f"{path}: a bag of ROS 1: expected one of ROS 2; convert it with `pip install rosbags` and "
            f"`rosbags-convert --src {path.name} --dst FOLDER`"
        )
    if head.startswith(ZSTD_MAGIC):
        raise SourceError(f"{path}: packed as a whole: unpack it first with `zstd -d {path.name}`")
