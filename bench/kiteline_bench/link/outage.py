"""A long link outage: the agent's end goes on writing, then the link comes back. Simulated time, real memory."""

import random
from dataclasses import dataclass
from pathlib import Path

from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import Key, KeyframeHeader, LivePose, NewLandmarks, Observations
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from kiteline_hw.system.memory import rss_mib

_MINUTE_NS = 60_000_000_000
_TICK_NS = 50_000_000
_UP_MINUTES = 10
_GIVE_UP_MINUTES = 5
_LIVE = Key(LivePose.KIND, 0)


@dataclass(frozen=True, slots=True)
class Outage:
    """Memory and times of an outage."""

    backlog_mib: float  # codes that waited when the link came back
    most_mib: float  # of memory that values took, as the outbox counts it
    grown_mib: float  # of the process during the outage, while the other end receives nothing
    synced_s: float  # from the link's return until both ends held the same
    first_pose_s: float  # from the link's return until a newer pose arrived


def fly_outage(folder: Path, minutes: int) -> Outage:
    """Ten minutes up, some down, up again, at two keyframes a second; over Wi-Fi with 1 % of loss."""
    draw = random.Random(5)
    down_ns = _UP_MINUTES * _MINUTE_NS, (_UP_MINUTES + minutes) * _MINUTE_NS
    spill = SpillFile(folder)
    agent = coded_channel(1, 1_000_000, "wifi", spill=spill, bounded=True).endpoint
    base = Endpoint(SyncConfig(budget_bytes=1_000_000), 1)
    model = LinkModelConfig(rate_bytes_s=2_000_000, delay_ns=20_000_000, loss=0.01, outages=(down_ns,))
    up, down = LinkModel(model, 1), LinkModel(model, 2)
    most = backlog = 0
    before_mib = after_mib = 0.0
    synced_s = first_pose_s = 999.0
    pose = b""
    for tick in range((_UP_MINUTES + minutes + _GIVE_UP_MINUTES) * 60 * 20):
        now_ns = tick * _TICK_NS
        if now_ns == down_ns[0]:
            before_mib = rss_mib()
        if now_ns == down_ns[1]:
            after_mib, backlog, pose = rss_mib(), agent.backlog_bytes, base.peer_values()[_LIVE]
        if now_ns < down_ns[1]:
            agent.put(_LIVE, draw.randbytes(29))
            if tick % 10 == 0:
                put_keyframe(agent, tick // 10, draw)
        for packet in up.deliver(now_ns):
            base.receive(packet, now_ns)
        for packet in down.deliver(now_ns):
            agent.receive(packet, now_ns)
        for end, wire in ((agent, up), (base, down)):
            while (out := end.poll(now_ns)) is not None:
                wire.send(out, now_ns)
        if tick % 20 == 0:
            most = max(most, agent.stats.resident_bytes)
        if now_ns >= down_ns[1]:
            since_s = (now_ns - down_ns[1]) / 1e9
            if first_pose_s == 999.0 and base.peer_value(_LIVE) != pose:
                first_pose_s = since_s
            if agent.digest_equal and base.digest_equal:
                synced_s = since_s
                break
    spill.close()
    return Outage(backlog / 2**20, most / 2**20, after_mib - before_mib, synced_s, first_pose_s)


def put_keyframe(agent: Endpoint, number: int, draw: random.Random) -> None:
    """Share a keyframe of 8 kB."""
    agent.put(Key(KeyframeHeader.KIND, number), draw.randbytes(26))
    for part in range(7):
        agent.put(Key(NewLandmarks.KIND, number, part), draw.randbytes(1000))
    agent.put(Key(Observations.KIND, number), draw.randbytes(900))
