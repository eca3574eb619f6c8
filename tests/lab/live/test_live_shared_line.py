"""A live flight whose poses and packets for a base share one connection to a flight controller."""

from pathlib import Path

import pytest

from kiteline_agent.runtime import live
from kiteline_agent.runtime.options import AgentOptions
from kiteline_hw.mavlink.messages import MavlinkMessage, Tunnel
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.system import process


class Listening(FlightController):
    """Counts what it would forward to the radio."""

    packets = 0

    def _process(self, messages: list[MavlinkMessage], now_ns: int) -> list[bytes]:
        self.packets += sum(isinstance(m, Tunnel) and m.payload_type == 0xB17E for m in messages)
        return super()._process(messages, now_ns)


@pytest.mark.alone  # a live flight of one second: frames are dropped where other work takes the cores
def test_packets_for_the_base_go_through_the_controllers_connection(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(live, "_DRAIN_S", 0.5)  # no base will ever answer
    model = Listening("ardupilot")
    with UdpFlightController(model) as controller:
        url = f"udp:127.0.0.1:{controller.port}"
        spec = AgentOptions(source=str(recording), folder=str(tmp_path), mavlink=url, link=f"mavlink:{url}", axes="frd",
                            seconds=3.0)  # fmt: skip
        stop = process.StopSignal()
        live.fly_live(spec, None, stop)
    assert len(model.accepted) > 10 and not model.dropped
    assert model.packets > 3
    assert (process.kept_folder("agent0") / "last_pose.json").exists()
