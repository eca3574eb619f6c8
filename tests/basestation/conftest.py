"""A synthetic flight: points on the walls of a room, keyframes along a path, a forgetful tracker, noisy pixels."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.station import Station
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, NewLandmarks, Observations, Record
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id
from kiteline_core.places.place_index import Vocabulary, nodes
from tests.basestation.saved_flights import ELSEWHERE, Agents, MakeFlight, new_station


@dataclass
class Flight:
    """Records by keyframe, and the truth. agent_T_m_k: the poses that the agent believes in (they drift)."""

    camera: RectifiedCamera
    agent: AgentId
    world: F64
    keyframes: list[KeyframeId] = field(default_factory=list)
    true_T_m_k: list[F64] = field(default_factory=list)
    true_T_w_k: list[F64] = field(default_factory=list)
    agent_T_m_k: list[F64] = field(default_factory=list)
    records: list[list[Record]] = field(default_factory=list)
    observations: set[tuple[KeyframeId, int]] = field(default_factory=set)  # keyframe and keypoint
    wild: set[tuple[KeyframeId, int]] = field(default_factory=set)  # observations that are wrong by 12 px or more
    point_of: dict[int, int] = field(default_factory=dict)  # point id -> row of world

    def all_records(self) -> list[Record]:
        """Everything in order, the camera first."""
        return [CameraIntrinsics(self.agent, self.camera), *(r for part in self.records for r in part)]


@dataclass
class Scene:
    """Points (n,3) with descriptors (n,32), sizes and directions (n,), and the way through them: turns -> T_w_k."""

    world: F64
    descriptors: U8
    size: F64
    direction: I64
    path: Callable[[float], F64]


def look(position: F64, forward: F64) -> F64:
    """T_w_k (4,4) of a camera at position (3,) that looks along forward (3,) with a level horizon."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return se3.from_rt(np.stack([right, np.cross(forward, right), forward], 1), position)


def circle(turns: float) -> F64:
    """Around a circle of 1.2 m radius, looking outwards."""
    phi = 2 * np.pi * turns
    forward = np.array([np.cos(phi), np.sin(phi), 0.05 * np.sin(3 * phi)])
    return look(np.array([1.2 * np.cos(phi), 1.2 * np.sin(phi), 0.2 * np.sin(2 * phi)]), forward)


def room(rng: np.random.Generator, points: int) -> Scene:
    """Points on the walls of a room of 8 x 7 x 3 m."""
    half = np.array([4.0, 3.5, 1.5])
    world = rng.uniform(-1, 1, (points, 3)) * half
    wall = rng.integers(0, 2, points)
    world[np.arange(points), wall] = np.sign(world[np.arange(points), wall]) * half[wall]
    descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    size, direction = rng.uniform(-0.4, 1.4, points), rng.integers(0, 256, points)
    return Scene(world, descriptors, size, direction, circle)


