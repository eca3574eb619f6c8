"""People and cars in the view, and surfaces that mislead."""

from typing import Any

import numpy as np
import pytest

from kiteline_core.frame import Frame
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.sensors.camera import SimCamera
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sim.world.actors import make_actors
from kiteline_hw.sim.world.raycast_kernels import GLOSSY

SMALL: dict[str, Any] = {"scale": 0.25, "texture_bits": 8}


def casts(source: SimSource, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t_s = 0.05 * k
    pose = source.path.motion(np.array([t_s])).T_w_b[0]
    radiance, distance, hits = source.cameras()[0].cast(pose, t_s)
    return radiance, distance, hits


def test_people_cover_what_is_behind_them_and_nothing_else() -> None:
    crowd, empty = (open_sim("room", seconds=8.0, people=n, **SMALL) for n in (5, 0))
    seen = 0
    for k in range(20, 160, 20):
        radiance, distance, hits = casts(crowd, k)
        still, behind, _ = casts(empty, k)
        person = hits >= 6 * len(crowd.world.boxes)
        seen += bool(person.mean() > 0.02)
        assert (distance[person] < behind[person]).all()
        assert np.array_equal(distance[~person], behind[~person])
        border = np.zeros_like(person)  # a pixel of which one quarter is covered is drawn, but keeps its distance
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
            border |= np.roll(person, (dy, dx), (0, 1))
        changed = (radiance != still) & ~person & ~border
        assert changed.mean() < 0.005
    assert seen >= 4


def test_people_walk_and_keep_off_the_camera() -> None:
    source = open_sim("hall", seconds=15.0, **SMALL)
    actors = make_actors(source.world, source.path, source.rig.T_b_c, 4, 0, 1)
    again = make_actors(source.world, source.path, source.rig.T_b_c, 4, 0, 1)
    assert actors is not None and again is not None
    last = actors.boxes(0.0)
    moved = 0
    for t_s in np.arange(0.05, 15.0, 0.05):
        boxes = actors.boxes(float(t_s))
        assert np.array_equal(boxes, again.boxes(float(t_s)))
        here = source.path.motion(np.array([t_s])).T_w_b[0, :3, 3]
        present = boxes[:, 2] > -10.0
        if present.any():
            assert np.linalg.norm(boxes[present, :2] - here[:2], axis=1).min() > 0.4
        both = present & (last[:, 2] > -10.0)
        step = np.linalg.norm(boxes[both, :2] - last[both, :2], axis=1)
        walked = step < 0.25  # larger: the next crossing begins
        moved += int((step[walked] > 0.02).sum())
        last = boxes
    assert moved > 200


def test_cars_drive_on_the_road_ahead_and_towards_the_camera() -> None:
    source = open_sim("street", seconds=10.0, **SMALL)
    actors = make_actors(source.world, source.path, source.rig.T_b_c, 0, 2, 3)
    assert [gap > 0.0 for gap in actors.gaps_s] == [False, True]
    gaps = []
    for t_s in np.arange(2.0, 6.0, 0.5):
        oncoming, ahead = actors.boxes(float(t_s)).reshape(2, 2, 8)
        here = source.path.motion(np.array([t_s])).T_w_b[0, :3, 3]
        assert 4.0 < np.linalg.norm(ahead[0, :2] - here[:2]) < 40.0
        assert ahead[0, 2] == pytest.approx(float(source.world.height(ahead[0:1, :2])[0]) + 0.62)
        gaps.append(float(np.linalg.norm(oncoming[0, :2] - here[:2])))
    assert np.ptp([g for g in gaps if g < 1e5]) > 10.0


def test_frames_with_people_do_not_depend_on_threads() -> None:
    one, two = (
        [f for f in open_sim("room", n, seconds=0.6, people=3, rest=0.0, **SMALL) if isinstance(f, Frame)]
        for n in (1, 2)
    )
    assert all(np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right) for a, b in zip(one, two))  # type: ignore[arg-type]


def test_repeated_surfaces_have_a_period_and_gloss_depends_on_the_view() -> None:
    plain, tiled = (open_sim("room", seconds=2.0, repeated=share, **SMALL) for share in (0.0, 1.0))
    image = tiled.world.pool.image("tiles").astype(int)
    assert np.array_equal(image, np.roll(image, 64, 1)) and not np.array_equal(image, np.roll(image, 32, 1))
    assert {tiled.world.pool.names[int(k)] for k in tiled.world.faces[:, 6]} == {"tiles"}
    assert np.array_equal(plain.world.boxes, tiled.world.boxes)
    glossy = open_sim("room", seconds=2.0, glossy=1.0, **SMALL)
    assert (glossy.world.faces[:, 7] >= GLOSSY).all()
    pose = plain.path.motion(np.array([1.0])).T_w_b[0]
    a, b = (SimCamera(s.world, s.rig.left, s.rig.T_b_c).cast(pose)[0].copy() for s in (plain, glossy))
    brighter = b - a
    assert brighter.min() >= 0.0 and (brighter > 0.05).mean() > 0.02
    shifted = pose.copy()
    shifted[:3, 3] += 0.2
    c, d = (SimCamera(s.world, s.rig.left, s.rig.T_b_c).cast(shifted)[0].copy() for s in (plain, glossy))
    assert not np.allclose(brighter, d - c, atol=0.05)


@pytest.mark.parametrize("text", ["room?people=-1", "room?glossy=2", "room?readout_s=1", "room?flicker=2"])
def test_limits_of_the_options(text: str) -> None:
    with pytest.raises(SourceError, match="must be 0 to"):
        open_sim(text, texture_bits=6)
