"""Compile all kernels of the onboard half before the first frame, by flying a few frames of noise."""

from functools import cache

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.ekf.filter_warm import warm_filter
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging.alignment_kernels import TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.epipolar_kernels import search_segments
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.initialisation.two_view import two_view
from kiteline_agent.initialisation.window.window_kernels import add_observations
from kiteline_agent.keyframes.seed_kernels import intersect, seed_segments
from kiteline_agent.local_map.disparity_kernels import linearise_pair, move_points
from kiteline_agent.scan_config import LocalGridConfig
from kiteline_agent.scans.local_grid import LocalGrid
from kiteline_agent.scans.range_error import RangeError
from kiteline_agent.scans.scan_stage import Scanned
from kiteline_agent.step import Identity, StepInput
from kiteline_agent.tracking.shutter.readout_kernels import readout_equation
from kiteline_core.arrays import F64, U8
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier
from kiteline_core.geometry.se3 import from_rt
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.ground_warm import warm_ground
from kiteline_core.ids import AgentId
from kiteline_core.imaging.matching import match, match_near
from kiteline_core.places.place_index import PlaceIndex, Vocabulary, nodes
from kiteline_core.pose.pnp import solve_pnp

WARMING = ("kiteline_codec.warm", "kiteline_agent.runtime.warm")  # modules whose `warm` runs all kernels of an agent


@cache
def warm(config: AgentConfig | None = None) -> None:
    """Run every kernel once, on the types that flights use; once in a process for each configuration.

    config: of a flight, whose tracker's kernels do; None: those of both trackers. A filled cache makes this take a
    fraction of a second.
    """
    if config is None or config.tracker == "ekf":
        warm_filter((config or AgentConfig()).detector)
    if config is not None and config.tracker == "ekf":
        return
    # Deterministic noise, corners everywhere: s <- 1103515245 s + 12345 from s = 1 on, modulo 2^31, in closed form.
    powers = np.cumprod(np.full(240 * 320, 1103515245, np.uint64), dtype=np.uint64)
    sums = np.cumsum(np.concatenate([np.ones(1, np.uint64), powers[:-1]]), dtype=np.uint64)
    states = powers + np.uint64(12345) * sums
    pixels = (states >> np.uint64(16) & np.uint64(255)).astype(np.uint8)
    image = np.kron(pixels.reshape(240, 320)[:60, :80], np.ones((4, 4), np.uint8))
    camera = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5)
    small = CameraRig(camera, camera, np.eye(4), from_rt(np.eye(3), np.array([0.1, 0.0, 0.0])))
    right = np.ascontiguousarray(np.roll(image, -8, axis=1))
    centres = pixels[: 32 * nodes(4, 2)].view(np.uint64).reshape(-1, 4)
    vocabulary = Vocabulary(4, 2, centres, np.ones(16, np.float32))
    agent = Agent(
        small, ImuCalibration(), config or AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel(), vocabulary
    )
    for k in range(14):
        # In the last frame the image shifts by a quarter of its width: tracking fails, and the frame is relocalised.
        shift = 0 if k < 13 else -80
        pair = [np.ascontiguousarray(np.roll(one, shift, axis=1)) for one in (image, right)]
        agent.step(StepInput(Frame(k * 50_000_000, pair[0], pair[1]), _resting(k)), k * 50_000_000)
    _warm_disparities()
    _warm_readout()
    _warm_scans(small)
    _warm_relocalisation(vocabulary, pixels)
    _warm_monocular(image, pixels[:1200].reshape(3, 400).astype(np.float64) / 255.0)


def _warm_disparities() -> None:
    """A pair of frames without landmarks: the noise's frames have no parallax."""
    none, rho, system, point = np.zeros((0, 3)), np.zeros(0), np.empty((11, 12)), np.empty((0, 12))
    linearise_pair(np.zeros((0, 2)), rho, rho, none, np.eye(4), np.ones(5), np.zeros(5), rho, system, point)
    move_points(point, np.zeros(11), 0.0, rho)


