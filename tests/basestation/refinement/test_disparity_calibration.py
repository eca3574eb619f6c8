"""What all disparities are off by is found by bundles of the whole map, and taken off."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.refinement.disparity_calibration import has_bent, prior_mean, sideways_share
from kiteline_codec.schema import (
    CameraIntrinsics,
    DisparityCalibration,
    NewLandmarks,
    Observations,
    Record,
    StereoAlignment,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.geometry.disparity_offset import none, terms
from kiteline_core.ids import AgentId
from tests.basestation.feeding import WITHOUT_GRID

MakeFlight = Callable[..., Any]
FOCAL, CX, CY = 420.0, 376.0, 240.0
BF = FOCAL * 0.11
TURNED = FOCAL * np.array([0.0, 0.0, 8e-4, 0.0, 0.0]) + [0.02, 0.0, 0.0, 0.0, 0.0]  # a right camera rolled by 0.8 mrad
NONE = none()
CONSTANT = np.array([0.12, 0.0, 0.0, 0.0, 0.0])
WORN = FOCAL * np.array([1.2e-3, 0.0, 5e-4, 1e-3, 0.0])  # half a pixel: a mount that bent by a milliradian
BENT_ROWS = FOCAL * np.array([1e-3, -8e-4, 0.0, 0.0, 0.0])  # the same mount, about the other axes
CORNERS = np.array([[x, y] for x in (-0.7, 0.0, 0.7) for y in (-0.45, 0.0, 0.45)])


def shifted(record: Record, offset: F64) -> Record:
    if isinstance(record, NewLandmarks | Observations):
        by = terms((record.uv - [CX, CY]) / FOCAL) @ offset
        deep = record.inv_depth > 0
        return replace(record, inv_depth=np.where(deep, record.inv_depth + by / BF, 0.0).astype(np.float32))
    return record


def fly(mapper: Mapper, flight: Any, offset: F64, said: tuple[Record, ...] = ()) -> list[Job]:
    done: tuple[JobDone, ...] = ()
    jobs: list[Job] = []
    for n in range(len(flight.records) + 30):
        records = flight.records[n] if n < len(flight.records) else []
        first = [CameraIntrinsics(flight.agent, flight.camera), *said] if n == 0 else []
        given = tuple(first) + tuple(shifted(r, offset) for r in records)
        output = mapper.step(MapperInput(((flight.agent, given),), done), n * 250_000_000)
        done = tuple(run_job(job) for job in output.jobs)
        jobs.extend(output.jobs)
    return jobs


Mapped = Callable[[F64], tuple[Any, Mapper]]


@pytest.fixture(scope="module")
def mapped(make_flight: MakeFlight, words: Any) -> Mapped:
    """A flight around a room, and its map where all disparities are off by an offset."""
    flight = make_flight(keyframes=60, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    exact = replace(BaseConfig().disparity, inflation=1.0)  # the lens of this flight is known exactly
    flown: dict[bytes, Mapper] = {}

    def get(offset: F64) -> tuple[Any, Mapper]:
        if offset.tobytes() not in flown:
            flown[offset.tobytes()] = Mapper(replace(WITHOUT_GRID, disparity=exact), words)
            fly(flown[offset.tobytes()], flight, offset)
        return flight, flown[offset.tobytes()]

    return get


@pytest.mark.parametrize("offset", [NONE, CONSTANT, TURNED])
def test_an_offset_is_found(mapped: Mapped, offset: F64) -> None:
    flight, mapper = mapped(offset)
    left = offset - mapper.map.disparity_offset_px.get(AgentId(0), NONE)
    assert np.sqrt(np.mean(np.square(terms(CORNERS) @ left))) < 0.045
    error = [np.linalg.norm(mapper.map.pose(k)[:3, 3] - t[:3, 3]) for k, t in zip(flight.keyframes, flight.true_T_m_k)]
    assert np.sqrt(np.mean(np.square(error))) < 0.01


def test_disparities_that_are_right_are_left_alone(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=40, turns=0.6, drift_m=0.001)
    mapper = Mapper(WITHOUT_GRID, words)
    jobs = fly(mapper, flight, NONE)
    assert any(job.kind == "full" for job in jobs)
    assert mapper.map.disparity_offset_px == {}
    assert mapper.idle


def test_the_next_flight_begins_with_the_offset_unless_the_rig_was_calibrated_again(mapped: Mapped, words: Any) -> None:
    flight, mapper = mapped(CONSTANT)
    kept = mapper.map.disparity_offset_px[AgentId(0)].copy()
    assert np.any(kept != 0.0)

    def told(base: Mapper, focal: float) -> list[DisparityCalibration]:
        """Offsets that are sent when an agent begins with a camera of this focal length."""
        camera = replace(flight.camera, fx=focal, fy=focal)
        output = base.step(MapperInput(((flight.agent, (CameraIntrinsics(flight.agent, camera),)),), ()), 10**12)
        records = [record for _, batch in output.publish for record in batch]
        return [record for record in records if isinstance(record, DisparityCalibration)]

    after = Mapper(WITHOUT_GRID, words)  # a later base, with the saved state
    after.map.set_camera(AgentId(0), flight.camera)
    after.restore_state(mapper.state())
    assert [r.disparity_px.tolist() for r in told(after, flight.camera.fx)] == [kept.tolist()]
    assert told(after, flight.camera.fx) == []
    assert [r.disparity_px.tolist() for r in told(after, flight.camera.fx + 1.0)] == [NONE.tolist()]
    assert AgentId(0) not in after.map.disparity_calibrated


def test_what_an_agent_found_counts_until_the_base_knows_more(make_flight: MakeFlight, words: Any) -> None:
    worn = np.array([-0.6, 0.1, -0.2, -0.5, 0.8])
    flight = make_flight(keyframes=60, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    close = worn + [0.3, 0.0, 0.2, 0.0, 0.0]
    said = StereoAlignment(flight.agent, NONE, False, close, 0.15)
    mapper = Mapper(WITHOUT_GRID, words)
    first = (CameraIntrinsics(flight.agent, flight.camera), said)
    output = mapper.step(MapperInput(((flight.agent, first),), ()), 0)
    sent = [r for _, records in output.publish for r in records]
    assert not any(isinstance(r, DisparityCalibration) for r in sent)  # the agent has it
    assert np.array_equal(mapper.map.disparity_offset_px[flight.agent], close)
    fly(mapper, flight, worn, (said,))
    assert mapper.map.disparity_sigma_px[flight.agent] < 0.1
    assert np.sqrt(np.mean((terms(CORNERS) @ (mapper.map.disparity_offset_px[flight.agent] - worn)) ** 2)) < 0.12
    mapper.map.set_stereo_alignment(said)  # less certain than what the base knows now
    assert not np.array_equal(mapper.map.disparity_offset_px[flight.agent], close)


def test_the_offset_of_a_good_calibration_is_the_agent_s_while_it_flies(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=30, points=1200, memory=8, drift_m=0.001, noise_px=0.2)
    good, later, worn = (np.array([-0.1, 0.05, -0.1, -0.15, 0.0]) * k for k in (1.0, 1.3, 6.0))

    def said(offset: F64) -> StereoAlignment:
        return StereoAlignment(flight.agent, NONE, False, offset, None, good_calibration=True)

    mapper = Mapper(WITHOUT_GRID, words)
    fly(mapper, flight, good, (said(good),))
    of = mapper.map
    assert np.array_equal(of.disparity_offset_px[flight.agent], good) and flight.agent not in of.disparity_sigma_px
    assert np.array_equal(of.offset_measured_with(of.submaps[next(iter(of.submaps))][-1]), good)
    of.set_stereo_alignment(said(later))
    assert np.array_equal(of.disparity_offset_px[flight.agent], later) and not prior_mean(of, flight.agent).any()
    sent = [r for _, records in mapper.step(MapperInput(()), 10**11).publish for r in records]
    assert not any(isinstance(r, DisparityCalibration) for r in sent)
    of.set_stereo_alignment(StereoAlignment(flight.agent, NONE, False, worn, 0.1))
    assert np.array_equal(of.disparity_offset_px[flight.agent], worn) and of.disparity_sigma_px[flight.agent] == 0.1
    of.set_stereo_alignment(said(good))  # it was no worn rig, or one that was repaired
    assert np.array_equal(of.disparity_offset_px[flight.agent], good) and not of.disparity_sigma_px


def test_a_rig_that_was_repaired_is_not_held_to_earlier_flights(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=4, points=200, memory=4, drift_m=0.001, noise_px=0.2)
    known = np.array([-0.6, 0.1, -0.2, -0.5, 0.8])
    for found, holds in ((known + 0.1, True), (NONE, False), (-known, False)):
        mapper = Mapper(WITHOUT_GRID, words)
        mapper.map.set_camera(flight.agent, flight.camera)
        mapper.map.set_stereo_alignment(StereoAlignment(flight.agent, NONE, False, known))  # of a rig file
        mapper.map.set_stereo_alignment(StereoAlignment(flight.agent, NONE, False, found, 0.1))  # of this flight
        mean = prior_mean(mapper.map, flight.agent)
        assert np.allclose(mean, known if holds else found)
        if not holds:
            assert np.allclose(mapper.map.disparity_offset_px[flight.agent], found)


def test_a_restarted_base_tells_an_offset_that_it_knows_better(make_flight: MakeFlight, words: Any) -> None:
    """Its own estimate is no prior of itself, and not the agent's."""
    flight = make_flight(keyframes=4, points=200, memory=4, drift_m=0.001, noise_px=0.2)
    found, better = np.array([-0.6, 0.1, -0.2, -0.5, 0.8]), np.array([-0.55, 0.1, -0.2, -0.45, 0.8])
    received = (CameraIntrinsics(flight.agent, flight.camera), StereoAlignment(flight.agent, NONE, False, found, 0.1))
    first, second = Mapper(WITHOUT_GRID, words), Mapper(WITHOUT_GRID, words)
    first.restore(flight.agent, received, (), 0)
    first.map.disparity_offset_px[flight.agent], first.map.disparity_sigma_px[flight.agent] = better, 0.04
    second.restore(flight.agent, received, (), 0)
    second.restore_state(first.state())
    assert np.array_equal(prior_mean(second.map, flight.agent), found)
    output = second.step(MapperInput(()), 0)
    sent = [r for _, records in output.publish for r in records if isinstance(r, DisparityCalibration)]
    assert [(r.disparity_px.tolist(), r.sigma_px) for r in sent] == [(better.tolist(), 0.04)]


