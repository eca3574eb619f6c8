"""Modelled ArduPilot and PX4: what they make of an agent's poses, and how soon wrong axes are named."""

import contextlib
import math
import os
import signal
import time
from math import radians, sin
from typing import Literal

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.vehicle.agent_process import command, favour, start
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import R_L_O, mounting
from kiteline_hw.mavlink.watch.attitude import CANDIDATES, attitude_rotation
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.findings import FindingLevel
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.autopilot import ModelledAutopilot
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController, VisionSample

KINDS: tuple[Literal["ardupilot", "px4"], ...] = ("ardupilot", "px4")

_FLIGHT_S, _WARM_S, _LIMIT_S = 20.0, 3.0, 120.0  # s of poses, of them not counted, s until the first one
_RATE_HZ = 30.0
_S, _STEP_NS, _LATENCY_NS = 1_000_000_000, 10_000_000, 30_000_000
_STILL_S, _NAMED_S = 5.0, 5.0  # s at rest before the motion; s of motion until wrong axes are named


def run(bench: Bench) -> list[Bar]:
    """Fly an agent beside each model, then tell agents wrong axes."""
    return [bar for kind in KINDS for bar in _fly(bench, kind)] + [_wrong_axes(bench, kind) for kind in KINDS]


def _fly(bench: Bench, kind: Literal["ardupilot", "px4"]) -> list[Bar]:
    bench.say(f"an agent beside the modelled {kind}")
    folder = bench.folder / f"controller-{kind}"
    folder.mkdir(parents=True, exist_ok=True)
    model = FlightController(kind)
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.ExitStack() as stack:
        favour(0)  # the model must not wait for the machine
        controller = stack.enter_context(UdpFlightController(model))
        options = ["--mavlink", f"udp:127.0.0.1:{controller.port}", "--no-imu", "--axes", "urf"]
        agent = start(stack, command(bench.source("room_flight.mcap"), "", options), folder / "agent.txt")
        end_s = time.monotonic() + _LIMIT_S
        while not model.accepted and not model.dropped and time.monotonic() < end_s:
            time.sleep(0.1)
        time.sleep(_FLIGHT_S)
        agent.send_signal(signal.SIGTERM)
        agent.wait(10.0)
        with controller.lock:
            samples, dropped = list(model.accepted), sum(model.dropped.values())
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, before)
    jitter_ms, rate_hz = _timing(samples)
    share = 100.0 * len(samples) / max(1, len(samples) + dropped)
    return [
        is_true(f"{kind}: accepted", ">= 99 %", share >= 99.0 and bool(samples),
                f"{share:.1f} % of {len(samples) + dropped}"),
        at_most(f"{kind}: latency beside its median, p95", jitter_ms, 5.0, "ms", 1),
        at_most(f"{kind}: rate off {_RATE_HZ:g} Hz", 100.0 * abs(rate_hz / _RATE_HZ - 1.0), 5.0, "%", 1),
    ]  # fmt: skip


def _timing(samples: list[VisionSample]) -> tuple[float, float]:
    """95th percentile of the latency's distance from its median in ms, and the rate in Hz."""
    if len(samples) < 2:
        return math.inf, 0.0
    received = np.array([s.received_ns for s in samples])
    counted = received > received[0] + _WARM_S * _S
    if int(counted.sum()) < 2:
        return math.inf, 0.0
    latency = received[counted] - np.array([s.t_ns for s in samples])[counted]
    jitter = np.percentile(np.abs(latency - np.median(latency)), 95) / 1e6
    at = received[counted]
    return float(jitter), float((len(at) - 1) * _S / (at[-1] - at[0]))


def _wrong_axes(bench: Bench, kind: Literal["ardupilot", "px4"]) -> Bar:
    """Every wrong choice of axes, carried about by hand: the longest time of motion until the right ones are named."""
    bench.say(f"wrong axes beside the modelled {kind}")
    named = {used: _named_s(kind, used, "flu") for used in CANDIDATES if used != "flu"}
    worst = max(named, key=lambda used: named[used])
    quick = sum(s <= _NAMED_S for s in named.values())
    return Bar(
        f"{kind}: wrong axes named after the first motion", f"<= {_NAMED_S:g} s, all {len(named)}",
        f"{quick} of {len(named)}, worst {worst} {named[worst]:.1f} s", quick == len(named),
    )  # fmt: skip


def _named_s(kind: Literal["ardupilot", "px4"], used: str, true: str) -> float:
    """Seconds of motion until the watch names the right axes alone; infinity if it does not within 30 s."""
    model, watch = ModelledAutopilot(kind), ControllerWatch(mounting(used), "udp:127.0.0.1:14550")
    session, T_b_f = ControllerSession(mounting(used), watch=watch), mounting(true)
    rng = np.random.default_rng(1)
    R_l_n = se3.so3_exp(np.array([0.0, 0.0, 1.1]))  # the odometry frame's heading is not the compass's
    now_ns = _S
    for i in range(round((_STILL_S + 30.0) * _S / _STEP_NS)):
        now_ns += _STEP_NS
        pose = None
        if i % 3 == 0:
            T_o_b = np.eye(4)
            turned = R_l_n @ attitude_rotation(_carried(now_ns - _LATENCY_NS)) @ se3.so3_exp(rng.normal(0.0, 0.003, 3))
            T_o_b[:3, :3] = R_L_O.T @ turned @ T_b_f[:3, :3].T
            pose = PoseSample(now_ns - _LATENCY_NS, T_o_b, True, 80)
        model.angles_rad = _carried(now_ns)
        back = [a for m in session.step(pose, now_ns) + session.watch(now_ns) for a in model.receive(m, now_ns)]
        for data in back + model.poll(now_ns):
            for answer in session.receive(data, now_ns, datagram=True):
                model.receive(answer, now_ns)
        for finding in watch.take():
            if finding.topic == "axes" and finding.level == FindingLevel.ERROR and f"--axes {true}" in finding.remedy:
                return max(0.0, now_ns / _S - 1.0 - _STILL_S)
    return math.inf


def _carried(t_ns: int) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a vehicle that stands, then is carried about by hand."""
    t_s = max(0.0, t_ns / _S - 1.0 - _STILL_S)
    return radians(12.0) * sin(1.9 * t_s), radians(10.0) * sin(1.3 * t_s), radians(40.0) * sin(0.7 * t_s)
