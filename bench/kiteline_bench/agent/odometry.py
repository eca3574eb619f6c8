"""The agent's bars for odometry: it carries through the dark, gives one eye its metre, and costs nothing where bad."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_bench.benchmark import Bar, Bench, at_most
from kiteline_bench.harness import faults
from kiteline_bench.harness.clip import Clip, load
from kiteline_core import odometry
from kiteline_core.frame import OdometryBatch, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.sim.source import open_sim
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.evaluation import metrics

_RATE_HZ = 50.0
_DARK_S = 2.0
_DARK_FROM_S = (6.0, 12.0, 18.0)
_STALE_NS = 200_000_000
_BAD_SECONDS = 20.0


@dataclass(frozen=True, slots=True)
class Simulated:
    """A simulated flight: its recording, and the scene and options that made it."""

    recording: str
    scene: str
    options: Mapping[str, Any]

    def odometry(self, **errors: Any) -> OdometryBatch:
        """What an odometer measures on it, with options of the simulator."""
        driven = open_sim(self.scene, **self.options, odometry=_RATE_HZ, **errors).odometry()
        assert driven is not None
        return driven


def bars(bench: Bench, flights: Mapping[str, Simulated]) -> list[Bar]:
    """All of them. flights: by name."""
    out: list[Bar] = []
    for name, flight in flights.items():
        bench.say(f"flying {name} with odometry, in the dark and with one eye")
        good = flight.odometry()
        clip = replace(load(flight.recording), imu=None)
        out += dark_bars(name, clip, good)
        out += one_eye_bars(name, replace(load(flight.recording, mono=True), imu=None), good)
    bench.say("flying with bad odometry")
    out += _bad_bars(flights)
    return out


def fly(clip: Clip, driven: OdometryBatch | None) -> tuple[Agent, list[Estimate]]:
    """An agent without a base; the odometry reaches it with the frames that follow."""
    agent = Agent(clip.rig, clip.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel(), shipped_vocabulary())
    out, done = [], 0
    for frame, imu in clip.items:
        part = None
        if driven is not None:
            end = int(np.searchsorted(driven.t_ns, frame.t_ns, side="right"))
            part = odometry.chosen(driven, slice(done, end)) if end > done else None
            done = end
        given = StepInput(frame, imu if clip.imu is not None else None, odometry=part)
        estimate = agent.step(given, frame.t_ns).estimate
        assert estimate is not None
        out.append(estimate)
    return agent, out


# in the dark


def dark_bars(name: str, clip: Clip, good: OdometryBatch) -> list[Bar]:
    """Two seconds of black at several moments, without an IMU: how far the odometry is off at their end."""
    off, plain, late = [], [], 0
    for from_s in _DARK_FROM_S:
        begin = round(from_s * 1e9 / clip.period_ns)
        end = begin + round(_DARK_S * 1e9 / clip.period_ns)
        if end + 5 > len(clip.items):
            continue
        dark = faults.blind(clip, begin, end, black=True)
        _, found = fly(dark, good)
        off.append(drift_m(clip, found, begin, end))
        plain.append(drift_m(clip, fly(dark, None)[1], begin, end))
        late = max(late, next((k for k, e in enumerate(found[end:]) if e.tracked and not e.bridged), len(found)))
    return [
        at_most(f"{name}, {_DARK_S:g} s of black, odometry and no IMU: off at the end, worst "
                f"(without odometry {max(plain):.2f} m)", max(off), 0.15, "m", 3),
        at_most(f"{name}, {_DARK_S:g} s of black, odometry: relative to without", max(off) / max(plain), 0.25, "", 3),
        at_most(f"{name}, {_DARK_S:g} s of black, odometry: frames from texture to a pose", late + 1, 3, "", 0),
    ]  # fmt: skip


def drift_m(clip: Clip, found: list[Estimate], begin: int, end: int) -> float:
    """How far the odometry frame's pose is off at the end of frames begin..end, if it was right before them."""
    assert clip.truth is not None
    _, true = metrics.truth_at(np.array([found[k].t_ns for k in (begin - 1, end - 1)]), clip.truth)
    flown = se3.inverse(found[begin - 1].T_o_b) @ found[end - 1].T_o_b
    return float(np.linalg.norm((flown - se3.inverse(true[0]) @ true[1])[:3, 3]))