def fly(
    keyframes: int = 20, points: int = 700, seed: int = 0, memory: int = 4, noise_px: float = 0.3,
    drift_m: float = 0.004, outliers: float = 0.01, stereo: bool = True, agent: int = 0, turns: float = 1.0,
    missed: float = 0.1, no_depth: float = 0.0, submap: int = 0, start: float = 0.0, variant: int = 0,
    T_w_m: F64 | None = None, scene: Scene | None = None, boot: int = 1,
) -> Flight:  # fmt: skip
    """Fly a circle of 1.2 m radius, looking outwards. memory: keyframes after which the tracker forgets a point.

    start: where on the circle, in turns. variant: of the noise, in the same world. T_w_m: where the agent's m lies in
    the world. scene: another world than the room that the seed makes.
    """
    rng = np.random.default_rng(seed)
    camera = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, stereo, np.eye(4))
    if scene is None:
        scene = room(rng, points)
    world, descriptors, size, direction, path = scene.world, scene.descriptors, scene.size, scene.direction, scene.path
    points = len(world)
    if variant:
        rng = np.random.default_rng([seed, variant])
    T_m_w = np.eye(4) if T_w_m is None else se3.inverse(T_w_m)
    flight = Flight(camera, AgentId(agent), world)
    in_submap = submap_id(agent, boot, submap)
    tracked: dict[int, tuple[int, int]] = {}  # row of world -> point id, number of the keyframe that last saw it
    for n in range(keyframes):
        in_world = path(start + turns * n / keyframes)
        true = T_m_w @ in_world
        if n == 0:
            parent, T_p_k = NO_KEYFRAME, true
        else:
            step = np.concatenate([rng.normal(0, drift_m, 3), rng.normal(0, drift_m / 3, 3)])
            parent, T_p_k = flight.keyframes[-1], se3.inverse(flight.true_T_m_k[-1]) @ true @ se3.exp(step)
        believed = T_p_k if n == 0 else flight.agent_T_m_k[-1] @ T_p_k
        keyframe = keyframe_id(in_submap, n)
        local = se3.transform(se3.inverse(in_world), world)
        z = np.maximum(local[:, 2], 0.01)
        uv = np.stack([420 * local[:, 0] / z + 376, 420 * local[:, 1] / z + 240], 1)
        seen = (local[:, 2] > 0.3) & (uv > 8).all(1) & (uv < [744, 472]).all(1) & (rng.random(points) > missed)
        rows = rng.permutation(np.flatnonzero(seen))[:300]
        octave = np.clip(np.rint(size[rows] + np.log2(3.0 / z[rows])), 0, 2).astype(np.uint8)
        # As in rendered flights: errors double with each octave, and disparities err by 0.4 of what pixels do.
        px = 2.0 ** octave[:, None] * rng.normal(0, noise_px, (len(rows), 3)) * [1.0, 1.0, 0.4]
        wild = rng.random(len(rows)) < outliers
        px[wild] += rng.choice([-12.0, 12.0], (int(wild.sum()), 3))
        measured = (uv[rows] + px[:, :2]).astype(np.float32)
        disparity = np.maximum(420 * 0.11 / z[rows] + px[:, 2], 0.2)
        inverse = (disparity / (420 * 0.11)).astype(np.float32)
        inverse[(not stereo) | (rng.random(len(rows)) < no_depth)] = 0.0
        known = np.array([r in tracked and n - tracked[r][1] <= memory for r in rows.tolist()], bool)
        ids = np.array([tracked[r][0] if k else -1 for r, k in zip(rows.tolist(), known, strict=True)], np.int64)
        flips = np.packbits(rng.random((len(rows), 256)) < 0.06, axis=1)
        made: list[Record] = [
            KeyframeHeader(keyframe, 10**9 + submap * 10**12 + n * 250_000_000, parent, T_p_k, len(rows))
        ]
        index = np.arange(len(rows), dtype=np.uint16)
        for kind, mask in (("new landmark", ~known), ("observation", known)):
            for part, some in enumerate(np.array_split(np.flatnonzero(mask), 3)):
                if kind == "new landmark":
                    angle = ((direction[rows[some]] + rng.integers(-5, 6, len(some))) & 255).astype(np.uint8)
                    made.append(
                        NewLandmarks(
                            keyframe,
                            part,
                            index[some],
                            measured[some],
                            inverse[some],
                            octave[some],
                            angle,
                            descriptors[rows[some]] ^ flips[some],
                        )
                    )
                else:
                    made.append(
                        Observations(
                            keyframe, part, index[some], measured[some], inverse[some], octave[some], ids[some]
                        )
                    )
        flight.observations |= {(keyframe, int(i)) for i in np.flatnonzero(known)}
        flight.wild |= {(keyframe, int(i)) for i in np.flatnonzero(wild & known)}
        for i, r in enumerate(rows.tolist()):
            if known[i]:
                tracked[r] = (tracked[r][0], n)
            else:
                tracked[r] = (int(point_id(keyframe, i)), n)
                flight.point_of[tracked[r][0]] = r
        flight.keyframes.append(keyframe)
        flight.true_T_m_k.append(true)
        flight.true_T_w_k.append(in_world)
        flight.agent_T_m_k.append(believed)
        flight.records.append(made)
    return flight


@pytest.fixture(scope="session")
def words() -> Vocabulary:
    """Words for descriptors that are noise: cells around noise."""
    rng = np.random.default_rng(5)
    centres = rng.integers(0, 2**64, (nodes(20, 2), 4), dtype=np.uint64)
    return Vocabulary(20, 2, centres, np.ones(400, np.float32))


@pytest.fixture(scope="session")
def make_flight() -> Callable[..., Flight]:
    """The maker of synthetic flights."""
    return fly


@pytest.fixture(scope="session")
def lively_room() -> Scene:
    """A room of 8 x 7 x 3 m, flown with accelerations in all directions."""

    def path(turns: float) -> F64:
        there = circle(turns)
        return look((1.0 + 0.1 * np.sin(2 * np.pi * 3.1 * turns)) * there[:3, 3], there[:3, 2])

    return replace(room(np.random.default_rng(21), 700), path=path)


