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
    """Rays (h,w,3) of the pixels, in camera axes."""
    u, v = np.meshgrid(np.arange(float(W)), np.arange(float(H)))
    return np.stack([(u - CAMERA.cx) / FOCAL, (v - CAMERA.cy) / FOCAL, np.ones_like(u)], -1)


def room(T_w_c: F64) -> tuple[U8, F64]:
    """What a camera sees of the room, (h,w) grey, and the depths (h,w)."""
    ray = rays() @ T_w_c[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.stack([(d - normal @ T_w_c[:3, 3]) / (ray @ normal) for normal, d, _, _ in PLANES])
    depths = np.where(depths > 1e-6, depths, np.inf)
    best, nearest = depths.min(axis=0), depths.argmin(axis=0)
    hit = T_w_c[:3, 3] + ray * np.where(np.isfinite(best), best, 0.0)[..., None]
    place, image = (hit * 60.0).astype(np.float32) % 510, np.zeros((H, W), np.uint8)
    for seed, (_, _, a, b) in enumerate(PLANES):
        here = (nearest == seed) & np.isfinite(best)
        if here.any():
            image[here] = cv2.remap(texture(seed), place[..., a], place[..., b], cv2.INTER_LINEAR)[here]
    return image, best


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
