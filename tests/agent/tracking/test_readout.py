"""A read-out that no calibration says: found from turning views, and never where the shutter is a global one."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, LocalMapConfig, ReadoutConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.local_map.projection_kernels import views
from kiteline_agent.step import Identity, StepInput
from kiteline_agent.tracking.shutter.readout import BLOCK_SIGMA_S, MOST_S, ReadoutEstimate
from kiteline_agent.tracking.shutter.readout_kernels import readout_equation, row_shift
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_agent.tracking.shutter.shutter_stage import ShutterStage
from kiteline_agent.tracking.track import track_without_landmarks
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3, tum
from kiteline_core.geometry.cameras import RectifiedCamera, Rectifier
from kiteline_core.ids import AgentId, submap_id
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import open_sim

CAMERA = np.array([400.0, 410.0, 320.0, 240.0, 40.0])
HEIGHT = 480
RNG = np.random.default_rng


def test_a_row_s_shift_is_that_of_the_rolling_shutter() -> None:
    rectifier = Rectifier(make_rig())
    camera, grid, twist = rectifier.camera, rectifier.left_grid, np.array([0.8, -0.5, 0.9, 0.6, -0.7, 0.5])
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    uv = RNG(1).uniform([20.0, 20.0], [camera.width - 20.0, camera.height - 20.0], (50, 2))
    rho = RNG(2).uniform(0.1, 1.0, 50)
    shutter = RollingShutter(camera, 1e-6, camera.height, grid, twist)
    expected = (shutter.to_rows(uv, rho)[:, :2] - uv) / 1e-6
    found = [
        row_shift(u, v, p, twist, intrinsics, float(camera.height), grid) for (u, v), p in zip(uv, rho, strict=True)
    ]
    assert np.array(found) == pytest.approx(expected, rel=1e-3, abs=0.05)


def equation(readout_s: float, seed: int, moved: bool = True, pixel_noise: float = 0.0) -> tuple[float, float]:
    """The equation of a frame that sees landmarks of four keyframes, all through a shutter of this read-out.

    moved: the keyframes' poses are off by what shutters do to poses.
    """
    rng = RNG(seed)
    slots, n = 4, 40
    camera = RectifiedCamera(640, HEIGHT, 400.0, 410.0, 320.0, 240.0, 0.1, False, np.eye(4))
    T_m_k = np.array([se3.exp(rng.normal(0.0, 0.1, 6)) for _ in range(slots)])
    twists = rng.normal(0.0, 1.0, (slots, 6))
    twists[0] = np.nan  # of an image whose motion nothing told
    twist = rng.normal(0.0, 1.0, 6)
    uv = rng.uniform([60.0, 60.0], [580.0, 420.0], (slots, n, 2))
    rho = rng.uniform(0.2, 0.6, (slots, n))
    focal, centre = CAMERA[:2], CAMERA[2:4]
    rows, observed, T_c_m = np.arange(slots * n), np.empty((slots, n, 2)), np.eye(4)
    for k in range(slots):
        seen = np.column_stack([(uv[k] - centre) / focal, np.ones(n)]) / rho[k, :, None]
        p = seen @ T_m_k[k, :3, :3].T + T_m_k[k, :3, 3]
        in_frame = p[:, :2] / p[:, 2:] * focal + centre
        shutter = RollingShutter(camera, readout_s, HEIGHT, None, twist)
        observed[k] = shutter.to_rows(in_frame, 1.0 / p[:, 2])[:, :2] + rng.normal(0.0, pixel_noise, (n, 2))
        if k:
            uv[k] = RollingShutter(camera, readout_s, HEIGHT, None, twists[k]).to_rows(uv[k], rho[k])[:, :2]
        if moved:
            T_m_k[k] = T_m_k[k] @ se3.exp(rng.normal(0.0, 0.005, 6))
    bearing = (uv - centre) / focal
    warp, parallax = np.empty((slots * n, 2, 2)), np.empty((slots * n, 2))
    views(T_c_m, CAMERA, rows, T_m_k, bearing, rho, np.zeros((slots, n, 2)), warp, parallax)
    information, gradient = readout_equation(
        T_c_m, CAMERA, float(HEIGHT), NO_GRID, twist, rows, observed.reshape(-1, 2), np.zeros(slots * n, np.uint8),
        warp, parallax, T_m_k, bearing, rho, twists,
    )  # fmt: skip
    return information, gradient


@pytest.mark.parametrize("readout_s", [0.0, 0.004, -0.004])
def test_an_equation_tells_the_read_out_whatever_the_keyframes_poses(readout_s: float) -> None:
    for moved in (False, True):
        information, gradient = np.sum([equation(readout_s, seed, moved, 0.3) for seed in range(10)], axis=0)
        assert gradient / information == pytest.approx(readout_s, abs=4e-4)
        assert information > 1.0 / 0.001**2  # known to better than 1 ms by 1 px


def test_without_the_motion_of_keyframes_nothing_is_told() -> None:
    information, gradient = readout_equation(
        np.eye(4), CAMERA, float(HEIGHT), NO_GRID, np.ones(6), np.arange(40), np.zeros((40, 2)),
        np.zeros(40, np.uint8), np.zeros((40, 2, 2)), np.zeros((40, 2)), np.eye(4)[None], np.zeros((1, 40, 2)),
        np.ones((1, 40)), np.full((1, 6), np.nan),
    )  # fmt: skip
    assert information == gradient == 0.0


def changes(estimate: ReadoutEstimate, true_s: float, scatter_s: float, blocks: int) -> list[float]:
    """What the estimate changes while blocks scatter about the true read-out."""
    rng, information = RNG(5), BLOCK_SIGMA_S**-2
    out = []
    for _ in range(blocks):
        off = true_s - estimate.readout_s + rng.normal(0.0, scatter_s)
        for _ in range(4):  # frames
            out.append(estimate.add(0.26 * information, 0.26 * information * off))
    return [change for change in out if change]


def test_a_rolling_shutter_is_found_and_then_refined() -> None:
    estimate = ReadoutEstimate(0.0)
    found = changes(estimate, 0.02, 0.003, 40)
    assert sum(found) == pytest.approx(estimate.readout_s)
    assert estimate.readout_s == pytest.approx(0.02, abs=0.003)
    assert estimate.sigma_s is not None and estimate.sigma_s < 0.003
    assert len(found) <= 4


@pytest.mark.parametrize(("bias_s", "scatter_s"), [(0.0, 0.004), (0.002, 0.001), (-0.003, 0.012)])
def test_errors_of_a_global_shutter_s_lens_are_no_read_out(bias_s: float, scatter_s: float) -> None:
    estimate = ReadoutEstimate(0.0)
    assert changes(estimate, bias_s, scatter_s, 100) == []
    assert estimate.sigma_s is None


def test_a_read_out_of_an_earlier_flight_is_where_the_next_one_begins() -> None:
    estimate = ReadoutEstimate(0.02, 0.0005)
    assert changes(estimate, 0.021, 0.002, 40) == []  # it agrees
    assert (estimate.readout_s, estimate.sigma_s) == (0.02, 0.0005)
    assert estimate.settled


def test_a_read_out_of_an_earlier_flight_that_is_refuted_no_longer_counts() -> None:
    estimate = ReadoutEstimate(0.02, 0.0005)
    first, *_ = changes(estimate, 0.01, 0.001, 8)
    assert first == pytest.approx(-0.01, abs=0.002)


def test_a_read_out_is_no_longer_than_between_two_images() -> None:
    estimate = ReadoutEstimate(0.0)
    changes(estimate, 0.5, 0.001, 40)
    assert estimate.readout_s == MOST_S


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A camera that nods and pans: a trajectory file of 8 s."""
    t_s = np.arange(0.0, 9.0, 0.02)
    pan, nod = 0.5 * np.sin(4.1 * t_s), 0.3 * np.sin(5.3 * t_s)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    for T, a, b in zip(poses, pan, nod, strict=True):
        T[:3, :3] = se3.so3_exp(np.array([0.0, 0.0, a])) @ se3.so3_exp(np.array([0.0, b, 0.0]))
    poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = 0.3 * np.sin(1.3 * t_s), 0.3 * np.sin(0.9 * t_s), 1.5
    file = tmp_path_factory.mktemp("turning") / "turning.txt"
    file.write_text("".join(tum.line(int(1e9 * t), T) for t, T in zip(t_s, poses, strict=True)))
    return str(file)


