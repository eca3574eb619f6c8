"""The filter's keyframes: what the base receives of them, and what its corrections move."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, GovernorConfig, SmoothingConfig
from kiteline_agent.ekf.ekf_agent import EkfAgent
from kiteline_agent.ekf.shared_keyframes import FilteredFrame, SharedKeyframes
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Governor
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.keyframes import reference
from kiteline_agent.runtime.options import is_filter
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import (
    KeyframeHeader,
    KeyframePose,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    SubmapPlacement,
    SubmapScale,
    SubmapTie,
)
from kiteline_core.frame import Frame, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, RectifiedCamera
from kiteline_core.ids import (
    KEYPOINT_BITS,
    MAX_KEYFRAMES,
    NO_KEYFRAME,
    SEQUENCE_BITS,
    AgentId,
    keyframe_id,
    submap_of_keyframe,
)

_PERIOD_NS = 50_000_000
_DEPTH_M, _SPEED_M_S, _FOCAL_PX = 4.0, 0.8, 200.0
_LEFT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _flown(
    frames: int, config: AgentConfig, shifted_at: int = -1, shift_m: float = 0.0, cpu_ns: int = 0, dark: bool = False
) -> tuple[list[Estimate | None], list[Record]]:
    """Flies to the right along a textured wall; at a frame the base moves the newest keyframe up. What it received."""
    wall = np.kron(np.random.default_rng(0).integers(0, 256, (60, 300)), np.ones((4, 4))).astype(np.uint8)
    camera = CameraModel(320, 240, _FOCAL_PX, _FOCAL_PX, 159.5, 119.5)
    ours, theirs = plain_pair()
    agent = EkfAgent(CameraRig(camera, None, _LEFT, None), config, Identity(AgentId(0), 0), ours)
    small, estimates, received = np.tile(1e-4 * np.eye(3), (5, 1, 1)), [], []
    poses: dict[int, np.ndarray] = {}
    for k in range(frames):
        at = round(k * _SPEED_M_S * 0.05 * _FOCAL_PX / _DEPTH_M)  # a whole number: nothing is interpolated
        image = np.zeros((240, 320), np.uint8) if dark else np.ascontiguousarray(wall[:, at : at + 320])
        t_ns = k * _PERIOD_NS - np.arange(4, -1, -1) * 10_000_000
        batch = OdometryBatch(t_ns, np.tile([0.0, -_SPEED_M_S, 0.0], (5, 1)), np.zeros((5, 3)), small, small)
        if k == shifted_at:
            newest = max(poses)
            moved = se3.from_rt(np.eye(3), np.array([0.0, 0.0, shift_m])) @ poses[newest]
            theirs.put(SubmapPlacement(agent.submap, np.eye(4)))
            theirs.put(KeyframePose(newest, moved))
        step = StepInput(Frame(k * _PERIOD_NS, image), odometry=batch if k else None, cpu_ns=cpu_ns)
        estimates.append(agent.step(step, k * _PERIOD_NS).estimate)
        for record in theirs.receive((), 0):
            received.append(record)
            if isinstance(record, KeyframeHeader):
                poses[record.keyframe] = poses.get(record.parent, np.eye(4)) @ record.T_p_k
    return estimates, received


def test_base_receives_a_metric_submap_whose_observations_name_what_it_holds() -> None:
    estimates, received = _flown(60, AgentConfig(tracker="ekf"))
    headers = [r for r in received if isinstance(r, KeyframeHeader)]
    assert 3 <= len(headers) <= 20
    assert [r.metres for r in received if isinstance(r, SubmapScale)] == [1.0]
    held = {(r.keyframe << KEYPOINT_BITS) + int(i) for r in received if isinstance(r, NewLandmarks) for i in r.index}
    observed = [r for r in received if isinstance(r, Observations)]
    assert sum(len(r.index) for r in observed) > 100
    for r in observed:
        assert set(r.point.tolist()) <= held
        assert not r.inv_depth.any()  # else the base takes the camera for one that measures depths
    # Live poses, composed with their keyframes, are those of the odometry frame.
    T_m_k: dict[int, np.ndarray] = {}
    for header in headers:
        T_m_k[header.keyframe] = T_m_k.get(header.parent, np.eye(4)) @ header.T_p_k
    live = [r for r in received if isinstance(r, LivePose)]
    last = estimates[-1]
    np.testing.assert_allclose((T_m_k[live[-1].keyframe] @ live[-1].T_k_c)[:3, 3], last.T_o_b[:3, 3], atol=1e-3)


def test_a_submap_without_ids_for_keyframes_is_continued_in_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    config = AgentConfig(tracker="ekf")
    usual, _ = _flown(60, config)
    monkeypatch.setattr(reference, "FULL_AT", 2)
    estimates, received = _flown(60, config)
    for a, b in zip(usual, estimates, strict=True):
        np.testing.assert_array_equal(a.T_o_b, b.T_o_b)
    headers = {r.keyframe: r for r in received if isinstance(r, KeyframeHeader)}
    ties = [r for r in received if isinstance(r, SubmapTie)]
    firsts = [r for r in headers.values() if r.parent == NO_KEYFRAME]
    assert len(ties) == len(firsts) - 1 >= 2
    assert [r.submap for r in received if isinstance(r, SubmapScale)] == [
        submap_of_keyframe(r.keyframe) for r in firsts
    ]
    assert all(r.keyframe & MAX_KEYFRAMES - 1 <= 2 for r in headers.values())
    for tie in ties:
        first = headers[keyframe_id(tie.submap, 0)]
        assert first.t_ns == headers[tie.since].t_ns  # two keyframes of one frame
        np.testing.assert_allclose(tie.T_k_f, np.eye(4), atol=1e-5)
    for r in (r for r in received if isinstance(r, Observations)):
        assert {int(point) >> KEYPOINT_BITS + SEQUENCE_BITS for point in r.point} <= {submap_of_keyframe(r.keyframe)}


def test_a_landmark_has_the_depth_that_the_filter_knows() -> None:
    image = np.random.default_rng(1).integers(0, 256, (240, 320)).astype(np.uint8)
    camera, config = RectifiedCamera(320, 240, 200.0, 200.0, 159.5, 119.5, 0.0, False, np.eye(4)), AgentConfig()
    ours, theirs = plain_pair()
    keyframes = SharedKeyframes(
        camera, config, Identity(AgentId(0), 0), ours, Governor(config.governor), Work()
    )  # fmt: skip
    depth_m = np.where(np.arange(6) % 2, np.arange(2.0, 8.0), 0.0)
    uv, octave = np.array([[60.0 + 30.0 * i, 120.0] for i in range(6)]), np.zeros(6, np.uint8)
    keyframes.add(
        FilteredFrame(0, 0, build_pyramid(image, 4), np.eye(4), np.arange(6), uv, octave, depth_m), tracked=True
    )
    (sent,) = (r for r in theirs.receive((), 0) if isinstance(r, NewLandmarks))
    told = dict(zip(sent.uv[:, 0].round().tolist(), sent.inv_depth.tolist(), strict=True))
    assert [told[60.0 + 30.0 * i] for i in range(6)] == pytest.approx([0, 1 / 3, 0, 1 / 5, 0, 1 / 7], abs=1e-3)


def test_correction_of_a_keyframe_moves_the_live_pose_and_not_the_odometry() -> None:
    config = AgentConfig(tracker="ekf", smoothing=SmoothingConfig(max_m_s=0.0, max_rad_s=0.0))
    plain, _ = _flown(30, config)
    moved, _ = _flown(30, config, shifted_at=22, shift_m=0.5)
    a, b = plain[29], moved[29]
    assert a is not None and b is not None and a.T_m_b is not None and b.T_m_b is not None and b.T_w_b is not None
    np.testing.assert_array_equal(a.T_o_b, b.T_o_b)
    np.testing.assert_allclose(b.T_m_b[:3, 3] - a.T_m_b[:3, 3], [0.0, 0.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(b.T_w_b, b.T_m_b, atol=1e-9)


def test_governor_skips_frames_and_the_odometer_bridges_them() -> None:
    config = AgentConfig(tracker="ekf", governor=GovernorConfig(cpu_percent=10.0))
    estimates, _ = _flown(120, config, cpu_ns=20_000_000)
    tracked = [e for e in estimates if e is not None]
    assert 5 <= len(tracked) <= 100
    np.testing.assert_allclose(
        tracked[-1].T_o_b[1, 3], -_SPEED_M_S * tracked[-1].t_ns * 1e-9, atol=0.15
    )  # fmt: skip


def test_darkness_costs_few_keyframes() -> None:
    _, received = _flown(120, AgentConfig(tracker="ekf"), dark=True)
    assert 1 <= sum(isinstance(r, KeyframeHeader) for r in received) <= 3


def test_tracker_of_a_configuration_file_counts(tmp_path: Path) -> None:
    """A stereo source was opened as a pair."""
    file = tmp_path / "kiteline.toml"
    file.write_text('[agent]\ntracker = "ekf"\n')
    assert is_filter(str(file), "")
    assert not is_filter(str(file), "map")
    assert not is_filter("", "")
