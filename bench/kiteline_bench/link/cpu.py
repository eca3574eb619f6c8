"""CPU of the codec and of the endpoint, on keyframes of usual size."""

import random
import time

import numpy as np

from kiteline_codec.pacing.profiles import WIFI
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import (
    CameraIntrinsics,
    Key,
    KeyframeHeader,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id

_NEW_LANDMARKS = 170  # of a keyframe
_OBSERVATIONS = 190
_BACK = 10  # keyframes whose landmarks are observed again


def flight(keyframes: int) -> list[list[Record]]:
    """Records by keyframe of a flight along a wall; only their sizes and spreads matter."""
    rng = np.random.default_rng(1)
    camera = RectifiedCamera(752, 480, 430.0, 430.0, 370.0, 240.0, 0.11, True, np.eye(4))
    submap = submap_id(0, 0, 0)
    out: list[list[Record]] = [[CameraIntrinsics(AgentId(0), camera)]]
    created: list[tuple[np.ndarray, np.ndarray]] = []  # pixels and inverse depths of each keyframe's new landmarks
    step = 0.05  # m along x between keyframes
    for k in range(keyframes):
        keyframe = keyframe_id(submap, k)
        n = _OBSERVATIONS if k else 0
        back = np.sort(k - 1 - np.minimum(rng.integers(0, _BACK, n), k - 1)) if k else np.zeros(0, np.int64)
        point = np.unique(keyframe_id(submap, 0) + back << 11 | rng.integers(0, _NEW_LANDMARKS, n))
        rows = [(int(p >> 11) - keyframe_id(submap, 0), int(p & 2047)) for p in point]
        uv = np.array([created[a][0][i] - (step * (k - a) * 430.0 * created[a][1][i], 0.0) for a, i in rows]).reshape(
            -1, 2
        )
        rho = np.array([created[a][1][i] for a, i in rows])
        inside = (uv > -50).all(axis=1) if len(rows) else np.zeros(0, bool)
        point, uv, rho = point[inside], uv[inside], rho[inside]
        noise = rng.normal(0, 0.3, uv.shape)
        T = se3.from_rt(np.eye(3), np.array([step if k else 0.0, 0.0, 0.0]))
        parent = KeyframeId(keyframe - 1) if k else NO_KEYFRAME
        new_uv = np.rint(rng.uniform(20, (730, 460), (_NEW_LANDMARKS, 2)))
        new_uv = new_uv[np.argsort(new_uv[:, 1] // 32, kind="stable")]
        new_rho = rng.uniform(0.1, 0.6, _NEW_LANDMARKS)
        landmarks = NewLandmarks(
            keyframe, 0, np.arange(_NEW_LANDMARKS, dtype=np.uint16), new_uv.astype(np.float32),
            new_rho.astype(np.float32), rng.integers(0, 3, _NEW_LANDMARKS).astype(np.uint8),
            rng.integers(0, 256, _NEW_LANDMARKS).astype(np.uint8),
            rng.integers(0, 256, (_NEW_LANDMARKS, 32)).astype(np.uint8),
        )  # fmt: skip
        observations = Observations(
            keyframe, 0, np.arange(_NEW_LANDMARKS, _NEW_LANDMARKS + len(point), dtype=np.uint16),
            (uv + noise).astype(np.float32), (rho * rng.normal(1, 0.01, len(rho))).astype(np.float32),
            np.zeros(len(point), np.uint8), point,
        )  # fmt: skip
        parts = WIFI.choose(landmarks, rng.uniform(size=_NEW_LANDMARKS), observations)
        out.append([KeyframeHeader(keyframe, k, parent, T, _NEW_LANDMARKS + len(point)), *parts[0], *parts[1]])
        created.append((new_uv, new_rho))
    return out


def coding_ms() -> float:
    """CPU ms to code a keyframe's records, compress the codes, and reverse both on the other side; the median."""
    held: dict[Key, tuple[int, bytes]] = {}
    ours, theirs = ResidualCoder(), ResidualCoder()
    took = []
    for records in flight(40):
        begin = time.process_time()
        for record in records:
            key, code = messages.key(record), messages.encode(record)
            form = ours.compress(key, code, held.get, held.get)
            got = code if form is None else theirs.expand(key, form, held.get)
            messages.decode(key, got)
            held[key] = (len(held) + 1, code)
        took.append((time.process_time() - begin) * 1e3)
    return float(np.median(took[len(took) // 2 :]))


def packet_ms() -> float:
    """CPU ms of a packet with values through both endpoints, acknowledgements included."""
    draw = random.Random(1)
    a, b = Endpoint(SyncConfig(), 1), Endpoint(SyncConfig(), 1)
    begin, now_ns = time.process_time(), 0
    for i in range(400):
        a.put(Key(LivePose.KIND, 0), draw.randbytes(29))
        for part in range(4):
            a.put(Key(NewLandmarks.KIND, i, part), draw.randbytes(900))
        for _ in range(3):
            now_ns += 20_000_000
            for end, other in ((a, b), (b, a)):
                while (packet := end.poll(now_ns)) is not None:
                    other.receive(packet, now_ns)
    return (time.process_time() - begin) * 1e3 / a.stats.packets_sent
