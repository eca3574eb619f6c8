"""Rows of a rolling shutter: moved to the frame's time as the true motion says, and flights that gain by it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, ReadoutConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity, StepInput
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import GRID_STEP, Rectifier
from kiteline_core.ids import AgentId
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import SimSource, open_sim

READOUT_S = 0.02
TWIST = np.array([0.8, -0.5, 0.9, 0.6, -0.7, 0.5])


def shutter(twist: F64, readout_s: float = READOUT_S) -> RollingShutter:
    rectifier = Rectifier(make_rig())
    return RollingShutter(rectifier.camera, readout_s, rectifier.camera.height, rectifier.left_grid, twist)


def test_a_pixel_is_moved_to_where_the_frame_would_show_it() -> None:
    rolling, rng = shutter(TWIST), np.random.default_rng(1)
    camera = rolling.camera
    uv = rng.uniform([20.0, 20.0], [camera.width - 20.0, camera.height - 20.0], (200, 2))
    rho = rng.uniform(0.1, 1.0, 200)
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    seen = np.column_stack([(uv - centre) / focal, np.ones(200)]) / rho[:, None]
    T_c0_ct = np.array([se3.exp(t * TWIST) for t in rolling.row_times_s(uv)])
    at_frame = np.einsum("nij,nj->ni", T_c0_ct[:, :3, :3], seen) + T_c0_ct[:, :3, 3]
    true = at_frame[:, :2] / at_frame[:, 2:] * focal + centre
    moved = rolling.to_frame(uv, rho)
    assert np.abs(moved[:, :2] - uv).max() > 5.0
    assert moved[:, :2] == pytest.approx(true, abs=0.1)  # of second order
    assert rho * moved[:, 2] == pytest.approx(1.0 / at_frame[:, 2], rel=1e-3)
    back = rolling.to_rows(moved[:, :2], rho * moved[:, 2])
    assert back[:, :2] == pytest.approx(uv, abs=0.35)


def test_rows_are_those_of_the_raw_image_and_the_middle_one_stays() -> None:
    rolling = shutter(TWIST)
    v, u = 200, 600
    times = rolling.row_times_s(np.array([[u, v], [u, 10.0], [u, 470.0]], np.float64))
    assert times[0] == pytest.approx(READOUT_S * ((rolling.grid[v // 4, u // 4, 1] + 0.5) / 480 - 0.5))
    assert times[1] < times[0] < times[2]
    assert np.abs(times).max() <= 0.5 * READOUT_S
    assert shutter(np.zeros(6)).largest_px() == pytest.approx(0.0, abs=1e-9)


Rolled = tuple[SimSource, list[Frame | ImuBatch | OdometryBatch]]


@pytest.fixture(scope="module")
def rolled() -> Rolled:
    """4 s at half size, in full motion after 2 s at rest: the source, and all that it yields."""
    source = open_sim("room", seconds=5.0, seed=5, scale=0.5, texture_bits=9, readout_s=READOUT_S)
    return source, list(source)


def step_error_m(rolled: Rolled, readout_s: float, begin: int) -> float:
    """Error rms of the motion between frames, from frame `begin` on. readout_s: as the calibration tells it."""
    source, items = rolled
    rig = replace(source.rig, left=replace(source.rig.left, readout_s=readout_s))
    config = AgentConfig(readout=ReadoutConfig(on=False))
    agent = Agent(rig, source.imu, config, Identity(AgentId(0), 0), NoBaseChannel())
    found, imu, frames, truth = [], None, 0, source.ground_truth
    for item in items:
        if isinstance(item, ImuBatch):
            imu = item
        elif isinstance(item, Frame):
            frames += 1
            if frames > begin:
                estimate = agent.step(StepInput(item, imu), item.t_ns).estimate
                assert estimate.tracked
                found.append(estimate.T_o_b)
    true = truth.T_w_b[begin:]
    moved = zip(pairwise(found), pairwise(true), strict=True)
    off = [se3.inverse(se3.inverse(c) @ d) @ se3.inverse(a) @ b for (a, b), (c, d) in moved]
    return float(np.sqrt(np.mean([np.sum(T[:3, 3] ** 2) for T in off])))


@pytest.mark.parametrize("begins", [(0,), (40, 50, 60)])
def test_a_calibrated_read_out_makes_the_motion_truer(rolled: Rolled, begins: tuple[int, ...]) -> None:
    """From rest, and from starts in motion together: there depths err too, and single starts differ by chance."""
    assert rolled[0].rig.left.readout_s == READOUT_S

    def error_m(readout_s: float) -> float:
        return float(np.hypot.reduce([step_error_m(rolled, readout_s, begin) for begin in begins]))

    assert error_m(READOUT_S) < 0.9 * error_m(0.0)


def test_disparities_are_those_of_images_exposed_at_once() -> None:
    """Rows that rectification brings together are 6 px apart in the raw images: the right one is exposed later."""
    camera, rng = shutter(TWIST).camera, np.random.default_rng(2)
    places = np.meshgrid(np.arange(0.0, camera.width, GRID_STEP), np.arange(0.0, camera.height, GRID_STEP))
    left = np.stack(places, axis=-1).astype(np.float32)
    rolling = replace(shutter(TWIST), grid=left, right_grid=left + np.array([0.0, 6.0], np.float32))
    uv = rng.uniform([150.0, 20.0], [camera.width - 20.0, camera.height - 20.0], (200, 2))
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    xyz = np.column_stack([(uv - centre) / focal, np.ones(200)]) * rng.uniform(1.5, 6.0, (200, 1))
    true = camera.bf / xyz[:, 2]
    T_c0_c1 = se3.exp(READOUT_S * 6.0 / 480 * TWIST)  # the pair, when the right row is exposed
    moved = se3.transform(se3.inverse(T_c0_c1), xyz)
    right_u = (moved[:, 0] - camera.baseline_m) / moved[:, 2] * camera.fx + camera.cx
    measured = uv[:, 0] - right_u
    assert np.abs(measured - true).max() > 0.1
    assert rolling.at_once(uv, measured) == pytest.approx(true, abs=0.02)
    assert (rolling.at_once(uv, np.full(200, -1.0)) == -1.0).all()
    assert rolling.at_once(uv, measured) is not measured
    assert shutter(TWIST).at_once(uv, measured) is measured  # one camera, or a depth camera
