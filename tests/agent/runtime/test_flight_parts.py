"""The source read ahead, the tally, the virtual core, and estimates that pass through a log unchanged."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_agent.runtime.flight_log import estimate_from_json, estimate_to_json
from kiteline_agent.runtime.frame_counts import CpuAccount, FrameCounts, live_line, odometry_line
from kiteline_agent.runtime.frame_reader import SAMPLES, FrameReader
from kiteline_agent.runtime.options import AgentOptions, agent_config
from kiteline_agent.step import Estimate
from kiteline_core import config as configuration
from kiteline_core.config import ConfigError
from kiteline_core.frame import Frame, ImuBatch, joined
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, SubmapId

IMAGE = np.zeros((4, 4), np.uint8)


def imu(*t_ns: int) -> ImuBatch:
    n = len(t_ns)
    return ImuBatch(np.array(t_ns, np.int64), np.ones((n, 3)), np.full((n, 3), 9.8))


def source() -> Iterator[Frame | ImuBatch]:
    for t_ns in (100, 200, 300, 400):
        yield imu(t_ns - 50, t_ns)
        yield Frame(t_ns, IMAGE)


def no_clock() -> int:
    return 0


def test_frames_come_with_the_samples_before_them() -> None:
    camera = FrameReader(source(), None, no_clock)
    assert camera.next_ns == 100
    frame, batch, _ = camera.take()
    assert frame.t_ns == 100
    assert batch.t_ns.tolist() == [50, 100]
    assert camera.period_ns == 100


def test_samples_of_a_dropped_frame_go_with_the_next() -> None:
    camera = FrameReader(source(), None, no_clock)
    camera.drop()
    frame, batch, _ = camera.take()
    assert frame.t_ns == 200
    assert batch.t_ns.tolist() == [50, 100, 150, 200]
    assert batch.gyro.shape == (4, 3)


def test_frames_beyond_the_end_are_left_out() -> None:
    camera = FrameReader(source(), 250, no_clock)
    assert [camera.take()[0].t_ns, camera.take()[0].t_ns] == [100, 200]
    assert camera.next_ns is None


def test_decoding_is_measured_apart() -> None:
    ticks = iter(range(0, 10**9, 3_000_000))
    camera = FrameReader(source(), None, lambda: next(ticks))
    camera.take()
    assert list(camera.decode_ms) == [3.0, 3.0]
    assert camera.decode_ns == 6_000_000


def accounted(whole: bool) -> list[float]:
    """Two steps without and three with a frame, at ticks of 1 ms: decoding takes one between two looks at the clock."""
    ticks = iter(range(0, 10**9, 1_000_000))
    camera = FrameReader(source(), None, lambda: next(ticks))
    account = CpuAccount(lambda: next(ticks), camera, whole)
    for with_frame in (True, False, True, False, True):
        if with_frame:
            camera.take()
        account.begin()
        account.end(with_frame)
        assert account.last_ns == round(account.ms[-1] * 1e6)
    return list(account.ms)


def test_cpu_times_of_days_take_no_memory() -> None:
    ticks = itertools.count(0, 1_000_000)
    camera = FrameReader((), None, lambda: next(ticks))
    account = CpuAccount(lambda: next(ticks), camera, whole=True)
    for _ in range(2 * SAMPLES):
        account.end(with_frame=True)
    assert len(account.ms) == SAMPLES and account.frames == 2 * SAMPLES
    assert camera.decode_ms.maxlen == SAMPLES


def test_a_frame_alone_in_its_process_costs_all_but_decoding() -> None:
    assert accounted(whole=True) == [2.0, 3.0, 3.0]
    assert accounted(whole=False) == [1.0, 2.0, 2.0]


def test_nothing_joined_is_nothing() -> None:
    assert joined([]) is None
    one = imu(1)
    assert joined([one]) is one


def estimate(tracked: bool = True, placed: bool = False, keyframe: int = 3) -> Estimate:
    pose = se3.exp(np.array([0.1, -0.2, 1 / 3, 0.3, 1e-9, -2.0]))
    return Estimate(
        1_000_000_007, tracked, False, pose if tracked else None, pose, KeyframeId(keyframe), np.eye(4), SubmapId(0),
        120, 80, 0.1 * np.eye(6), np.full((6, 6), 1 / 3), np.eye(3) if tracked else None,
        np.eye(4) if placed and tracked else None,
    )  # fmt: skip


def test_frames_are_tracked_lost_or_dropped() -> None:
    tally = FrameCounts(dropped=2, bytes_up=700)
    first, second = estimate(keyframe=1), estimate(keyframe=2)  # a map may begin with what the camera saw before
    for e in (first, replace(second, quality=74), replace(first, bridged=True), replace(second, tracked=False), None):
        tally.count(e)
    assert tally.as_report() == {
        "frames": 7, "tracked": 3, "bridged": 1, "flagged": 1, "lost": 1, "initialising": 0, "dropped": 3,
        "predicted": 0, "submaps": 1, "keyframes": 3, "bytes_up": 700, "bytes_down": 0, "bytes_per_keyframe": 233.3,
    }  # fmt: skip


def test_a_frame_before_the_first_map_is_lost_and_has_no_line() -> None:
    before = replace(estimate(tracked=False), initialising=True)
    counts = FrameCounts()
    counts.count(before)
    assert (counts.lost, counts.initialising, counts.tracked) == (1, 1, 0)
    assert live_line(before) == "" and odometry_line(before) == ""


def test_a_lost_frame_has_odometry_but_no_live_line() -> None:
    assert live_line(estimate(tracked=False)) == ""
    assert odometry_line(estimate(tracked=False)).startswith("1.000000007 ")
    assert live_line(estimate(placed=True)).split()[1:4] == ["0.000000000"] * 3  # in w where w is known
    apart = replace(estimate(), T_o_b=np.eye(4))
    assert live_line(apart) == odometry_line(estimate()) != odometry_line(apart)


@pytest.mark.parametrize("e", [estimate(), estimate(placed=True), estimate(tracked=False)])
def test_estimates_pass_through_json_to_the_last_bit(e: Estimate) -> None:
    back = estimate_from_json(json.loads(json.dumps(estimate_to_json(e))))
    for name in Estimate.__slots__:
        a, b = getattr(e, name), getattr(back, name)
        if isinstance(a, np.ndarray):
            assert a.tobytes() == b.tobytes()
        else:
            assert a == b


def test_an_estimate_of_another_version_is_refused() -> None:
    with pytest.raises(ValueError, match="fields"):
        estimate_from_json({"t_ns": 1})


def test_a_limited_core_is_busy_for_longer_than_a_whole_one() -> None:
    cpu = VirtualCpu(25.0)
    cpu.spend(10_000_000, 1_000)
    assert cpu.free_ns == 40_001_000
    assert cpu.newest_wins(5_000, 30_000_000)
    assert not cpu.newest_wins(20_000_000, 30_000_000)
    assert not cpu.newest_wins(5_000, 0)  # no period is known yet: a frame is not passed over
    free = VirtualCpu(0.0)
    free.spend(10**12, 0)
    assert not free.newest_wins(0, 1)


def test_a_spec_travels_as_json() -> None:
    spec = AgentOptions(source="a", folder="b", seconds=2.5)
    assert (
        configuration.from_json(
            AgentOptions, json.dumps({name: getattr(spec, name) for name in AgentOptions.__slots__})
        )
        == spec
    )
    with pytest.raises(ValueError, match="speed"):
        configuration.from_json(AgentOptions, '{"source": "a", "folder": "b", "speed": 1}')


def test_configuration_files_name_their_mistakes(tmp_path: object) -> None:
    from pathlib import Path

    path = Path(str(tmp_path)) / "c.toml"
    path.write_text("[agent.pose]\nmin_inliers = 20\n")
    assert agent_config(str(path)).pose.min_inliers == 20
    for text, word in (("[agents]\n", "agents"), ("[agent\n", "c.toml"), ("agent = 3\n", "section")):
        path.write_text(text)
        with pytest.raises(ConfigError, match=word):
            agent_config(str(path))
