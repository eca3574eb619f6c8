"""Surfaces that mislead a tracker: patterns that repeat, and gloss in which lights move with the camera."""

from dataclasses import replace

import numpy as np

from kiteline_hw.sim.world.raycast_kernels import GLOSSY
from kiteline_hw.sim.world.textures import LEVELS, TexturePool, make_pool
from kiteline_hw.sim.world.world import World


def with_difficult_surfaces(world: World, seed: int, bits: int, repeated: float, glossy: float) -> World:
    """The world with shares of its faces repeating or glossy; which ones is drawn from the seed."""
    rng = np.random.default_rng([seed, 89])
    draws = rng.random((len(world.faces), 2))
    faces, pool = world.faces.copy(), world.pool
    if repeated > 0.0:
        pool = _joined(pool, make_pool(("tiles",), seed, bits))
        faces[draws[:, 0] < repeated, 6] = pool.index("tiles")
    faces[draws[:, 1] < glossy, 7] += GLOSSY
    return replace(world, faces=faces, pool=pool)


def _joined(pool: TexturePool, other: TexturePool) -> TexturePool:
    """A pool with the textures of both, those of `other` last, without the detail texture of `other`."""
    table = other.table[1:].copy()
    table[:, 1 : 1 + LEVELS] += len(pool.atlas)
    atlas = np.concatenate([pool.atlas, other.atlas])
    return TexturePool(atlas, np.concatenate([pool.table, table]), (*pool.names, *other.names[1:]))
