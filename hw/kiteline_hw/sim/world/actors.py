"""People and cars that move through a scene: where their boxes are at any time. Deterministic."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sim.world.path import Path
from kiteline_hw.sim.world.textures import TEXEL_M, TexturePool
from kiteline_hw.sim.world.world import World

Rng = np.random.Generator

PASS_S = 4.0  # s before and after a person crosses the view
_EVERY_S = 3.0  # s, mean time between two crossings by one person
_CLEARANCE_M = 0.7  # of a person from the camera
_STRIDE_M = 1.4  # m of a double step
# Boxes of a person: centre (ahead, left, up), half-extents, swing of the limb (1, -1 or 0). 1.75 m tall.
_PERSON = np.array([
    [0.00, 0.00, 1.18, 0.12, 0.21, 0.30, 0.0],  # torso
    [0.00, 0.00, 1.62, 0.10, 0.08, 0.13, 0.0],  # head
    [0.00, 0.10, 0.44, 0.09, 0.08, 0.44, 1.0],  # legs
    [0.00, -0.10, 0.44, 0.09, 0.08, 0.44, -1.0],
    [0.00, 0.27, 1.13, 0.06, 0.05, 0.33, -1.0],  # arms
    [0.00, -0.27, 1.13, 0.06, 0.05, 0.33, 1.0],
])  # fmt: skip
_SWING_M = 0.22
_CAR = np.array([
    [0.00, 0.00, 0.62, 2.10, 0.88, 0.42, 0.0],
    [-0.15, 0.00, 1.22, 1.15, 0.78, 0.24, 0.0],
])  # fmt: skip
_LANE_M = 3.2  # m to the left of the path, where oncoming cars drive
_AWAY = 1e6  # m; where what is not in the scene is put


@dataclass(frozen=True, slots=True)
class _Crossing:
    """A straight walk: at `xy` (2,) at time at_s, with velocity (2,) in m/s."""

    at_s: float
    xy: F64
    velocity: F64


@dataclass(frozen=True, slots=True)
class Actors:
    """Moving solids. faces (6 n, 8): surfaces of their n boxes. walks: of each person. gaps_s: of each car, see below.

    A car with a positive gap drives ahead of the camera by so many seconds of its path; one with a negative gap comes
    towards it and meets it after so many seconds, and every 12 s again.
    """

    world: World
    path: Path
    faces: F64
    walks: tuple[tuple[_Crossing, ...], ...]
    gaps_s: tuple[float, ...]

    def boxes(self, t_s: float) -> F64:
        """Boxes (n, 8) at a flight time, laid out as those of the world; those away are far below."""
        people = [_person(self.world, walk, t_s) for walk in self.walks]
        cars = [self._car(gap_s, t_s) for gap_s in self.gaps_s]
        return np.concatenate([*people, *cars]).reshape(-1, 8)

    def _car(self, gap_s: float, t_s: float) -> F64:
        if gap_s > 0.0:
            at_s, side = t_s + gap_s + 0.35 * np.sin(0.5 * t_s + 3.0 * gap_s), 0.0
        else:
            since = (t_s + gap_s) % 12.0  # meets the camera where the path is at t - since
            at_s, side = t_s - since + 0.9 * (6.0 - since) + 6.0, _LANE_M
        if not 0.0 < at_s < self.path.duration_s - 0.2:
            return _gone(len(_CAR))
        here, ahead = self.path.motion(np.array([at_s, at_s + 0.1])).T_w_b[:, :3, 3]
        along = ahead[:2] - here[:2]
        if np.linalg.norm(along) < 0.05:
            return _gone(len(_CAR))
        yaw = float(np.arctan2(along[1], along[0]))
        xy = here[:2] + side * np.array([-np.sin(yaw), np.cos(yaw)])
        return _placed(_CAR, self.world, xy, yaw, 0.0)


def make_actors(world: World, path: Path, camera_in_body: F64, people: int, cars: int, seed: int) -> Actors | None:
    """People who cross the view of a camera flown along `path`, and cars on its road; None without any."""
    if not people and not cars:
        return None
    rng = np.random.default_rng([seed, 83])
    times = np.arange(0.0, path.duration_s + PASS_S, 0.1)
    T_w_c = path.motion(times).T_w_b @ camera_in_body
    walks = tuple(_walk(rng, world, times, T_w_c) for _ in range(people))
    gaps = tuple(float(rng.uniform(1.2, 2.2)) if k % 2 else -float(rng.uniform(3.0, 11.0)) for k in range(cars))
    faces = [_clothes(rng, world.pool) for _ in range(people)] + [_paint(rng, world.pool) for _ in range(cars)]
    return Actors(world, path, np.concatenate(faces), walks, gaps)


def _walk(rng: Rng, world: World, times: F64, T_w_c: F64) -> tuple[_Crossing, ...]:
    """Crossings of the view 1.5 to 4 m ahead of the camera, none of them through the camera or through a wall."""
    found: list[_Crossing] = []
    at_s = float(rng.uniform(0.0, _EVERY_S))
    while at_s < times[-1]:
        for _ in range(40):
            k = int(np.searchsorted(times, at_s).clip(0, len(times) - 1))
            ahead = T_w_c[k, :2, 2] / max(1e-6, float(np.linalg.norm(T_w_c[k, :2, 2])))
            xy = T_w_c[k, :2, 3] + ahead * rng.uniform(1.5, 4.0)
            turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.9, 2.2)
            c, s = np.cos(turn), np.sin(turn)
            velocity = rng.uniform(0.8, 1.6) * np.array([c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]])
            near = np.abs(times - at_s) <= PASS_S
            places = xy + np.outer(times[near] - at_s, velocity)
            apart = np.linalg.norm(places - T_w_c[near, :2, 3], axis=1)
            if apart.min() > _CLEARANCE_M and _inside(world, xy):
                found.append(_Crossing(at_s, xy, velocity))
                break
        at_s += float(rng.uniform(0.5, 1.5)) * _EVERY_S
    return tuple(found)


def _inside(world: World, xy: F64) -> bool:
    if world.shell is None:
        return True
    room = world.boxes[world.shell]
    return bool((np.abs(xy - room[:2]) < room[3:5] - 0.3).all())


def _person(world: World, walk: tuple[_Crossing, ...], t_s: float) -> F64:
    """The boxes of a person: those of the crossing nearest in time, away between two crossings."""
    if not walk:
        return _gone(len(_PERSON))
    crossing = min(walk, key=lambda c: abs(c.at_s - t_s))
    since = t_s - crossing.at_s
    if abs(since) > PASS_S:
        return _gone(len(_PERSON))
    speed = float(np.linalg.norm(crossing.velocity))
    yaw = float(np.arctan2(crossing.velocity[1], crossing.velocity[0]))
    swing = _SWING_M * float(np.sin(2 * np.pi * speed * since / _STRIDE_M))
    return _placed(_PERSON, world, crossing.xy + since * crossing.velocity, yaw, swing)


def _placed(parts: F64, world: World, xy: F64, yaw: float, swing: float) -> F64:
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left = parts[:, 0] + swing * parts[:, 6], parts[:, 1]
    floor = float(world.height(xy[None])[0])
    out = np.empty((len(parts), 8))
    out[:, 0], out[:, 1] = xy[0] + c * ahead - s * left, xy[1] + s * ahead + c * left
    out[:, 2], out[:, 3:6] = floor + parts[:, 2], parts[:, 3:6]
    out[:, 6], out[:, 7] = c, s
    return out


def _gone(n: int) -> F64:
    return np.tile(np.array([0.0, 0.0, -_AWAY, 0.1, 0.1, 0.1, 1.0, 0.0]), (n, 1))


def _faces(rng: Rng, pool: TexturePool, contrast: float, brightness: float) -> F64:
    """Faces (6, 8) of one box, all of one cloth or paint."""
    texture = int(rng.integers(1, len(pool.names)))
    side = 1 << int(pool.table[texture, 0])
    out = np.zeros((6, 8))
    out[:, :2], out[:, 2:4] = 1.0 / TEXEL_M, rng.uniform(0, side, (6, 2))
    out[:, 4], out[:, 5], out[:, 6] = brightness, contrast, texture
    return out


def _clothes(rng: Rng, pool: TexturePool) -> F64:
    """Faces of a person: torso and arms alike, legs alike, a head."""
    shirt, trousers = (_faces(rng, pool, rng.uniform(0.2, 0.9), rng.uniform(0.35, 1.2)) for _ in range(2))
    head = _faces(rng, pool, 0.25, 0.8)
    return np.concatenate([shirt, head, trousers, trousers, shirt, shirt])


def _paint(rng: Rng, pool: TexturePool) -> F64:
    return np.concatenate([_faces(rng, pool, 0.3, rng.uniform(0.3, 1.1)), _faces(rng, pool, 0.6, 0.4)])
