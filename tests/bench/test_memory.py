"""Memory of the parts of a base."""

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Station
from kiteline_bench.base.memory import Sample, bytes_of, parts_of, table
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, LivePose
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id


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
