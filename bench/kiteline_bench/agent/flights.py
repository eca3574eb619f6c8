"""The agent's bars: accuracy, cost, the governor beside the same flights without it, faults, losses, memory, start."""

from kiteline_bench.agent import governor, odometry
from kiteline_bench.agent.faults import fault_bars, loss_bars
from kiteline_bench.harness import processes
from kiteline_bench.harness.bars import Bar, Bench, at_most, in_turn
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import NAMES, SIM_SECONDS, render, simulated
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

_SOAK_MINUTES = 30.0
_SOAK_FRAMES = 200  # of the recording, flown to and fro
_DEPTH_SECONDS = 18.0


# accuracy and cost


def _room(bench: Bench) -> list[Bar]:
    room = bench.source("room_flight.mcap")
    full = bench.fly(room, "agent_room")
    plain = bench.fly(room, "agent_room_no_imu", imu=False)
    alone = bench.fly(room, "agent_room_alone", imu=False, mode="tracker")
    cpu = bench.fly(room, "agent_room_no_scans", grid="off").agent()["timing"]["cpu_ms_per_frame"]
    with_scans = full.agent()["timing"]["cpu_ms_per_frame"]
    a, b, c = (flown.accuracy("live") for flown in (full, plain, alone))
    return [
        at_most("room_flight, IMU and base: ATE live", a["ate_m"], 0.02, "m", 4),
        at_most("room_flight, IMU and base: relative error a frame", a["rpe_mm"], 2.5, "mm", 2),
        at_most("room_flight, base: ATE live", b["ate_m"], 0.03, "m", 4),
        at_most("room_flight, base: relative error a frame", b["rpe_mm"], 4.0, "mm", 2),
        at_most("room_flight, tracker only: ATE live", c["ate_m"], 0.05, "m", 4),
        at_most("room_flight: CPU a frame, mean, IMU, link and log included", cpu["mean"], 5.0, "ms", 2),
        at_most("room_flight: the same with scans for the grid", with_scans["mean"], 5.0, "ms", 2),
        at_most("room_flight: CPU a frame, with scans, p95", with_scans["p95"], 12.0, "ms", 2),
        at_most("room_flight: resident memory", full.agent()["timing"]["rss_mib"], 200.0, "MiB", 0),
    ]


def _kitti(bench: Bench) -> list[Bar]:
    cpu = bench.fly(bench.source("kitti_straight"), "agent_kitti").agent()["timing"]["cpu_ms_per_frame"]
    return [at_most("KITTI size: CPU a frame, with scans, mean", cpu["mean"], 9.0, "ms", 2)]


def _simulated(bench: Bench) -> list[Bar]:
    """Flights in the simulator along recorded paths, with IMU and base."""
    bars = []
    for name in NAMES:
        flown = bench.fly(simulated(bench, name).recording, f"agent_{name}")
        further = flown.agent()["lost"] + flown.agent()["submaps"] - 1
        bars += [
            at_most(f"{name} in the simulator, IMU and base: ATE live", flown.ate_m("live"), 0.03, "m", 4),
            at_most(f"{name} in the simulator: frames lost, further submaps", further, 0, "", 0),
        ]
    return bars


# monocular


def _monocular(bench: Bench) -> list[Bar]:
    bench.say("flying kitti07_mono")
    kitti = fly_alone(load(bench.source("kitti07_mono")), vocabulary=False)
    bars = [
        at_most("kitti07_mono: frames until its map begins", kitti.first_tracked + 1, 15, "", 0),
        at_most("kitti07_mono: frames lost afterwards", kitti.lost_after_start, 0, "", 0),
    ]
    for name in NAMES:
        bench.say(f"flying {name} monocular")
        recording = load(simulated(bench, name).recording, mono=True)
        plain = fly_alone(recording.without_imu(), vocabulary=False)
        inertial = fly_alone(recording, vocabulary=False)
        found = plain.evaluate(plain.found, TrajectoryAlignment.SIM3) if plain.submaps == 1 else None
        ate_m = float("inf") if found is None else found.ate_m.rmse
        metric = [e for e in inertial.found if e.submap == inertial.metric_submap]
        off = _scale_error_percent(inertial.evaluate(metric, TrajectoryAlignment.SIM3))
        bars += [
            at_most(f"{name}, monocular: Sim3 ATE over {SIM_SECONDS:g} s", ate_m, 0.05, "m", 4),
            at_most(f"{name}, monocular: frames lost", plain.lost_after_start, 0, "", 0),
            at_most(f"{name}, monocular and IMU: scale off by", off, 5.0, "%", 1),
        ]
    return bars


def _scale_error_percent(found: metrics.Evaluation | None) -> float:
    """Percent by which lengths are off; the alignment's scale makes ours true."""
    return float("inf") if found is None else 100.0 * abs(1.0 / found.scale - 1.0)


# the rest


def _odometry(bench: Bench) -> list[Bar]:
    return odometry.bars(bench, {name: simulated(bench, name) for name in NAMES})


def _governor(bench: Bench) -> list[Bar]:
    return governor.bars(bench, [simulated(bench, name).recording for name in NAMES])


def _faults(bench: Bench) -> list[Bar]:
    return fault_bars(bench, render(bench, "depth", ["room", "--depth", "--seconds", f"{_DEPTH_SECONDS}"])[0])


def _first_pose(bench: Bench) -> list[Bar]:
    bench.say("starting an agent with compiled kernels")
    seconds = [processes.start("first-pose", bench.source("room_flight.mcap"))["seconds"] for _ in range(2)]
    return [at_most("start of the process to its first pose, warm", min(seconds), 2.0, "s", 2)]


def _soak(bench: Bench) -> list[Bar]:
    """To and fro for half an hour: the link down and no IMU; the link up and an IMU."""
    room, bars = bench.source("room_flight.mcap"), []
    for what, options in (
        ("link down", ["--no-imu", "--frames", f"{_SOAK_FRAMES}"]),
        ("IMU, link up", ["--link", "--frames", f"{2 * _SOAK_FRAMES}"]),
    ):
        bench.say(f"flying {_SOAK_MINUTES:g} minutes to and fro: {what}")
        found = processes.start("soak", room, "--minutes", f"{_SOAK_MINUTES}", *options)
        growth = max(found["rss_mib"][1:]) - found["rss_mib"][1]
        bars += [
            at_most(f"soak, {_SOAK_MINUTES:g} minutes, {what}: memory after minute 2 grows by", growth, 5.0, "MiB", 1),
            at_most(f"soak, {what}: frames without a pose", found["lost"], 0, "", 0),
        ]
    return bars


PARTS = {
    "flights": (
        "The onboard agent: accuracy and cost", in_turn(_room, _kitti, _simulated, _first_pose, warm=True)
    ),
    "monocular": ("The onboard agent: monocular", in_turn(_monocular, warm=True)),
    "odometry": ("The onboard agent: odometry as a prior", in_turn(_odometry, warm=True)),
    "governor": ("The onboard agent: under a limit", in_turn(_governor, warm=True)),
    "faults": ("The onboard agent: losses and faults", in_turn(loss_bars, _faults, warm=True)),
    "soak": ("The onboard agent: half an hour", in_turn(_soak, warm=True)),
}  # fmt: skip
