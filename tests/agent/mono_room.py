"""A rendered room and the path of one camera through it."""

from functools import cache

import cv2
import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_core.arrays import F64, U8
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.ids import AgentId

W, H, FOCAL = 320, 240, 220.0


CAMERA = CameraModel(W, H, FOCAL, FOCAL, 159.5, 119.5)


RIG = CameraRig(CAMERA, None, np.eye(4), None, has_body=False)


# A room in camera axes: planes n . x = d, each with the two axes of its texture.
PLANES = (
    (np.array([0.0, 0.0, 1.0]), 5.0, 0, 1),
    (np.array([0.0, 1.0, 0.0]), 1.2, 0, 2),
    (np.array([0.0, -1.0, 0.0]), 1.8, 0, 2),
    (np.array([-1.0, 0.0, 0.0]), 2.2, 2, 1),
    (np.array([1.0, 0.0, 0.0]), 2.6, 2, 1),
)


@cache
def texture(seed: int) -> U8:
    noise = np.random.default_rng(seed).integers(0, 256, (512, 512), np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.6), None, 5, 250, cv2.NORM_MINMAX), np.uint8)


@cache
def rays() -> F64:
    """Rays (n,3) of the pixels, row by row, in camera axes."""
    u, v = np.meshgrid(np.arange(float(W)), np.arange(float(H)))
    return np.stack([(u - CAMERA.cx) / FOCAL, (v - CAMERA.cy) / FOCAL, np.ones_like(u)], -1).reshape(-1, 3)


def room(T_w_c: F64) -> tuple[U8, F64]:
    """What a camera sees of the room, (h,w) grey, and the depths (h,w)."""
    ray = np.ascontiguousarray((rays() @ T_w_c[:3, :3].T).T)  # (3,n): four times as fast as (n,3)
    depth, nearest = np.full(W * H, np.inf), np.full(W * H, len(PLANES), np.uint8)
    for k, (normal, d, _, _) in enumerate(PLANES):
        axis = int(np.argmax(np.abs(normal)))
        with np.errstate(divide="ignore"):
            here = (d - normal @ T_w_c[:3, 3]) / (ray[axis] * normal[axis])
        nearer = (here > 1e-6) & (here < depth)
        depth[nearer], nearest[nearer] = here[nearer], k
    hit = T_w_c[:3, 3, None] + ray * np.where(np.isfinite(depth), depth, 0.0)
    place = (hit * 60.0).astype(np.float32)
    if np.abs(place).max() < 510.0:
        np.add(place, np.float32(510.0), out=place, where=place < 0.0)  # as below, in a tenth of the time
    else:
        place %= 510.0
    place, image = place.reshape(3, H, W), np.zeros((H, W), np.uint8)
    for k, (_, _, a, b) in enumerate(PLANES):
        shown = (nearest == k).reshape(H, W)
        if shown.any():
            image[shown] = cv2.remap(texture(k), place[a], place[b], cv2.INTER_LINEAR)[shown]
    return image, depth.reshape(H, W)


def path(k: float) -> F64:
    """A sideways and forward sweep with turns; at rest for the first frames."""
    s = max(k - 3, 0) * 0.05
    turn = se3.so3_exp(np.array([0.06 * np.sin(1.3 * s), 0.16 * np.sin(0.9 * s), 0.05 * np.sin(s)]))
    return se3.from_rt(turn, np.array([0.7 * np.sin(0.8 * s), 0.15 * np.sin(1.1 * s), 0.35 * s]))


@cache
def frame(k: int) -> Frame:
    return Frame(k * 50_000_000, room(path(k))[0])


def context(k: int, images: FrameImages) -> FrameContext:
    return FrameContext(k, k, 0.0, None, images, np.eye(4), False, AgentConfig())


def agent() -> Agent:
    return Agent(RIG, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())


def step(one: Agent, f: Frame) -> Estimate:
    estimate = one.step(StepInput(f), f.t_ns).estimate
    assert estimate is not None
    return estimate


def similar(p: F64, q: F64) -> tuple[float, float]:
    """Scale that brings points p (n,3) onto q (n,3), and the rms distance that is left (S. Umeyama, 1991)."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = float((s * d).sum() / (a**2).sum())
    return scale, float(np.sqrt(((b - scale * a @ (u @ np.diag(d) @ vt).T) ** 2).sum(axis=1).mean()))
