"""An IMU that measures something else than the images: it is left, and the images alone carry the pose."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.inertial.calibration.disagreement import Disagreement
from kiteline_agent.inertial.gravity_alignment import level_rotation, up_of
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch, joined
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics
from tests.agent.room_flight import RoomFlight


def fly(flight: RoomFlight, T_b_c: F64) -> tuple[list[Estimate], list[str], float]:
    """Estimates, events, and the worst error in m of a camera position, from the first one on.

    T_b_c: (4,4) true place of the camera in the axes in which the truth is given.
    """
    _, found, events = flown(flight)
    camera, truth = np.array([e.T_o_b for e in found]) @ flight.rig.T_b_c, flight.truth @ T_b_c
    aligned = truth[0] @ se3.inverse(camera[0]) @ camera
    return found, events, float(np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1).max())


def flown(flight: RoomFlight) -> tuple[Agent, list[Estimate], list[str]]:
    """The agent at the end of a flight, its estimates and events."""
    agent = Agent(flight.rig, flight.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    found, events, felt, begin = list[Estimate](), list[str](), flight.samples, 0
    for frame in flight.frames:
        end = int(np.searchsorted(felt.t_ns, frame.t_ns, side="right"))
        imu = ImuBatch(felt.t_ns[begin:end], felt.gyro[begin:end], felt.accel[begin:end])
        output, begin = agent.step(StepInput(frame, imu), frame.t_ns), end
        assert output.estimate is not None
        found.append(output.estimate)
        events += output.events
    return agent, found, events


def turned(flight: RoomFlight, axis: int, degrees: float) -> RoomFlight:
    """The camera is said to be turned in the axes of the IMU."""
    turn = se3.from_rt(se3.so3_exp(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))
    return replace(flight, rig=replace(flight.rig, T_b_c=turn @ flight.rig.T_b_c))


def inverted(flight: RoomFlight) -> RoomFlight:
    return replace(flight, rig=replace(flight.rig, T_b_c=se3.inverse(flight.rig.T_b_c)))


def measuring(flight: RoomFlight, gyro: float = 1.0, accel: float = 1.0) -> RoomFlight:
    s = flight.samples
    return replace(flight, samples=ImuBatch(s.t_ns, gyro * s.gyro, accel * s.accel))


def late(flight: RoomFlight, ns: int) -> RoomFlight:
    return replace(flight, samples=replace(flight.samples, t_ns=flight.samples.t_ns + ns))


WRONG: dict[str, Callable[[RoomFlight], RoomFlight]] = {
    "camera turned by 90 degrees": lambda flight: turned(flight, 2, 90.0),
    "T_BS inverted": inverted,
    "rates in degrees": lambda flight: measuring(flight, gyro=57.3),
    "a dead gyro": lambda flight: measuring(flight, gyro=0.0),
}
IN_A_FAST_FLIGHT: dict[str, Callable[[RoomFlight], RoomFlight]] = {
    "forces of the other sign": lambda flight: measuring(flight, accel=-1.0),
    "0.2 s early": lambda flight: late(flight, -200_000_000),
}


FOUND: dict[str, Callable[[RoomFlight], RoomFlight]] = {
    "camera turned by 5 degrees": lambda flight: turned(flight, 2, 5.0),
    "camera turned by 15 degrees": lambda flight: turned(flight, 0, 15.0),
    "0.1 s late": lambda flight: late(flight, 100_000_000),
    "0.1 s early": lambda flight: late(flight, -100_000_000),
    "turned by 6 degrees, 40 ms late": lambda flight: turned(late(flight, 40_000_000), 1, 6.0),
}


@pytest.fixture(scope="module")
def fast_flight(data_dir: Path) -> RoomFlight:
    """5 s of a recording with fast turns."""
    source = open_source(str(data_dir / "room_flight.mcap"))
    frames, samples = list[Frame](), list[ImuBatch]()
    for item in source:
        if isinstance(item, Frame):
            frames.append(item)
        elif isinstance(item, ImuBatch):
            samples.append(item)
        if len(frames) == 100:
            break
    assert source.imu is not None and source.ground_truth is not None
    felt, (known, truth) = joined(samples), metrics.truth_at(np.array([f.t_ns for f in frames]), source.ground_truth)
    assert felt is not None and len(known) == len(frames)
    empty = (np.zeros((0, *shape)) for shape in ((3,), (3,), (3, 3), (3, 3)))
    no_odometry = OdometryBatch(np.zeros(0, np.int64), *empty)
    return RoomFlight(source.rig, source.imu, frames, felt, no_odometry, truth)


@pytest.mark.parametrize("what", WRONG)
def test_the_images_alone_carry_the_pose(room_flight: RoomFlight, what: str) -> None:
    """Where the IMU is believed, the pose is metres off, or a hundred, and said to be tracked."""
    assert_images_alone(*fly(WRONG[what](room_flight.first(3.0)), room_flight.rig.T_b_c))


@pytest.mark.parametrize("what", IN_A_FAST_FLIGHT)
def test_the_images_alone_carry_the_pose_of_a_fast_flight(fast_flight: RoomFlight, what: str) -> None:
    assert_images_alone(*fly(IN_A_FAST_FLIGHT[what](fast_flight), fast_flight.rig.T_b_c))


@pytest.mark.parametrize("what", FOUND)
def test_a_calibration_that_can_be_estimated_is_found_and_used(fast_flight: RoomFlight, what: str) -> None:
    """Where it is believed as told, or the IMU is left, the pose errs by up to decimetres or the vertical is lost."""
    found, events, worst_m = fly(FOUND[what](fast_flight), fast_flight.rig.T_b_c)
    assert any("used from now on" in event for event in events)
    assert not any("contradicts the images" in event for event in events)
    assert worst_m < 0.05 and all(estimate.tracked for estimate in found)
    wrong, last = FOUND[what](fast_flight), found[-1]
    assert last.R_l_o is not None
    up = (last.R_l_o @ last.T_o_b[:3, :3] @ wrong.rig.T_b_c[:3, :3])[2]
    true_up = (fast_flight.truth[-1, :3, :3] @ fast_flight.rig.T_b_c[:3, :3])[2]
    assert np.degrees(np.arccos(up @ true_up)) < 2.0, "a flight controller flies by this vertical"


@pytest.mark.parametrize("late_ms", [100, 130])
def test_samples_that_come_frames_late_tell_the_vertical(fast_flight: RoomFlight, late_ms: int) -> None:
    """Held in their places, forces of two frames before turned it by 15 degrees in 20 s, told as 0.6."""
    agent, found, _ = flown(late(fast_flight, late_ms * 1_000_000))
    tracker = agent._camera.motion.tracker
    assert tracker is not None and tracker.state is not None
    up, sigma_rad = up_of(tracker.state)
    off_rad = np.arccos(np.clip(up @ fast_flight.truth[len(found) - 1, 2, :3], -1.0, 1.0))
    assert off_rad < 3.0 * sigma_rad and sigma_rad < np.radians(0.7)


def assert_images_alone(found: list[Estimate], events: list[str], worst_m: float) -> None:
    assert sum("contradicts the images" in event for event in events) == 1
    assert worst_m < 0.05 and all(estimate.tracked for estimate in found)
    assert found[-1].R_l_o is None, "a flight controller would fly by a vertical that such an IMU gave"
    assert any("the vertical is not known" in event for event in events)


def test_an_imu_that_breaks_in_flight_leaves_the_vertical(room_flight: RoomFlight) -> None:
    """It had agreed with the images before; the odometry frame stays upright without it."""
    s = room_flight.samples
    broken = np.where((s.t_ns > s.t_ns[0] + 4_000_000_000)[:, None], [0.9, -0.7, 0.8], s.gyro)
    found, events, worst_m = fly(replace(room_flight, samples=replace(s, gyro=broken)), room_flight.rig.T_b_c)
    assert sum("contradicts the images" in event for event in events) == 1
    assert not any("vertical" in event for event in events)
    assert worst_m < 0.1 and found[-1].R_l_o is not None


def test_a_sound_imu_is_kept(room_flight: RoomFlight) -> None:
    _, events, worst_m = fly(room_flight, room_flight.rig.T_b_c)
    assert worst_m < 0.03 and not any(event.startswith("imu:") for event in events)


def test_a_large_bias_of_the_gyro_is_no_contradiction(room_flight: RoomFlight) -> None:
    biased = replace(room_flight.samples, gyro=room_flight.samples.gyro + [0.3, -0.2, 0.1])
    _, events, worst_m = fly(replace(room_flight, samples=biased), room_flight.rig.T_b_c)
    assert worst_m < 0.03 and not any(event.startswith("imu:") for event in events)


def test_an_accelerometer_that_gives_zeros_tells_no_vertical(room_flight: RoomFlight) -> None:
    found, _, worst_m = fly(measuring(room_flight, accel=0.0), room_flight.rig.T_b_c)
    assert worst_m < 0.1 and all(np.isfinite(estimate.T_o_b).all() for estimate in found)
    np.testing.assert_array_equal(level_rotation(np.zeros(3)), np.eye(3))


def test_old_windows_are_forgotten_and_noise_tells_nothing() -> None:
    compared = Disagreement(memory_s=1.0, least=0.01, most_share=0.1, most_bias=1.0)
    nothing, large = np.zeros(3), np.array([0.3, 0.0, 0.0])
    compared.add(nothing, 0.8 * large, 0.0, 0.25)  # the bias is not known yet
    compared.add(nothing, 0.5 * large, 0.0075, 0.25)
    assert not compared.contradicts and not compared.moves
    compared.add(large, large, 0.0, 0.25)
    assert compared.contradicts and compared.share == pytest.approx(0.9, abs=0.02)
    for _ in range(20):
        compared.add(large, 0.1 * large, 0.0, 0.25)
    assert not compared.contradicts and compared.agrees and compared.moves
