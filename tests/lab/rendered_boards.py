"""Pictures of a calibration board by a camera of known intrinsics, with blur and noise."""

import cv2
import numpy as np

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_lab.calibration.boards import Board
from kiteline_lab.calibration.lenses import project

PX_A_SQUARE = 40


def intrinsics(camera: CameraModel) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def directions_of(camera: CameraModel) -> np.ndarray:
    """Directions (h, w, 3) of all pixels, found by inverting the projection numerically."""
    h, w = camera.height, camera.width
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    px = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
    k, d = camera.matrix(), np.array(camera.distortion)
    if camera.lens is Lens.EQUIDISTANT:
        xy = (px[:, 0] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        bent = np.linalg.norm(xy, axis=1)
        theta = bent.copy()
        for _ in range(30):
            t2 = theta * theta
            f = theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))) - bent
            slope = 1 + t2 * (3 * d[0] + t2 * (5 * d[1] + t2 * (7 * d[2] + t2 * 9 * d[3])))
            theta = theta - f / slope
        unit = xy / np.maximum(bent, 1e-12)[:, None]
        out = np.concatenate([unit * np.sin(theta)[:, None], np.cos(theta)[:, None]], 1)
    else:
        xy = np.asarray(cv2.undistortPoints(px, k, d), np.float64).reshape(-1, 2)
        for _ in range(20):  # OpenCV stops early: finish by its own error
            error = project(camera.lens, intrinsics(camera), np.c_[xy, np.ones(len(xy))]) - px[:, 0]
            xy = xy - error / (camera.fx, camera.fy)
        out = np.c_[xy, np.ones(len(xy))]
    return out.reshape(h, w, 3)


def picture(
    board: Board, directions: np.ndarray, T_c_board: np.ndarray, rng: np.random.Generator, blur_px: float = 0.6,
    noise: float = 3.0,
) -> np.ndarray:  # fmt: skip
    """The board as seen, on a grey wall."""
    texture = board.draw(PX_A_SQUARE).astype(np.float32)
    margin = 0.5 * PX_A_SQUARE
    normal, origin = T_c_board[:3, 2], T_c_board[:3, 3]
    along = directions @ normal
    distance = (origin @ normal) / np.where(np.abs(along) > 1e-9, along, 1e-9)
    points = directions * distance[..., None] - origin
    xy = points @ T_c_board[:3, :2] / board.square_m * PX_A_SQUARE + margin - 0.5
    hit = (distance > 0) & (xy[..., 0] > -1) & (xy[..., 1] > -1)
    hit &= (xy[..., 0] < texture.shape[1]) & (xy[..., 1] < texture.shape[0])
    xy = np.where(hit[..., None], xy, -1e4).astype(np.float32)
    step = (
        float(np.median(np.linalg.norm(np.diff(xy[hit.any(1)], axis=1), axis=-1)[hit[hit.any(1)][:, 1:]]))
        if hit.any()
        else 1.0
    )
    soft = cv2.GaussianBlur(texture, (0, 0), max(0.3, 0.4 * step))
    image = cv2.remap(soft, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    image = cv2.GaussianBlur(image, (0, 0), blur_px) if blur_px > 0 else image
    return np.clip(30 + 0.75 * image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def poses(
    board: Board, camera: CameraModel, count: int, rng: np.random.Generator, half_angle: float
) -> list[np.ndarray]:
    """Board poses that cover the view: its middle in directions up to half_angle (rad) off the axis."""
    middle = 0.5 * np.array([board.columns, board.rows, 0.0]) * board.square_m
    size = board.columns * board.square_m
    out = []
    for i in range(count):
        x = half_angle * (2 * ((i * 0.618) % 1.0) - 1)
        y = half_angle * camera.height / camera.width * (2 * ((i * 0.381 + 0.2) % 1.0) - 1)
        direction = np.array([np.sin(x), np.sin(y) * np.cos(x), np.cos(x) * np.cos(y)])
        away = size * rng.uniform(0.9, 1.6) * camera.fx / camera.width * 1.4
        # towards the camera, then tilted
        facing = se3.so3_exp(np.array([-y, x, 0.0])) @ se3.so3_exp(rng.uniform(-0.6, 0.6, 3) * (1, 1, 0.3))
        T = se3.from_rt(facing, direction * away)
        T[:3, 3] -= T[:3, :3] @ middle
        out.append(T)
    return out
