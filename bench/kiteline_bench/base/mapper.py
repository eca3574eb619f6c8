"""The base's bars: accuracy of single and merged maps, loops, losses, CPU and memory."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_basestation.config import GraphConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.essential_graph import GraphInputs, optimise
from kiteline_bench.base import memory, monocular, store
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.harness.simulated import rendered_paths
from kiteline_bench.harness.starts import compared_with_monolith, cut, in_pieces, length_s, pieces
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, keyframe_id, submap_id
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, bundle
from kiteline_lab.evaluation import metrics, trajectories
from kiteline_lab.tools import logs

_CUT_OVERLAP = 0.05  # of the uncut flight's frames, that two neighbouring pieces share
_PIECES = 3
_HALL_S = 100.0  # of both flights, so that they are rendered in minutes
_AGENTS, _SECONDS = 20, 120  # of the modelled queue: one keyframe a second each


# accuracy


def _recordings(bench: Bench) -> list[Bar]:
    """The recordings, compared with a flight without a codec; and the CPU of bundles and graphs."""
    room = bench.fly(bench.source("room_flight.mcap"), "room")
    kitti = bench.fly(bench.source("kitti_straight"), "kitti")
    return [
        at_most("room_flight: ATE base", room.ate_m(), 0.008, "m", 4),
        at_most("kitti_straight: ATE base", kitti.ate_m(), 0.06, "m"),
        *compared_with_monolith(bench, partial(_flown_ate, bench)),
        *_work(bench, room),
    ]


def _hall(bench: Bench) -> list[Bar]:
    """The beginnings of MH_01 and MH_03 in one hall: apart, together, one of them cut in three, and one with losses."""
    both = _hall_recordings(bench)
    apart = [bench.fly(source, f"hall_{i}") for i, source in enumerate(both)]
    together = bench.fly(both, "hall_together")
    in_three = bench.fly(pieces(bench, both[1], "hall", _PIECES, _CUT_OVERLAP), "hall_cut")
    uncut = [(name, source, flown.ate_m()) for name, source, flown in zip(("MH_01", "MH_03"), both, apart)]
    joint = in_pieces(bench, uncut, _PIECES, _CUT_OVERLAP, partial(_flown_ate, bench))
    lost = bench.fly(_with_losses(bench, both[1]), "hall_losses")
    agent = lost.agent()
    return [
        at_most("MH_01 in the hall: ATE base", apart[0].ate_m(), 0.02, "m", 4),
        at_most("MH_03 in the hall: ATE base", apart[1].ate_m(), 0.02, "m", 4),
        is_true("MH_01 and MH_03 as two agents", "merged", together.base["merges"] == 1,
                f"{together.base['merges']} merges"),
        at_most("MH_01 and MH_03 as two agents: joint ATE", together.joint_ate_m(both), 0.025, "m", 4),
        is_true(f"MH_03 cut in {_PIECES} agents, overlaps of {_CUT_OVERLAP:.0%}", "one map",
                in_three.base["merges"] == _PIECES - 1, f"{in_three.base['merges']} merges"),
        joint,
        at_most("MH_03 with three forced losses: ATE base of what is placed", lost.ate_m(), 0.05, "m", 4),
        is_true("MH_03 with three forced losses: tracked", "all but 3 frames a loss", agent["lost"] <= 9,
                f"{agent['lost']} lost, {agent['submaps']} submaps, {lost.base['merges']} merged"),
    ]  # fmt: skip


def _street(bench: Bench) -> list[Bar]:
    """A loop of 1.2 km, and the memory that it takes."""
    source = _street_recording(bench)
    flown = bench.fly(source, "street")
    start = bench.fly(cut(bench, source, "street_start", 0.0, 30.0), "street_start")
    truth = trajectories.read(f"mcap:{source}").trajectory
    estimate = trajectories.read(str(flown.folder / "base" / "agent0.tum")).trajectory
    drift = metrics.kitti_drift(metrics.match(estimate, truth, metrics.TrajectoryAlignment.SE3))
    assert drift is not None
    bench.say("measuring the memory of the base's parts")
    samples = memory.measured(flown.folder / "base" / "log.mcap")
    peak = flown.base["timing"]["rss_mib"]
    bench.more.append(
        "What the base of the street holds, measured as it runs again from its log. Pages of code and of libraries, "
        f"about 270 MiB, are there from the start; at the most it had {peak:.0f} MiB.\n\n{memory.table(samples)}"
    )
    return [
        is_true("KITTI 06 in the street: loop", "closed", flown.base["loops"] >= 1, f"{flown.base['loops']} loops"),
        at_most("KITTI 06 in the street: ATE base", flown.ate_m(), 0.6, "m"),
        at_most("KITTI 06 in the street: t_rel", drift.t_rel_percent, 0.4, "%"),
        at_most("memory of the base for each keyframe after the first 30 s",
                further_kb(start.base, flown.base), 100.0, "kB", 1),
    ]  # fmt: skip


def _monocular(bench: Bench) -> list[Bar]:
    """The loop in the street and the two flights in the hall, monocular."""
    street = bench.fly(_street_recording(bench), "street_monocular", mono=True, imu=False)
    return monocular.bars(bench, street, _hall_recordings(bench))


def _street_recording(bench: Bench) -> Path:
    return rendered_paths(bench, "street", "street", ["KITTI_06.txt"])[0]


def _hall_recordings(bench: Bench) -> list[Path]:
    return rendered_paths(bench, "hall", "hall", ["MH_01_easy.txt", "MH_03_medium.txt"], _HALL_S)


def _flown_ate(bench: Bench, sources: Sequence[Path], folder: str, mode: str) -> float:
    """The joint ATE of a flight of one agent or of several."""
    return bench.fly(sources, folder, mode=mode).joint_ate_m(sources)


def _with_losses(bench: Bench, source: Path) -> Path:
    """The same flight with three gaps of 6 s, after which the camera is somewhere else."""
    length = length_s(source)
    holes = [length * part for part in (0.25, 0.5, 0.75)]
    begins, ends = [0.0, *(hole + 6.0 for hole in holes)], [*holes, length]
    parts = [cut(bench, source, f"part{i}", a, b) for i, (a, b) in enumerate(zip(begins, ends))]
    out = bench.folder / "losses.mcap"
    logs.main(["merge", "--force", str(out), *map(str, parts)])
    return out


# cost


def _work(bench: Bench, room: FlownProcesses) -> list[Bar]:
    bench.say("timing bundles and pose graphs")
    local = _least_ms(lambda: bundle(row_of_cameras(20, 1400, 10), BundleConfig()))
    whole = _least_ms(lambda: bundle(row_of_cameras(100, 10_000, 99), BundleConfig()))
    graph = ring_of_poses(1000, 20)
    posed = _least_ms(lambda: optimise(graph))
    base = room.base
    cost_ms = base["timing"]["bundle_ms"]["mean"] + base["timing"]["step_ms"]["mean"]
    wait_s = queue_p95_s(np.full(_AGENTS, cost_ms / 1000.0))
    return [
        at_most("local bundle of 10 + 10 keyframes", local, 12.0, "ms", 1),
        at_most("full bundle of 100 keyframes and 10,000 points", whole, 150.0, "ms", 1),
        at_most("pose graph of 1000 keyframes", posed, 50.0, "ms", 1),
        at_most(f"{_AGENTS} agents at a keyframe a second on one core: wait, p95 (modelled queue)", wait_s, 1.0, "s"),
        at_most("memory of a keyframe in the map", map_bytes_a_keyframe() / 1000.0, 100.0, "kB", 1),
    ]


def _least_ms(work: Any) -> float:
    """CPU of the fastest of three runs after one that compiles."""
    work()
    took = []
    for _ in range(3):
        begin_ns = time.process_time_ns()
        work()
        took.append((time.process_time_ns() - begin_ns) / 1e6)
    return min(took)


def row_of_cameras(cameras: int, points: int, free: int) -> BundleProblem:
    """Perturbed cameras along a wall; each point is seen by the nearest few. The last `free` may move."""
    rng = np.random.default_rng(0)
    lens = np.tile([420.0, 420.0, 376.0, 240.0, 46.0], (cameras, 1))
    true = np.tile(np.eye(4), (cameras, 1, 1))
    true[:, 0, 3] = -0.25 * np.arange(cameras)  # T_c_m
    world = np.column_stack(
        [rng.uniform(-1.0, 0.25 * cameras + 1.0, points), rng.uniform(-1.5, 1.5, points), rng.uniform(2.5, 6.0, points)]
    )
    nearest = np.clip(np.rint(world[:, 0] / 0.25), 0, cameras - 1).astype(np.int64)
    seen = np.clip(nearest[:, None] + np.arange(-2, 3), 0, cameras - 1)
    rows = [np.unique(line) for line in seen]
    starts = np.concatenate([[0], np.cumsum([len(line) for line in rows])]).astype(np.int32)
    camera, which = np.concatenate(rows).astype(np.int32), np.repeat(np.arange(points), np.diff(starts))
    local = np.einsum("nij,nj->ni", true[camera, :3, :3], world[which]) + true[camera, :3, 3]
    measured = np.column_stack(
        [420 * local[:, 0] / local[:, 2] + 376, 420 * local[:, 1] / local[:, 2] + 240, 46.0 / local[:, 2]]
    ) + rng.normal(0, 0.3, (len(camera), 3))
    start = np.stack([se3.exp(rng.normal(0, 0.004, 6)) @ T for T in true])
    moves = np.arange(cameras) >= cameras - free
    start[~moves] = true[~moves]
    sigma = np.full((len(camera), 2), 0.3)
    return BundleProblem(
        start, lens, moves, world + rng.normal(0, 0.02, world.shape), starts, camera, measured, sigma
    )  # fmt: skip


def ring_of_poses(count: int, loops: int) -> GraphInputs:
    """Four rounds of drifting odometry on a circle, with loop edges between them."""
    rng = np.random.default_rng(0)
    turn = count // 4
    angle = 2 * np.pi * np.arange(count) / turn
    places = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), np.zeros(count)])
    true = np.stack([se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, a])), t) for a, t in zip(angle.tolist(), places)])
    start, edges, between = [true[0]], [], []
    for i in range(1, count):
        noise = se3.exp(np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.001, 3)]))
        between.append(se3.inverse(true[i - 1]) @ true[i] @ noise)
        edges.append((i - 1, i))
        start.append(start[-1] @ between[-1])
    for i in range(2, count, 2):
        edges.append((i - 2, i))
        between.append(se3.inverse(start[i - 2]) @ start[i])
    near = len(edges)
    for a in rng.integers(0, count - turn, loops).tolist():
        edges.append((a, a + turn))
        between.append(se3.inverse(true[a]) @ true[a + turn])
    held = np.arange(count) == 0
    return GraphInputs(
        np.arange(count), np.stack(start), held, np.array(edges), np.stack(between),
        np.tile([0.01, 0.003], (len(edges), 1)), np.arange(len(edges)) >= near, GraphConfig(),
    )  # fmt: skip


def queue_p95_s(cost_s: F64) -> float:
    """95th percentile of a keyframe's wait and work at one server; each agent sends one a second, at its own phase."""
    rng = np.random.default_rng(0)
    at = np.sort((rng.random(len(cost_s))[:, None] + np.arange(_SECONDS)).ravel())
    free_s, took = 0.0, []
    for arrival in at.tolist():
        free_s = max(free_s, arrival) + float(cost_s.mean()) * float(rng.gamma(2.0, 0.5))
        took.append(free_s - arrival)
    return float(np.percentile(took, 95))


def further_kb(short: dict[str, Any], long: dict[str, Any]) -> float:
    """Growth of the base's resident memory from a short to a long flight, in kB a keyframe."""
    more = (long["timing"]["rss_mib"] - short["timing"]["rss_mib"]) * 2**20 / 1000.0
    return float(more / (long["keyframes"] - short["keyframes"]))


def map_bytes_a_keyframe(keyframes: int = 400, keypoints: int = 400) -> float:
    """Bytes by which the map grows with each keyframe of a usual size."""
    sparse_map, submap = SparseMap(), submap_id(0, 0, 0)
    for k in range(keyframes):
        parent = NO_KEYFRAME if k == 0 else keyframe_id(submap, k - 1)
        sparse_map.add_keyframe(keyframe_id(submap, k), k, parent, np.eye(4), keypoints)
    return sparse_map.nbytes() / keyframes


PARTS = {
    "recordings": ("The base's mapper", _recordings),
    "hall": (f"The base's mapper: a hall, two agents, losses (the first {_HALL_S:g} s of both flights)", _hall),
    "street": ("The base's mapper: a street, a loop", _street),
    "monocular": ("The base's mapper: monocular without IMU", _monocular),
    "store": ("The base's store", store.run),
}
