"""One camera in metres that loses its images: the map that begins after them has a place only if a sensor told it."""

from functools import cache
from pathlib import Path

import numpy as np

from kiteline_bench.harness.faults import dark_between
from kiteline_bench.harness.odometer import with_odometer_between
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import Record, SubmapTie
from kiteline_core.geometry import se3

DARK_S = (4.0, 5.5)


@cache
def flown(
    data_dir: Path, odometer_until_s: float, until_s: float = 6.5, *dark_s: tuple[float, float]
) -> tuple[FlyingAgent, list[Record]]:
    """The agent after so many seconds, and what it told the base. dark_s: more spans in which nothing is seen."""
    whole = load(str(data_dir / "room_flight.mcap")).left_only().without_imu().seconds(6.0, 6.0 + until_s)
    flight = dark_between(with_odometer_between(whole, ((-np.inf, odometer_until_s),)), (DARK_S, *dark_s))
    near, far = plain_pair()
    agent = FlyingAgent(flight.rig, None, channel=near, vocabulary=False)
    for item in flight.items:
        agent.step(item)
    return agent, list(far.receive((), 0))


def words(agent: FlyingAgent, start: str) -> list[str]:
    return [event for events in agent.run.events for event in events if event.startswith(start)]


def test_the_way_that_an_odometer_told_is_told_on(data_dir: Path) -> None:
    agent, said = flown(data_dir, np.inf)
    run, submap = agent.run, agent.box.submap
    assert words(agent, "mono: scale by the motion") and not words(agent, "mono: lengths are not metres")
    (tie,) = [r for r in said if isinstance(r, SubmapTie) and r.submap == submap]
    assert 0.0 < tie.sigma_m < 0.1 and tie.sigma_rad < 0.03
    # from the last keyframe before the loss to the first view after it, which odometry leads to
    found = {e.t_ns: e for e in run.estimates if e is not None}
    before = next(e for e in reversed(list(found.values())) if e.keyframe == tie.since and e.tracked and not e.bridged)
    T_b_c = agent.box.map.camera.T_b_c
    T_o_k = before.T_o_b @ T_b_c @ se3.inverse(before.T_k_c)
    way = (T_o_k @ tie.T_k_f)[:3, 3]
    true = dict(zip(run.t_ns, run.truth, strict=True))
    off = [
        np.linalg.norm(way - (before.T_o_b @ se3.inverse(true[before.t_ns]) @ true[e.t_ns] @ T_b_c)[:3, 3])
        for e in found.values()
        if e.t_ns > before.t_ns
    ]
    assert min(off) < 0.05


def test_there_are_poses_as_certain_as_the_way_that_was_told(data_dir: Path) -> None:
    """Before the metre of the new map is known to 2 %."""
    agent, _ = flown(data_dir, np.inf)
    run, begin_ns = agent.run, agent.run.t_ns[0]
    seen = [e for e in run.estimates if e is not None and e.t_ns - begin_ns >= DARK_S[1] * 1e9]
    lost = [e for e in seen if not e.tracked]
    assert len(lost) <= 10 and not agent.box.metric and agent.box.in_metres
    found = [e for e in seen if e.tracked]
    true = dict(zip(run.t_ns, run.truth, strict=True))
    way, true_way = (se3.inverse(a) @ b for a, b in ((found[0].T_o_b, found[-1].T_o_b),
                                                     (true[found[0].t_ns], true[found[-1].t_ns])))  # fmt: skip
    off_m = abs(float(np.linalg.norm(way[:3, 3]) - np.linalg.norm(true_way[:3, 3])))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(found[-1].cov_o[:3, :3])[-1]))
    assert 0.05 * float(np.linalg.norm(true_way[:3, 3])) < sigma_m and off_m < 2.0 * sigma_m


def test_an_odometer_leads_on_where_images_are_lost_again(data_dir: Path) -> None:
    """While the metre is told roughly: the way is known, and lengths are metres as before."""
    agent, _ = flown(data_dir, np.inf, 8.6, (6.4, 8.0))
    run, begin_ns = agent.run, agent.run.t_ns[0]
    late = {round((e.t_ns - begin_ns) * 1e-9, 2): e for e in run.found if e.t_ns - begin_ns >= 6.4 * 1e9}
    assert not agent.box.metric and not words(agent, "mono: lengths are not metres")
    assert all(e.tracked and e.bridged for t_s, e in late.items() if 6.45 < t_s < 7.3)
    assert all(e.quality > 0 for e in late.values())
    assert sum(not e.tracked for t_s, e in late.items() if t_s >= 8.0) <= 10 and agent.box.in_metres


def test_what_nothing_measured_is_said_and_has_no_quality(data_dir: Path) -> None:
    agent, said = flown(data_dir, 3.9)
    submap = agent.box.submap
    assert not agent.box.metric and len(words(agent, "mono: lengths are not metres any more")) == 1
    assert not [r for r in said if isinstance(r, SubmapTie) and r.submap == submap]
    last = agent.run.estimates[-1]
    assert last is not None and last.submap == submap and last.quality < 50