def test_an_offset_of_a_worn_rig_is_found_early(make_flight: MakeFlight, words: Any) -> None:
    worn = np.array([1.2, 0.1, -0.2, 0.6, 0.2])
    flight = make_flight(keyframes=60, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    flight.records[8:] = []
    mapper = Mapper(WITHOUT_GRID, words)
    fly(mapper, flight, worn)
    corners = terms(np.array([[x, y] for x in (-0.7, 0.0, 0.7) for y in (-0.45, 0.0, 0.45)]))
    left = corners @ (worn - mapper.map.disparity_offset_px.get(AgentId(0), NONE))
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean((corners @ worn) ** 2))


def test_motion_across_the_axis_is_that_of_the_cameras_own_axes() -> None:
    """A camera that looks along its path moves along its axis, whichever way the path bends."""
    turn = se3.so3_exp(np.array([0.0, 0.3, 0.0]))
    step = {"ahead": np.array([0.0, 0.0, 0.5]), "sideways": np.array([0.5, 0.0, 0.0]), "both": np.array([0.3, 0, 0.4])}
    for name, share in (("ahead", 0.0), ("sideways", 1.0), ("both", 0.36)):
        T_m_c = [np.eye(4)]
        for _ in range(6):
            T_m_c.append(T_m_c[-1] @ se3.from_rt(np.eye(3), step[name]) @ se3.from_rt(turn, np.zeros(3)))
        assert sideways_share(np.stack([se3.inverse(T) for T in T_m_c])) == pytest.approx(share, abs=1e-9)
    assert sideways_share(np.tile(np.eye(4), (3, 1, 1))) == 0.0


