"""The recipes of CONTRIBUTING.md: a new source, link and MAVLink message is one file and one line in a table."""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from kiteline_core.frame import Frame
from kiteline_hw.links import kinds as link_kinds
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.kinds import LinkKind, LinkTraits
from kiteline_hw.links.open import open_link
from kiteline_hw.mavlink import messages
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.ports import LinkError, SourceError
from kiteline_hw.sources import kinds as source_kinds
from kiteline_hw.sources.kinds import SourceKind
from kiteline_hw.sources.open import open_source

_number = itertools.count()


def write_module(folder: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write the one file of a recipe. Returns its module name."""
    name = f"kiteline_recipe_{next(_number)}"
    (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    return name


SOURCE = '''
from pathlib import Path
import numpy as np
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.sensors.frames import EncodedFrame
from kiteline_hw.sensors.raw_pixels import RawPixels
from kiteline_hw.sources.recording import Recording

def open_source(argument, mono, imu):
    """Frames of one grey value per line of flight.toy."""
    values = [int(line) for line in (Path(argument) / "flight.toy").read_text().split()]
    def frames(report):
        for i, value in enumerate(values):
            yield EncodedFrame(i * 50_000_000, RawPixels(4, 3, "mono8", 4, bytes([value]) * 12))
    rig = CameraRig(CameraModel(4, 3, 4.0, 4.0, 2.0, 1.5), None, np.eye(4), None)
    return Recording("toy:" + argument, rig, len(values), frames)
'''


def test_a_new_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = write_module(tmp_path, SOURCE, monkeypatch)
    kind = SourceKind("toy", "DIR", "a toy", module, ("*.toy",), "*.toy (a toy)")
    monkeypatch.setattr(source_kinds, "SOURCES", (*source_kinds.SOURCES, kind))
    folder = tmp_path / "recording"
    folder.mkdir()
    with pytest.raises(SourceError, match=r"layout not recognised: expected mav0/.* or \*\.toy \(a toy\);"):
        open_source(str(folder))
    with pytest.raises(SourceError, match=r"toy:$"):
        open_source(str(tmp_path / "nothing"))
    (folder / "flight.toy").write_text("7\n9\n")
    for spec in (f"toy:{folder}", str(folder)):
        source = open_source(spec)
        frames = [item for item in source if isinstance(item, Frame)]
        assert [int(frame.left.mean()) for frame in frames] == [7, 9] and source.frame_count == 2
    assert "toy:DIR" in source_kinds.source_forms() and "a toy" in source_kinds.source_table()
    assert source_kinds.is_source("toy:x")


LINK = """
from kiteline_hw.links.ends import OneLinkHub

_queues = {}

class ToyLink:
    def __init__(self, out, into):
        self._out, self._into = out, into
    def send(self, packet):
        self._out.append(packet)
        return True
    def receive(self):
        packets, self._into[:] = list(self._into), []
        return packets
    def close(self):
        pass

def open_agent_end(address, options):
    up, down = _queues.setdefault(address, ([], []))
    return ToyLink(up, down)

def open_base_end(address, options):
    up, down = _queues.setdefault(address, ([], []))
    return OneLinkHub(ToyLink(down, up), options.agent)
"""


def test_a_new_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LinkError, match="unknown link 'toy:here'"):
        open_link("toy:here", "agent")
    module = write_module(tmp_path, LINK, monkeypatch)
    kind = LinkKind("toy", "PLACE", "a toy", module, LinkTraits(3, "radio", thin=True))
    monkeypatch.setattr(link_kinds, "LINKS", (*link_kinds.LINKS, kind))
    five = LinkOptions(5)
    agent, hub = open_link("toy:here", "agent", five), open_link("toy:here", "base", five)
    assert agent.send(b"up") and hub.links()[5].send(b"down")
    assert hub.links()[5].receive() == [b"up"] and agent.receive() == [b"down"]
    assert link_kinds.link_traits("toy:here") == LinkTraits(3, "radio", thin=True)
    assert "toy:PLACE" in link_kinds.link_forms() and "a toy" in link_kinds.link_table() and link_kinds.is_link("toy:x")
    with pytest.raises(LinkError, match=r"unknown link 'toy:': expected .* toy:PLACE"):
        open_link("toy:", "agent")


@dataclass(frozen=True, slots=True)
class Rangefinder(messages.MavlinkMessage):
    """Distance to the ground, in cm."""

    NAMES = ("DISTANCE_SENSOR",)
    t_ms: int
    distance_cm: int

    @classmethod
    def parse(cls, m: object) -> "Rangefinder":
        return cls(m.time_boot_ms, m.current_distance)  # type: ignore[attr-defined]

    def values(self) -> tuple[int, ...]:
        return self.t_ms, 20, 700, self.distance_cm, 0, 1, 25, 0


def test_a_new_mavlink_message(monkeypatch: pytest.MonkeyPatch) -> None:
    message = Rangefinder(1234, 321)
    data = MavlinkCodec().encode(message)
    unaware = MavlinkCodec()
    assert unaware.receive(data) == [] and unaware.unknown == 1
    monkeypatch.setattr(messages, "MESSAGES", (*messages.MESSAGES, Rangefinder))
    codec = MavlinkCodec()
    assert codec.receive(data) == [message] and codec.unknown == codec.bad == 0
    assert codec.receive(np.random.default_rng(1).bytes(40) + data)[-1:] == [message]


def test_every_message_of_the_table_can_be_built_and_parsed() -> None:
    three, covariance = (1.0, 2.0, 3.0), (0.5,) * 21
    examples: list[messages.MavlinkMessage] = [
        messages.Heartbeat(2, 12, True, 1, 1),
        messages.TimeSync(5, 6, 1, 1),
        messages.VehicleImu(7, three, three),
        messages.LocalPosition(8, three, three),
        messages.Attitude(9, three, three, 1),
        messages.WheelDistance(10, (1.5, 2.5)),
        messages.Odometry(
            11, three, (1.0, 0.0, 0.0, 0.0), three, three, covariance, covariance, 3, 50, system=1, component=1
        ),
        messages.Tunnel(255, 197, 40000, b"packet", 1, 1),
        messages.RadioStatus(40, 1, 2),
        messages.GlobalOrigin(473_566_100, 85_190_300, 408_000),
    ]
    assert {type(example) for example in examples} == set(messages.MESSAGES)
    for example in examples:
        assert MavlinkCodec().receive(MavlinkCodec(1, 1).encode(example)) == [example]
