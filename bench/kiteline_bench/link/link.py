"""The thin line's bars: bytes, budgets, delays, outages, serial lines, a flight controller's radio, CPU."""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np

from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness.link_silence import silence
from kiteline_bench.harness.link_watch import Watched, live_shift_ns, watch
from kiteline_bench.link.cpu import coding_ms, packet_ms
from kiteline_codec.pacing.profiles import RADIO
from kiteline_hw.mavlink.tunnel import TunnelConfig, TunnelEnd
from kiteline_hw.sim.links.link_model import LinkModelConfig
from kiteline_hw.sim.links.relay import UdpController, UdpRelay
from kiteline_hw.sim.links.serial_pair import SerialPair
from kiteline_hw.sim.links.telemetry_radio import RoutingController, TelemetryConfig
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.flight import free_endpoint
from kiteline_lab.flights.fly import Options, flight_starts, fly

TITLE = "The thin line"

_FLIGHT = "room_flight.mcap"


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order of the promise."""
    return [bar for part in (_profiles, _thin, _serial, _relay, _tunnel, _outage, _cpu) for bar in part(bench)]


def _fly(bench: Bench, folder: str, **options: Any) -> dict[str, Any]:
    bench.say(f"flying {_FLIGHT} ({folder})")
    report, outcome = fly(Options((bench.source(_FLIGHT),), bench.folder / folder, **options), quiet=True)
    report["failed"] = outcome.failed
    return dict(report)


def _ate(report: dict[str, Any], what: str) -> float:
    return float(report["agents"][0]["accuracy"][what]["ate_m"])


def _ratio(name: str, report: dict[str, Any], other: dict[str, Any], what: str, limit: float) -> Bar:
    """A bar on one flight's ATE over another's."""
    return at_most(name, _ate(report, what) / max(_ate(other, what), 1e-4), limit, "", 2)


def _profiles(bench: Bench) -> list[Bar]:
    """Both profiles over a link that takes everything, against a flight without any codec."""
    plain = _fly(bench, "link_monolith", mode="monolith")
    wifi = _fly(bench, "link_wifi", profile="wifi")
    radio = _fly(bench, "link_radio", profile="radio")
    return [
        at_most("wifi: bytes a keyframe", wifi["agents"][0]["bytes_per_keyframe"] / 1000.0, 8.0, "kB", 2),
        at_most(
            "wifi: ATE base over that of a monolith", _ate(wifi, "base") / max(_ate(plain, "base"), 1e-4), 1.25, "", 2
        ),
        at_most("radio: bytes a keyframe", radio["agents"][0]["bytes_per_keyframe"] / 1000.0, 2.5, "kB", 2),
        _ratio("radio: ATE base over that of wifi", radio, wifi, "base", 1.5),
        is_true("digests of both", "equal", wifi["base"]["digest_equal"] and radio["base"]["digest_equal"]),
    ]


def _report(bench: Bench, folder: str) -> dict[str, Any]:
    """What an earlier flight of this benchmark left."""
    return dict(json.loads((bench.folder / folder / "report.json").read_text()))


def _thin(bench: Bench) -> list[Bar]:
    """1000 B/s up, 500 B/s down, a tenth lost, 200 ms late; then 300 B/s."""
    _fly(bench, "link_alone", mode="tracker")
    thin = _fly(bench, "link_1000", profile="radio", up_bytes_s=1000, down_bytes_s=500, loss=0.1, delay_s=0.2)
    scarce = _fly(bench, "link_300", profile="radio", up_bytes_s=300, down_bytes_s=300)
    seen = watch(bench.folder / "link_1000", 0, _start_ns(bench), RADIO.overhead_bytes)
    return [
        at_most("1000 B/s: bytes in any second, up", seen.most_bytes_s, 1000, "B", 0),
        *_carried(bench, "1000 B/s", thin, seen),
        is_true(
            "300 B/s: a map at the end", "points and poses", scarce["base"]["map_points"] > 20 and not scarce["failed"],
            f"{scarce['base']['map_points']} points, {scarce['base']['keyframes']} keyframes",
        ),
    ]  # fmt: skip


def _carried(bench: Bench, name: str, report: dict[str, Any], seen: Watched) -> list[Bar]:
    """What every thin link has to carry of a flight."""
    wifi, alone = _report(bench, "link_wifi"), _report(bench, "link_alone")
    agent = report["agents"][0]
    early = sum(delay <= 3.0 for delay in seen.head_delays_s) / agent["keyframes"]
    return [
        Bar(f"{name}: headers within 3 s", ">= 80 %", f"{100 * early:.0f} % of {agent['keyframes']}", early >= 0.8),
        _ratio(f"{name}: ATE base over that of wifi", report, wifi, "base", 2.0),
        _ratio(f"{name}: ATE live over that of the tracker alone", report, alone, "live", 1.0),
        at_most(f"{name}: longest gap between poses on the base", max(seen.pose_gaps_s, default=1e9), 1.0, "s", 2),
    ]


def _live(bench: Bench, name: str, folder: str, link: str, **options: Any) -> list[Bar]:
    """The same on real clocks, between processes that a device or a relay joins."""
    report = _fly(bench, folder, link=link, realtime=True, profile="radio", **options)
    where = bench.folder / folder
    seen = watch(where, 0, live_shift_ns(where / "agent0" / "log.mcap"), RADIO.overhead_bytes)
    return _carried(bench, name, report, seen)


def _start_ns(bench: Bench) -> int:
    source = open_source(bench.source(_FLIGHT))
    try:
        return flight_starts([source])[0]
    finally:
        source.close()


def _serial(bench: Bench) -> list[Bar]:
    """A cable of 57,600 baud whose ends take turns, with bit errors."""
    with SerialPair(baud=57600, turn_s=0.1, bit_errors=1e-4, seed=4) as pair:
        link = f"serial:{pair.a}:57600,{pair.b}:57600"
        return _live(bench, "57,600 baud", "link_serial", link, up_bytes_s=1000, down_bytes_s=500)


def _relay(bench: Bench) -> list[Bar]:
    """Zenoh over UDP through a modelled link: a tenth lost, 200 ms late, some in other order."""
    air = LinkModelConfig(rate_bytes_s=4000, delay_ns=200_000_000, jitter_ns=20_000_000, loss=0.1, reorder=0.02)
    port = int(free_endpoint().rpartition(":")[2])
    with UdpRelay(air, air, seed=4, far=("127.0.0.1", port)) as relay:
        link = f"zenoh:udp/127.0.0.1:{relay.port_a},udp/127.0.0.1:{port}"
        return _live(bench, "relay", "link_relay", link, up_bytes_s=1000, down_bytes_s=500)


def _tunnel(bench: Bench) -> list[Bar]:
    """A flight through a modelled flight controller's radio, and what 500 B/s of telemetry pay for it."""
    with UdpController(RoutingController(None, TelemetryConfig(bytes_s=500))) as controller:
        link = f"mavlink:udp:127.0.0.1:{controller.port_a},udp:127.0.0.1:{controller.port_b}"
        flown = _live(bench, "TUNNEL", "link_tunnel", link, up_bytes_s=1000, down_bytes_s=500)
        in_flight_ms = float(np.percentile(controller.controller.up.telemetry_delay_ns, 95)) / 1e6
    bench.say("tunnel through a modelled flight controller")
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


