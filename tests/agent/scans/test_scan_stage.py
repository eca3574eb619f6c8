"""The agent's scans in flight: spread over frames, the same each time, shared last, dropped first."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.scans import scan_queue
from kiteline_agent.step import Identity, StepInput
from kiteline_codec.schema import Key, KeyframeHeader, KeyframeScan, Record, messages
from kiteline_core.frame import Frame
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.ground_height import Verdict
from kiteline_core.ids import AgentId, KeyframeId
from kiteline_hw.sources.open import open_source


class Heard(NoBaseChannel):
    """Keeps the scans that are shared, and the ids of keyframes. busy: nothing arrives."""

    def __init__(self, busy: bool = False) -> None:
        super().__init__()
        self.busy = busy
        self.scans: list[KeyframeScan] = []
        self.keyframes: set[KeyframeId] = set()

    def put(self, record: Record) -> Record:
        if isinstance(record, KeyframeScan):
            self.scans.append(record)
        elif isinstance(record, KeyframeHeader):
            self.keyframes.add(record.keyframe)
        return super().put(record)

    def arrived(self, key: Key) -> bool:
        return not self.busy


def flown(
    path: Path, config: AgentConfig, busy: bool = False, every: int = 1, known: bool = True
) -> tuple[Agent, Heard, list[int], list[str]]:
    source = open_source(str(path))
    channel = Heard(busy)
    agent = Agent(source.rig, None, config, Identity(AgentId(0), 0), channel)
    if known and agent._scans is not None:  # the recording shows a wall alone
        agent._scans._ground.start_at(np.array([0.0, 0.0, -1.0]))
    matched, events = [], []
    for frame in [item for item in source if isinstance(item, Frame)][::every]:
        events += agent.step(StepInput(frame, cpu_ns=3_000_000), frame.t_ns).events
        matched.append(agent.work.matched_px)
    return agent, channel, matched, events


def eager() -> AgentConfig:
    """Every view is scanned, and every third frame becomes a keyframe."""
    config = AgentConfig()
    scan = replace(config.scan, moved_m=0.0, turned_rad=0.0)
    return replace(config, scan=scan, keyframe=replace(config.keyframe, baseline_ratio=0.06))


def test_a_scan_is_spread_over_frames_and_the_same_each_time(recording: Path) -> None:
    agent, channel, matched, _ = flown(recording, eager())
    _, again, _, _ = flown(recording, eager())
    assert channel.scans
    assert [messages.encode(s) for s in channel.scans] == [messages.encode(s) for s in again.scans]
    camera = agent.map.camera
    whole = (camera.width // 2 + 32) * (camera.height // 4)  # with what it is continued by to the left
    assert max(matched) == whole // GroundConfig().stripes  # never more than a stripe
    for scan in channel.scans:
        assert scan.keyframe in channel.keyframes
        assert (scan.scan.free_m >= scan.scan.free_from_m - 1e-9).all()


def test_what_covers_the_view_is_neither_mapped_nor_scanned(recording: Path) -> None:
    def covered(*part: float) -> tuple[Agent, Heard]:
        agent, channel, _, _ = flown(recording, replace(eager(), detector=DetectorConfig(covered=part)))
        return agent, channel

    def seen_to_the_left(channel: Heard) -> bool:
        return any(
            (np.isfinite(s.scan.obstacle_m) | (s.scan.free_m > 0.0))[s.scan.azimuth0_rad
             + s.scan.azimuth_step_rad * np.arange(len(s.scan.free_m)) > 0.1].any()
            for s in channel.scans
        )  # fmt: skip

    (whole, every), (half, right) = covered(), covered(0.0, 0.0, 0.5, 1.0)
    assert seen_to_the_left(every) and right.scans and not seen_to_the_left(right)
    middle = 0.5 * half.map.camera.width
    assert (whole.map.uv[whole.map.usable][:, 0] < middle).any()
    assert half.map.usable.any() and (half.map.uv[half.map.usable][:, 0] >= middle).all()


def test_covered_parts_at_a_border_end_where_the_scans_view_ends(data_dir: Path) -> None:
    """It is wider than the rectified image and lies lower: a strip beside them would show what is to be left out."""
    rig = open_source(str(data_dir / "euroc_v101_start")).rig
    stage = Agent(rig, None, AgentConfig(), Identity(AgentId(0), 0), Heard())._scans
    assert stage is not None
    seen, side, lower = stage._segmenter.camera, 64, 32
    at = seen.columns * 2
    assert stage._covered_slices(np.array([[0.0, 0.0, 1.0, 1.0]])) == ((slice(0, seen.height), slice(0, seen.width)),)
    left, top, right, bottom = 0.25 * 752, 0.5 * 480, 0.5 * 752, 0.75 * 480
    ((rows, columns),) = stage._covered_slices(np.array([[0.25, 0.5, 0.5, 0.75]]))
    assert (columns.start, columns.stop - 1) == pytest.approx(((left + side) / at, (right + side) / at), abs=1)
    assert (rows.start, rows.stop - 1) == pytest.approx(((top - lower) / 4, (bottom - lower) / 4), abs=1)


def test_what_is_matched_with_a_covered_part_of_the_right_image_is_left_out(recording: Path) -> None:
    agent, _, _, _ = flown(recording, AgentConfig(), every=20)
    stage, seen, right = agent._scans, agent._scans._segmenter.camera, np.array([[0.0, 0.5, 0.5, 1.0]])
    ((rows, columns),) = stage._covered_slices(right)
    for left in (np.empty((0, 4)), np.array([[0.9, 0.0, 1.0, 0.25]])):
        disparity = np.full((seen.height, seen.width), 3.0, np.float32)
        disparity[:, 0] = 0.0  # unknown, and stays so
        expected = disparity.copy()
        expected[rows, : columns.stop + 3] = 0.0
        for part in stage._covered_slices(left):
            expected[part] = 0.0
        stage.cover(left, right)
        stage._without_covered(disparity)
        assert np.array_equal(disparity, expected)


def test_a_slow_camera_matches_two_stripes_a_frame(recording: Path) -> None:
    """Else a keyframe of every third frame at 10 Hz would come before the scan of the one before is made."""
    (_, _, fast, _), (_, slow, matched, _) = flown(recording, eager()), flown(recording, eager(), every=2)
    assert max(matched) == 2 * max(fast)
    assert slow.scans


def test_without_scans_nothing_is_matched(recording: Path) -> None:
    config = eager()
    _, channel, matched, _ = flown(recording, replace(config, scan=replace(config.scan, on=False)))
    assert not channel.scans and not any(matched)


def test_scans_do_not_pile_up_on_a_link_that_carries_none(recording: Path) -> None:
    _, channel, _, _ = flown(recording, eager(), busy=True)
    later = [scan for scan in channel.scans if scan.part >= KeyframeScan.FIRST_PARTS]
    assert channel.scans and len(later) <= 4


def test_scans_are_dropped_first_when_cpu_time_is_short(recording: Path) -> None:
    config = eager()
    short = replace(config, governor=replace(config.governor, cpu_percent=4.0, grace_s=0.0))
    _, channel, matched, _ = flown(recording, short)
    assert not channel.scans
    assert not any(matched)


def test_the_log_tells_the_nearest_obstacle(recording: Path) -> None:
    _, channel, _, events = flown(recording, eager())
    told = [event for event in events if event.startswith("nearest obstacle")]
    assert told and len(told) <= len(channel.scans)
    assert np.isfinite([s.scan.up_c for s in channel.scans]).all()


def test_errors_of_ranges_are_renewed_with_the_disparity_offset_or_its_covariance(recording: Path) -> None:
    agent, _, _, _ = flown(recording, AgentConfig(), every=20)
    stage, cov = agent._scans, np.eye(5)
    first = stage.range_error(cov)
    assert first.cov_px is cov and stage.range_error(cov) is first and stage.range_error(None) is first
    second = stage.range_error(2.0 * cov)
    assert second is not first
    agent.map.disparity_offset = agent.map.disparity_offset + 0.1
    assert stage.range_error(second.cov_px).offset_px is agent.map.disparity_offset


def test_the_local_grid_is_told_how_high_the_ground_is(recording: Path) -> None:
    agent, _, _, _ = flown(recording, eager())
    assert agent._local_grid._ground_m == pytest.approx(-1.0, abs=0.05)


def test_scans_are_not_shared_while_the_height_of_the_ground_is_unknown(recording: Path) -> None:
    agent, channel, matched, _ = flown(recording, eager(), known=False)
    assert any(matched)
    assert agent._local_grid._ground_m is None  # all height bands of tiles count
    # The base is told that there are scans: else it draws landmarks, the lowest of which are taken for the floor.
    (told,) = channel.scans
    assert np.isnan(told.scan.camera_height_m) and not told.scan.free_m.any() and not told.scan.bands.any()


def test_scans_above_a_table_are_taken_back_once_the_floor_is_seen(recording: Path) -> None:
    agent, channel, _, _ = flown(recording, eager())
    stage = agent._scans
    table = replace(channel.scans[0], keyframe=KeyframeId(10))
    channel.scans.clear()
    stage._take(Verdict([], [table]))
    (sent,) = channel.scans
    assert sent.keyframe == table.keyframe
    assert np.isnan(sent.scan.camera_height_m) and not sent.scan.free_m.any() and not sent.scan.bands.any()
    messages.encode(sent)


def test_frames_between_keyframes_are_scanned_and_hang_on_the_one_before(recording: Path) -> None:
    _, channel, _, _ = flown(recording, eager())
    later = [record for record in channel.scans if record.part]
    assert later
    assert len({record.key() for record in channel.scans}) == len(channel.scans)
    for record in later:
        assert record.T_k_s is not None and not len(record.labels)
        assert np.linalg.norm(record.T_k_s[:3, 3]) > 0.01  # the vehicle flies sideways
        messages.encode(record)
    _, still, _, _ = flown(recording, AgentConfig())
    assert len(still.scans) < len(channel.scans)


def test_the_scan_of_a_keyframe_itself_labels_its_landmarks(recording: Path) -> None:
    _, channel, _, _ = flown(recording, eager())
    own = [record for record in channel.scans if record.part == 0]
    assert len(own) > 1
    for record in own:
        assert record.T_k_s is None and len(record.labels)
        messages.encode(record)


def test_the_next_scan_begins_in_the_frame_that_finishes_one(recording: Path) -> None:
    """At 20 Hz two of three frames match a stripe, but for keyframes; a keyframe takes the place of a begun frame."""
    _, channel, matched, _ = flown(recording, eager())
    assert sum(px > 0 for px in matched) >= 13  # 10 with a frame of nothing after each scan
    assert len(channel.scans) >= 6  # then, 5
    assert len([scan for scan in channel.scans if scan.part == 0]) >= 3
    keys = [scan.key() for scan in channel.scans]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("used_up", [False, True])
def test_a_view_that_stays_is_scanned_again_and_not_shared(recording: Path, used_up: bool) -> None:
    """Also where the keyframe has no number left for a scan that would be shared."""
    source = open_source(str(recording))
    channel = Heard(busy=False)
    agent = Agent(source.rig, None, AgentConfig(), Identity(AgentId(0), 0), channel)
    agent._scans._ground.start_at(np.array([0.0, 0.0, -1.0]))
    first, matched = next(item for item in source if isinstance(item, Frame)), 0
    for k in range(100):  # 5 s
        frame = replace(first, t_ns=first.t_ns + 50_000_000 * k)
        agent.step(StepInput(frame), frame.t_ns)
        matched += agent.work.matched_px > 0
        if used_up:
            agent._scans._part = KeyframeScan.PARTS - 1
    assert matched <= 11 * GroundConfig().stripes  # every 0.5 s
    grid = agent._local_grid
    assert len(grid._scans) == 1 + AgentConfig().local_grid.repeats
    assert len(channel.scans) == 1


def test_an_outage_keeps_the_newest_scans_as_codes(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, free, _, _ = flown(recording, eager())
    monkeypatch.setattr(scan_queue, "_UNDER_WAY", 1)
    monkeypatch.setattr(scan_queue, "_WAITING", 2)
    monkeypatch.setattr(KeyframeScan, "FIRST_PARTS", 0)
    agent, channel, _, _ = flown(recording, eager(), busy=True)
    stage = agent._scans
    assert stage is not None and len(free.scans) > 3
    assert [scan.key() for scan in channel.scans] == [free.scans[0].key()]
    assert list(stage._queue._waiting) == [scan.key() for scan in free.scans[-2:]]
    assert all(isinstance(code, bytes) for code in stage._queue._waiting.values())


def test_an_older_keyframe_gets_no_second_scan_under_a_number(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a relocalisation frames hang on it, and its own scans would be replaced."""
    source, channel, config = open_source(str(recording)), Heard(), eager()
    agent = Agent(source.rig, None, config, Identity(AgentId(0), 0), channel)
    agent._scans._ground.start_at(np.array([0.0, 0.0, -1.0]))
    reference, returned = agent._camera.reference, False
    for number, frame in enumerate((item for item in source if isinstance(item, Frame)), 1):
        agent.step(StepInput(frame, cpu_ns=3_000_000), frame.t_ns)
        if not returned and len(channel.keyframes) > 5:
            first = channel.scans[0].keyframe
            assert first < max(channel.keyframes) and agent.map.slot_of(first) >= 0
            reference.return_to(first, 100, number)
            monkeypatch.setattr(agent._keyframes, "add_if_needed", lambda ctx, track: [])
            returned = True
    assert returned and len(channel.scans) > 1
    keys = [scan.key() for scan in channel.scans]
    assert len(set(keys)) == len(keys)


