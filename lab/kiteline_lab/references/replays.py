"""Replays kept logs, and notes what each stage computes."""

import math
from collections import Counter
from pathlib import Path

import numpy as np

from kiteline_agent.runtime.frame_counts import FrameCounts, live_pose
from kiteline_agent.step import Estimate, StepOutput
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job
from kiteline_basestation.runtime import flight_log as base_log
from kiteline_basestation.runtime.base_runtime import load_vocabulary
from kiteline_basestation.station import Station, StationOutput
from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.logs.machine import machine
from kiteline_hw.logs.mcap_log import RIG, LogReader
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import TrajectoryAlignment
from kiteline_lab.references import kept_log
from kiteline_lab.references.flights import KeptFlight, agent_log_of, base_log_of
from kiteline_lab.references.observation import Half, Observation, Row, add_digests, digest
from kiteline_lab.replay.logged_steps import Step, agent_input, agent_of_log, check_replayable, steps

_POSE = ("x_m", "y_m", "z_m", "turn_x_rad", "turn_y_rad", "turn_z_rad", "live_x_m", "live_y_m", "live_z_m")
_AGENT_COLUMNS = (*_POSE, "inliers", "quality", "up_bytes")
_AGENT_STAGES = ("tracking", "pose", "live", "covariance", "packets")
_BASE_COLUMNS = ("mean_x_m", "mean_y_m", "mean_z_m", "keyframes", "landmarks", "down_bytes")
_BASE_STAGES = ("jobs", "map", "packets")
_NOTHING = (math.nan,) * 3


def replay(folder: Path, flight: KeptFlight) -> Observation:
    """Replay the logs of a kept flight. Raises SourceError."""
    images = kept_log.read_images(folder / flight.images)
    found = Observation(flight.name, flight.about, machine())
    for k in range(len(flight.frames)):
        found.halves.append(replay_agent(folder, flight, k, images))
    found.halves.append(replay_base(folder, flight))
    return found


def replay_agent(folder: Path, flight: KeptFlight, number: int, images: kept_log.Images) -> Half:
    """Replay an agent: its packets from the base are those of the log, whatever it sends."""
    half = Half(f"agent {number}", "frame", _AGENT_COLUMNS, _AGENT_STAGES)
    counts, live, packets = FrameCounts(), list[tuple[int, F64]](), 0
    unsent: list[bytes] = []
    with LogReader(agent_log_of(folder, flight, number)) as log:
        agent = agent_of_log(log)
        rig, _ = rig_from_json(next(log.messages((RIG,))).json())
        for step in kept_log.agent_steps(log, images, right=rig.right is not None, depth=rig.has_depth):
            given = agent_input(step)
            output = agent.step(given, step.head["now_ns"])
            unsent += output.packets
            if given.frame is None:
                continue
            counts.count(output.estimate, output.predicted)
            half.rows.append(_agent_row(len(half.rows), step, output, unsent))
            packets += len(unsent)
            counts.bytes_up += sum(map(len, unsent))
            unsent = []
            pose = None if output.estimate is None else live_pose(output.estimate)
            if output.estimate is not None and pose is not None:
                live.append((output.estimate.t_ns, pose))
    report = counts.as_report()
    for name in ("frames", "tracked", "bridged", "lost", "initialising", "dropped", "submaps", "keyframes"):
        half.facts[name] = str(report[name])
    half.facts["bytes up"] = f"{counts.bytes_up} in {packets} packets"
    half.facts |= _accuracy(folder / flight.images, live)
    add_digests(half)
    return half


def _agent_row(number: int, step: Step, output: StepOutput, packets: list[bytes]) -> Row:
    e = output.estimate
    digests: tuple[str, ...] = ("-",) * 4
    numbers: tuple[float, ...] = (math.nan,) * 11
    if e is None:
        state = "skipped" if output.predicted is None else "predicted"
        if output.predicted is not None:
            numbers = (*_pose(output.predicted.T_o_b), *_NOTHING, math.nan, output.predicted.quality)
    else:
        state = _state(e)
        live = live_pose(e)
        at = _NOTHING if live is None else tuple(live[:3, 3].tolist())
        odometry = (math.nan,) * 6 if e.initialising else _pose(e.T_o_b)
        numbers = (*odometry, *at, e.inliers, e.quality)
        digests = (
            digest((e.tracked, e.bridged, e.inliers, e.keyframe, e.T_k_c)), digest((e.T_o_b,)),
            digest((e.T_m_b, e.T_w_b, e.R_l_o)), digest((e.cov_m, e.cov_o, e.quality)),
        )  # fmt: skip
    up = float(sum(map(len, packets)))
    return Row(number, step.head["now_ns"] / 1e9, state, (*numbers, up), (*digests, digest(packets)))


