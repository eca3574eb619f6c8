"""The offset of disparities is found on board, by the parallax of landmarks."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, DisparityAlignmentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.local_map.disparity_alignment import _WORN_SHARE
from kiteline_agent.mapping.right_camera import RightCamera
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier
from kiteline_core.geometry.disparity_offset import GOOD_PX, TERMS, terms
from kiteline_core.ids import AgentId
from tests.agent.disparity_flights import AHEAD, CAMERA, NOTHING, SIDEWAYS, WORN, Flight, normalised


def off_px(offset: F64) -> float:
    """Rms over the image of an offset (5,)."""
    grid = terms(normalised(np.array([[x, y] for x in (60.0, 376.0, 690.0) for y in (60.0, 240.0, 420.0)])))
    return float(np.sqrt(np.mean((grid @ offset) ** 2)))


@pytest.mark.parametrize("seed", range(4))
def test_the_offset_of_a_worn_rig_is_found_and_corrects_the_map(seed: int) -> None:
    flight = Flight(WORN, seed, SIDEWAYS)
    before = flight.alignment.expected_cov
    changes = flight.fly(80)
    assert changes and flight.alignment.worn > 0.95
    assert np.allclose(np.sum(changes, 0), flight.map.disparity_offset)
    left = off_px(WORN - flight.map.disparity_offset)
    assert left < 0.3 * off_px(WORN)
    worn_rig = np.trace(before) / _WORN_SHARE
    assert np.trace(flight.alignment.expected_cov) < 0.08 * worn_rig
    off = flight.map.rho[0, :160] - 1.0 / flight.depth
    assert abs(np.median(off * CAMERA.bf)) < 0.15
    assert flight.alignment.take_events() and not flight.alignment.take_events()


BENT = np.array([6.0, 0.4, 0.1, 5.5, 0.3])  # a right camera that is turned by 0.8 degrees


@pytest.mark.parametrize("seed", range(4))
def test_an_offset_beyond_any_wear_is_found_as_well(seed: int) -> None:
    flight, worn = Flight(BENT, seed, SIDEWAYS), Flight(1.5 * WORN, seed, SIDEWAYS)
    wear = np.trace(flight.alignment.cov)
    flight.fly(80), worn.fly(80)
    left = off_px(BENT - flight.map.disparity_offset)
    assert left < 0.06 * off_px(BENT)
    assert np.trace(np.linalg.inv(flight.alignment._prior.information)) == pytest.approx(64.0 * wear)
    assert np.trace(np.linalg.inv(worn.alignment._prior.information)) == pytest.approx(wear)  # wear keeps its own prior


def test_frames_that_are_skipped_do_not_make_pairs_rarer() -> None:
    flight = Flight(WORN, 0, SIDEWAYS)
    for k, frame in enumerate(flight.frames(80)):
        if k % 8 == 0:
            flight.alignment.add(*frame)
    assert flight.alignment.pairs >= 7
    whole = Flight(WORN, 0, SIDEWAYS)
    whole.fly(80)
    assert whole.alignment.pairs <= 20


@pytest.mark.parametrize("seed", range(4))
def test_people_in_a_third_of_the_view_are_hardly_an_offset(seed: int) -> None:
    """A third of the landmarks walk at the middle of the view while the first pairs of a true rig are compared."""
    flight = Flight(NOTHING, seed, SIDEWAYS)
    across, still = flight.xyz[:, 0] / flight.xyz[:, 2], flight.xyz.copy()
    walks = np.abs(across - np.median(across)) < np.quantile(np.abs(across - np.median(across)), 0.35)
    for k, frame in enumerate(flight.frames(12)):
        flight.alignment.add(*frame)
        flight.xyz = still + walks[:, None] * np.array([0.01 * (k + 2), 0.0, 0.0])
    assert not flight.alignment.applied  # as that of a worn rig
    assert off_px(flight.map.disparity_offset) < 0.6 * GOOD_PX


@pytest.mark.parametrize("seed", range(4))
def test_a_true_rig_is_left_nearly_alone(seed: int) -> None:
    flight = Flight(NOTHING, seed, SIDEWAYS)
    begin = np.trace(flight.alignment.expected_cov)
    flight.fly(80)
    assert off_px(flight.map.disparity_offset) < 0.5 * GOOD_PX
    assert flight.alignment.worn < 0.05 and not flight.alignment.applied
    assert np.trace(flight.alignment.expected_cov) < 0.05 * begin


def test_rows_that_are_off_tell_of_a_worn_rig_before_it_moves() -> None:
    alignment = Flight(NOTHING, 0, SIDEWAYS).alignment
    doubtful, prior, share = alignment.expected_cov, alignment.cov, _WORN_SHARE
    assert alignment.rig_worn == pytest.approx(share)
    alignment.add_row_evidence(12.0)
    assert alignment.rig_worn > 0.999
    np.testing.assert_allclose(alignment.expected_cov, prior, rtol=1e-3)
    alignment.add_row_evidence(math.log(0.5))
    assert alignment.rig_worn == pytest.approx(0.5 * share / (0.5 * share + 1.0 - share))
    assert np.trace(alignment.expected_cov) < np.trace(doubtful)
    assert alignment.worn == pytest.approx(share)  # that of the disparities themselves


def test_disparities_and_rows_count_together() -> None:
    with_rows, alone = Flight(NOTHING, 1, SIDEWAYS), Flight(NOTHING, 1, SIDEWAYS)
    with_rows.alignment.add_row_evidence(3.0)
    with_rows.fly(30), alone.fly(30)
    ours, theirs = with_rows.alignment, alone.alignment
    odds = math.log(ours.rig_worn / (1.0 - ours.rig_worn)) - math.log(theirs.rig_worn / (1.0 - theirs.rig_worn))
    assert odds == pytest.approx(3.0, abs=1e-6)
    assert ours.worn == theirs.worn
    np.testing.assert_allclose(ours.expected_cov / ours.rig_worn, theirs.expected_cov / theirs.rig_worn)


def test_whoever_knows_more_sets_the_offset() -> None:
    flight = Flight(WORN, 0, SIDEWAYS)
    alignment, offsets = flight.alignment, flight.map
    assert alignment.take_base(0.1 * WORN, None)  # nothing was found here yet
    assert np.array_equal(offsets.disparity_offset, 0.1 * WORN)
    assert flight.fly(40)  # the base takes the rig for a good one; here it is known to be worn
    found = offsets.disparity_offset.copy()
    assert not alignment.take_base(0.1 * WORN, None)
    assert not alignment.take_base(WORN, 1.1 * alignment.sigma_px)
    assert np.array_equal(offsets.disparity_offset, found)
    assert alignment.take_base(WORN, 0.01)
    assert flight.fly(60) == []
    assert np.array_equal(offsets.disparity_offset, WORN)


def test_an_estimate_here_replaces_one_of_the_base_once_more_is_known() -> None:
    flight = Flight(WORN, 0, SIDEWAYS)
    flight.fly(40)
    before = flight.alignment.sigma_px
    assert flight.alignment.take_base(0.5 * WORN, 0.99 * before)
    for _ in range(20):  # keyframes that tell anew
        flight.alignment._begin(0)
        flight.alignment._keyframe[0] = -2
        flight.fly(40)
    assert flight.alignment.sigma_px < 0.9 * before
    assert not np.array_equal(flight.map.disparity_offset, 0.5 * WORN)


@pytest.mark.parametrize("seed", range(3))
def test_forward_motion_tells_of_a_worn_rig_that_is_far_off(seed: int) -> None:
    flight = Flight(2.0 * WORN, seed, AHEAD)
    flight.fly(80)
    assert flight.alignment.applied and not flight.alignment.is_good_offset
    left = off_px(2.0 * WORN - flight.map.disparity_offset)
    assert left < 0.3 * off_px(2.0 * WORN)


def test_in_forward_motion_many_keyframes_tell_no_more_than_a_dozen() -> None:
    found = {}
    for name, way in (("ahead", AHEAD), ("sideways", SIDEWAYS)):
        flight = Flight(NOTHING, 0, way)
        flight.fly(40)
        sigmas = []
        for n in range(1, 49):  # keyframes that tell the same
            flight.alignment._begin(0)
            flight.alignment._keyframe[0] = -1 - n
            flight.fly(40)
            sigmas.append(flight.alignment.sigma_px)
        found[name] = sigmas[-1] / sigmas[11]
    assert found["ahead"] > 0.9 and found["sideways"] < 0.6


def test_forward_motion_leaves_what_sideways_motion_told() -> None:
    flight = Flight(2.0 * WORN, 0, SIDEWAYS)
    flight.fly(60)
    before = flight.map.disparity_offset.copy()
    assert flight.alignment.applied
    flight.alignment._evicted_moved += [0.0, 0.0, 1e6]  # a long way ahead
    flight.step = AHEAD
    assert flight.fly(60) == []
    assert np.array_equal(flight.map.disparity_offset, before)


def test_forward_motion_does_not_tell_of_a_rig_that_is_worn_a_little() -> None:
    flight = Flight(WORN, 1, AHEAD)
    assert flight.fly(60)  # as far off as good calibrations may be
    assert flight.alignment.is_good_offset and flight.alignment.applied_sigma_px is None
    good_px = np.full(TERMS, GOOD_PX)
    assert np.sqrt(np.mean((flight.map.disparity_offset / good_px) ** 2)) < 3.0


@pytest.mark.parametrize(("way", "share"), [(SIDEWAYS, 0.5), (AHEAD, 0.7)])
@pytest.mark.parametrize("seed", range(3))
def test_an_offset_that_a_good_calibration_may_have_is_reduced(seed: int, way: F64, share: float) -> None:
    off = np.array([-0.15, -0.1, 0.1, -0.15, 0.0])
    flight = Flight(off, seed, way)
    assert flight.fly(80)
    assert flight.alignment.is_good_offset and not flight.alignment.applied
    left = off_px(off - flight.map.disparity_offset)
    assert left < share * off_px(off)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("way", [AHEAD, SIDEWAYS])
def test_a_small_offset_is_found_by_several_keyframes(seed: int, way: F64) -> None:
    """Where landmarks are far away, as ahead, hundredths of a pixel are percents of the depth."""
    off = np.array([0.05, 0.0, 0.0, 0.0, 0.0])
    flight = Flight(off, seed, way)
    flight.fly(40)
    for n in range(8):  # further keyframes that see the same
        flight.alignment._begin(0)
        flight.alignment._keyframe[0] = -1 - n
        flight.fly(40)
    assert flight.alignment.is_good_offset and off_px(flight.map.disparity_offset - off) < 0.6 * off_px(off)


@pytest.mark.parametrize("way", [SIDEWAYS, AHEAD])
def test_the_information_about_a_good_calibration_tells_what_its_offset_leaves(way: F64) -> None:
    """Of eight rigs: it leaves a third of the squares, and no more than the posterior by the information says."""
    px = 0.7 * GOOD_PX
    before, left, told = [], [], []
    for seed, rig in enumerate(np.random.default_rng(7).normal(0.0, px, (8, TERMS))):
        flight = Flight(rig, seed, way)
        assert not flight.alignment.good_information.any()
        flight.fly(80)
        information = flight.alignment.good_information
        assert information.any() and not flight.alignment.applied
        before.append(off_px(rig) ** 2)
        left.append(off_px(rig - flight.map.disparity_offset) ** 2)
        told.append(flight.alignment._rms_px(np.linalg.inv(np.eye(TERMS) / px**2 + information)) ** 2)
    assert np.mean(left) < 0.35 * np.mean(before) and 0.2 * np.mean(told) < np.mean(left) < np.mean(told)


def test_a_good_calibration_s_offset_begins_at_what_the_base_tells() -> None:
    off = np.array([-0.15, -0.1, 0.1, -0.15, 0.0])
    flight = Flight(off, 0, AHEAD)
    assert flight.alignment.take_base(off, None)
    flight.fly(80)
    assert off_px(flight.map.disparity_offset - off) < 0.3 * off_px(off)
    wrong = Flight(off, 0, AHEAD)
    assert wrong.alignment.take_base(-off, None)
    assert wrong.fly(80) and wrong.alignment.is_good_offset
    late = Flight(off, 0, AHEAD)
    late.fly(40)
    before = late.alignment.expected_px.copy()
    assert late.alignment.take_base(-off, None)
    assert np.array_equal(late.alignment.expected_px, before)  # the same flight tells both
    worn = Flight(off, 0, AHEAD)
    assert worn.alignment.take_base(-off, 0.05)  # a worn rig's, which the base is sure of
    assert worn.fly(80) == []


def test_forward_motion_is_believed_where_rows_are_those_of_a_worn_rig() -> None:
    for evidence, corrected in ((4.0, False), (9.0, True)):
        flight = Flight(WORN, 1, AHEAD)
        flight.alignment.add_row_evidence(evidence)
        flight.fly(60)
        assert flight.alignment.applied == corrected
        left = off_px(WORN - flight.map.disparity_offset)
        assert (left < 0.3 * off_px(WORN)) == corrected
    good = Flight(NOTHING, 1, AHEAD)
    good.alignment.add_row_evidence(9.0)
    good.fly(60)
    assert not good.alignment.applied  # disparities have to tell, too


def test_the_base_s_map_is_left_to_the_base() -> None:
    flight = Flight(WORN, 1, SIDEWAYS)
    assert flight.alignment.take_base(NOTHING, 0.001)
    assert flight.fly(80) == []
    assert flight.alignment.worn > 0.95  # the covariance knows
    assert flight.alignment._rms_px(flight.alignment.expected_cov) == pytest.approx(off_px(WORN), rel=0.2)


def test_a_good_calibration_s_offset_is_the_posterior_about_the_expected_one() -> None:
    alignment, rng = Flight(NOTHING, 0, SIDEWAYS).alignment, np.random.default_rng(1)
    half = rng.normal(0.0, 8.0, (TERMS, TERMS))
    h, told, expected = half @ half.T, rng.normal(0.0, 0.1, TERMS), rng.normal(0.0, 0.1, TERMS)
    alignment.expected_px = expected
    alignment._solve_good(h, h @ told)
    good = alignment._good.information
    posterior = np.linalg.solve(h + good, h @ told + good @ expected)
    np.testing.assert_allclose(alignment._good_estimate, posterior, atol=1e-9)
    alignment._solve_good(np.zeros_like(h), np.zeros(TERMS))
    np.testing.assert_allclose(alignment._good_estimate, expected)


def test_what_earlier_flights_found_is_where_it_begins() -> None:
    fresh, known = Flight(WORN, 2, SIDEWAYS), Flight(WORN, 2, SIDEWAYS)
    known.map.set_disparity_offset(WORN)
    known.alignment.begin_with(WORN, 0.03)
    assert np.trace(known.alignment.expected_cov) < 0.1 * np.trace(fresh.alignment.cov)  # of a rig known to be worn
    known.fly(12)
    assert off_px(WORN - known.map.disparity_offset) < 0.1


class Camera:
    """In place of CameraState: what the covariance was told, and what it held as the odometry left the map."""

    def __init__(self) -> None:
        self.covariance = self.motion = self
        self.error = np.zeros((TERMS, TERMS))
        self.forgotten = 0
        self.left: list[tuple[F64, F64]] = []

    def set_disparity_error(self, cov: F64, worn: float, good_information: F64) -> None:
        self.error, self.worn, self.good_information = cov, worn, good_information

    def correct_disparities(self, change: F64) -> None:
        self.left.append((change, self.error))

    def forget_turns(self) -> None:
        self.forgotten += 1


@pytest.mark.parametrize("seed", range(3))
def test_the_odometry_keeps_the_error_that_the_map_had(seed: int) -> None:
    flight, camera = Flight(WORN, seed, SIDEWAYS), Camera()
    lens = CameraModel(752, 480, 430.0, 430.0, 376.0, 240.0)
    rectifier = Rectifier(CameraRig(lens, lens, np.eye(4), se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0]))))
    right = RightCamera(AgentId(0), cast("Any", camera), flight.map, rectifier, AgentConfig(), NoBaseChannel(), Work())
    right.disparities = flight.alignment
    for t_ns, T, rows, seen in flight.frames(80):
        track = SimpleNamespace(T_c_m=T, rows=rows, inlier=np.ones(len(rows), np.bool_), observed=seen)
        right.add(t_ns, cast("Any", track))
    assert camera.left and camera.forgotten == sum(off_px(change) >= 0.2 for change, _ in camera.left) > 0
    for change, error in camera.left:
        assert change @ np.linalg.solve(error, change) <= 1.0  # it was within a deviation of what was found
    assert np.trace(camera.error) < 0.3 * np.trace(camera.left[0][1])  # the map is better now
    assert camera.worn == flight.alignment.rig_worn and not camera.good_information.any()


def begun(offset: F64, seed: int, way: F64) -> Flight:
    """A flight of a rig with this offset, with a rig file of a worn one."""
    flight = Flight(offset, seed, way)
    flight.map.set_disparity_offset(WORN)
    flight.alignment.begin_with(WORN, 0.03)
    return flight


def test_a_rig_that_was_repaired_is_found_anew() -> None:
    good = begun(NOTHING, 2, SIDEWAYS)
    good.fly(80)
    assert np.abs(good.map.disparity_offset).max() < 0.05
    assert good.alignment.applied_sigma_px is None and good.alignment.is_good_offset
    assert good.alignment.worn < 0.2
    bent = begun(-WORN, 2, SIDEWAYS)
    bent.fly(80)
    assert off_px(-WORN - bent.map.disparity_offset) < 0.15
    ahead = begun(NOTHING, 2, AHEAD)  # forward motion alone does not tell
    assert ahead.fly(60) == []
    assert np.array_equal(ahead.map.disparity_offset, WORN)


def test_an_offset_of_the_same_rig_is_not_refuted() -> None:
    for seed in range(4):
        flight = begun(WORN + np.random.default_rng(seed).normal(0.0, 0.1, 5), seed, SIDEWAYS)
        flight.fly(80)
        assert not any("rig file" in event for event in flight.alignment.take_events())


def test_it_is_deterministic() -> None:
    def found() -> bytes:
        flight = Flight(WORN, 3, SIDEWAYS)
        flight.fly(40)
        assert flight.map.disparity_offset.any()
        return flight.map.disparity_offset.tobytes() + flight.alignment.expected_cov.tobytes()

    assert found() == found()


@pytest.mark.parametrize("on", [True, False])
def test_it_may_be_left_to_the_base(on: bool) -> None:
    lens = CameraModel(752, 480, 430.0, 430.0, 376.0, 240.0)
    rectifier = Rectifier(CameraRig(lens, lens, np.eye(4), se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0]))))
    config = replace(AgentConfig(), disparities=DisparityAlignmentConfig(on=on))
    flight = Flight(WORN, 0, SIDEWAYS)
    right = RightCamera(AgentId(0), cast("Any", Camera()), flight.map, rectifier, config, NoBaseChannel(), Work())
    assert (right.disparities is not None) == on