@pytest.fixture(scope="session")
def ring() -> Scene:
    """A corridor that runs in a ring of 9 m radius, 4 m wide, every piece of wall another."""
    rng = np.random.default_rng(11)
    points = 4000
    phi, z = rng.uniform(0, 2 * np.pi, points), rng.uniform(-1.2, 1.2, points)
    radius = np.where(rng.random(points) < 0.6, 11.0, 7.0)
    world = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], 1)

    def path(turns: float) -> F64:
        a = 2 * np.pi * turns
        here = np.array([9.0 * np.cos(a), 9.0 * np.sin(a), 0.1 * np.sin(5 * a)])
        return look(here, np.array([-np.sin(a), np.cos(a), 0.0]) + 0.35 * np.array([np.cos(a), np.sin(a), 0.0]))

    descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    return Scene(world, descriptors, rng.uniform(-0.4, 1.4, points), rng.integers(0, 256, points), path)


def straight(pieces: int, period_m: float, same: float, seed: int) -> Scene:
    """A straight corridor whose walls repeat: this share of each piece's points is the same in every piece."""
    rng = np.random.default_rng(seed)
    n = 260
    piece = np.stack([rng.uniform(0, period_m, n), rng.choice([-1.5, 1.5], n), rng.uniform(-1.2, 1.2, n)], 1)
    descriptor = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    size, direction = rng.uniform(-0.4, 1.4, n), rng.integers(0, 256, n)
    world, described = [], []
    for k in range(pieces):
        own = rng.random(n) >= same
        at, code = piece + [k * period_m, 0.0, 0.0], descriptor.copy()
        at[own] = np.stack(
            [rng.uniform(0, period_m, n) + k * period_m, rng.choice([-1.5, 1.5], n), rng.uniform(-1.2, 1.2, n)], 1
        )[own]
        code[own] = rng.integers(0, 256, (int(own.sum()), 32), dtype=np.uint8)
        world.append(at)
        described.append(code)
    length = (pieces - 2) * period_m

    def path(turns: float) -> F64:
        return look(np.array([turns * length, 0.0, 0.0]), np.array([0.5, 1.0, 0.0]))

    return Scene(
        np.concatenate(world), np.concatenate(described), np.tile(size, pieces), np.tile(direction, pieces), path
    )  # fmt: skip


@pytest.fixture(scope="session")
def corridor() -> Scene:
    """Ten times the same 3 m of wall."""
    return straight(10, 3.0, 1.0, 12)


@pytest.fixture(scope="session")
def shelves() -> Scene:
    """Four times the same 4 m of shelf, 2 m deep. The path leads along it, in metres."""
    rng = np.random.default_rng(3)
    n = 220
    one = rng.uniform([0.0, 1.5, -1.2], [4.0, 3.5, 1.2], (n, 3))
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    size, direction = rng.uniform(-0.4, 1.4, n), rng.integers(0, 256, n)
    world = np.concatenate([one + [4.0 * k, 0.0, 0.0] for k in range(4)])

    def path(metres: float) -> F64:
        return look(np.array([metres, -0.5, 0.0]), np.array([0.2, 1.0, 0.0]))

    return Scene(world, np.tile(descriptors, (4, 1)), np.tile(size, 4), np.tile(direction, 4), path)


def two_rooms(shared: float, seed: int) -> tuple[Scene, Scene]:
    """Two rooms of 8 x 7 x 3 m and 10 x 9 x 3 m: of each wall's paper this share is the same in both."""
    first = room(np.random.default_rng(seed), 900)
    other = room(np.random.default_rng(seed + 1), 900)
    half, wide = np.array([4.0, 3.5, 1.5]), np.array([5.0, 4.5, 1.5])
    world = other.world * (wide / half)
    same = np.random.default_rng(seed + 2).random(900) < shared
    copied = first.world[same]
    on_x = np.abs(np.abs(copied[:, 0]) - half[0]) < 1e-9  # the paper is not stretched: only the wall stands elsewhere
    copied[on_x, 0] *= wide[0] / half[0]
    copied[~on_x, 1] *= wide[1] / half[1]
    world[same] = copied
    descriptors, size, direction = other.descriptors.copy(), other.size.copy(), other.direction.copy()
    descriptors[same], size[same], direction[same] = first.descriptors[same], first.size[same], first.direction[same]
    return first, Scene(world, descriptors, size, direction, circle)


@pytest.fixture(scope="session")
def papered() -> tuple[Scene, Scene]:
    """Two rooms with one wallpaper all over."""
    return two_rooms(1.0, 30)


@pytest.fixture(scope="session")
def half_papered() -> tuple[Scene, Scene]:
    """Two rooms that share half of what hangs on their walls."""
    return two_rooms(0.5, 40)


@pytest.fixture(scope="module")
def joined(make_flight: MakeFlight, words: Any) -> tuple[Agents, Station]:
    """Two agents whose maps have become one, and a third that is alone."""
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    c = make_flight(keyframes=8, turns=0.1, seed=9, agent=2)
    agents, station = Agents([a, b, c]), new_station(words)
    agents.fly(station, 0, 45)
    assert station.mapper.summary()["merges"] == 1
    return agents, station