def _state(e: Estimate) -> str:
    if e.initialising:
        return "starting"
    return "lost" if not e.tracked else "bridged" if e.bridged else "tracked"


def _pose(T: F64) -> tuple[float, ...]:
    return (*T[:3, 3].tolist(), *se3.so3_log(T[:3, :3]).tolist())


def _accuracy(images: Path, live: list[tuple[int, F64]]) -> dict[str, str]:
    """Error of the live poses and the last one."""
    if len(live) < 3:
        return {"error of live poses": "none: fewer than 3 poses"}
    source = open_source(str(images))
    truth = source.ground_truth
    source.close()
    assert truth is not None
    path = Trajectory(np.array([t for t, _ in live], np.int64), np.array([pose for _, pose in live]))
    errors = metrics.evaluate(path, truth, TrajectoryAlignment.SE3)
    last = " ".join(f"{value:.4f}" for value in live[-1][1][:3, 3])
    return {"error of live poses, rmse in mm": f"{1e3 * errors.ate_m.rmse:.2f}", "last live position in m": last}


def replay_base(folder: Path, flight: KeptFlight) -> Half:
    """Replay the base: packets of the agents are those of the log. Jobs end at the steps of the log; one that the log
    does not know ends at the next step.
    """
    half = Half("base", "step", _BASE_COLUMNS, _BASE_STAGES)
    kinds: Counter[str] = Counter()
    packets = total = 0
    with LogReader(base_log_of(folder, flight)) as log:
        check_replayable(log, "base")
        known = {number for step in steps(log) for number in step.head["done"]}
        station = base_log.station_of(log.metadata, load_vocabulary(), link_traits)
        jobs: dict[int, Job] = {}
        for step in steps(log):
            logged = {m.json()["id"]: m for m in step.of(base_log.JOB)}
            due = [n for n in step.head["done"] if n in jobs] + sorted(jobs.keys() - known)
            done = [base_log.done_again(jobs.pop(n), logged[n]) if n in logged else run_job(jobs.pop(n)) for n in due]
            arrived = {AgentId(int(a)): step.blobs(base_log.packets_in(int(a))) for a in step.head["agents"]}
            output = station.step(arrived, done, step.head["now_ns"])
            jobs.update({job.id: job for job in output.jobs})
            kinds.update(job.kind for job in done)
            results = [(job.kind, base_log.fingerprint(job)) for job in done]
            half.rows.append(_base_row(len(half.rows), step, station, output, results))
            packets += sum(len(sent) for _, sent in output.packets)
            total += int(half.rows[-1].numbers[-1])
    summary = station.mapper.summary()
    for name in ("keyframes", "points", "observations", "maps", "loops", "merges", "jobs_failed"):
        half.facts[name] = str(summary[name])
    half.facts["jobs done"] = ", ".join(f"{kind} {kinds[kind]}" for kind in sorted(kinds)) or "none"
    half.facts["cells of the grid known"] = str(_known_cells(station))
    half.facts["bytes down"] = f"{total} in {packets} packets"
    add_digests(half)
    return half


def _base_row(number: int, step: Step, station: Station, output: StationOutput, done: list[tuple[str, str]]) -> Row:
    world = station.mapper.map
    rows = [row for _, row in sorted(world.rows.items())]
    poses = world.keyframes.T_w_k[rows]
    mean = _NOTHING if not rows else tuple(poses[:, :3, 3].mean(axis=0).tolist())
    landmarks = world.count_live()
    sent = [packet for _, packets in output.packets for packet in packets]
    state = "+".join(sorted({kind for kind, _ in done})) or "-"
    digests = (digest(done) if done else "-", digest((sorted(world.rows), poses, landmarks)), digest(sent))
    numbers = (*mean, float(len(rows)), float(landmarks), float(sum(map(len, sent))))
    return Row(number, step.head["now_ns"] / 1e9, state, numbers, digests)


def _known_cells(station: Station) -> int:
    grid = station.mapper.grid
    return sum(int(np.count_nonzero(grid.log_odds(place))) for place in grid.places)
