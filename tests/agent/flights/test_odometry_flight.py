"""Whole flights of an agent through a simulated room, with an odometer and without."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_codec.channel import RecordChannel, plain_pair
from kiteline_codec.schema import KeyframeHeader, SubmapTie
from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight

DARK = range(70, 110)  # 2 s


def fly(
    room_flight: RoomFlight,
    driven: OdometryBatch | None,
    dark: range = range(0),
    *,
    one_eye: bool = False,
    with_imu: bool = False,
    channel: RecordChannel | None = None,
) -> tuple[Agent, list[Estimate], list[str]]:
    rig = replace(room_flight.rig, right=None, T_c_r=None) if one_eye else room_flight.rig
    imu = room_flight.imu if with_imu else None
    agent = Agent(rig, imu, AgentConfig(), Identity(AgentId(0), 0), channel or NoBaseChannel())
    out, events, done, felt = [], [], 0, 0
    for k, shown in enumerate(room_flight.frames):
        frame = replace(shown, right=None) if one_eye else shown
        if k in dark:
            frame = replace(frame, left=np.full_like(shown.left, 8), right=np.full_like(shown.left, 8))
        part = None
        if driven is not None:
            end = int(np.searchsorted(driven.t_ns, frame.t_ns, side="right"))
            part, done = odometry.chosen(driven, slice(done, end)), end
        samples, before = room_flight.samples, felt
        felt = int(np.searchsorted(samples.t_ns, frame.t_ns, side="right"))
        new = slice(before, felt)
        batch = ImuBatch(samples.t_ns[new], samples.gyro[new], samples.accel[new]) if with_imu else None
        output = agent.step(StepInput(frame, batch, odometry=part), frame.t_ns)
        assert output.estimate is not None
        out.append(output.estimate)
        events += output.events
    return agent, out, events


def drift(room_flight: RoomFlight, found: list[Estimate], begin: int, end: int) -> F64:
    """(6,) by which the odometry frame's pose is off at the end of frames begin..end, [translation, rotation]."""
    flown = se3.inverse(found[begin - 1].T_o_b) @ found[end - 1].T_o_b
    true = se3.inverse(room_flight.truth[begin - 1]) @ room_flight.truth[end - 1]
    return np.concatenate([flown[:3, 3] - true[:3, 3], se3.so3_log(true[:3, :3].T @ flown[:3, :3])])


def test_two_seconds_of_black_are_bridged(room_flight: RoomFlight) -> None:
    _, found, events = fly(room_flight, room_flight.driven, DARK)
    _, without, _ = fly(room_flight, None, DARK)
    off, plain = (np.linalg.norm(drift(room_flight, f, DARK.start, DARK.stop)[:3]) for f in (found, without))
    assert off < 0.08
    assert off < 0.25 * plain
    assert any(event.startswith("odometer: agrees") for event in events)
    # for a second it counts as tracking, as with an IMU, and its certainty is told all the way
    assert [e.tracked and e.bridged for e in found[DARK.start : DARK.start + 19]] == [True] * 19
    assert not any(e.tracked for e in found[DARK.start + 21 : DARK.stop])
    assert found[DARK.start + 15].quality > 50
    sigma = [float(np.sqrt(np.trace(found[k].cov_o[:3, :3]))) for k in (DARK.start, DARK.start + 20, DARK.stop - 1)]
    assert sigma[0] < sigma[1] < sigma[2] < 0.3
    assert off < 3.0 * sigma[2]
    # the old map is found again at once, where it was expected
    assert found[DARK.stop].tracked
    assert not found[DARK.stop].bridged
    assert len({e.submap for e in found}) == 1


@pytest.fixture(scope="module")
def without_odometer(room_flight: RoomFlight) -> list[Estimate]:
    """The whole flight without an odometer, in sight all the time."""
    return fly(room_flight, None)[1]


