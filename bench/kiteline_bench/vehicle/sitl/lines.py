"""One line to ArduCopter in the loop, on the ground: poses, inertial samples and a tunnel together; signing."""

import time
from pathlib import Path

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.station import Station
from kiteline_bench.harness.bars import Bar, Bench, is_true
from kiteline_bench.vehicle.sitl.ground_station import HAS_POSITION
from kiteline_bench.vehicle.sitl.loop import Loop
from kiteline_bench.vehicle.sitl.onboard import Onboard, SimulatedClock
from kiteline_codec.channel import coded_channel
from kiteline_core.ids import AgentId
from kiteline_hw.mavlink.transport.signing import read_key
from kiteline_hw.mavlink.tunnel.tunnel_end import BASE_END
from kiteline_hw.mavlink.tunnel.tunnel_link import MavlinkTunnelLink
from kiteline_hw.system.vocabulary import shipped_vocabulary

_SETTLE_S, _SPAN_S, _ARRIVE_S = 8.0, 20.0, 8.0
_SIGNED_S, _REFUSED_S, _FORGETS_S = 30.0, 12.0, 20.0  # the EKF gives up its position after 15 s without poses
_DOWN_BYTES_S = 900
_STAMPS_S = 1420070400  # s: 1 January 2015


def run(bench: Bench, program: Path) -> list[Bar]:
    """Share a line with a base behind the autopilot, then sign."""
    bench.say("SITL: one line for poses, inertial samples and the tunnel")
    folder = bench.folder / "sitl-line"
    with Loop(program, folder, tunnel=True) as loop:
        loop.fly(3.0)
        onboard = loop.start_agent()
        bars = _shared(loop, onboard)
        bench.say("SITL: signing")
        return bars + _signed(loop, folder / "key")


class _Base:
    """A base at another line of the autopilot, in simulated time."""

    def __init__(self, url: str, clock: SimulatedClock) -> None:
        self.link = MavlinkTunnelLink(url, BASE_END, clock=clock.now_ns)
        self._station = Station(
            BaseConfig(), lambda _: coded_channel(1, _DOWN_BYTES_S, "radio"), shipped_vocabulary()
        )  # fmt: skip
        self._jobs = LockstepJobs()
        self.sends = True
        self.received = self.sent = 0

    def tick(self, now_ns: int) -> None:
        packets = self.link.receive()
        self.received += len(packets)
        out = self._station.step({AgentId(0): packets}, self._jobs.done(now_ns), now_ns)
        self._jobs.add(out.jobs, now_ns)
        for _, down in out.packets if self.sends else ():
            self.sent += sum(self.link.send(packet) for packet in down)


def _shared(loop: Loop, onboard: Onboard) -> list[Bar]:
    base = _Base(loop.autopilot.url(2), loop.clock)

    def fly(seconds: float, *, sends: bool) -> None:
        onboard.sends = base.sends = sends
        loop.fly(seconds, each=lambda: base.tick(loop.clock.t_ns))

    def counts() -> tuple[int, ...]:
        mine = onboard.sink.counters.odometry, onboard.imu_samples
        return *mine, onboard.packets_up, base.received, base.sent, onboard.packets_down

    try:
        fly(_SETTLE_S, sends=True)  # the autopilot learns where the base is
        fly(_ARRIVE_S, sends=False)  # what is under way arrives
        begin_s, before = loop.t_s, counts()
        fly(_SPAN_S, sends=True)
        fly(_ARRIVE_S, sends=False)
        span_s = loop.t_s - begin_s
        poses, samples, up, at_base, down, on_board = (b - a for a, b in zip(before, counts(), strict=True))
    finally:
        base.link.close()
        onboard.sends = True
    return [
        Bar("one line: poses", ">= 30 Hz", f"{poses / span_s:.1f} Hz", round(poses / span_s, 1) >= 30.0),
        Bar("one line: inertial samples", "200 Hz", f"{samples / span_s:.1f} Hz", abs(samples / span_s - 200.0) < 2.0),
        is_true("one line: packets to the base", ">= 99 %", at_base >= 0.99 * up > 0, f"{at_base} of {up}"),
        is_true("one line: packets from the base", ">= 99 %", on_board >= 0.99 * down > 0, f"{on_board} of {down}"),
    ]  # fmt: skip


def _signed(loop: Loop, key: Path) -> list[Bar]:
    key.write_text("a pass phrase of the bench\n")
    loop.pilot.sign_with(read_key(key), round((time.time() - _STAMPS_S) * 1e5))
    begin_s = loop.t_s
    loop.fly(_REFUSED_S)
    assert loop.onboard is not None
    said = [f.text for t, f in loop.onboard.said if f.topic in ("signing", "answers")]
    loop.kill_agent()
    loop.fly(_FORGETS_S)
    blind = not loop.pilot.flags & HAS_POSITION
    loop.sign(key)
    signed = loop.start_agent()
    used = loop.fly(_SIGNED_S, lambda: bool(loop.pilot.flags & HAS_POSITION))
    refused = [f.text for _, f in signed.said if f.topic == "signing"]
    return [
        is_true("signing on: an agent without the key", "says so", bool(said), said[0] if said else "said nothing"),
        is_true("signing on: poses of an agent with the key", "used", used and not refused,
                f"used {loop.t_s - begin_s - _REFUSED_S - _FORGETS_S:.1f} s after its start"
                + ("" if blind else " (the position before had not gone)") if used else "not used"),
    ]  # fmt: skip
