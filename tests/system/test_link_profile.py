"""An agent without a named profile selects the one that suits its link, and its poses are not queued."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_bench.link.cpu import flight
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import KeyframeHeader, LivePose, NewLandmarks, Observations
from kiteline_core.ids import AgentId, KeyframeId
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig

TICK_NS = 50_000_000


class Flight:
    """Two keyframes a second, as far as the link asks for them, over a link whose rate changes."""

    def __init__(self, seconds: int) -> None:
        self.ends = coded_channel(1), coded_channel(1)
        self.keyframes = flight(2 * seconds)[1:]
        self.late_s: list[float] = []
        self.profiles: list[str] = []

    def fly(self, seconds: int, rate_bytes_s: int, begin_s: int) -> None:
        config = LinkModelConfig(rate_bytes_s=rate_bytes_s, delay_ns=30_000_000)
        wires = LinkModel(config, 1), LinkModel(config, 2)
        agent, base = self.ends
        next_ns = 0
        for tick in range(begin_s * 20, (begin_s + seconds) * 20):
            now_ns = tick * TICK_NS
            if now_ns >= next_ns and self.keyframes:
                self.share(agent, self.keyframes.pop(0), now_ns)
                next_ns = now_ns + max(500_000_000, agent.keyframe_gap_ns())
            agent.put(LivePose(AgentId(0), now_ns, KeyframeId(0), np.eye(4), 50))
            agent.receive(wires[1].deliver(now_ns), now_ns)
            for record in base.receive(wires[0].deliver(now_ns), now_ns):
                if isinstance(record, LivePose):
                    self.late_s.append((now_ns - record.t_ns) / 1e9)
            for end, wire in zip(self.ends, wires, strict=True):
                for packet in end.poll(now_ns):
                    wire.send(packet, now_ns)
            self.profiles.append(agent.profile.name)

    @staticmethod
    def share(agent: CodedChannel, records: list[object], now_ns: int) -> None:
        landmarks = [r for r in records if isinstance(r, NewLandmarks)]
        all_births = NewLandmarks(
            landmarks[0].keyframe, 0, *(np.concatenate([getattr(b, name) for b in landmarks]) for name in
            ("index", "uv", "inv_depth", "octave", "angle", "descriptor"))
        )  # fmt: skip
        order = np.argsort(all_births.index)
        all_births = replace(
            all_births, **{n: getattr(all_births, n)[order] for n in
            ("index", "uv", "inv_depth", "octave", "angle", "descriptor")}
        )  # fmt: skip
        seen = next(
            (r for r in records if isinstance(r, Observations)),
            Observations(
                landmarks[0].keyframe, 0, np.zeros(0, np.uint16), np.zeros((0, 2), np.float32), np.zeros(0, np.float32),
                np.zeros(0, np.uint8), np.zeros(0, np.int64),
            ),
        )  # fmt: skip
        head = next(r for r in records if isinstance(r, KeyframeHeader))
        agent.put(replace(head, t_ns=now_ns))
        parts, sections = agent.profile.choose(all_births, -np.arange(len(order), dtype=np.float64), seen)
        for record in (*parts, *sections):
            agent.put(record)


@pytest.mark.parametrize("rate_bytes_s", [3000, 5000])
def test_the_profile_follows_the_link(rate_bytes_s: int) -> None:
    f = Flight(80)
    f.fly(40, rate_bytes_s, 0)
    assert f.profiles[0] == "wifi"
    assert f.profiles[-1] == "radio"
    assert f.profiles.index("radio") < 8 * 20
    settled = f.late_s[len(f.late_s) // 2 :]
    assert len(settled) > 20
    assert np.percentile(settled, 95) < 1.5  # without a window that follows the delay: more than ten
    f.late_s.clear()
    f.fly(40, 100_000, 40)
    assert f.profiles[-1] == "wifi"
    assert np.percentile(f.late_s[len(f.late_s) // 2 :], 95) < 0.2
