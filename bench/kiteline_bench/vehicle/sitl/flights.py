"""Flights of ArduCopter in the loop: what each of them measures, as bars."""

import math
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.vehicle.sitl import arducopter, lines
from kiteline_bench.vehicle.sitl.ground_station import GUIDED, HAS_POSITION, LAND, USES
from kiteline_bench.vehicle.sitl.loop import Loop
from kiteline_core.arrays import F64

_HEIGHT_M = 1.2
_SPAN_S = 60.0  # of each measurement
_READY_S, _ARM_S, _CLIMB_S = 60.0, 40.0, 20.0  # s until it gives up
_RADIUS_M, _LAP_S, _SWAY_RAD = 0.7, 24.0, 0.5  # of the course
_RESTART_S, _AFTER_S = 3.0, 25.0  # s without an agent; s that are watched after its return


class FlightFailedInLoop(Exception):
    """The vehicle could not do what the flight needs; says why."""


def run(bench: Bench) -> list[Bar]:
    """Fly as far as it goes; without a built ArduCopter nothing is measured."""
    program = arducopter.binary()
    if program is None:
        bench.more.append(f"Not flown: {arducopter.VARIABLE} names no built ArduCopter.")
        return []
    if not program.is_file():
        return [is_true(f"{arducopter.VARIABLE} names a program", "a file", False, str(program))]
    bars: list[Bar] = []
    with Loop(program, bench.folder / "sitl") as loop:
        try:
            _take_off(bench, loop)
            for part in (_course, _hold, _restart, _reboot):
                bars += part(bench, loop)
        except (FlightFailedInLoop, TimeoutError) as error:
            bars.append(is_true("the flight", "goes to its end", False, str(error)))
        _write_log(loop, bench.folder / "sitl" / "said.txt")
    return bars + lines.run(bench, program)


def _take_off(bench: Bench, loop: Loop) -> None:
    bench.say("SITL: starting")
    pilot = loop.pilot
    loop.fly(3.0)
    loop.start_agent()
    if not loop.fly(_READY_S, lambda: pilot.heard(USES) is not None and bool(pilot.flags & HAS_POSITION)):
        raise FlightFailedInLoop(f"no position after {_READY_S:.0f} s: {_last(loop)}")
    bench.say(f"SITL: {USES} at {loop.t_s:.1f} s")
    pilot.set_mode(GUIDED)
    due = [loop.t_s]

    def arm() -> None:
        if loop.t_s >= due[0]:
            due[0] = loop.t_s + 2.0
            pilot.set_mode(GUIDED)
            pilot.arm()

    loop.fly(5.0)
    if not loop.fly(_ARM_S, lambda: pilot.armed, arm):
        raise FlightFailedInLoop(f"not armed after {_ARM_S:.0f} s: {_last(loop)}")
    pilot.take_off(_HEIGHT_M)
    if not loop.fly(_CLIMB_S, lambda: float(loop.copter.position_m[2]) < -0.9 * _HEIGHT_M):
        raise FlightFailedInLoop(f"not in the air after {_CLIMB_S:.0f} s: {_last(loop)}")
    bench.say(f"SITL: in the air at {loop.t_s:.1f} s")
    loop.fly(3.0)


def _course(bench: Bench, loop: Loop) -> list[Bar]:
    """A figure in the room, flown by the position that the EKF has from kiteline."""
    assert loop.onboard is not None
    begin_s, sent, taken = loop.t_s, loop.onboard.sink.counters.odometry, loop.onboard.imu_samples

    def aim() -> None:
        a = 2 * math.pi * (loop.t_s - begin_s) / _LAP_S
        loop.pilot.go_to((_RADIUS_M * math.sin(a), _RADIUS_M * math.sin(2 * a), -_HEIGHT_M - 0.2 * math.sin(3 * a)),
                         _SWAY_RAD * math.sin(1.5 * a))  # fmt: skip

    loop.fly(_SPAN_S, each=aim)
    position_m, yaw_deg = _errors(loop, begin_s)
    rate = (loop.onboard.sink.counters.odometry - sent) / (loop.t_s - begin_s)
    samples_hz = (loop.onboard.imu_samples - taken) / (loop.t_s - begin_s)
    bench.say("SITL: course flown")
    return [
        at_most("the EKF on kiteline alone, 60 s of course: off the truth, rms", 100 * _rms(position_m), 3.0, "cm", 1),
        at_most("yaw off the truth, rms", float(np.sqrt(np.mean(yaw_deg**2))), 1.0, "degrees", 2),
        Bar("ODOMETRY", ">= 30 Hz", f"{rate:.1f} Hz", round(rate, 1) >= 30.0),
        Bar(
            "its inertial samples that kiteline flies on, on the same line",
            "200 Hz",
            f"{samples_hz:.1f} Hz",
            abs(samples_hz - 200.0) < 2.0,
        ),
        _no_failsafe("course: no failsafe", loop, begin_s),
    ]


def _hold(bench: Bench, loop: Loop) -> list[Bar]:
    """Hold the place, by kiteline alone."""
    loop.pilot.go_to((0.0, 0.0, -_HEIGHT_M), 0.0)
    loop.fly(8.0)
    begin_s = loop.t_s
    loop.fly(_SPAN_S)
    t = np.array(loop.truth.t_s)
    p = np.array(loop.truth.position_m)[t >= begin_s]
    away = np.linalg.norm(p - p[:20].mean(0), axis=1)
    off_m, _ = _errors(loop, begin_s)
    bench.say("SITL: place held")
    return [
        at_most("closed loop: farthest from its place in 60 s", 100 * float(away.max()), 10.0, "cm", 1),
        Bar("hold: the EKF off the truth, rms", "told", f"{100 * _rms(off_m):.1f} cm", True),
        _no_failsafe("hold: no failsafe", loop, begin_s),
    ]


