"""The first flight's bars: accuracy, cost, bytes, agreement, repetition, killed processes, bad input; on recordings."""

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import cv2
import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed, at_most, is_true, run_command
from kiteline_bench.harness.contract import check_contract
from kiteline_bench.harness.result import FlownProcesses
from kiteline_lab.flights.flight_report import without_timing
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.replay.replay import main as replay

TITLE = "First flight"

_SPAWN_S = 120.0  # s after which a command with bad input counts as hung
_DEMO_S = 60.0


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order of the promise."""
    bars: list[Bar] = []
    bench.warm()
    for part in (_room, _others, _agreement, _kills, _bad_input, _demo):
        try:
            bars += part(bench)
        except FlightFailed as error:
            bars.append(is_true(f"{part.__name__.strip('_')}: all its flights", "fly", False, str(error)))
    return bars


def _all_tracked(what: str, flown: FlownProcesses) -> Bar:
    agent = flown.agent()
    return is_true(f"{what}: every frame tracked", "all", agent["tracked"] == agent["frames"],
                   f"{agent['tracked']} of {agent['frames']}")  # fmt: skip


def _contract(flown: FlownProcesses) -> Bar:
    breaches = check_contract(flown.folder)
    return is_true(
        f"contract of the folder of {flown.folder.name}", "kept", not breaches, "; ".join(breaches) or "kept"
    )


def _room(bench: Bench) -> list[Bar]:
    """room_flight, twice distributed and once alone: accuracy, cost, bytes, repetition, replay."""
    source = bench.source("room_flight.mcap")
    flown, again = bench.fly(source, "room"), bench.fly(source, "room_again")
    alone = bench.fly(source, "room_tracker", mode="tracker")
    agent, base = flown.agent(), flown.base
    cpu = agent["timing"]["cpu_ms_per_frame"]
    alike = all(
        (flown.folder / name).read_bytes() == (again.folder / name).read_bytes()
        for name in ("agent0/live.tum", "agent0/odometry.tum", "base/agent0.tum")
    )
    bench.say("replaying both logs")
    with contextlib.redirect_stdout(io.StringIO()):
        same = [replay([str(flown.folder / half / "log.mcap"), "--verify"]) == 0 for half in ("agent0", "base")]
    return [
        _all_tracked("room_flight, distributed", flown),
        at_most("room_flight: ATE live", flown.ate_m("live"), 0.06, "m", 4),
        at_most("room_flight: ATE base", flown.ate_m(), 0.03, "m", 4),
        at_most("room_flight: ATE, tracker only", alone.ate_m("live"), 0.10, "m", 4),
        at_most("agent: CPU a frame, mean", cpu["mean"], 10.0, "ms", 2),
        at_most("agent: CPU a frame, p95", cpu["p95"], 20.0, "ms", 2),
        at_most("agent: resident memory", agent["timing"]["rss_mib"], 250.0, "MiB", 0),
        at_most("base: CPU of a local bundle, p50", base["timing"]["bundle_ms"]["p50"], 20.0, "ms", 2),
        at_most("base: resident memory", base["timing"]["rss_mib"], 500.0, "MiB", 0),
        at_most("bytes a keyframe, up", agent["bytes_per_keyframe"] / 1000.0, 12.0, "kB", 2),
        is_true("digests at the end", "equal", base["digest_equal"] is True),
        is_true("two flights: trajectories", "byte-identical", alike),
        is_true("two flights: reports but timing", "equal",
                without_timing(flown.report) == without_timing(again.report)),
        is_true("replay --verify of the agent's and the base's log", "bit for bit", all(same)),
        _contract(flown),
        _contract(alone),
    ]  # fmt: skip


def _others(bench: Bench) -> list[Bar]:
    """The shorter recordings."""
    kitti, tum, euroc = (
        bench.fly(bench.source(name), folder)
        for name, folder in (("kitti_straight", "kitti"), ("tum_rgbd_xyz", "tum"), ("euroc_v101_start", "euroc"))
    )
    k, t, e = (flown.accuracy("live") for flown in (kitti, tum, euroc))
    return [
        _all_tracked("kitti_straight", kitti),
        at_most("kitti_straight: relative error a frame", k["rpe_mm"], 20.0, "mm", 2),
        at_most("kitti_straight: relative rotation a frame", k["rpe_deg"], 0.07, "degrees", 4),
        at_most("kitti_straight: ATE live", k["ate_m"], 0.20, "m"),
        at_most("kitti_straight: ATE base", kitti.ate_m(), 0.12, "m"),
        at_most("tum_rgbd_xyz: relative error a frame", t["rpe_mm"], 2.5, "mm", 2),
        at_most("euroc_v101_start: largest deviation", 1000.0 * e["ate_max_m"], 4.0, "mm", 2),
        *(_contract(flown) for flown in (kitti, tum, euroc)),
    ]


def _agreement(bench: Bench) -> list[Bar]:
    """20 % of the packets lost, doubled and reordered, both ways."""
    flown = bench.fly(bench.source("room_flight.mcap"), "room_lossy", loss=0.2)
    equal = flown.base["digest_equal"] is True
    drained_s = flown.report["drain"]["base"]["flight_ms"] / 1000.0
    return [
        is_true("20 % loss, duplication, reordering: digests at the end", "equal", equal,
                f"{'equal' if equal else 'not equal'}, {drained_s:.1f} s of flight time after the last frame"),
        _all_tracked("20 % loss", flown),
        at_most("20 % loss: ATE live", flown.ate_m("live"), 0.06, "m", 4),
        _contract(flown),
    ]  # fmt: skip


def _kills(bench: Bench) -> list[Bar]:
    """A base that is killed and started again; an agent that is killed beside another."""
    room = bench.source("room_flight.mcap")
    flown = bench.fly(room, "room_base_killed", kill_base_at_s=6.0, restart_base_at_s=12.0)
    bench.say("flying two agents, one of which is killed")
    out = bench.folder / "room_agent_killed"
    report, outcome = fly(Options((room, room), out, seconds=10.0, kill_agent_at_s=5.0), quiet=True)
    killed = FlownProcesses(out, dict(report), outcome)
    caught_up, made = flown.base["keyframes"], flown.agent()["keyframes"]
    held = killed.base
    return [
        _all_tracked("base killed at 6 s, started again at 12 s", flown),
        is_true("base started again: catches up, digests", "equal", flown.base["digest_equal"] is True),
        is_true("base started again: keyframes it holds", "all", caught_up == made, f"{caught_up} of {made}"),
        is_true("agent killed: the base keeps its map and reports it", "yes",
                held["agents_lost"] == [0] and held["keyframes"] > killed.agent(1)["keyframes"],
                f"{held['keyframes']} keyframes, agent {held['agents_lost']} reported"),
        _contract(flown),
        _contract(killed),
    ]  # fmt: skip


def _bad_input(bench: Bench) -> list[Bar]:
    """Each broken source gets a clear error or counted skips; never a traceback, never a hang."""
    bars = []
    for name, source in _broken_sources(bench):
        bench.say(f"flying a broken source: {name}")
        out = bench.folder / f"broken {name}"
        command = [sys.executable, "-m", "kiteline_cli", "fly", source, "--out", str(out)]
        try:
            done = run_command(command, _SPAWN_S)
        except subprocess.TimeoutExpired:
            bars.append(is_true(f"bad input: {name}", "clear error or counted skip", False, "hangs"))
            continue
        errors = done.stderr + "".join(path.read_text() for path in out.glob("*/stderr.log"))
        reported = [line for line in done.stderr.splitlines() if line.startswith("kiteline: error:")]
        skipped: dict[str, int] = {}
        if (out / "report.json").exists():
            skipped = json.loads((out / "report.json").read_text())["agents"][0].get("skipped", {})
        handled = bool(reported) if done.returncode else bool(skipped) or name == "truncated MCAP"
        fine = handled and "Traceback" not in errors
        words = (
            reported[0].removeprefix("kiteline: error: ") if reported else f"flown, skipped: {skipped or 'the rest'}"
        )
        words = words.replace(str(bench.folder), "…").replace("|", "/") if fine else errors[-200:]
        bars.append(is_true(f"bad input: {name}", "clear error or counted skip", fine, " ".join(words.split())[:140]))
    return bars


def _broken_sources(bench: Bench) -> Iterator[tuple[str, str]]:
    broken = bench.folder / "broken"
    broken.mkdir(parents=True, exist_ok=True)
    cut = broken / "cut.mcap"
    with open(bench.source("room_flight.mcap"), "rb") as file:
        cut.write_bytes(file.read(5_000_000))
    yield "truncated MCAP", str(cut)
    (broken / "empty").mkdir(exist_ok=True)
    yield "empty folder", str(broken / "empty")
    kitti = broken / "kitti"
    shutil.copytree(bench.source("kitti_straight"), kitti, dirs_exist_ok=True)
    rows = [line.split() for line in (kitti / "calib.txt").read_text().splitlines() if line.strip()]
    for row in rows:  # the right camera's fourth column is -focal * baseline
        if len(row) in (12, 13):
            row[-9] = "0"
    os.chmod(kitti / "calib.txt", 0o644)
    (kitti / "calib.txt").write_text("\n".join(" ".join(row) for row in rows) + "\n")
    yield "calibration without baseline", str(kitti)
    for name in ("image of another size", "NaN IMU", "text file named .png"):
        euroc = broken / name.replace(" ", "_")
        shutil.copytree(bench.source("euroc_v101_start"), euroc, dirs_exist_ok=True)
        images = sorted((euroc / "mav0" / "cam0" / "data").iterdir())
        target = images[10] if name != "NaN IMU" else euroc / "mav0" / "imu0" / "data.csv"
        os.chmod(target, 0o644)
        if name == "NaN IMU":
            lines = target.read_text().splitlines()
            lines[30:60] = [line.split(",")[0] + ",nan,nan,nan,nan,nan,nan" for line in lines[30:60]]
            target.write_text("\n".join(lines) + "\n")
        elif name == "image of another size":
            cv2.imwrite(str(target), np.zeros((100, 100), np.uint8))
        else:
            target.write_text("this is no picture\n")
        yield name, f"euroc:{euroc}"


def _demo(bench: Bench) -> list[Bar]:
    """The demo with an empty kernel cache."""
    bench.say("running the demo with an empty kernel cache")
    cache = bench.folder / "numba-cache"
    shutil.rmtree(cache, ignore_errors=True)
    begin_s = time.monotonic()
    command = [sys.executable, "-m", "kiteline_lab.demo", "--out", str(bench.folder / "demo")]
    done = run_command(command, 10 * _DEMO_S, NUMBA_CACHE_DIR=str(cache))
    took_s = time.monotonic() - begin_s
    return [
        is_true("demo, after installation", "ends with the table", done.returncode == 0, f"status {done.returncode}"),
        at_most("demo, kernel compilation included", took_s, _DEMO_S, "s", 1),
    ]
