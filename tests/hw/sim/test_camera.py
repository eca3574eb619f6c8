"""The renderer against a plain reference and the camera model."""

from typing import Any

import cv2
import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Lens
from kiteline_hw.sim.sensors import lens
from kiteline_hw.sim.sensors.camera import LAMP_HZ, Shutter, SimCamera
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.sensors.sensor_kernels import expose, motion_blur
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sim.world.raycast_kernels import box_hit, ground_hit, texture_value
from kiteline_hw.sim.world.textures import TexturePool, make_pool
from kiteline_hw.sim.world.world import NO_GROUND, World, bilinear

SMALL: dict[str, Any] = {"miscalibration": 0.0, "scale": 0.25, "texture_bits": 8}


@pytest.fixture(scope="module")
def room() -> SimSource:
    return open_sim("room", seconds=8.0, seed=3, **SMALL)


@pytest.fixture(scope="module")
def pool() -> TexturePool:
    return make_pool(("leaves",), 1, 8)


def slabs(box: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Where a ray enters and leaves a box."""
    c, s = box[6:8]
    to_box = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    p, v = to_box @ (o - box[:3]), to_box @ d
    t = np.sort(np.stack([(-box[3:6] - p) / v, (box[3:6] - p) / v]), axis=0)
    return float(t[0].max()), float(t[1].min())


def test_box_hit_equals_the_reference() -> None:
    rng = np.random.default_rng(0)
    entered = left = 0
    for _ in range(3000):
        yaw = rng.uniform(0, 2 * np.pi)
        box = np.array([*rng.normal(0, 1, 3), *rng.uniform(0.1, 2, 3), np.cos(yaw), np.sin(yaw)])
        o, d = rng.normal(0, 3, 3), rng.normal(0, 1, 3)
        d /= np.linalg.norm(d)
        near, far = slabs(box, o, d)
        for inside in (False, True):
            t, face = box_hit(box[None], 0, o, d[0], d[1], d[2], inside)
            expected = (far if inside else near) if near <= far and (far if inside else near) > 0 else np.inf
            assert t == pytest.approx(expected, abs=1e-9)
            if np.isfinite(t):
                c, s = box[6:8]
                q = o + t * d - box[:3]
                local = np.array([c * q[0] + s * q[1], c * q[1] - s * q[0], q[2]])
                assert local[face // 2] == pytest.approx((1 if face % 2 else -1) * box[3 + face // 2], abs=1e-9)
                entered, left = entered + (not inside), left + inside
    assert entered > 50 and left > 50


def test_ground_hit_lies_on_the_ground() -> None:
    y, x = np.mgrid[:60, :60]
    field = np.stack([2.0 * np.sin(x / 9.0) + 0.05 * y, 0.0 * x]).astype(np.float32)
    slope = float(np.hypot(*np.gradient(field[0].astype(float))).max()) * 1.5 + 0.02
    frame = np.array([0.0, 0.0, 1.0, slope, 0.0, 3.0, 5.0])
    rng = np.random.default_rng(1)
    o = np.array([30.0, 30.0, 6.0])
    hits = 0
    for _ in range(500):
        d = rng.normal(0, 1, 3) * [1, 1, 0.4]
        d /= np.linalg.norm(d)
        t = ground_hit(field, frame, o, d[0], d[1], d[2], 28.0)
        steps = o + np.linspace(0, 28.0, 6000)[:, None] * d
        below = steps[:, 2] < bilinear(field[0], frame, steps[:, :2])
        if np.isfinite(t):
            hits += 1
            assert t == pytest.approx(28.0 * np.argmax(below) / 5999, abs=0.03)
        else:
            assert not below.any()
    assert hits > 100


def test_texture_value_is_the_mean_under_the_footprint(pool: TexturePool) -> None:
    image = pool.image("leaves").astype(float)
    for level in (0, 1, 3):
        side = 1 << level
        block = image[64 : 64 + side, 32 : 32 + side].mean()
        value = texture_value(pool.atlas, pool.table, 1, 32 + side / 2, 64 + side / 2, float(level))
        assert value == pytest.approx(block, abs=0.51)
        wrapped = texture_value(pool.atlas, pool.table, 1, 32 + side / 2 - 512, 64 + side / 2 + 1024, float(level))
        assert wrapped == value


@pytest.mark.parametrize("kind", list(Lens))
def test_rays_invert_opencvs_lens_models(kind: Lens) -> None:
    camera = make_rig(kind).left
    rays = lens.pixel_rays(camera)[1:-1, 1:-1].astype(np.float64)
    points = rays[::7, ::7].reshape(-1, 3) * 3.0
    v, u = np.mgrid[: camera.height : 7, : camera.width : 7]
    expected = np.stack([u.ravel(), v.ravel()], 1)
    assert np.abs(lens.project(camera, points) - expected).max() < 2e-3
    zero, d = np.zeros(3), np.array(camera.distortion or [0.0] * 4)
    if kind is Lens.EQUIDISTANT:
        theirs, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix(), d)
    else:
        theirs, _ = cv2.projectPoints(points, zero, zero, camera.matrix(), d)
    assert np.abs(theirs.reshape(-1, 2) - expected).max() < 2e-3


def one_box(pool: TexturePool) -> World:
    boxes = np.array([[3.0, 0.2, 0.1, 0.5, 0.4, 0.3, np.cos(0.5), np.sin(0.5)]])
    faces = np.tile(np.array([200.0, 200.0, 0.0, 0.0, 1.0, 0.5, 1.0, 0.0]), (6, 1))
    ground = np.tile(np.array([200.0, 200.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0]), (4, 1))
    return World(boxes, faces, None, NO_GROUND, np.zeros(7), ground, pool, 50.0, 0.0)


def corners(box: np.ndarray) -> np.ndarray:
    c, s = box[6:8]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return signs * box[3:6] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + box[:3]


def test_corners_of_a_box_are_where_the_camera_model_projects_them(pool: TexturePool) -> None:
    """The silhouette is the hull of the projected corners, and depth at visible corners is theirs."""
    world, rig = one_box(pool), make_rig()
    t_w_c = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.4]))
    eye = SimCamera(world, rig.left, rig.T_b_c)
    _, distance, hits = eye.cast(t_w_c @ se3.inverse(rig.T_b_c))
    depth = eye.depth()
    seen = hits >= 0
    in_camera = se3.transform(se3.inverse(t_w_c), corners(world.boxes[0]))
    pixels = lens.project(rig.left, in_camera)
    v, u = np.nonzero(seen)
    assert u.min() == pytest.approx(pixels[:, 0].min(), abs=1.0)
    assert u.max() == pytest.approx(pixels[:, 0].max(), abs=1.0)
    assert v.min() == pytest.approx(pixels[:, 1].min(), abs=1.0)
    assert v.max() == pytest.approx(pixels[:, 1].max(), abs=1.0)
    nearest = int(np.argmin(in_camera[:, 2] + (in_camera[:, 1] > 0)))  # an upper corner on the near edge
    x, y = np.round(pixels[nearest]).astype(int)
    patch = depth[y - 2 : y + 3, x - 2 : x + 3]
    assert patch[patch > 0].min() == pytest.approx(in_camera[nearest, 2], rel=0.01)
    assert (depth[~seen] == 0).all() and np.isinf(distance[~seen]).all()


def test_true_depth_warps_the_left_image_to_the_right(room: SimSource) -> None:
    """Stereo geometry end to end: what the left eye sees, warped by true depth, is what the right eye sees."""
    rig = room.rig
    assert rig.right is not None and rig.T_c_r is not None
    left, right = room.cameras()
    pose = room.path.motion(np.array([5.0])).T_w_b[0]
    radiance, distance, _ = (a.copy() for a in left.cast(pose))
    other, other_distance, _ = right.cast(pose)
    points = lens.pixel_rays(rig.left)[1:-1, 1:-1] * distance[..., None]
    in_right = se3.transform(se3.inverse(rig.T_c_r), points.reshape(-1, 3).astype(np.float64))
    uv = lens.project(rig.right, in_right).astype(np.float32).reshape(*distance.shape, 2)
    warped = cv2.remap(other, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderValue=-1)
    seen_at = cv2.remap(other_distance, uv[..., 0], uv[..., 1], cv2.INTER_NEAREST, borderValue=-1)
    expected = np.linalg.norm(in_right, axis=1).reshape(distance.shape)
    both = np.abs(seen_at - expected) < 0.02 * expected
    assert both.mean() > 0.7
    assert np.median(np.abs(warped - radiance)[both]) < 0.02
    assert np.corrcoef(warped[both], radiance[both])[0, 1] > 0.93


def test_motion_blur_is_the_mean_of_the_exposure(room: SimSource) -> None:
    """The streak of one cast against many casts along the exposure."""
    eye = room.cameras()[0]
    t, exposure = 3.0, 0.06
    times = t + exposure * ((np.arange(25) + 0.5) / 25 - 0.5)
    many = np.mean([eye.cast(pose)[0].copy() for pose in room.path.motion(times).T_w_b], axis=0)
    motion = room.path.motion(np.array([t]))
    sharp = eye.cast(motion.T_w_b[0])[0].copy()
    t_b_c = eye.T_b_c
    angular = t_b_c[:3, :3].T @ motion.rate[0]
    to_camera = (motion.T_w_b[0, :3, :3] @ t_b_c[:3, :3]).T
    arm = motion.T_w_b[0, :3, :3] @ np.cross(motion.rate[0], t_b_c[:3, 3])
    linear = to_camera @ (motion.velocity[0] + arm)
    _, distance, _ = eye.cast(motion.T_w_b[0])
    out = np.empty_like(sharp)
    motion_blur(sharp, distance, lens.pixel_rays(room.rig.left), linear, angular, exposure, 0.0, out)
    assert np.abs(sharp - many).mean() > 3 * np.abs(out - many).mean()


def test_rows_of_a_rolling_shutter_are_those_of_their_times(room: SimSource) -> None:
    """Rows of one warped cast against casts at the times of the rows."""
    eye = room.cameras()[0]
    times = np.arange(2.5, 7.5, 0.1)
    t = float(times[np.argmax(np.linalg.norm(room.path.motion(times).rate, axis=1))])
    readout, exposure = 0.045, 1e-5
    motion = room.path.motion(np.array([t]))
    mid = eye.cast(motion.T_w_b[0])[0].copy()
    shutter = Shutter(exposure, readout)
    rolled = eye.take_image(motion.T_w_b[0], motion.velocity[0], motion.rate[0], shutter, 100.0, (0.0, 0.0), 1)
    still = eye.take_image(motion.T_w_b[0], motion.velocity[0], motion.rate[0], Shutter(exposure), 100.0, (0.0, 0.0), 1)
    off = {"rolled": 0.0, "still": 0.0}
    rows = range(2, len(mid) - 2, 6)
    for row in rows:
        at = t + readout * ((row + 0.5) / len(mid) - 0.5)
        pose = room.path.motion(np.array([at]))
        true = eye.take_image(pose.T_w_b[0], pose.velocity[0], pose.rate[0], Shutter(exposure), 100.0, (0.0, 0.0), 1)
        for name, image in (("rolled", rolled), ("still", still)):
            off[name] += float(np.abs(image[row].astype(int) - true[row]).mean()) / len(rows)
    assert off["still"] > 2.0 * off["rolled"], off


def test_lamps_flicker_in_bands_and_a_long_exposure_averages_them_out() -> None:
    rows = Shutter(0.002, 0.03, 0.5, 0.1).lamps(480)
    assert rows.max() - rows.min() > 0.8 and np.abs(rows.mean() - 1.0) < 0.1
    assert np.ptp(Shutter(0.002, 0.0, 0.5, 0.1).lamps(480)) == 0.0
    assert np.abs(Shutter(1.0 / LAMP_HZ, 0.03, 0.5, 0.1).lamps(480) - 1.0).max() < 1e-9


def test_noise_variance() -> None:
    flat = np.full((200, 200), 100.0, np.float32)
    out = np.empty((200, 200), np.uint8)
    expose(flat, np.ones_like(flat), np.full(200, 1.2), 1.5, 0.05, np.uint64(9), out)
    assert out.mean() == pytest.approx(120.0, abs=0.1)
    assert out.var() == pytest.approx(1.5**2 + 0.05 * 120 + 1 / 12, rel=0.05)
    again = np.empty_like(out)
    expose(flat, np.ones_like(flat), np.full(200, 1.2), 1.5, 0.05, np.uint64(10), again)
    assert abs(np.corrcoef(out.ravel(), again.ravel())[0, 1]) < 0.03
