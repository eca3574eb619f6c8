"""Reads calibration files, whichever tool wrote them, and writes them in the form of any."""

from collections.abc import Callable
from pathlib import Path

from kiteline_hw.calibration import euroc, kalibr, opencv, orb_slam, own
from kiteline_hw.calibration.file_calibration import FileCalibration, FilePart, joined
from kiteline_hw.calibration.nodes import Node, read_nodes
from kiteline_hw.ports import SourceError
from kiteline_hw.system.process import home_path

# How each form is recognised, and its reader. An IMU of Kalibr's has the keys of EuRoC's without T_BS, so it is last.
_READERS: tuple[tuple[Callable[[Node], bool], Callable[[Node], FilePart]], ...] = (
    (own.is_own, own.read_own),
    (kalibr.is_chain, kalibr.read_chain),
    (euroc.is_sensor, euroc.read_sensor),
    (opencv.is_pair, opencv.read_pair),
    (opencv.is_camera, opencv.read_camera),
    (orb_slam.is_settings, orb_slam.read_settings),
    (kalibr.is_imu, kalibr.read_imu),
)

FORMS: dict[str, Callable[[FileCalibration], dict[str, str]]] = {
    "kiteline": own.texts,
    "kalibr": kalibr.texts,
    "euroc": euroc.texts,
    "ros": opencv.ros_texts,
    "opencv": opencv.texts,
}


def read_calibration(text: str) -> FileCalibration:
    """The calibration of FILE[,FILE…]: left camera first. Raises SourceError."""
    names = [name for name in text.split(",") if name]
    if not names:
        raise SourceError(f"{text!r} names no calibration: expected FILE, or several with commas between")
    return joined([_read(home_path(name)) for name in names])


def _read(path: Path) -> FilePart:
    node = read_nodes(path)
    for recognises, read in _READERS:
        if recognises(node):
            return read(node)
    some = ", ".join(sorted(node.keys)[:6])
    raise SourceError(
        f"{path}: no calibration that is known: expected kiteline's calibration.yaml, Kalibr's camchain or imu, "
        f"EuRoC's sensor.yaml, ROS' camera_info, OpenCV's FileStorage or ORB-SLAM3's settings; found the keys {some}"
    )
