"""Images in place of scans: the base makes these, except while the link does not carry images."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity, StepInput
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel, RecordChannel, coded_channel
from kiteline_codec.pacing.profiles import RADIO, WIFI, Profile
from kiteline_codec.schema import Key, KeyframeScan, Record, ScanImages, messages
from kiteline_core.frame import Frame
from kiteline_core.ground.disparity import DisparityCamera
from kiteline_core.ground.ground_height import GroundHeight
from kiteline_core.ground.image_codes import decode_pair
from kiteline_core.ids import AgentId
from kiteline_hw.sources.open import open_source

BEGINNING = np.array([0.0, 0.0, -1.0])  # of the ground: the recording shows a wall alone


class Heard(NoBaseChannel):
    """Keeps what is shared and removed. busy: nothing arrives."""

    def __init__(self, busy: bool = False, profile: Profile = WIFI) -> None:
        super().__init__()
        self.busy, self.profile = busy, profile
        self.images: list[ScanImages] = []
        self.scans: list[KeyframeScan] = []
        self.removed: list[Key] = []

    def put(self, record: Record) -> Record:
        if isinstance(record, ScanImages):
            self.images.append(record)
        elif isinstance(record, KeyframeScan):
            self.scans.append(record)
        return super().put(record)

    def arrived(self, key: Key) -> bool:
        return not self.busy

    def remove(self, key: Key) -> None:
        self.removed.append(key)


def by_base() -> AgentConfig:
    config = AgentConfig()
    ground = replace(config.ground, wider=0.085, lower=0.067)  # which the base does not know
    return replace(config, scan=replace(config.scan, by_base=True, moved_m=0.0, turned_rad=0.0), ground=ground)


def agent_of(path: Path, config: AgentConfig, channel: RecordChannel) -> tuple[Agent, list[Frame]]:
    source = open_source(str(path))
    agent = Agent(source.rig, None, config, Identity(AgentId(0), 0), channel)
    agent._scans._ground.start_at(BEGINNING)
    return agent, [item for item in source if isinstance(item, Frame)]


def flown(path: Path, config: AgentConfig, channel: Heard) -> tuple[Agent, int]:
    """The agent, and how many pixels it matched."""
    agent, frames = agent_of(path, config, channel)
    matched = 0
    for frame in frames:
        agent.step(StepInput(frame, cpu_ns=3_000_000), frame.t_ns)
        matched += agent.work.matched_px
    return agent, matched


def test_images_are_sent_and_nothing_is_matched_on_board(recording: Path) -> None:
    channel = Heard()
    agent, matched = flown(recording, by_base(), channel)
    assert len(channel.images) > 3 and not channel.scans and not matched
    keys = [record.key() for record in channel.images]
    assert len(set(keys)) == len(keys) and set(channel.removed) <= set(keys)
    assert len(channel.removed) >= len(keys) - 1  # the newest may be under way
    assert {record.part > 0 for record in channel.images} == {False, True}
    for record in channel.images:
        messages.encode(record)
        assert record.stretch == 0 and decode_pair(record.images, DisparityCamera.of(agent.map.camera)) is not None
    again = Heard()
    flown(recording, by_base(), again)
    assert [messages.encode(r) for r in again.images] == [messages.encode(r) for r in channel.images]


def test_images_of_lower_quality_take_fewer_bytes(recording: Path) -> None:
    sizes = []
    for jpeg_quality in (90, 50):
        channel, config = Heard(), by_base()
        flown(recording, replace(config, scan=replace(config.scan, jpeg_quality=jpeg_quality)), channel)
        sizes.append(sum(len(record.images) for record in channel.images))
    assert sizes[1] < 0.6 * sizes[0]


def test_while_images_do_not_arrive_the_agent_makes_its_scans(recording: Path) -> None:
    channel = Heard(busy=True)
    _, matched = flown(recording, by_base(), channel)
    assert len(channel.images) == 4 and not channel.removed
    assert matched and channel.scans
    assert not {(r.keyframe, r.part) for r in channel.images} & {(r.keyframe, r.part) for r in channel.scans}


def test_a_thin_link_carries_no_images(recording: Path) -> None:
    channel = Heard(profile=RADIO)
    _, matched = flown(recording, by_base(), channel)
    assert not channel.images and channel.scans and matched


def test_the_base_draws_what_the_images_show_and_they_are_gone(recording: Path) -> None:
    ends: list[CodedChannel] = []

    def open_end(_: AgentId) -> RecordChannel:
        ends.append(coded_channel(1, profile="wifi"))
        return ends[-1]

    channel = coded_channel(64, profile="wifi")
    agent, frames = agent_of(recording, by_base(), channel)
    station = Station(BaseConfig(), open_end)
    station.join(AgentId(0))
    known: GroundHeight[KeyframeScan] = GroundHeight()
    known.start_at(BEGINNING)
    station.mapper.image_scans._ground_of = lambda record: known  # type: ignore[method-assign]
    done: tuple[JobDone, ...] = ()
    up: tuple[bytes, ...] = ()
    for k in range(len(frames) + 20):
        now_ns = frames[0].t_ns + 50_000_000 * k
        output = station.step({AgentId(0): up}, done, now_ns)
        done = tuple(run_job(job) for job in output.jobs)
        down = dict(output.packets).get(AgentId(0), ())
        frame = frames[k] if k < len(frames) else None
        up = agent.step(StepInput(frame, packets=tuple(down), cpu_ns=3_000_000), now_ns).packets
    mapper = station.mapper
    made = mapper.image_scans.made
    assert mapper.idle and len(made) > 3 and not mapper.image_scans.unreadable
    drawn = {(int(k), part) for k, parts in mapper.grid_updates._scans.items() for part in parts}
    assert drawn and drawn <= made.keys()
    images = [key for key in ends[0].endpoint.peer_values() if key.kind == ScanImages.KIND]
    sent = {key for key in channel.endpoint.own_values() if key.kind == ScanImages.KIND}
    assert set(images) == sent and len(images) < len(made)  # the last ones, as no frame came after they arrived
