"""A monocular flight: it begins when two views give depth, keeps its own scale, and landmarks find their true depth."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, LocalMapConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid
from kiteline_agent.initialisation.two_view_start import TwoViewStart
from kiteline_agent.keyframes.depth_from_motion import triangulated_sigma
from kiteline_agent.keyframes.pair_search import Fault
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import NewLandmarks
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ids import NO_KEYFRAME, AgentId
from kiteline_hw.sources.open import open_source
from tests.agent.mono_room import CAMERA, FOCAL, RIG, agent, context, frame, path, room, similar, step


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


def test_a_camera_that_stands_is_told_once_to_move() -> None:
    one, still, told = agent(), frame(0), []
    for k in range(30):
        t_ns = still.t_ns + 500_000_000 * k
        output = one.step(StepInput(frame=replace(still, t_ns=t_ns)), t_ns)
        told += [(0.5 * k, event) for event in output.events if event.startswith("images:")]
    assert told == [(10.0, Fault.PARALLAX.value)]


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


def test_images_that_show_nothing_hardly_delay_a_start() -> None:
    def frames_until_a_map(blank: tuple[int, ...]) -> int:
        start = TwoViewStart(Rectifier(RIG).camera, AgentConfig(), Work())
        for k in range(3, 30):
            left = np.full_like(frame(k).left, 90) if k in blank else frame(k).left
            if start.add(context(k, FrameImages(build_pyramid(left, 4), None, None))) is not None:
                return k
        raise AssertionError("no map")

    assert frames_until_a_map((5, 7)) <= frames_until_a_map(()) + 1


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