# one eye


def one_eye_bars(name: str, clip: Clip, good: OdometryBatch) -> list[Bar]:
    """One eye and an odometer, without an IMU: lengths in metres."""
    agent, found = fly(clip, good)
    metric = [e for e in found if e.submap == agent.submap] if agent.metric else []
    first = next((e.t_ns for e in metric if e.tracked), found[-1].t_ns)
    scale = _scale(clip, metric)
    return [
        at_most(f"{name}, one eye and odometry: scale off by", 100.0 * abs(1.0 / scale - 1.0), 5.0, "%", 1),
        at_most(f"{name}, one eye and odometry: metres after", (first - found[0].t_ns) * 1e-9, 15.0, "s", 1),
    ]


def _scale(clip: Clip, found: list[Estimate]) -> float:
    """What makes the flown path as long as the true one; 0 with too little of it."""
    good = [e for e in found if e.T_m_b is not None]
    if clip.truth is None or len(good) < 20:
        return 1e-9
    flown = Trajectory(np.array([e.t_ns for e in good], np.int64), np.array([e.T_m_b for e in good]))
    return float(metrics.evaluate(flown, clip.truth, metrics.TrajectoryAlignment.SIM3).scale)


# bad odometry


def _dead(flight: Simulated) -> OdometryBatch:
    good = flight.odometry()
    return replace(good, velocity=np.zeros_like(good.velocity), rate=np.zeros_like(good.rate))


def _wrong_axes(flight: Simulated) -> OdometryBatch:
    """Forward, right, down where forward, left, up is meant: two of three axes point the other way."""
    good, flip = flight.odometry(), np.array([1.0, -1.0, -1.0])
    return replace(good, velocity=good.velocity * flip, rate=good.rate * flip)


def _stale(flight: Simulated) -> OdometryBatch:
    good = flight.odometry()
    return replace(good, t_ns=good.t_ns + _STALE_NS)


BAD: dict[str, Callable[[Simulated], OdometryBatch]] = {
    "5 % off": lambda flight: flight.odometry(odometry_scale=1.05),
    "slips": lambda flight: flight.odometry(odometry_slip=0.25),
    "dead": _dead,
    "wrong axes": _wrong_axes,
    "0.2 s late": _stale,
    "noisy": lambda flight: flight.odometry(odometry_noise=0.5),
}


def _bad_bars(flights: Mapping[str, Simulated]) -> list[Bar]:
    """What bad odometry costs of the accuracy, all flights together: of one flight 10 % are chance."""
    out = []
    for imu in (True, False):
        clips = {}
        for name, flight in flights.items():
            clip = load(flight.recording)
            clip = clip.part(0, round(_BAD_SECONDS * 1e9 / clip.period_ns))
            clips[name] = clip if imu else replace(clip, imu=None)
        plain = sum(_ate_m(clip, fly(clip, None)[1]) for clip in clips.values())
        worst = {
            kind: sum(_ate_m(clip, fly(clip, spoil(flights[name]))[1]) for name, clip in clips.items()) / plain
            for kind, spoil in BAD.items()
        }
        what = "IMU" if imu else "no IMU"
        told = ", ".join(f"{kind} {ratio:.2f}" for kind, ratio in worst.items())
        out.append(at_most(f"bad odometry, {what}: ATE relative to none ({told})", max(worst.values()), 1.1, "", 2))
    return out


def _ate_m(clip: Clip, found: list[Estimate]) -> float:
    good = [e for e in found if e.T_m_b is not None]
    assert clip.truth is not None
    if len(good) < len(found) // 2:
        return float("inf")
    flown = Trajectory(np.array([e.t_ns for e in good], np.int64), np.array([e.T_o_b for e in good]))
    return float(metrics.evaluate(flown, clip.truth).ate_m.rmse)
