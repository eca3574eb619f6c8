"""Files of data set folders as tests write and read them."""

from pathlib import Path

import cv2
import numpy as np

from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.ports import FrameSource


def read(source: FrameSource) -> tuple[list[Frame], list[ImuBatch]]:
    frames, batches, last_ns = [], [], -1
    for item in source:
        if isinstance(item, Frame):
            assert item.t_ns > last_ns
            assert not batches or batches[-1].t_ns[-1] <= item.t_ns
            last_ns = item.t_ns
            frames.append(item)
        else:
            assert item.t_ns[0] > (batches[-1].t_ns[-1] if batches else -1)
            batches.append(item)
    return frames, batches


def picture(seed: int = 0, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, size, np.uint8)


def put(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