def test_a_base_begins_with_what_the_agent_began_with_but_keeps_its_own(words: Any, make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=2)
    mapper = Mapper(WITHOUT_GRID, words)
    said = StereoAlignment(flight.agent, BENT_ROWS, True, WORN)
    first = (CameraIntrinsics(flight.agent, flight.camera), said)
    mapper.step(MapperInput(((flight.agent, first),), ()), 0)
    assert np.array_equal(mapper.map.disparity_offset_px[AgentId(0)], WORN)
    mapper.map.disparity_offset_px[AgentId(0)] = CONSTANT  # estimated here
    mapper.step(MapperInput(((flight.agent, (said,)),), ()), 10**9)
    assert np.array_equal(mapper.map.disparity_offset_px[AgentId(0)], CONSTANT)
    again = CameraIntrinsics(flight.agent, replace(flight.camera, fx=flight.camera.fx + 1.0))
    mapper.step(MapperInput(((flight.agent, (again,)),), ()), 2 * 10**9)
    assert AgentId(0) not in mapper.map.rows_px
    assert AgentId(0) not in mapper.map.rows_read
    assert AgentId(0) not in mapper.map.known_offset_px
    assert not np.any(mapper.map.disparity_offset_px[AgentId(0)])


def test_a_worn_rig_is_held_about_what_earlier_flights_found(words: Any, make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=14, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    left = []
    for told in (NONE, WORN):
        config = replace(BaseConfig().disparity, min_sideways=2.0)  # no motion is believed
        mapper = Mapper(replace(WITHOUT_GRID, disparity=config), words)
        fly(mapper, flight, WORN, (StereoAlignment(flight.agent, 0.1 * BENT_ROWS, False, told),))
        assert not has_bent(mapper.map, flight.agent)
        error = WORN - mapper.map.disparity_offset_px.get(AgentId(0), NONE)
        left.append(float(np.sqrt(np.mean(np.square(terms(CORNERS) @ error)))))
    assert left[1] < 0.06
    assert left[1] < 0.5 * left[0]


def test_what_a_good_calibration_may_have_is_not_carried_from_flight_to_flight(words: Any) -> None:
    mapper = Mapper(WITHOUT_GRID, words)
    assert not np.any(prior_mean(mapper.map, AgentId(0)))
    camera = RectifiedCamera(752, 480, FOCAL, FOCAL, CX, CY, 0.11, True, np.eye(4))
    mapper.map.set_camera(AgentId(0), camera)
    mapper.map.set_stereo_alignment(StereoAlignment(AgentId(0), NONE, False, CONSTANT))
    assert np.array_equal(mapper.map.disparity_offset_px[AgentId(0)], CONSTANT)  # where it begins
    assert not np.any(prior_mean(mapper.map, AgentId(0)))
    mapper.map.known_offset_px[AgentId(0)] = WORN
    assert np.array_equal(prior_mean(mapper.map, AgentId(0)), WORN)


def test_bent_rows_let_a_large_offset_be_found_whatever_the_motion(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=14, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    left = []
    for rows_px in (0.4 * BENT_ROWS, BENT_ROWS):  # as in a good calibration, and bent
        mapper = Mapper(replace(WITHOUT_GRID, disparity=replace(BaseConfig().disparity, min_sideways=2.0)), words)
        fly(mapper, flight, WORN, (StereoAlignment(flight.agent, rows_px, True, NONE),))
        error = WORN - mapper.map.disparity_offset_px.get(AgentId(0), NONE)
        left.append(float(np.sqrt(np.mean(np.square(terms(CORNERS) @ error)))))
    assert left[1] < 0.1
    assert left[1] < 0.6 * left[0]


def test_what_forward_motion_told_an_agent_does_not_bound_the_base(make_flight: MakeFlight, words: Any) -> None:
    flight = make_flight(keyframes=14, points=1500, memory=8, drift_m=0.001, noise_px=0.2)
    left = []
    for min_sideways, sigma_px in ((2.0, 0.25), (2.0, 0.05), (0.0, 0.25)):
        config = replace(BaseConfig().disparity, min_sideways=min_sideways)
        mapper = Mapper(replace(WITHOUT_GRID, disparity=config), words)
        fly(mapper, flight, 2.0 * WORN, (StereoAlignment(flight.agent, NONE, False, 0.8 * WORN, sigma_px),))
        error = 2.0 * WORN - mapper.map.disparity_offset_px.get(AgentId(0), NONE)
        left.append(float(np.sqrt(np.mean(np.square(terms(CORNERS) @ error)))))
    assert left[0] < 0.5 * min(left[1:])  # known well, or told in sideways motion: as the agent told
