"""The link's bars: bytes, budgets, delays, outages, serial lines, a flight controller's radio, CPU."""

import random
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.link.arrivals import LinkUse, link_use, live_shift_ns
from kiteline_bench.link.cpu import coding_ms, packet_ms
from kiteline_bench.link.outage import fly_outage
from kiteline_bench.link.relay import UdpController, UdpRelay
from kiteline_codec.pacing.profiles import RADIO
from kiteline_hw.mavlink.tunnel.tunnel_end import TunnelConfig, TunnelEnd
from kiteline_hw.sim.links.link_model import LinkModelConfig
from kiteline_hw.sim.links.serial_pair import SerialPair
from kiteline_hw.sim.links.telemetry_radio import RoutingController, TelemetryConfig
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.plan import flight_starts
from kiteline_lab.flights.processes import free_endpoint

TITLE = "The thin link"

_FLIGHT = "room_flight.mcap"
_TELEMETRY_S = 120  # s over which the telemetry's delay is measured


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    room = bench.source(_FLIGHT)
    plain = bench.fly(room, "link_monolith", mode="monolith")
    wifi = bench.fly(room, "link_wifi", profile="wifi")
    flown = Reference(bench, room, wifi, bench.fly(room, "link_alone", mode="tracker"))
    return [
        *_profiles(flown, plain), *_thin(flown), *_serial(flown), *_relay(flown), *_tunnel(flown),
        *_outage(bench), *_cpu(bench),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Reference:
    """The flights of one recording with which those over thin links are compared."""

    bench: Bench
    source: str
    wifi: FlownProcesses
    alone: FlownProcesses

    def fly(self, folder: str, **options: Any) -> FlownProcesses:
        """Fly the same recording with other options."""
        return self.bench.fly(self.source, folder, **options)


def _ratio(name: str, flown: FlownProcesses, other: FlownProcesses, trajectory: str, limit: float) -> Bar:
    """A bar on one flight's ATE over another's."""
    return at_most(name, flown.ate_m(trajectory) / max(other.ate_m(trajectory), 1e-4), limit, "", 2)


def _profiles(reference: Reference, plain: FlownProcesses) -> list[Bar]:
    """Both profiles over an unlimited link, compared with a flight without a codec."""
    wifi, radio = reference.wifi, reference.fly("link_radio", profile="radio")
    equal = bool(wifi.base["digest_equal"] and radio.base["digest_equal"])
    return [
        at_most("wifi: bytes a keyframe", wifi.agent()["bytes_per_keyframe"] / 1000.0, 8.0, "kB", 2),
        _ratio("wifi: ATE base over that of a monolith", wifi, plain, "base", 1.25),
        at_most("radio: bytes a keyframe", radio.agent()["bytes_per_keyframe"] / 1000.0, 2.5, "kB", 2),
        _ratio("radio: ATE base over that of wifi", radio, wifi, "base", 1.5),
        is_true("digests of both", "equal", equal),
    ]


def _thin(reference: Reference) -> list[Bar]:
    """1000 B/s up, 500 B/s down, a tenth lost, 200 ms late; then 300 B/s."""
    thin = reference.fly("link_1000", profile="radio", up_bytes_s=1000, down_bytes_s=500, loss=0.1, delay_s=0.2)
    scarce = reference.fly("link_300", profile="radio", up_bytes_s=300, down_bytes_s=300).base
    use = link_use(thin.folder, _start_ns(reference.source), RADIO.overhead_bytes)
    return [
        at_most("1000 B/s: bytes in any second, up", use.most_bytes_s, 1000, "B", 0),
        *_carried(reference, "1000 B/s", thin, use),
        is_true("300 B/s: a map at the end", "points and poses", scarce["map_points"] > 20,
                f"{scarce['map_points']} points, {scarce['keyframes']} keyframes"),
    ]  # fmt: skip


def _carried(reference: Reference, name: str, flown: FlownProcesses, use: LinkUse) -> list[Bar]:
    """What every thin link has to carry of a flight."""
    keyframes = flown.agent()["keyframes"]
    early = sum(delay <= 3.0 for delay in use.header_delays_s) / keyframes
    return [
        Bar(f"{name}: headers within 3 s", ">= 80 %", f"{100 * early:.0f} % of {keyframes}", early >= 0.8),
        _ratio(f"{name}: ATE base over that of wifi", flown, reference.wifi, "base", 2.0),
        _ratio(f"{name}: ATE live over that of the tracker alone", flown, reference.alone, "live", 1.0),
        at_most(f"{name}: longest gap between poses on the base", max(use.pose_gaps_s, default=1e9), 1.0, "s", 2),
    ]


def _live(reference: Reference, name: str, folder: str, link: str, **options: Any) -> list[Bar]:
    """The same on real clocks, between processes that a device or a relay joins."""
    flown = reference.fly(folder, link=link, realtime=True, profile="radio", **options)
    shift_ns = live_shift_ns(flown.folder / "agent0" / "log.mcap")
    return _carried(reference, name, flown, link_use(flown.folder, shift_ns, RADIO.overhead_bytes))


def _start_ns(name: str) -> int:
    """The stamp of flight time 0."""
    source = open_source(name)
    try:
        return flight_starts([source])[0]
    finally:
        source.close()


def _serial(reference: Reference) -> list[Bar]:
    """A cable of 57,600 baud whose ends take turns, with bit errors."""
    with SerialPair(baud=57600, turn_s=0.1, bit_errors=1e-4, seed=4) as pair:
        link = f"serial:{pair.a}:57600,{pair.b}:57600"
        return _live(reference, "57,600 baud", "link_serial", link, up_bytes_s=1000, down_bytes_s=500)


def _relay(reference: Reference) -> list[Bar]:
    """Zenoh over UDP through a modelled link: a tenth lost, 200 ms late, some in other order."""
    air = LinkModelConfig(rate_bytes_s=4000, delay_ns=200_000_000, jitter_ns=20_000_000, loss=0.1, reorder=0.02)
    port = int(free_endpoint().rpartition(":")[2])
    with UdpRelay(air, air, seed=4, far=("127.0.0.1", port)) as relay:
        link = f"zenoh:udp/127.0.0.1:{relay.port_a},udp/127.0.0.1:{port}"
        return _live(reference, "relay", "link_relay", link, up_bytes_s=1000, down_bytes_s=500)


def _tunnel(reference: Reference) -> list[Bar]:
    """A flight through a modelled flight controller's radio, and how it delays 500 B/s of telemetry."""
    with UdpController(RoutingController(None, TelemetryConfig(bytes_s=500))) as controller:
        link = f"mavlink:udp:127.0.0.1:{controller.port_a},udp:127.0.0.1:{controller.port_b}"
        flown = _live(reference, "TUNNEL", "link_tunnel", link, up_bytes_s=1000, down_bytes_s=500)
        in_flight_ms = float(np.percentile(controller.controller.up.telemetry_delay_ns, 95)) / 1e6
    reference.bench.say("tunnel through a modelled flight controller")
    alone, _ = telemetry_p95_ms(0)
    shared, goodput = telemetry_p95_ms(1000)
    return [
        *flown,
        at_most(
            "TUNNEL: growth of the telemetry's delay in flight, p95", 100.0 * (in_flight_ms / alone - 1), 20, "%", 1
        ),
        at_most("TUNNEL: the same, always full", 100.0 * (shared / alone - 1.0), 20.0, "%", 1),
        Bar("TUNNEL: packets' bytes that arrive", ">= 500 B/s", f"{goodput:.0f} B/s", goodput >= 500),
    ]


def telemetry_p95_ms(rate_bytes_s: int) -> tuple[float, float]:
    """p95 of the telemetry's delay in ms, and B/s of packets that arrive, with as much traffic as the rate allows."""
    draw = random.Random(2)
    controller = RoutingController(None, TelemetryConfig(bytes_s=500))
    a = TunnelEnd(TunnelConfig(rate_bytes_s=max(1, rate_bytes_s)))
    b = TunnelEnd(TunnelConfig(system=255, peer_system=1, is_base=True, rate_bytes_s=max(1, rate_bytes_s // 2)))
    to_a: list[bytes] = []
    to_b: list[bytes] = []
    arrived = 0
    for tick in range(_TELEMETRY_S * 100):
        now_ns = tick * 10_000_000
        for end, incoming in ((a, to_a), (b, to_b)):
            for message in incoming:
                packets = end.receive(message)
                arrived += sum(map(len, packets)) if end is b else 0
            while rate_bytes_s and end.send(draw.randbytes(150)):
                pass
        out = (a.poll(now_ns), b.poll(now_ns)) if rate_bytes_s else ([], [])
        to_a, to_b = controller.step(*out, now_ns)
    return float(np.percentile(controller.up.telemetry_delay_ns, 95)) / 1e6, arrived / _TELEMETRY_S


def _outage(bench: Bench) -> list[Bar]:
    """Ten minutes up, ten down or an hour, up again, at two keyframes a second of the wide profile."""
    bars = []
    for minutes in (10, 60):
        bench.say(f"{minutes} minutes without a link")
        found = fly_outage(bench.folder, minutes)
        name = f"after {minutes} minutes without a link"
        bench.more.append(
            f"{name.capitalize()}: {found.backlog_mib:.1f} MiB waited, values took {found.most_mib:.1f} MiB of memory "
            f"at most; the process grew by {found.grown_mib:.1f} MiB."
        )
        if minutes == 10:
            bars.append(at_most(f"{name}: synchronised", found.synced_s, 30.0, "s", 1))
        bars += [
            at_most(f"{name}: process grown, agent's end", found.grown_mib, 20.0, "MiB", 1),
            at_most(f"{name}: first pose", found.first_pose_s, 2.5, "s", 2),
            is_true(f"{name}: all arrived, digests", "equal", found.synced_s < 300, f"after {found.synced_s:.1f} s"),
        ]
    return bars


def _cpu(bench: Bench) -> list[Bar]:
    """Coding of a keyframe there and back, residual codes included; an endpoint's work a packet."""
    bench.say("CPU of codec and endpoint")
    return [
        at_most("codec: CPU of a keyframe there and back", coding_ms(), 2.0, "ms", 2),
        at_most("endpoint: CPU a packet, both ends, without residual codes", packet_ms(), 0.3, "ms", 3),
    ]
