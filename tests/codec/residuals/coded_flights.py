"""Keyframes of a flight, coded relative to each other."""

import numpy as np

from kiteline_codec.schema import CameraIntrinsics, Key, KeyframeHeader, NewLandmarks, Observations, Record, messages
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id

CAMERA = RectifiedCamera(752, 480, 430.0, 431.0, 370.0, 241.0, 0.11, True, np.eye(4))
SUBMAP = submap_id(3, 7, 2)
Values = dict[Key, tuple[int, bytes]]


def flight(seed: int, keyframes: int = 6, landmarks: int = 60, narrow: bool = False) -> list[Record]:
    """Keyframes of a sideways flight along a wall of landmarks, with noise; each observes earlier landmarks."""
    rng = np.random.default_rng(seed)
    records: list[Record] = [CameraIntrinsics(AgentId(3), CAMERA)]
    poses: list[F64] = []
    points: list[tuple[int, F64]] = []
    for k in range(keyframes):
        keyframe = keyframe_id(SUBMAP, k)
        T_m_k = se3.exp(np.concatenate([[0.2 * k, 0.02 * k, 0.05 * k], rng.normal(0, 0.02, 3)]))
        poses.append(T_m_k)
        parent = KeyframeId(keyframe - 1) if k else NO_KEYFRAME
        T_p_k = se3.inverse(poses[k - 1]) @ T_m_k if k else T_m_k
        seen = [(p, *project(T_m_k, x)) for p, x in points]
        seen = [(p, u, v, rho) for p, u, v, rho in seen if 0 < u < 752 and 0 < v < 480 and rho > 0]
        seen.sort()
        uv = np.array([[u, v] for _, u, v, _ in seen]).reshape(-1, 2) + rng.normal(0, 0.3, (len(seen), 2))
        rho = np.array([r for *_, r in seen]) * rng.normal(1, 0.01, len(seen))
        rho[rng.uniform(size=len(seen)) < 0.1] = 0.0
        records.append(KeyframeHeader(keyframe, k * 10**8, parent, T_p_k, landmarks + len(seen)))
        new_uv = np.rint(rng.uniform(20, (730, 460), (landmarks, 2)))
        new_rho = rng.uniform(0.1, 0.5, landmarks)
        descriptor = rng.integers(0, 256, (landmarks, 32)).astype(np.uint8)
        half = landmarks // 2
        for part, rows in enumerate((np.arange(half), np.arange(half, landmarks))):
            records.append(
                NewLandmarks(
                    keyframe, part, rows.astype(np.uint16), new_uv[rows].astype(np.float32),
                    new_rho[rows].astype(np.float32), rng.integers(0, 3, len(rows)).astype(np.uint8),
                    rng.integers(0, 256, len(rows)).astype(np.uint8), descriptor[rows],
                )
            )  # fmt: skip
        octave = np.zeros(len(seen), np.uint8)
        records.append(
            Observations(
                keyframe, 0, np.arange(landmarks, landmarks + len(seen), dtype=np.uint16), uv.astype(np.float32),
                rho.astype(np.float32), octave, np.array([p for p, *_ in seen], np.int64),
            )
        )  # fmt: skip
        for i in range(landmarks):
            x = np.append((new_uv[i] - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy), 1.0) / new_rho[i]
            points.append((keyframe << 11 | i, T_m_k[:3, :3] @ x + T_m_k[:3, 3]))
    return records


def project(T_m_k: F64, x: F64) -> tuple[float, float, float]:
    p = T_m_k[:3, :3].T @ (x - T_m_k[:3, 3])
    if p[2] < 0.1:
        return -1.0, -1.0, 0.0
    return p[0] / p[2] * CAMERA.fx + CAMERA.cx, p[1] / p[2] * CAMERA.fy + CAMERA.cy, 1.0 / p[2]


def coded(records: list[Record]) -> Values:
    return {messages.key(r): (i + 1, messages.encode(r)) for i, r in enumerate(records)}
