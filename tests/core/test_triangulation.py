"""Points from rays."""

import numpy as np

from kiteline_core.geometry import se3
from kiteline_core.geometry.triangulation import nearest_point, parallax, project, rays

CAMERA = np.array([400.0, 410.0, 320.0, 240.0])


def test_rays_meet_where_the_pixels_came_from() -> None:
    rng = np.random.default_rng(3)
    n = 50
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (n, 3))
    poses = [np.stack([se3.exp(np.array([0.3 * k, 0, 0, 0, 0.02 * k, 0.01])) for _ in range(n)]) for k in range(3)]
    cameras = np.tile(CAMERA, (n, 1))
    lines = []
    for T in poses:
        pixels, depth = project(points, cameras, T)
        assert (depth > 0).all()
        lines.append(rays(pixels, cameras, T))
    found, good = nearest_point(np.stack([o for o, _ in lines], 1), np.stack([d for _, d in lines], 1))
    assert good.all()
    assert np.allclose(found, points, atol=1e-8)
    cosine = parallax(lines[0][0], lines[2][0], points)
    a, b = points[0] - lines[0][0][0], points[0] - lines[2][0][0]
    assert np.isclose(cosine[0], a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def test_parallel_rays_are_said_to_meet_nowhere() -> None:
    direction = np.tile([0.0, 0.0, 1.0], (1, 2, 1))
    _, good = nearest_point(np.array([[[0.0, 0, 0], [1.0, 0, 0]]]), direction)
    assert not good[0]