def _warm_readout() -> None:
    """A frame without landmarks: the noise's camera does not turn."""
    none, keyframe = np.zeros((0, 2)), np.zeros((1, 1))
    readout_equation(
        np.eye(4), np.ones(5), 1.0, NO_GRID, np.zeros(6), np.zeros(0, np.int64), none, np.zeros(0, np.uint8),
        np.zeros((0, 2, 2)), none, np.eye(4)[None], np.zeros((1, 1, 2)), keyframe, np.zeros((1, 6)),
    )  # fmt: skip


def _warm_scans(rig: CameraRig) -> None:
    """A scan over level ground with a wall behind it, drawn and read."""
    segmenter, scan = warm_ground(Rectifier(rig).camera)
    grid = LocalGrid(LocalGridConfig())
    error = RangeError.of_noise(segmenter.camera.bf, segmenter.surface_sigma_px)
    grid.add(Scanned(scan, np.eye(4), 1.0, np.zeros(5)), error)
    grid.around(np.eye(4), None, {}, GroundConfig().bands_m)


def _warm_relocalisation(vocabulary: Vocabulary, noise: U8) -> None:
    """A place looked up, descriptors matched, and a pose from points, on 40 corners of noise."""
    descriptor, angle = noise[:1280].reshape(40, 32).copy(), np.zeros(40, np.uint8)
    places = PlaceIndex(vocabulary)
    for key in (0, 1):
        places.add(key, descriptor)
    places.query(descriptor)
    places.remove(0)
    match(descriptor, angle, descriptor, angle)
    points = noise[1280:1400].reshape(40, 3) / 128.0 + np.array([-1.0, -1.0, 2.0])
    observed = np.column_stack([100.0 * points[:, :2] / points[:, 2:] + 150.0, np.full(40, -1.0)])
    camera = np.array([100.0, 100.0, 150.0, 150.0, 10.0])
    flat = np.zeros(40, np.uint8)
    solve_pnp(points, np.zeros((40, 3)), observed, flat, camera, 0)
    uv = np.ascontiguousarray(observed[:, :2])
    match_near(
        uv, np.full(40, 4.0), np.zeros(40), descriptor, uv, flat, descriptor, (320, 240), 1.2
    )  # fmt: skip


def _resting(k: int) -> ImuBatch:
    """Inertial samples of a standing vehicle between frames k - 1 and k."""
    t_ns = np.arange(k * 50_000_000 - 45_000_000, k * 50_000_000 + 1, 5_000_000, dtype=np.int64)
    return ImuBatch(t_ns, np.zeros((10, 3)), np.tile([0.0, 0.0, 9.81], (10, 1)))


def _warm_monocular(image: U8, draw: F64) -> None:
    """Both starts, on a cloud of points (3,n) drawn from 0 to 1 and on one point, and the search of a seed."""
    x, y, z = draw[0] - 0.5, draw[1] - 0.5, 1.0 + draw[2]
    a, b = (np.column_stack([200.0 * (x - shift) / z + 159.5, 200.0 * y / z + 119.5]) for shift in (0.0, 0.2))
    two_view(a, b, np.array([200.0, 200.0, 159.5, 119.5]), 0)
    one, two, three, turn = np.ones((1, 1)), np.zeros((1, 1, 2)), np.zeros((1, 3)), np.eye(3)
    add_observations(
        two, two, one, 1.0, three[None], one, turn, turn[None], three, three[0], one[0], three, turn[None],
        np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros((1, 3, 14)), np.zeros((14, 14)), np.zeros(14),
    )  # fmt: skip
    place = np.array([[160.0, 120.0]])
    templates = np.zeros((1, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
    search_segments(
        build_pyramid(image, 4), NO_GRID, templates, np.zeros(1, np.int64), np.zeros(1, np.uint8), np.eye(2)[None],
        place, place + 5.0, 0.7, 40, 0.7, 0.9, place.copy(), np.zeros(1, np.int8),
    )  # fmt: skip
    ray, mean = np.ones((1, 3)), np.ones(1)
    seed_segments(
        np.eye(4), np.ones(5), np.zeros(1, np.int64), np.eye(4)[None], np.zeros((1, 1, 2)), mean, mean, 1.0, 2.0, ray,
        ray.copy(), place.copy(), place.copy(),
    )  # fmt: skip
    intersect(ray, ray, place, np.zeros(1, np.uint8), np.ones(5), 1.0, mean, mean.copy(), mean.copy())
