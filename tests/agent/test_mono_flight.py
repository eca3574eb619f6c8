"""A monocular flight: it begins when two views give depth, keeps its own scale, and landmarks find their true depth."""

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, KeyframeConfig, LocalMapConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import Work, cost_ns
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid
from kiteline_agent.initialisation.two_view_start import TwoViewStart
from kiteline_agent.keyframes.depth_from_motion import triangulated_sigma
from kiteline_agent.runtime.controller import pose_sample
from kiteline_agent.runtime.frame_counts import FrameCounts, live_line, odometry_line
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import KeyframeHeader, NewLandmarks, Observations
from kiteline_core.arrays import F64, U8
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, AgentId, submap_of_keyframe
from kiteline_hw.sources.open import open_source

W, H, FOCAL = 320, 240, 220.0
CAMERA = CameraModel(W, H, FOCAL, FOCAL, 159.5, 119.5)
RIG = CameraRig(CAMERA, None, np.eye(4), None, has_body=False)
# A room in camera axes: planes n . x = d, each with the two axes of its texture.
PLANES = (
    (np.array([0.0, 0.0, 1.0]), 5.0, 0, 1),
    (np.array([0.0, 1.0, 0.0]), 1.2, 0, 2),
    (np.array([0.0, -1.0, 0.0]), 1.8, 0, 2),
    (np.array([-1.0, 0.0, 0.0]), 2.2, 2, 1),
    (np.array([1.0, 0.0, 0.0]), 2.6, 2, 1),
)


@cache
def texture(seed: int) -> U8:
    noise = np.random.default_rng(seed).integers(0, 256, (512, 512), np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.6), None, 5, 250, cv2.NORM_MINMAX), np.uint8)


@cache
def rays() -> F64:
    """Rays (h,w,3) of the pixels, in camera axes."""
    u, v = np.meshgrid(np.arange(float(W)), np.arange(float(H)))
    return np.stack([(u - CAMERA.cx) / FOCAL, (v - CAMERA.cy) / FOCAL, np.ones_like(u)], -1)