@pytest.mark.parametrize("kind", ["slip", "dead", "axes"])
def test_a_bad_odometer_costs_nothing_in_sight(
    room_flight: RoomFlight, without_odometer: list[Estimate], kind: str
) -> None:
    good = room_flight.driven
    velocity, rate = good.velocity.copy(), good.rate.copy()
    if kind == "slip":
        velocity[(good.t_ns // 1_000_000_000) % 2 == 1] *= 2.0
    elif kind == "dead":
        velocity[:], rate[:] = 0.0, 0.0
    else:
        velocity, rate = velocity[:, [2, 0, 1]], rate[:, [2, 0, 1]]
    _, found, _ = fly(room_flight, replace(good, velocity=velocity, rate=rate))
    off, plain = (_ate(room_flight, f) for f in (found, without_odometer))
    assert all(e.tracked for e in found)
    assert off < 1.1 * plain + 1e-4


def test_a_monocular_map_gets_its_metre(room_flight: RoomFlight) -> None:
    near, far = plain_pair()
    agent, found, events = fly(room_flight, room_flight.driven, one_eye=True, channel=near)
    assert agent.metric
    assert any(event.startswith("mono: metric") for event in events)
    metric = [k for k, e in enumerate(found) if e.submap == agent.submap and e.T_m_b is not None]
    a, b = metric[0], metric[-1]
    flown = se3.inverse(found[a].T_m_b) @ found[b].T_m_b  # type: ignore[arg-type, operator]
    true = se3.inverse(room_flight.truth[a]) @ room_flight.truth[b]
    assert np.linalg.norm(true[:3, 3]) > 0.3
    assert np.linalg.norm(flown[:3, 3]) == pytest.approx(np.linalg.norm(true[:3, 3]), rel=0.05)
    # the base is told how the new submap lies to the last keyframe, whatever live poses reach it
    said = far.receive((), 0)
    (tie,) = [r for r in said if isinstance(r, SubmapTie)]
    headers = {r.keyframe: r for r in said if isinstance(r, KeyframeHeader)}
    T_b_c = agent.map.camera.T_b_c
    before, first = (found[k].T_o_b @ T_b_c for k in (a - 1, a))
    T_r_f, keyframe = tie.T_k_f, tie.since  # camera in the reference keyframe of the frame before
    while keyframe != found[a - 1].keyframe:
        T_r_f, keyframe = headers[keyframe].T_p_k @ T_r_f, headers[keyframe].parent
    assert tie.submap == agent.submap
    assert np.allclose(T_r_f, found[a - 1].T_k_c @ se3.inverse(before) @ first, rtol=0.0, atol=1e-6)
    plain, _, _ = fly(room_flight, None, one_eye=True)
    assert not plain.metric


def test_no_pose_is_given_in_another_unit_before_the_metre_is_known(room_flight: RoomFlight) -> None:
    agent, found, _ = fly(room_flight, room_flight.driven, one_eye=True)
    assert agent.metric
    metric = next(k for k, e in enumerate(found) if not e.initialising)
    assert any(e.submap == 0 for e in found[:metric])  # the map in its own unit
    assert not any(e.tracked or e.quality >= 0 for e in found[:metric])
    assert all(e.tracked for e in found[metric:])
    assert found[metric].submap == agent.submap


def test_an_odometer_gives_the_metre_beside_an_imu_too(room_flight: RoomFlight) -> None:
    agent, found, _ = fly(room_flight, room_flight.driven, one_eye=True, with_imu=True)
    assert agent.metric
    told = [e.quality for e in found if e.tracked]
    assert len(told) > 20 and min(told) > 80  # its lengths are known, by the odometer


def _ate(room_flight: RoomFlight, found: list[Estimate]) -> float:
    flown = np.array([(se3.inverse(found[0].T_o_b) @ e.T_o_b)[:3, 3] for e in found])
    true = np.array([(se3.inverse(room_flight.truth[0]) @ T)[:3, 3] for T in room_flight.truth])
    return float(np.sqrt(np.mean(np.sum((flown - true) ** 2, axis=1))))