def telemetry_p95_ms(rate_bytes_s: int, seconds: int = 120) -> tuple[float, float]:
    """p95 of the telemetry's delay in ms, and B/s of packets that arrive, with as much traffic as the rate allows."""
    draw = random.Random(2)
    controller = RoutingController(None, TelemetryConfig(bytes_s=500))
    a = TunnelEnd(TunnelConfig(rate_bytes_s=max(1, rate_bytes_s)))
    b = TunnelEnd(TunnelConfig(system=255, peer_system=1, rate_bytes_s=max(1, rate_bytes_s // 2)))
    to_a: list[bytes] = []
    to_b: list[bytes] = []
    arrived = 0
    for tick in range(seconds * 100):
        now_ns = tick * 10_000_000
        for end, incoming in ((a, to_a), (b, to_b)):
            for message in incoming:
                packets = end.receive(message)
                arrived += sum(map(len, packets)) if end is b else 0
            while rate_bytes_s and end.send(draw.randbytes(150)):
                pass
        out = (a.poll(now_ns), b.poll(now_ns)) if rate_bytes_s else ([], [])
        to_a, to_b = controller.step(*out, now_ns)
    return float(np.percentile(controller.up.telemetry_delay_ns, 95)) / 1e6, arrived / seconds


def _outage(bench: Bench) -> list[Bar]:
    """Ten minutes up, ten down or an hour, up again, at two keyframes a second of the wide profile."""
    bars = []
    for minutes in (10, 60):
        bench.say(f"{minutes} minutes without a link")
        found = silence(bench.folder, minutes)
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
    """Coding and tight forms of a keyframe there and back; an endpoint's work a packet."""
    bench.say("CPU of codec and endpoint")
    return [
        at_most("codec: CPU of a keyframe there and back", coding_ms(), 2.0, "ms", 2),
        at_most("endpoint: CPU a packet, both ends, tight forms apart", packet_ms(), 0.3, "ms", 3),
    ]
