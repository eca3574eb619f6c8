"""What tests of bags share: calibration and pictures of a stereo camera, and fields of its messages."""

from itertools import pairwise

import cv2
import numpy as np

from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3
from kiteline_hw.ports import FrameSource

START_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000
T_B_L = se3.exp(np.array([0.02, -0.06, 0.01, 1.2, -1.2, 1.2]))
T_L_R = se3.exp(np.array([0.11, 0.0, 0.0, 0.001, -0.002, 0.003]))
D = (-0.28, 0.07, 0.0002, 1.8e-05)


def picture(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (48, 64), np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def read(source: FrameSource) -> tuple[list[Frame], list[ImuBatch]]:
    items = list(source)
    frames, batches = [i for i in items if isinstance(i, Frame)], [i for i in items if isinstance(i, ImuBatch)]
    assert all(b.t_ns > a.t_ns for a, b in pairwise(frames))
    stamps = np.concatenate([b.t_ns for b in batches]) if batches else np.zeros(0)
    assert (np.diff(stamps) > 0).all()
    return frames, batches


def xyz(v: np.ndarray) -> dict[str, float]:
    return {"x": float(v[0]), "y": float(v[1]), "z": float(v[2])}


def quaternion(t: np.ndarray) -> dict[str, float]:
    q = se3.quaternion_from_rotation(t[:3, :3])
    return {"w": float(q[0]), "x": float(q[1]), "y": float(q[2]), "z": float(q[3])}
