"""A simulated camera: renders the world to grey values and depth."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F32, F64, I32, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel
from kiteline_hw.sim.sensors.lens import pixel_rays, vignette
from kiteline_hw.sim.sensors.sensor_kernels import expose, motion_blur
from kiteline_hw.sim.world.actors import Actors
from kiteline_hw.sim.world.overlay_kernels import overlay
from kiteline_hw.sim.world.raycast_kernels import NO_SHELL, TILE, render, tile_lists, visible_boxes
from kiteline_hw.sim.world.textures import DETAIL_M
from kiteline_hw.sim.world.world import NO_GROUND, World

LAMP_HZ = 119.7  # twice the mains' frequency, which is a little off: a whole number of periods a frame would hide it


@dataclass(frozen=True, slots=True)
class Shutter:
    """When the rows of an image are exposed, and how lamps flicker then.

    readout_s: from the first row's exposure to the last row's. flicker: amplitude of the lamps' brightness over its
    mean; phase: of the lamps at the middle row, in turns.
    """

    exposure_s: float
    readout_s: float = 0.0
    flicker: float = 0.0
    phase: float = 0.0

    def lamps(self, rows: int) -> F64:
        """Mean brightness (rows,) of the lamps over the exposure of each row; 1 without flicker."""
        if self.flicker == 0.0:
            return np.ones(rows)
        row_s = self.readout_s * ((np.arange(rows) + 0.5) / rows - 0.5)
        seen = self.flicker * np.sinc(LAMP_HZ * self.exposure_s)  # a long exposure averages it out
        return np.asarray(1.0 + seen * np.sin(2 * np.pi * (self.phase + LAMP_HZ * row_s)))


class SimCamera:
    """A camera in a world. Not thread-safe: its buffers are reused."""

    def __init__(self, world: World, camera: CameraModel, T_b_c: F64, actors: Actors | None = None) -> None:
        self.world = world
        self._actors = actors
        self.T_b_c = T_b_c
        self._rays = pixel_rays(camera)
        self._vignette = vignette(self._rays)
        shape = (camera.height, camera.width)
        inner = self._rays[1:-1, 1:-1].reshape(-1, 3).astype(np.float64)
        axis = inner.mean(0)
        self._axis = axis / np.linalg.norm(axis)
        self._half_angle = float(np.arccos(np.clip((inner @ self._axis).min(), -1, 1))) + 0.01
        self._pixel = 2.0 / (camera.fx + camera.fy)
        n = max(len(world.boxes), 0 if actors is None else len(actors.faces) // 6)
        tiles = ((camera.height + TILE - 1) // TILE) * ((camera.width + TILE - 1) // TILE)
        self._near = np.empty(n)
        self._items = np.empty(n, np.int32)
        self._lists = np.empty((tiles, n), np.int32)
        self._lengths = np.empty(tiles, np.int32)
        self._radiance = np.empty(shape, np.float32)
        self._streaked = np.empty(shape, np.float32)
        self._distance = np.empty(shape, np.float32)
        self._hits = np.empty(shape, np.int32)

    def cast(self, T_w_b: F64, t_s: float = 0.0) -> tuple[F32, F32, I32]:
        """Radiance, distance in m along the ray (inf for the sky) and hit of every pixel, each (h, w).

        t_s: flight time, of the solids that move. The arrays are overwritten by the next call.
        """
        w = self.world
        t_w_c = T_w_b @ self.T_b_c
        o, rot = np.ascontiguousarray(t_w_c[:3, 3]), np.ascontiguousarray(t_w_c[:3, :3])
        near, items = self._near, self._items
        shell = NO_SHELL if w.shell is None else w.shell
        count = visible_boxes(w.boxes, shell, o, rot @ self._axis, self._half_angle, near, items)
        count = int(np.searchsorted(near[:count], w.far_m))
        tile_lists(w.boxes, items, count, o, rot, self._rays, self._lists, self._lengths)
        render(
            w.boxes, w.faces, shell, w.field, w.field_frame, w.ground, w.pool.atlas, w.pool.table, DETAIL_M,
            o, rot, self._rays, self._pixel, w.far_m, near, items, self._lists, self._lengths,
            self._radiance, self._distance, self._hits,
        )  # fmt: skip
        if self._actors is not None:
            self._draw_actors(self._actors, o, rot, t_s)
        return self._radiance, self._distance, self._hits

    def _draw_actors(self, actors: Actors, o: F64, rot: F64, t_s: float) -> None:
        """Draw what moves over the still world, as it stands at the middle of the exposure."""
        w, boxes, near, items = self.world, actors.boxes(t_s), self._near, self._items
        count = visible_boxes(boxes, NO_SHELL, o, rot @ self._axis, self._half_angle, near, items)
        count = int(np.searchsorted(near[:count], w.far_m))
        tile_lists(boxes, items, count, o, rot, self._rays, self._lists, self._lengths)
        overlay(
            boxes, actors.faces, NO_GROUND, w.field_frame, w.ground, w.pool.atlas, w.pool.table, DETAIL_M, o, rot,
            self._rays, self._pixel, w.far_m, near, items, self._lists, self._lengths, len(w.boxes),
            self._radiance, self._distance, self._hits,
        )  # fmt: skip

    def depth(self) -> F32:
        """Depth (h, w) in m along the optical axis of the last cast, 0 for the sky."""
        z = self._distance * self._rays[1:-1, 1:-1, 2]
        return np.where(np.isfinite(z), z, 0.0).astype(np.float32)

    def take_image(
        self, T_w_b: F64, velocity: F64, rate: F64, shutter: Shutter, gain: float, noise: tuple[float, float], key: int,
        t_s: float = 0.0,
    ) -> U8:  # fmt: skip
        """The image (h, w) of an exposure whose middle row is centred on this pose.

        velocity (3,) in w, rate (3,) in b. noise: read and shot (see `expose`), drawn from `key`.
        t_s: flight time, of the solids that move.
        """
        radiance, distance, _ = self.cast(T_w_b, t_s)
        to_camera = (T_w_b[:3, :3] @ self.T_b_c[:3, :3]).T
        angular = self.T_b_c[:3, :3].T @ rate
        linear = to_camera @ (velocity + T_w_b[:3, :3] @ (se3.skew(rate) @ self.T_b_c[:3, 3]))
        motion_blur(
            radiance, distance, self._rays, linear, angular, shutter.exposure_s, shutter.readout_s, self._streaked
        )
        out = np.empty(radiance.shape, np.uint8)
        gains = gain * shutter.lamps(len(radiance))
        expose(self._streaked, self._vignette, gains, noise[0], noise[1], np.uint64(key), out)
        return out
