"""A FrameSource over files on disk: what the readers of data set folders return."""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import EncodedFrame, decode_frames, pair_by_time, pair_tolerance_ns
from kiteline_hw.sensors.image_names import Keys, in_natural_order
from kiteline_hw.sensors.images import ImageFile, decode_grey
from kiteline_hw.sensors.imu_buffer import ImuSamples, NoImu
from kiteline_hw.sensors.raw_pixels import BadImage

Stamped = list[tuple[int, Path]]  # t_ns, image file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(slots=True)
class Recording:
    """A FrameSource that starts anew with each iteration. frames: the images in order of time, still encoded.

    T_s_b: (4,4) body in the frame that EuRoC's sensor.yaml share; None without such files.
    """

    name: str
    rig: CameraRig
    frame_count: int | None
    frames: Callable[[SourceReport], Iterator[EncodedFrame]]
    imu: ImuCalibration | None = None
    ground_truth: Trajectory | None = None
    samples: Callable[[SourceReport], ImuSamples] | None = None
    report: SourceReport = field(default_factory=SourceReport)
    T_s_b: F64 | None = None

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        self.report.clear()
        samples = NoImu() if self.imu is None or self.samples is None else self.samples(self.report)
        return decode_frames(self.frames(self.report), samples, self.rig, self.report, self.name)

    def close(self) -> None:
        """Nothing is held open between two images."""


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder by name, numbers by their value; empty if there is no such folder."""
    if not folder.is_dir():
        return []
    return in_natural_order(
        [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    )


def frames_by_key(
    times: list[int], lefts: list[Path], rights: list[Path], keys: tuple[Keys, Keys], report: SourceReport
) -> Iterator[EncodedFrame]:
    """Frames of left and right images with the same key; a left image without a partner comes alone.

    keys: of the left and of the right images. No right images: one camera.
    """
    by_key = dict(zip(keys[1], rights, strict=True))
    for t, left, key in zip(times, lefts, keys[0], strict=True):
        right = by_key.pop(key, None)
        if right is None and rights:
            report.skip("missing right image", f"{left.name} has no partner")
        yield EncodedFrame(t, ImageFile(left), None if right is None else ImageFile(right))
    for path in by_key.values():
        report.skip("missing left image", f"{path.name} has no partner")


def frames_by_time(lefts: Stamped, rights: Stamped, report: SourceReport) -> Iterator[EncodedFrame]:
    """Frames of left and right images, paired by their stamps; a left image without a partner comes alone."""
    sides = ([(t, side, path) for t, path in images] for side, images in enumerate((lefts, rights)))
    tolerance_ns = pair_tolerance_ns(np.array([t for t, _ in lefts], np.int64))
    for t, left, right in pair_by_time(heapq.merge(*sides), tolerance_ns, ("left image", "right image"), report):
        yield EncodedFrame(t, ImageFile(left), None if right is None else ImageFile(right))


def image_size(images: list[Path]) -> tuple[int, int]:
    """Height and width in px of the first image that can be decoded. Raises SourceError."""
    for path in images[:20]:
        try:
            pixels, _ = decode_grey(ImageFile(path))
        except BadImage:
            continue
        return pixels.shape[0], pixels.shape[1]
    raise SourceError(f"{images[0].parent}: none of the first images can be decoded: expected PNG or JPEG files")


def sorted_trajectory(poses: list[tuple[int, F64]]) -> Trajectory:
    """Poses (t_ns, (4,4)) in order of time, repeated stamps dropped."""
    poses = sorted(poses, key=lambda pose: pose[0])
    kept = [pose for i, pose in enumerate(poses) if i == 0 or pose[0] > poses[i - 1][0]]
    matrices = np.array([pose[1] for pose in kept], np.float64).reshape(-1, 4, 4)
    return Trajectory(np.array([pose[0] for pose in kept], np.int64), matrices)
