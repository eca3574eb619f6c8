"""Scenes that keep their distance from the paths, and statistics of textures."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sim.world.scenes import SCENES
from kiteline_hw.sim.world.street import ground_field
from kiteline_hw.sim.world.texture_kernels import paint
from kiteline_hw.sim.world.textures import MAKERS, make_pool, shapes
from kiteline_hw.sim.world.world import World, bilinear, box_distances

T_B_C = make_rig().T_b_c


def spectrum_slope(image: np.ndarray) -> float:
    """Exponent of the power spectrum, averaged over directions, between 1/64 and 1/4 cycles per texel."""
    f = image.astype(float) - image.mean()
    power = np.abs(np.fft.fft2(f)) ** 2
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(len(f)), np.fft.fftfreq(len(f))))
    edges = 2.0 ** np.arange(-6, -1.5, 0.5)
    means = [power[(k >= a) & (k < b)].mean() for a, b in pairwise(edges)]
    return float(np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])), np.log(means), 1)[0])


def test_textures_have_natural_spectra_and_edges() -> None:
    names = tuple(name for name in MAKERS if name not in ("clouds", "detail"))
    pool = make_pool(names, 4, 9)
    slopes = {name: spectrum_slope(pool.image(name)) for name in names}
    assert all(-2.9 < slope < -1.3 for slope in slopes.values()), slopes
    assert -2.7 < np.mean(list(slopes.values())) < -1.5
    for name in ("leaves", "posters", "facade", "brick", "clutter"):  # unlike plain noise, steps have heavy tails
        step = np.diff(pool.image(name).astype(float), axis=1).ravel()
        assert ((step - step.mean()) ** 4).mean() / step.var() ** 2 > 6, name


def test_textures_depend_only_on_the_seed() -> None:
    first, second = make_pool(("leaves", "leaves2"), 4, 8), make_pool(("leaves2",), 4, 8)
    assert np.array_equal(first.image("leaves2"), second.image("leaves2"))
    assert not np.array_equal(first.image("leaves"), first.image("leaves2"))
    assert not np.array_equal(first.image("leaves"), make_pool(("leaves",), 5, 8).image("leaves"))


def test_no_texture_is_periodic() -> None:
    """No shift other than none brings a texture near to itself, but for the one that is asked to repeat."""
    names = tuple(name for name in MAKERS if name != "tiles")
    pool = make_pool(names, 2, 9)
    for name in names:
        f = pool.image(name).astype(float)
        f -= cv2.GaussianBlur(f, (0, 0), 12)  # the fine structure, by which features are matched
        spectrum = np.abs(np.fft.fft2(f)) ** 2
        likeness = np.fft.ifft2(spectrum).real / spectrum.mean()
        likeness[:12, :12] = likeness[-12:, :12] = likeness[:12, -12:] = likeness[-12:, -12:] = 0
        likeness[:, 0] = likeness[0, :] = 0  # boards and courses run straight on
        assert likeness.max() < 0.5, name


def test_paint_equals_the_reference() -> None:
    rng = np.random.default_rng(0)
    rows, kinds = shapes(rng, 64, 1.0, 3.0, 20.0)
    rows, kinds = rows[:40], kinds[:40]
    found, expected = np.zeros((64, 64), np.float32), np.zeros((64, 64))
    paint(rows, kinds, found)
    for (cx, cy, a, b, c, s, value, ga, gb), kind in zip(rows.astype(float), kinds, strict=True):
        for wrap_y in (-64, 0, 64):
            for wrap_x in (-64, 0, 64):
                y, x = np.mgrid[:64, :64]
                dx, dy = x + wrap_x - cx, y + wrap_y - cy
                p, q = (c * dx + s * dy) / a, (c * dy - s * dx) / b
                r = p * p + q * q
                inside = {
                    0: r <= 1,
                    1: (abs(p) <= 1) & (abs(q) <= 1),
                    2: (abs(q) <= 1) & (abs(p) <= 0.5 * (1 - q)),
                    3: (r <= 1) & (r >= 0.55),
                }[int(kind)]
                expected[inside] = (value + ga * p + gb * q)[inside]
    assert (np.abs(found - expected) > 1e-2).mean() < 0.002  # texels on an edge may fall to either side


def world_and_path(scene: str, **options: Any) -> tuple[World, np.ndarray]:
    source = open_sim(scene, texture_bits=7, scale=0.1, **options)
    return source.world, source.path.positions()


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", [0, 1])
def test_solids_keep_their_distance_from_the_path(scene: str, seed: int) -> None:
    world, path = world_and_path(scene, seed=seed)
    assert len(world.solids()) > 10
    for box in world.solids():
        assert box_distances(box, path).min() > 0.45
    if world.shell is not None:
        shell = world.boxes[world.shell]
        assert (np.abs(path - shell[:3]) < shell[3:6] - 0.45).all()
    else:
        assert (path[:, 2] - world.height(path[:, :2]) > 0.45).all()


@pytest.mark.parametrize(
    ("scene", "name"),
    [("room", "V1_02_medium"), ("hall", "MH_01_easy"), ("corridor", "MH_03_medium"), ("street", "KITTI_06")],
)
def test_scenes_are_built_around_recorded_paths(data_dir: Path, scene: str, name: str) -> None:
    file = data_dir / "trajectories" / f"{name}.txt"
    world, path = world_and_path(scene, trajectory=str(file))
    nearest = min(float(box_distances(box, path).min()) for box in world.solids())
    assert 0.45 < nearest < 1.5
    if world.shell is not None:
        shell = world.boxes[world.shell]
        assert (np.abs(path - shell[:3]) < shell[3:6] - 0.45).all()
    else:
        above = path[:, 2] - world.height(path[:, :2])
        assert above.min() > 0.5 and above.max() < 3.0


def test_ground_follows_a_hill() -> None:
    s = np.arange(0.0, 400.0, 0.1)
    points = np.stack([s, 30 * np.sin(s / 60), 1.65 + 6 * np.sin(s / 50)], 1)
    field, frame = ground_field(points)
    above = points[:, 2] - bilinear(field[0], frame, points[:, :2])
    assert np.abs(above - 1.65).max() < 0.3
    assert bilinear(field[1], frame, points[:, :2]).max() < 1.5
    assert bilinear(field[1], frame, points[::500, :2] + [0.0, 40.0]).min() > 15


def test_several_agents_share_a_world(tmp_path: Path) -> None:
    first = open_sim("room", also=("",), texture_bits=7, scale=0.1, seconds=3)
    second = open_sim("room", also=("",), agent=1, texture_bits=7, scale=0.1, seconds=3)
    assert np.array_equal(first.world.boxes, second.world.boxes)
    assert np.array_equal(first.world.faces, second.world.faces)
    assert not np.allclose(first.path.positions()[0], second.path.positions()[0])
    for source in (first, second):
        for box in first.world.solids():
            assert box_distances(box, source.path.positions()).min() > 0.45