def _restart(bench: Bench, loop: Loop) -> list[Bar]:
    """Kill the agent in mid-flight; another one comes."""
    before = math.degrees(loop.copter.heading_rad)
    begin_s = loop.t_s
    loop.kill_agent()
    loop.fly(_RESTART_S)
    loop.start_agent()
    back_s = loop.t_s
    loop.fly(_AFTER_S)
    t = np.array(loop.truth.t_s)
    late = t >= begin_s
    true_deg = np.degrees(np.unwrap(loop.truth.heading_rad)[late])
    _, off = _errors(loop, begin_s)
    turned = float(np.abs(true_deg - before).max())
    p = np.array(loop.truth.position_m)[late]
    moved_m = float(np.linalg.norm(p - p[0], axis=1).max())
    bench.say("SITL: agent restarted")
    assert loop.onboard is not None
    return [
        at_most("agent killed, back after 3 s, EK3_SRC1_YAW 6: the EKF's heading off the truth, worst",
                float(np.abs(off).max()), 3.0, "degrees", 2),
        at_most("the same: the vehicle turned", turned, 3.0, "degrees", 2),
        Bar("the same: the vehicle moved", "told", f"{100 * moved_m:.0f} cm", True),
        is_true("the same: poses again", "in 10 s", loop.onboard.sink.counters.odometry > 100,
                f"{loop.onboard.sink.counters.odometry} in {loop.t_s - back_s:.0f} s"),
        _no_failsafe("the same: no failsafe", loop, begin_s),
    ]  # fmt: skip


def _reboot(bench: Bench, loop: Loop) -> list[Bar]:
    """Land, restart the autopilot, see its poses come again."""
    assert loop.onboard is not None
    pilot = loop.pilot
    pilot.set_mode(LAND)
    if not loop.fly(40.0, lambda: not pilot.armed):
        raise FlightFailedInLoop(f"not landed: {_last(loop)}")
    pilot.reboot()
    if not loop.fly(20.0, lambda: loop.autopilot.reboots > 0):
        raise FlightFailedInLoop(f"not rebooted: {_last(loop)}")
    down_s = loop.t_s
    if not loop.fly(30.0, lambda: pilot.beats_s[-1] > down_s):
        raise FlightFailedInLoop("no heartbeat after the reboot")
    up_s = pilot.beats_s[-1]
    used = loop.fly(40.0, lambda: pilot.heard(USES, down_s) is not None)
    bench.say("SITL: controller rebooted")
    heard = pilot.heard(USES, down_s)
    told = sum("restarted" in f.text for t, f in loop.onboard.said if loop.simulated_s(t) >= down_s)
    return [
        is_true("controller rebooted: said by the agent", "once", told == 1, f"{told} times"),
        at_most("controller rebooted: its EKF uses poses again after its first heartbeat",
                heard.t_s - up_s if used and heard is not None else math.inf, 5.0, "s", 1),
    ]  # fmt: skip


def _errors(loop: Loop, since_s: float) -> tuple[F64, F64]:
    """Errors of the EKF's position (n, 3) in m and yaw (m,) in degrees since a time, nothing aligned."""
    position = [(loop.autopilot.boot_s(t), p) for t, p in loop.pilot.positions]
    position = [(t, p) for t, p in position if since_s <= t <= loop.truth.t_s[-1]]
    yaw = [(loop.autopilot.boot_s(t), y) for t, y in loop.pilot.yaws]
    yaw = [(t, y) for t, y in yaw if since_s <= t <= loop.truth.t_s[-1]]
    true_m, _ = loop.truth.at(np.array([t for t, _ in position]))
    _, true_rad = loop.truth.at(np.array([t for t, _ in yaw]))
    off = np.array([y for _, y in yaw]) - true_rad
    return np.array([p for _, p in position]) - true_m, np.degrees(np.arctan2(np.sin(off), np.cos(off)))


def _rms(errors_m: F64) -> float:
    return float(np.sqrt(np.mean(np.sum(errors_m**2, 1)))) if len(errors_m) else math.inf


def _no_failsafe(name: str, loop: Loop, since_s: float) -> Bar:
    bad = [s.text for s in loop.pilot.said if s.t_s >= since_s and ("failsafe" in s.text.lower() or s.severity <= 3)]
    return is_true(name, "none", not bad and loop.pilot.mode == GUIDED, "; ".join(bad[:3]) or f"mode {loop.pilot.mode}")


def _last(loop: Loop) -> str:
    return "; ".join(s.text for s in loop.pilot.said[-5:]) or "it said nothing"


def _write_log(loop: Loop, path: Path) -> None:
    texts = [(s.t_s, f"autopilot {s.severity}: {s.text}") for s in loop.pilot.said]
    if loop.onboard is not None:
        texts += [(loop.simulated_s(t), f"agent: {f.line}") for t, f in loop.onboard.said]
    path.write_text("".join(f"{t:8.2f}  {text}\n" for t, text in sorted(texts)))