def room(T_w_c: F64) -> tuple[U8, F64]:
    """What a camera sees of the room, (h,w) grey, and the depths (h,w)."""
    ray = rays() @ T_w_c[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.stack([(d - normal @ T_w_c[:3, 3]) / (ray @ normal) for normal, d, _, _ in PLANES])
    depths = np.where(depths > 1e-6, depths, np.inf)
    best, nearest = depths.min(axis=0), depths.argmin(axis=0)
    hit = T_w_c[:3, 3] + ray * np.where(np.isfinite(best), best, 0.0)[..., None]
    place, image = (hit * 60.0).astype(np.float32) % 510, np.zeros((H, W), np.uint8)
    for seed, (_, _, a, b) in enumerate(PLANES):
        here = (nearest == seed) & np.isfinite(best)
        if here.any():
            image[here] = cv2.remap(texture(seed), place[..., a], place[..., b], cv2.INTER_LINEAR)[here]
    return image, best


def path(k: float) -> F64:
    """A sideways and forward sweep with turns; at rest for the first frames."""
    s = max(k - 3, 0) * 0.05
    turn = se3.so3_exp(np.array([0.06 * np.sin(1.3 * s), 0.16 * np.sin(0.9 * s), 0.05 * np.sin(s)]))
    return se3.from_rt(turn, np.array([0.7 * np.sin(0.8 * s), 0.15 * np.sin(1.1 * s), 0.35 * s]))


@cache
def frame(k: int) -> Frame:
    return Frame(k * 50_000_000, room(path(k))[0])


def context(k: int, images: FrameImages) -> FrameContext:
    return FrameContext(k, k, 0.0, None, images, np.eye(4), False, AgentConfig())


def agent() -> Agent:
    return Agent(RIG, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())


def step(one: Agent, f: Frame) -> Estimate:
    estimate = one.step(StepInput(f), f.t_ns).estimate
    assert estimate is not None
    return estimate


def similar(p: F64, q: F64) -> tuple[float, float]:
    """Scale that brings points p (n,3) onto q (n,3), and the rms distance that is left (S. Umeyama, 1991)."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = float((s * d).sum() / (a**2).sum())
    return scale, float(np.sqrt(((b - scale * a @ (u @ np.diag(d) @ vt).T) ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def flown() -> tuple[Agent, list[Estimate]]:
    """A flight of 60 frames through the room, and its agent at the end."""
    one = agent()
    return one, [step(one, frame(k)) for k in range(60)]


def test_a_room_is_followed_at_a_scale_of_its_own(flown: tuple[Agent, list[Estimate]]) -> None:
    _, estimates = flown
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert 4 <= first <= 15
    assert all(e.tracked for e in estimates[first:])
    assert not any(e.T_m_b is not None or e.quality >= 0 for e in estimates[:first])
    assert {e.submap for e in estimates} == {estimates[0].submap}
    found = np.array([e.T_m_b[:3, 3] for e in estimates if e.T_m_b is not None])
    true = np.array([path(k)[:3, 3] for k in range(first, 60)])
    scale, error_m = similar(found, true)
    assert error_m < 0.01
    typical_m = float(np.median(room(path(first))[1]))
    assert scale == pytest.approx(typical_m / AgentConfig().two_view_start.median_depth_m, rel=0.25)
    # What flies must not jump when the map begins.
    moves = np.diff([e.T_o_b[:3, 3] for e in estimates], axis=0)
    assert np.linalg.norm(moves, axis=1).max() < 0.15 / scale


def test_bearings_find_their_true_depth(flown: tuple[Agent, list[Estimate]]) -> None:
    one, estimates = flown
    made: dict[int, int] = {}  # the frame of which each keyframe was made
    for k, estimate in enumerate(estimates):
        made.setdefault(int(estimate.keyframe), k)
    ratios = []
    for slot in np.flatnonzero(one.map.keyframe != NO_KEYFRAME):
        if int(one.map.keyframe[slot]) in made:  # all but the first, whose points two views gave
            depth = room(path(made[int(one.map.keyframe[slot])]))[1]
            known = one.map.usable[slot]
            uv = one.map.uv[slot][known].astype(int)
            ratios.append(1.0 / one.map.rho[slot][known] / depth[uv[:, 1], uv[:, 0]])
    ratio = np.concatenate(ratios)
    assert len(ratios) >= 3 and len(ratio) > 250  # keyframes are rare, and each has many landmarks
    assert np.mean(np.abs(ratio / np.median(ratio) - 1.0) < 0.05) > 0.9


def test_depths_follow_the_pose_by_images_not_the_fused_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """What moves the fused pose is in the pixels of all landmarks: taken for depth it would stretch the whole map."""
    flights = [agent(), agent()]
    for k in range(41):
        for one in flights:
            step(one, frame(k))
    alone, fused = flights
    known = alone.map.usable.copy()
    before = alone.map.rho[known].copy()
    fuse = fused._camera.motion.fuse

    def ahead(track: Track, t_ns: int) -> Track:
        track = fuse(track, t_ns)
        return replace(track, T_c_m=se3.from_rt(np.eye(3), np.array([-0.02, 0.0, 0.0])) @ track.T_c_m)

    monkeypatch.setattr(fused._camera.motion, "fuse", ahead)
    a, b = (step(one, frame(41)) for one in flights)
    assert np.linalg.norm(a.T_m_b[:3, 3] - b.T_m_b[:3, 3]) == pytest.approx(0.02, abs=1e-9)
    np.testing.assert_array_equal(alone.map.rho[known], fused.map.rho[known])
    assert (alone.map.rho[known] != before).any()


def test_points_too_far_for_stereo_get_their_depth_from_motion() -> None:
    baseline_m = 0.12
    # 36 baselines are 4.3 m: half of what is seen lies beyond.
    detector = DetectorConfig(cell_px=16)
    config = replace(AgentConfig(), detector=detector, local_map=LocalMapConfig(max_far_ratio=36.0))
    T_c_r = se3.from_rt(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    rig = CameraRig(CAMERA, CAMERA, np.eye(4), T_c_r, has_body=False)
    near, far = plain_pair()
    one = Agent(rig, None, config, Identity(AgentId(0), 0), near)
    made: dict[int, int] = {}
    for k in range(40):
        both = Frame(k * 50_000_000, frame(k).left, room(path(k) @ T_c_r)[0])
        estimate = step(one, both)
        assert estimate.tracked
        made.setdefault(int(estimate.keyframe), k)
    open_ = [(r.keyframe, r.index[r.inv_depth == 0]) for r in far.receive((), 0) if isinstance(r, NewLandmarks)]
    ratios = []
    for keyframe, index in open_:
        slot = one.map.slot_of(keyframe)
        depth = room(path(made[keyframe]))[1]
        known = index[one.map.usable[slot, index]]
        uv = one.map.uv[slot, known].astype(int)
        ratios.append(1.0 / one.map.rho[slot, known] / depth[uv[:, 1], uv[:, 0]])
    ratio = np.concatenate(ratios)
    assert len(ratio) > 30
    assert np.mean(np.abs(ratio - 1.0) < 0.05) > 0.9


def test_standing_and_turning_begin_nothing() -> None:
    for turns in (False, True):
        start = TwoViewStart(Rectifier(RIG).camera, AgentConfig(), Work())
        for k in range(14):
            turn = se3.so3_exp(np.array([0.0, 0.015 * k if turns else 0.0, 0.0]))
            view = FrameImages(build_pyramid(room(se3.from_rt(turn, np.zeros(3)))[0], 4), None, None)
            assert start.add(context(k, view)) is None


def test_a_second_start_takes_on_the_scale_of_the_first() -> None:
    start = TwoViewStart(Rectifier(RIG).camera, AgentConfig(), Work())
    start.note_depths(np.array([6.0, 7.0, 9.0]))
    start.rescale(2.0)
    opening = None
    for k in range(3, 20):
        opening = opening or start.add(context(k, FrameImages(build_pyramid(frame(k).left, 4), None, None)))
    assert opening.median_depth_m == 14.0
    depths = Rectifier(RIG).camera.bf / opening.points.disparity
    assert np.median(depths) == pytest.approx(14.0, rel=0.1)
    assert opening.t_ns == 3


def imu_at(t_s: F64, haste: float) -> ImuBatch:
    """Samples of an IMU in the camera, whose y axis points down, on the path `haste` times as fast."""
    h, gyro, accel = 1e-3, [], []
    for t in t_s:
        before, here, after = (path(3.0 + 20.0 * haste * x) for x in (t - h, t, t + h))
        gyro.append(se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2.0 * h))
        moved = (before[:3, 3] - 2.0 * here[:3, 3] + after[:3, 3]) / h**2
        accel.append(here[:3, :3].T @ (moved - np.array([0.0, 9.81, 0.0])))
    return ImuBatch(np.round(t_s * 1e9).astype(np.int64), np.array(gyro), np.array(accel))


def test_an_imu_gives_metres_from_the_first_pose_on() -> None:
    near, far = plain_pair()
    config = AgentConfig(keyframe=KeyframeConfig(earlier=True))
    one = Agent(RIG, ImuCalibration(), config, Identity(AgentId(0), 0), near)
    estimates: list[Estimate] = []
    words: list[str] = []
    begin, end, haste = 4, 110, 1.7  # in full motion from the first frame on
    for k in range(begin, end):
        t_s = (k - 3) * 0.05
        image = Frame(round(t_s * 1e9), room(path(3.0 + haste * (k - 3)))[0])
        output = one.step(StepInput(image, imu_at(t_s - np.arange(9, -1, -1) * 0.005, haste)), image.t_ns)
        assert output.estimate is not None
        estimates.append(output.estimate)
        words += output.events
        assert one.map.holds_landmarks == any(e.tracked for e in estimates[:-1])  # since then an IMU holds the scale
    assert any(word.startswith("mono: metric within") for word in words) and one.metric
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert 40 < first < 85
    before = estimates[:first]
    assert all(e.initialising and e.quality == -1 and odometry_line(e) == "" and live_line(e) == "" for e in before)
    assert all(e.tracked and not e.initialising for e in estimates[first:])
    found = np.array([e.T_m_b[:3, 3] for e in estimates[first:] if e.T_m_b is not None])
    true = np.array([path(3.0 + haste * (k - 3)) for k in range(begin + first, end)])
    scale, error_m = similar(found, true[:, :3, 3])
    assert scale == pytest.approx(1.0, abs=0.04) and error_m < 0.02
    # the map is gravity-aligned from its first pose on: the camera's y axis points down
    up = np.array([e.T_o_b[2, :3] for e in estimates[first:]])
    assert np.degrees(np.arccos(np.clip((up * -true[:, 1, :3]).sum(axis=1), -1.0, 1.0))).max() < 2.0
    records = far.receive((), 0)
    new_landmarks = [r for r in records if isinstance(r, NewLandmarks) and (r.inv_depth > 0).any()]
    assert {submap_of_keyframe(r.keyframe) for r in new_landmarks} == {e.submap for e in estimates[first:]}
    counts = FrameCounts()
    for e in estimates:
        counts.count(e)
    headers = {r.keyframe: r for r in records if isinstance(r, KeyframeHeader)}
    assert counts.keyframes == len(headers)
    # the base also gets what the camera saw before, from the first frame on
    began_ns = estimates[first].t_ns
    early = [k for k in sorted(headers) if headers[k].t_ns < began_ns]
    assert len(early) >= 3 and headers[early[0]].t_ns == estimates[0].t_ns
    T_m_k: dict[int, F64] = {NO_KEYFRAME: np.eye(4)}
    for k in sorted(headers):
        T_m_k[k] = T_m_k[headers[k].parent] @ headers[k].T_p_k
    at = np.array([T_m_k[k][:3, 3] for k in early])
    true_at = np.array([path(3.0 + haste * headers[k].t_ns / 5e7)[:3, 3] for k in early])
    scale, error_m = similar(at, true_at)
    assert scale == pytest.approx(1.0, abs=0.05) and error_m < 0.02
    observed = np.concatenate([r.point for r in records if isinstance(r, Observations) and r.keyframe in early])
    shared = Counter(dict.fromkeys(early, 0))
    for r in records:
        if isinstance(r, NewLandmarks) and r.keyframe in shared:
            shared[r.keyframe] += len(r.index)
    assert len(observed) > 50 and {int(p) >> KEYPOINT_BITS for p in observed} <= set(early)
    assert min(shared.values()) > 30  # corners as any keyframe has them, not only those that were followed


@pytest.mark.parametrize("percent", [8.0, 30.0])
def test_a_budget_delays_the_first_pose_and_nothing_else(percent: float) -> None:
    """The solution for the first map costs a tenth of a second and more: frames wait for it, and are tracked after."""

    def fly(cpu_percent: float) -> tuple[list[str], list[int], list[Estimate | None]]:
        config = AgentConfig()
        config = replace(config, governor=replace(config.governor, cpu_percent=cpu_percent))
        one = Agent(RIG, ImuCalibration(), config, Identity(AgentId(0), 0), NoBaseChannel())
        words: list[str] = []
        costs: list[int] = []
        estimates: list[Estimate | None] = []
        for k in range(4, 190):
            t_s, haste = (k - 3) * 0.05, 1.7
            image = Frame(round(t_s * 1e9), room(path(3.0 + haste * (k - 3)))[0])
            imu = imu_at(t_s - np.arange(9, -1, -1) * 0.005, haste)
            output = one.step(StepInput(image, imu, cpu_ns=costs[-1] if costs else 0), image.t_ns)
            costs.append(cost_ns(one.work))
            words += [word for word in output.events if word.startswith("mono")]
            estimates.append(output.estimate)
            if output.estimate is not None:
                assert output.estimate.t_ns == image.t_ns  # none of a frame that waited
        return words, costs, estimates

    words, costs, estimates = fly(percent)
    free, _, _ = fly(0.0)
    assert words[0] == free[0] and words[0].startswith("mono: metric within")
    assert max(sum(costs[k : k + 20]) for k in range(len(costs) - 20)) <= percent * 1e7
    assert sum(e is not None and e.tracked for e in estimates[-20:]) > 3  # it has caught up
    assert max(np.diff([k for k, e in enumerate(estimates) if e is not None and e.tracked])) < 10


def test_a_still_camera_with_an_imu_has_no_pose() -> None:
    one = Agent(RIG, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    image = room(path(0))[0]
    noise = np.random.default_rng(0)
    for k in range(60):
        t_ns = (k + 1) * 50_000_000
        stamps = t_ns - np.arange(9, -1, -1, dtype=np.int64) * 5_000_000
        imu = ImuBatch(
            stamps, 1e-3 * noise.normal(size=(10, 3)), np.array([0.0, -9.81, 0.0]) + 0.02 * noise.normal(size=(10, 3))
        )
        estimate = one.step(StepInput(Frame(t_ns, image), imu), t_ns).estimate
        assert estimate.initialising and not estimate.tracked


def test_images_alone_are_flown_where_the_imu_contradicts_them() -> None:
    config = AgentConfig()
    begin, end, haste = 4, 240, 0.8
    start = config.inertial_start
    start = replace(start, contradiction=replace(start.contradiction, lasts_s=1.5, unsure_s=2.0))
    one = Agent(RIG, ImuCalibration(), replace(config, inertial_start=start), Identity(AgentId(0), 0), NoBaseChannel())
    estimates: list[Estimate] = []
    words: list[str] = []
    for k in range(begin, end):
        t_s = (k - 3) * 0.05
        image = Frame(round(t_s * 1e9), room(path(3.0 + haste * (k - 3)))[0])
        imu = imu_at(t_s - np.arange(9, -1, -1) * 0.005, haste)
        turned = replace(imu, gyro=imu.gyro * [1.0, -1.0, -1.0], accel=imu.accel * [1.0, -1.0, -1.0])
        output = one.step(StepInput(image, turned), image.t_ns)
        assert output.estimate is not None
        estimates.append(output.estimate)
        words += output.events
        sample = pose_sample(one, output, image.t_ns, 0)
        assert sample is None or not sample.tracked  # a flight controller would take its lengths for metres
    assert sum(word.startswith("imu: images and IMU contradict") for word in words) == 1
    assert sum(word.startswith("imu: not used from here on") for word in words) == 1
    assert not one.metric and one.motion_reports()["time_offset"] is None
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert all(e.initialising for e in estimates[:first])
    assert all(e.tracked and not e.initialising for e in estimates[first:])
    found = np.array([e.T_m_b[:3, 3] for e in estimates[first:] if e.T_m_b is not None])
    true = np.array([path(3.0 + haste * (k - 3)) for k in range(begin + first, end)])
    assert similar(found, true[:, :3, 3])[1] < 0.03
    # as without an IMU, the camera counts as level where the flight began: z up in o is -y of the camera
    assert np.degrees(np.arccos(-estimates[first].T_o_b[2, 1])) < 12.0


def test_without_samples_a_monocular_map_keeps_its_own_unit() -> None:
    """An IMU that is calibrated but silent does not hold up tracking for ever."""
    one = Agent(RIG, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    estimates = [step(one, frame(k)) for k in range(4, 110)]
    assert estimates[-1].tracked and not one.metric
    assert estimates[40].initialising
    first = next(e for e in estimates if e.tracked)
    assert np.degrees(np.arccos(-first.T_o_b[2, 1])) < 12.0  # the camera counts as level where the flight began


def test_deviation_of_a_meeting_is_that_of_moved_pixels() -> None:
    bearing, rho = np.array([[0.1, -0.2], [-0.3, 0.05]]), np.array([0.3, 0.7])
    T_c_k = se3.exp(np.array([0.3, -0.1, 0.2, 0.02, 0.05, -0.03]))

    def pixel(r: F64) -> F64:
        p = np.column_stack([bearing, np.ones(2)]) @ T_c_k[:3, :3].T + T_c_k[:3, 3] * r[:, None]
        return np.asarray(FOCAL * p[:, :2] / p[:, 2:])

    slope = np.linalg.norm(pixel(rho + 1e-6) - pixel(rho - 1e-6), axis=1) / 2e-6
    np.testing.assert_allclose(triangulated_sigma(bearing, rho, T_c_k, FOCAL, np.array([0.5, 1.0])), [0.5, 1.0] / slope)


def test_a_street_is_followed_by_a_monocular_camera(data_dir: Path) -> None:
    source = open_source(str(data_dir / "kitti07_mono"))
    one = Agent(source.rig, source.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    estimates: list[Estimate] = []
    for item in source:
        if isinstance(item, Frame):
            estimates.append(step(one, item))
        if len(estimates) == 45:
            break
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert first < 15
    assert all(e.tracked for e in estimates[first:])
    steps = [se3.inverse(a.T_o_b) @ b.T_o_b for a, b in pairwise(estimates[first:])]
    speed = np.array([np.linalg.norm(T[:3, 3]) for T in steps])
    assert min(T[2, 3] for T in steps) > 0.0, "the car drives on"
    assert np.abs(np.diff(speed) / speed[1:]).max() < 0.4, "and changes its speed smoothly"
