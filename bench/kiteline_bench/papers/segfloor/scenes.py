"""Worlds like those of "Segfloor", section 6.2: two corridors with a low camera, and a long loop of wide ones.

The thesis prints sizes, not plans: areas, lengths, camera heights and objects are its own, the shapes are ours.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_bench.harness.recording import Item, Recording
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3, tum
from kiteline_hw.sim.config import read_config
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sim.world.textures import make_pool
from kiteline_hw.sim.world.world import NO_GROUND, Builder, World

Points = Sequence[tuple[float, float]]

_TEXTURES = ("leaves", "leaves2", "clutter", "posters", "plaster", "concrete", "wood", "brick")
_FLOOR = ("concrete", 0.6, 0.85)  # the thesis wants texture on the floor
_PATTERNED, _UNIFORM = ("brick", 0.6, 0.9), ("plaster", 0.3, 1.1)  # walls; the thesis's corridors have plain ones
_SHELF, _PILLAR = ("clutter", 0.8, 0.9), ("concrete", 0.54, 1.0)
_HEIGHT_M = 2.5
_SEED = 57
_EVERY = 2  # frames of the simulator's 20 Hz: the thesis has 15 Hz
_SMOOTHED_S, _SAMPLE_S = 0.5, 0.05
_LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a level camera that looks along x


@dataclass(frozen=True, slots=True)
class Scene:
    """A world and the way through it. xy: corners of the way in m, headings in rad as turned so far (n,).

    camera_m, tilt_rad: height of the camera, and how far it looks down. baseline_m: of its stereo rig.
    """

    name: str
    world: World
    way: F64
    speed_m_s: float
    camera_m: float
    tilt_rad: float
    baseline_m: float
    nodes: int


def corridor_1(texture_bits: int = 10) -> Scene:
    """10 m2: a corridor that widens, and a half-open door that leaves a narrow passage to its end."""
    walls = [(-1.15, 0.0, 0.35, 1.8), (7.4, 0.0, 0.1, 1.8), (3.0, -1.21, 4.5, 0.59), (1.0, 1.16, 2.0, 0.64),
             (5.2, 1.285, 2.3, 0.515), (2.95, 0.74, 0.05, 0.25)]  # fmt: skip
    door = [(4.3, 0.6, 0.05, 0.17, 0.0), (4.55, -0.42, 0.32, 0.02, 0.75)]
    way = _there_and_back([(0.2, 0.0), (3.6, 0.05), (4.45, 0.18), (5.2, 0.1), (6.5, 0.05)])
    return Scene("corridor 1", _world(walls, door, _UNIFORM, texture_bits), way, 0.4, 0.21,
                 np.radians(7.0), 0.06, 20)  # fmt: skip


def corridor_2(texture_bits: int = 10) -> Scene:
    """7.9 m2: the same corridor with its door closed, and a cylinder before it."""
    walls = [(-1.15, 0.0, 0.35, 1.8), (6.625, 0.0, 0.875, 1.8), (3.0, -1.21, 4.5, 0.59), (1.0, 1.16, 2.0, 0.64),
             (5.2, 1.285, 2.3, 0.515), (2.95, 0.74, 0.05, 0.25)]  # fmt: skip
    cylinder = [(5.2, -0.25, 0.13, 0.02, k * np.pi / 12) for k in range(12)]
    way = _there_and_back([(0.2, 0.0), (3.2, 0.05), (4.4, 0.2)])
    return Scene(
        "corridor 2", _world(walls, cylinder, _UNIFORM, texture_bits), way, 0.4, 0.21, np.radians(7.0), 0.06, 20
    )


def synthetic(texture_bits: int = 10) -> Scene:
    """683 m2 of corridors 4 to 6 m wide around a block, with shelves and pillars: a way of 138 m."""
    walls = [(24.0, 10.85, 22.0, 7.85)]  # half-extents of the block; the shell is around it
    shelves = [(x, y, 1.0, 0.2, 0.0) for x in (6.0, 12.0, 18.0, 30.0, 36.0) for y in (-2.45, 2.8)]
    pillars = [(x, y, 0.2, 0.2, 0.0) for x in (8.0, 16.0, 24.0, 32.0, 40.0) for y in (20.0, 23.2)]
    world = _world(walls, [*shelves, *pillars], _PATTERNED, texture_bits, shell=(24.0, 10.65, 26.0, 13.3))
    corners = [(1.5, 0.2), (48.0, 0.2), (48.0, 21.7), (0.0, 21.7), (0.0, 0.2), (3.0, 0.2)]
    return Scene("synthetic", world, _followed(corners), 1.8, 0.40, 0.0, 0.11, 100)


def _world(
    walls: Sequence[tuple[float, float, float, float]], objects: Sequence[tuple[float, float, float, float, float]],
    wall: tuple[str, float, float], texture_bits: int,
    shell: tuple[float, float, float, float] = (3.0, 0.0, 4.5, 1.8),
) -> World:  # fmt: skip
    """Walls (x, y, half-extents) from floor to ceiling, and objects (x, y, half-extents, yaw) half as high."""
    rng = np.random.default_rng(_SEED)
    builder = Builder(rng, make_pool(_TEXTURES, _SEED, texture_bits), np.zeros((0, 3)), 0.0)
    half = 0.5 * _HEIGHT_M
    sides = [builder.face(*wall, True, half) for _ in range(4)]
    faces = np.stack([*sides, builder.face(*_FLOOR, False), builder.face("concrete", 0.5, 1.0, False)])
    builder.add(np.array([shell[0], shell[1], half]), np.array([shell[2], shell[3], half]), 0.0, faces, force=True)
    for x, y, hx, hy in walls:
        faces = np.stack([builder.face(*wall, True, half) for _ in range(6)])
        builder.add(np.array([x, y, half]), np.array([hx, hy, half]), 0.0, faces, force=True)
    for k, (x, y, hx, hy, yaw) in enumerate(objects):
        material = _SHELF if k % 2 == 0 else _PILLAR
        faces = np.stack([builder.face(*material, False) for _ in range(6)])
        builder.add(np.array([x, y, 0.9]), np.array([hx, hy, 0.9]), yaw, faces, force=True)
    boxes, all_faces = builder.arrays()
    far = float(2.5 * np.hypot(shell[2], shell[3]) + _HEIGHT_M)
    return World(boxes, all_faces, 0, NO_GROUND, np.zeros(7), np.zeros((4, 8)), builder.pool, far, 0.0)


def _there_and_back(corners: Points) -> F64:
    """A way (n,3) of x, y, heading: to the last corner, a turn, back to the first one, and a turn again."""
    there, back = _followed(corners), _followed(corners[::-1])
    back[:, 2] += round((there[-1, 2] + np.pi - back[0, 2]) / (2 * np.pi)) * 2 * np.pi
    return np.concatenate([there, back, [[*back[-1, :2], back[-1, 2] + np.pi]]])


def _followed(corners: Points) -> F64:
    """A way (n,3) along corners, which looks to the next one; two poses at each where it turns."""
    p = np.array(corners)
    heading = np.unwrap(np.arctan2(*np.diff(p, axis=0).T[::-1]))
    ends = np.stack([p[:-1], p[1:]], 1).reshape(-1, 2)
    return np.column_stack([ends, np.repeat(heading, 2)])


def trajectory(scene: Scene) -> tuple[F64, F64]:
    """Times (n,) and camera poses T_w_c (n,4,4) along the way: driven and turned at one speed each, smoothed."""
    way = scene.way
    took = np.maximum(
        np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1) / scene.speed_m_s, np.abs(np.diff(way[:, 2])) / 0.8
    )
    at = np.concatenate([[0.0], np.cumsum(took + 1e-3)])
    t = np.arange(0.0, at[-1] + 1.0, _SAMPLE_S)
    tail = 4.0 * _SMOOTHED_S
    kernel = np.exp(-0.5 * (np.arange(-tail, tail + 1e-9, _SAMPLE_S) / _SMOOTHED_S) ** 2)
    kernel /= kernel.sum()
    pad = len(kernel) // 2
    smooth = [
        np.convolve(np.pad(np.interp(t, at, way[:, k]), pad, mode="edge"), kernel, mode="valid") for k in range(3)
    ]
    tilt = se3.so3_exp(np.array([0.0, scene.tilt_rad, 0.0])) @ _LOOKS_AHEAD
    poses = [
        se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])) @ tilt, np.array([x, y, scene.camera_m]))
        for x, y, yaw in zip(*smooth, strict=True)
    ]
    return t, np.array(poses)


def rendered(scene: Scene, scratch: Path) -> tuple[Recording, SimSource]:
    """A flight through a scene at 10 Hz with IMU, rendered into memory on all cores; and its source."""
    T_c_b = se3.inverse(make_rig().T_b_c)
    t, poses = trajectory(scene)
    file = scratch / f"{scene.name.replace(' ', '_')}.txt"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(tum.line(round(at * 1e9), T @ T_c_b) for at, T in zip(t.tolist(), poses, strict=True)))
    options = {"trajectory": str(file), "seed": _SEED, "baseline": scene.baseline_m}
    source = SimSource(read_config("room", **options), 1, scene.world)
    wanted = range(0, source.frame_count, _EVERY)
    cores = os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        parts = list(pool.map(lambda first: _render(source, wanted[first::cores]), range(cores)))
    frames = sorted((frame for part in parts for frame in part), key=lambda frame: frame.t_ns)
    samples, truth = source.imu_samples(), source.ground_truth
    ends = np.searchsorted(samples.t_ns, [frame.t_ns for frame in frames], side="right")
    items, begin = [], 0
    for frame, end, k in zip(frames, ends.tolist(), wanted, strict=True):
        imu = ImuBatch(samples.t_ns[begin:end], samples.gyro[begin:end], samples.accel[begin:end])
        items.append(Item(frame, imu if end > begin else None, None, truth.T_w_b[k]))
        begin = end
    return Recording(source.rig, source.imu, tuple(items)), source


def _render(source: SimSource, wanted: range) -> list[Frame]:
    cameras = source.cameras()
    return [source.render(k, cameras) for k in wanted]
