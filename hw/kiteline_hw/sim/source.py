"""`sim:SCENE[?key=value&…]`: a flight through a simulated world, rendered while it is read."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from kiteline_core import odometry
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig, Lens
from kiteline_hw.ports import FrameSource, SourceError, SourceReport
from kiteline_hw.sim.config import SimConfig, read_config
from kiteline_hw.sim.sensors import imu as inertial
from kiteline_hw.sim.sensors import odometer
from kiteline_hw.sim.sensors.lens import imperfect, make_rig
from kiteline_hw.sim.sensors.render import Eye
from kiteline_hw.sim.world.paths import built_in, course_length_s
from kiteline_hw.sim.world.scenes import build_indoor
from kiteline_hw.sim.world.street import build_street
from kiteline_hw.sim.world.trajectory import Motion, Path, flight_s, read_trajectory, to_trajectory
from kiteline_hw.sim.world.world import World
from kiteline_hw.sources.overrides import SourceView

F64 = NDArray[np.float64]

START_NS = 1_000_000_000  # stamp of flight time zero
FRAME_NS = 50_000_000  # 20 Hz
IMU_NS = 5_000_000  # 200 Hz


def open_sim(scene: str, workers: int = 1, **options: object) -> SimSource:
    """A simulated flight. `scene` may carry options as in `hall?seed=3&seconds=20&trajectory=F&mono=1`.

    options: fields of SimConfig. workers > 1 renders ahead in threads; the frames stay the same. Raises SourceError.
    """
    return SimSource(read_config(scene, **options), workers)


def open_source(scene: str, mono: bool, imu: bool) -> FrameSource:
    """A simulated flight as an entry of the table of sources. Raises SourceError."""
    source = open_sim(scene, mono=True) if mono else open_sim(scene)
    return source if imu and not mono else SourceView(source, mono, imu)


def build_world(config: SimConfig, camera_in_body: F64) -> World:
    """The world of a configuration; it depends on scene, seed and whole trajectories, not on what is flown of them."""
    files = (config.trajectory, *config.also)
    points = []
    for agent, file in enumerate(files):
        if file:
            points.append(read_trajectory(FilePath(file), camera_in_body).positions())
        else:
            points.append(built_in(config.scene, course_length_s(config.scene), camera_in_body, agent).positions())
    cloud = np.concatenate(points)
    if config.scene == "street":
        return build_street(cloud, config.seed, config.texture_bits)
    return build_indoor(config.scene, cloud, config.seed, config.texture_bits)


class SimSource:
    """A FrameSource of a simulated flight. `world` holds the truth about the solids."""

    def __init__(self, config: SimConfig, workers: int = 1, world: World | None = None) -> None:
        self.config = config
        stereo = not (config.mono or config.depth)
        self._rig = make_rig(Lens(config.lens), stereo, config.depth, config.baseline, config.scale)
        rng = np.random.default_rng([config.seed * 64 + config.agent, 41])
        self._true_rig = imperfect(self._rig, rng, config.miscalibration)
        self.path = self._choose_path()
        self.world = world if world is not None else build_world(config, self._rig.T_b_c)
        seconds = self.path.duration_s if not config.seconds else min(config.seconds, self.path.duration_s)
        self._frames = int(seconds * 1e9) // FRAME_NS + (1 if not config.seconds else 0)
        if self._frames < 1:
            raise SourceError(f"a flight of {seconds:.2f} s has no frame: expected at least {FRAME_NS * 1e-9} s")
        self._stamps = START_NS + FRAME_NS * np.arange(self._frames, dtype=np.int64)
        self._motion: Motion = self.path.motion(flight_s(self._stamps, START_NS))
        self._gains = _gains(self._frames, config.seed * 64 + config.agent)
        self._workers = workers
        self._report = SourceReport()
        self._truth: Trajectory | None = None

    def _choose_path(self) -> Path:
        c = self.config
        file = (c.trajectory, *c.also)[c.agent]
        if file:
            path = read_trajectory(FilePath(file), self._rig.T_b_c)
            if c.start >= path.length_s - 0.5:
                raise SourceError(f"start {c.start} s lies behind the end of {file}, which lasts {path.length_s:.1f} s")
        else:
            path = built_in(c.scene, (c.seconds or 20.0) + c.start, self._rig.T_b_c, c.agent)
        end = path.length_s if file else (c.seconds or 20.0) + c.start
        return Path(path.coefficients, path.knot_s, end, c.start, c.rest)

    @property
    def name(self) -> str:
        """What this is, for logs."""
        return f"sim:{self.config.scene}?seed={self.config.seed}"

    @property
    def rig(self) -> CameraRig:
        """The cameras on the vehicle."""
        return self._rig

    @property
    def imu(self) -> ImuCalibration | None:
        """Noise of the simulated inertial unit, or None without one."""
        return ImuCalibration(rate_hz=1e9 / IMU_NS) if self.config.imu else None

    @property
    def ground_truth(self) -> Trajectory | None:
        """True body poses at the stamps of the frames."""
        if self._truth is None:
            self._truth = to_trajectory(self.path, self._stamps, START_NS)
        return self._truth

    @property
    def report(self) -> SourceReport:
        """Always empty: nothing of a simulated flight is passed over."""
        return self._report

    @property
    def frame_count(self) -> int | None:
        """How many frames will come."""
        return self._frames

    def inertial(self) -> ImuBatch:
        """All inertial samples of the flight at once."""
        stamps = np.arange(START_NS, int(self._stamps[-1]) + 1, IMU_NS, dtype=np.int64)
        calibration = ImuCalibration(rate_hz=1e9 / IMU_NS)
        return inertial.measure(self.path, stamps, START_NS, calibration, self.config.seed * 64 + self.config.agent)

    def odometry(self) -> OdometryBatch | None:
        """All that the odometer measures on the flight, or None without one."""
        if self.config.odometry <= 0.0:
            return None
        stamps = np.arange(START_NS, int(self._stamps[-1]) + 1, round(1e9 / self.config.odometry), dtype=np.int64)
        return odometer.measure(self.path, stamps, START_NS, self.config, self._rig.T_b_c)

    def eyes(self) -> list[Eye]:
        """Fresh cameras in the world, left first."""
        rig = self._true_rig
        left = [Eye(self.world, rig.left, rig.T_b_c)]
        if rig.right is None or rig.T_c_r is None:
            return left
        return [*left, Eye(self.world, rig.right, rig.T_b_c @ rig.T_c_r)]

    def render(self, k: int, eyes: list[Eye]) -> Frame:
        """Frame k of the flight, whatever was rendered before."""
        c = self.config
        pose, velocity, rate = self._motion.T_w_b[k], self._motion.velocity[k], self._motion.rate[k]
        noise = (c.read_noise, c.shot_noise)
        images = []
        for side, eye in enumerate(eyes):
            gain = float(self._gains[k]) * (1.0, 0.97)[side]
            key = (((c.seed * 64 + c.agent) << 36) + (2 * k + side) * 0xD1342543DE82) & ((1 << 63) - 1)
            images.append(eye.see(pose, velocity, rate, c.exposure_s, gain, noise, key))
        right = images[1] if len(images) > 1 else None
        return Frame(int(self._stamps[k]), images[0], right, eyes[0].depth() if c.depth else None)

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        batch, driven = self.inertial() if self.config.imu else None, self.odometry()
        done = driven_done = 0
        for frame in self._images():
            if batch is not None:
                end = int(np.searchsorted(batch.t_ns, frame.t_ns, side="right"))
                yield ImuBatch(batch.t_ns[done:end], batch.gyro[done:end], batch.accel[done:end])
                done = end
            if driven is not None:
                end = int(np.searchsorted(driven.t_ns, frame.t_ns, side="right"))
                if end > driven_done:
                    yield odometry.chosen(driven, slice(driven_done, end))
                driven_done = end
            yield frame

    def _images(self) -> Iterator[Frame]:
        if self._workers <= 1:
            eyes = self.eyes()
            for k in range(self._frames):
                yield self.render(k, eyes)
            return
        free = deque(self.eyes() for _ in range(self._workers))

        def work(k: int) -> Frame:
            eyes = free.popleft()
            try:
                return self.render(k, eyes)
            finally:
                free.append(eyes)

        waiting: deque[Future[Frame]] = deque()
        with ThreadPoolExecutor(self._workers) as pool:
            for k in range(self._frames):
                waiting.append(pool.submit(work, k))
                if len(waiting) > 2 * self._workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def close(self) -> None:
        """Nothing to release."""


def _gains(frames: int, seed: int) -> F64:
    """Grey values per unit of radiance: slow drift of the exposure, and a step up or down every ten seconds or so."""
    rng = np.random.default_rng([seed, 29])
    phase = rng.uniform(0, 2 * np.pi, 2)
    t = np.arange(frames) * FRAME_NS * 1e-9
    drift = 0.10 * np.sin(2 * np.pi * t / 11.0 + phase[0]) + 0.05 * np.sin(2 * np.pi * t / 3.7 + phase[1])
    draws = rng.random((frames, 2))
    steps = np.where(draws[:, 0] < FRAME_NS * 1e-9 / 10.0, np.where(draws[:, 1] < 0.5, -0.18, 0.18), 0.0)
    level = np.zeros(frames)
    value = 0.0
    for k in range(frames):
        value = 0.985 * value + steps[k]  # auto-exposure pulls a step back within seconds
        level[k] = value
    return np.asarray(185.0 * np.exp(drift + level))