def test_the_window_of_one_camera_and_an_imu_finds_it_before_there_is_a_map() -> None:
    source = open_sim("room", seconds=6.0, start=3.0, seed=5, scale=0.5, texture_bits=9, readout_s=0.02, mono=True)
    rig = replace(source.rig, left=replace(source.rig.left, readout_s=0.0))
    agent = Agent(rig, source.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    imu, events = None, list[str]()
    for item in source:
        if isinstance(item, ImuBatch):
            imu = item
        elif isinstance(item, Frame) and agent.motion_reports()["readout"] is None:
            output = agent.step(StepInput(item, imu), item.t_ns)
            assert output.estimate is None or not output.estimate.tracked
            events += output.events
    assert agent.motion_reports()["readout"]["ms"] == pytest.approx(20.0, abs=5.0)
    assert any(event.startswith("rolling shutter: ") for event in events)


def flown(turning: str, readout_s: float, told_s: float, seconds: float) -> tuple[Agent, F64, F64]:
    """The agent after a flight, its poses and the true ones, (n,4,4)."""
    source = open_sim(
        "room", trajectory=turning, seconds=seconds, seed=5, scale=0.5, texture_bits=9, readout_s=readout_s
    )
    rig = replace(source.rig, left=replace(source.rig.left, readout_s=told_s))
    agent = Agent(rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    poses = [
        agent.step(StepInput(item), item.t_ns).estimate.T_o_b  # type: ignore[union-attr]
        for item in source if isinstance(item, Frame)
    ]  # fmt: skip
    return agent, np.array(poses), source.ground_truth.T_w_b


def test_a_flight_finds_the_read_out(turning: str) -> None:
    agent, _, _ = flown(turning, 0.02, 0.0, 8.0)
    found = agent.motion_reports()["readout"]
    assert found is not None
    assert found["ms"] == pytest.approx(20.0, abs=5.0)


def test_a_flight_with_a_global_shutter_finds_none(turning: str) -> None:
    agent, _, _ = flown(turning, 0.0, 0.0, 8.0)
    assert agent.motion_reports()["readout"] is None


def test_a_calibrated_read_out_stays(turning: str) -> None:
    agent, _, _ = flown(turning, 0.02, 0.012, 2.0)
    assert agent.motion_reports()["readout"] is None


def test_a_map_that_the_base_moves_is_no_motion_of_the_camera() -> None:
    """A correction moves it by a pixel or two at once, as a fifth of a usual turn does in a frame."""
    rectifier, step = Rectifier(make_rig()), se3.exp(np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.015]))
    local_map, submap = LocalMap(rectifier.camera, LocalMapConfig()), submap_id(0, 1, 0)
    stage = ShutterStage(local_map, rectifier, ReadoutConfig(), lambda *_: None, lambda: False)
    T_o_c, T_o_m, twists = np.eye(4), np.eye(4), []
    for number in range(6):
        if number == 3:
            T_o_m = se3.exp(np.array([0.02, 0.0, -0.01, 0.004, 0.003, -0.002]))
        ctx: Any = SimpleNamespace(number=number, t_ns=50_000_000 * number)
        track = track_without_landmarks(se3.inverse(T_o_c) @ T_o_m, 100)
        assert stage.measure(ctx, track, submap, T_o_m) == []
        twists.append(stage._measured)
        T_o_c = T_o_c @ step
    assert twists[0] is None
    assert twists[1:] == [pytest.approx(se3.log(step) / 0.05)] * 5