def test_a_keyframe_has_no_more_scans_than_numbers(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KeyframeScan, "PARTS", 3)
    frames, channel = open_source(str(recording)), Heard()
    agent = Agent(frames.rig, None, eager(), Identity(AgentId(0), 0), channel)
    agent._scans._ground.start_at(np.array([0.0, 0.0, -1.0]))
    for frame in (item for item in frames if isinstance(item, Frame)):
        agent.step(StepInput(frame, cpu_ns=3_000_000), frame.t_ns)
        if channel.scans:  # and no keyframe more
            monkeypatch.setattr(agent._keyframes, "add_if_needed", lambda ctx, track: [])
    assert max(scan.part for scan in channel.scans) == 2


def test_what_was_seen_before_a_long_loss_is_forgotten(recording: Path) -> None:
    """Nothing told how the vehicle moved: free space and ground lie elsewhere than in the odometry frame."""
    source = open_source(str(recording))
    frames = [item for item in source if isinstance(item, Frame)]
    for dark_s, forgotten in ((0.1, False), (0.6, True)):
        agent = Agent(source.rig, None, eager(), Identity(AgentId(0), 0), Heard())
        agent._scans._ground.start_at(np.array([0.0, 0.0, -1.0]))
        for frame in frames:
            agent.step(StepInput(frame, cpu_ns=3_000_000), frame.t_ns)
        assert agent._local_grid._scans and agent._scans._ground._foot is not None
        step_ns, t_ns, black = frames[1].t_ns - frames[0].t_ns, frames[-1].t_ns, np.zeros_like(frames[0].left)
        for k in range(1, round(dark_s * 1e9 / step_ns) + 1):
            agent.step(StepInput(Frame(t_ns + k * step_ns, black, black), cpu_ns=3_000_000), t_ns + k * step_ns)
        assert (not agent._local_grid._scans) == forgotten
        assert (agent._scans._ground._foot is None) == forgotten
        assert bool(agent._local_grid._canvas.marks.any()) != forgotten
