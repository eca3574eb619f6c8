"""What benchmarks measure with: yardsticks, starts, memory, queues and problems that can be solved."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Station
from kiteline_bench.base.mapper import further_kb, map_bytes_a_keyframe, queue_p95_s, ring_of_poses, row_of_cameras
from kiteline_bench.base.memory import Sample, bytes_of, parts_of, table
from kiteline_bench.harness import starts
from kiteline_bench.harness.bars import Bench
from kiteline_bench.reality.cpu import over_yardstick, yardstick_ms
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, LivePose
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from kiteline_core.optimisation.bundle import BundleConfig, bundle


def a_bench(folder: Path) -> Bench:
    return Bench(folder, folder, lambda _: None)


def test_the_median_counts_and_every_pair_is_listed(tmp_path: Path) -> None:
    bench = a_bench(tmp_path)
    bar = starts.median_ratio(bench, "x", [(0.002, 0.001), (0.001, 0.001), (0.0009, 0.001)], 1.1)
    assert bar.met and bar.measured == "1.00" and bar.name == "x: median of 3"
    assert bench.more == ["x, mm: 2.0 / 1.0 = 2.00, 1.0 / 1.0 = 1.00, 0.9 / 1.0 = 0.90."]
    assert not starts.median_ratio(bench, "x", [(0.002, 0.001), (0.0012, 0.001), (0.0009, 0.001)], 1.1).met


def test_pieces_overlap_and_cover_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spans: list[tuple[float, float]] = []
    monkeypatch.setattr(starts, "length_s", lambda _: 100.0)

    def note(bench: Bench, source: Path, name: str, begin_s: float, end_s: float) -> Path:
        spans.append((begin_s, end_s))
        return bench.folder / name

    monkeypatch.setattr(starts, "cut", note)
    names = starts.pieces(a_bench(tmp_path), Path("flight.mcap"), "a", 3, 0.05, 6.0)
    assert len(set(names)) == 3
    assert spans[0][0] == 0.0 and spans[2][1] >= 100.0
    assert [round(a[1] - b[0], 6) for a, b in pairwise(spans)] == [5.0, 5.0]
    assert abs(spans[0][1] - (100 / 3 + 6.0 + 2.5)) < 1e-9


def test_the_unit_is_the_median_around_the_flight() -> None:
    unit_ms, mean, p95 = over_yardstick({"mean": 4.0, "p50": 3.0, "p95": 9.0}, [5.0, 5.0, 90.0], [4.0, 4.0])
    assert (unit_ms, mean, p95) == (5.0, 0.8, 1.8)


def test_every_fourth_image_is_measured(data_dir: Path) -> None:
    spent = yardstick_ms(str(data_dir / "kitti_straight"))
    assert len(spent) > 3
    assert all(ms > 0.0 for ms in spent)


def test_the_row_of_cameras_is_a_bundle_that_converges() -> None:
    problem = row_of_cameras(12, 300, 8)
    assert np.count_nonzero(problem.free) == 8
    seen = np.diff(problem.starts)
    assert seen.min() >= 2 and all(np.all(np.diff(problem.camera[a : a + n]) > 0) for a, n in zip(problem.starts, seen))
    result = bundle(problem, BundleConfig())
    assert result.final_cost < 0.5 * result.initial_cost
    assert np.count_nonzero(result.inlier) > 0.85 * len(result.inlier)


def test_the_ring_of_poses_drifts_and_has_loops() -> None:
    graph = ring_of_poses(80, 5)
    assert np.count_nonzero(graph.loop) == 5 and np.count_nonzero(graph.held) == 1
    assert graph.edges.max() < 80


def test_a_queue_waits_longer_the_fuller_it_is() -> None:
    quick, slow, over = (queue_p95_s(np.full(20, cost)) for cost in (0.005, 0.045, 0.06))
    assert quick < slow < over
    assert over > 5.0  # more work comes than can be done


def test_memory_grows_with_keypoints() -> None:
    assert 2_000 < map_bytes_a_keyframe(100, 50) < map_bytes_a_keyframe(100, 400)


def test_memory_of_further_keyframes_is_that_of_the_process() -> None:
    short, long = ({"keyframes": n, "timing": {"rss_mib": mib}} for n, mib in ((60, 200.0), (560, 240.0)))
    assert abs(further_kb(short, long) - 40 * 1048.576 / 500) < 1e-9


def test_referenced_objects_are_counted_once_and_code_never() -> None:
    array = np.zeros(10_000)
    seen: set[int] = set()
    assert 80_000 < bytes_of({"a": array, "part of a": array[:10], "code": bytes_of}, seen) < 82_000
    assert bytes_of(array, seen) == 0


def test_parts_of_a_base_grow_with_its_map() -> None:
    station = Station(BaseConfig(), lambda _: coded_channel(1))
    station.join(AgentId(0))
    before = parts_of(station)
    for k in range(100):
        parent = NO_KEYFRAME if k == 0 else keyframe_id(submap_id(0, 0, 0), k - 1)
        station.mapper.map.add_keyframe(keyframe_id(submap_id(0, 0, 0), k), k, parent, np.eye(4), 300)
    after = parts_of(station)
    assert after["map: keypoints"] - before["map: keypoints"] > 100 * 300 * 60
    others = [name for name in after if not name.startswith("map: ") and after[name] - before[name] > 1000]
    assert not others


def test_the_table_lists_what_a_further_keyframe_takes() -> None:
    samples = [
        Sample(100, 200_000_000, 0, {"grid": 1_000_000, "rest": 500}),
        Sample(300, 210_000_000, 0, {"grid": 2_000_000, "rest": 700}),
    ]
    lines = table(samples).splitlines()
    assert lines[0].startswith("| keyframes 100 to 300")
    assert "| grid | 5.0 kB |" in lines and "| all parts | 5.0 kB |" in lines
    assert lines[-1].endswith("| 50.0 kB |") and len(lines) == 5


def test_a_base_whose_agent_stands_still_does_not_grow() -> None:
    submap, agent = submap_id(0, 0, 0), AgentId(0)
    ours, theirs = coded_channel(1), coded_channel(1)
    station = Station(BaseConfig(), lambda _: ours)
    theirs.put(CameraIntrinsics(agent, RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.1, True, np.eye(4))))
    theirs.put(KeyframeHeader(keyframe_id(submap, 0), 0, NO_KEYFRAME, np.eye(4), 0))
    held = []
    packets: tuple[bytes, ...] = ()
    for tick in range(4000):  # at 20 Hz
        now_ns = tick * 50_000_000
        theirs.receive(packets, now_ns)
        pose = np.eye(4)
        pose[:3, 3] = 0.001 * np.sin(tick * np.array([1.0, 2.0, 3.0]))
        theirs.put(LivePose(agent, now_ns, keyframe_id(submap, 0), pose, 100))
        packets = dict(station.step({agent: theirs.poll(now_ns)}, (), now_ns).packets)[agent]
        if tick in (500, 3999):
            held.append((sum(parts_of(station).values()), bytes_of(theirs, set())))
    assert held[1][0] - held[0][0] < 2000 and held[1][1] - held[0][1] < 2000
    assert station.mapper.live(agent) is not None
