"""`sim:SCENE[?key=value&…]`: a flight through a simulated world, rendered while it is read."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from pathlib import Path as FilePath

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64, U8
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig, Lens
from kiteline_hw.ports import FrameSource, SourceError, SourceReport
from kiteline_hw.sim.config import SimConfig, read_config, seed_of_agent
from kiteline_hw.sim.sensors import imu as inertial
from kiteline_hw.sim.sensors import odometer, wear
from kiteline_hw.sim.sensors.camera import LAMP_HZ, Shutter, SimCamera
from kiteline_hw.sim.sensors.rig import HEIGHT_PX, WIDTH_PX, make_rig, perturb
from kiteline_hw.sim.world.actors import make_actors
from kiteline_hw.sim.world.built_in_paths import built_in_path, lap_s
from kiteline_hw.sim.world.floors import with_floor
from kiteline_hw.sim.world.objects import with_objects
from kiteline_hw.sim.world.path import Motion, Path, flight_s, to_trajectory
from kiteline_hw.sim.world.path_fit import read_trajectory
from kiteline_hw.sim.world.scenes import build_indoor
from kiteline_hw.sim.world.street import build_street
from kiteline_hw.sim.world.surfaces import with_difficult_surfaces
from kiteline_hw.sim.world.world import World
from kiteline_hw.sources.overrides import SourceView

START_NS = 1_000_000_000  # stamp of flight time zero


def open_sim(scene: str, workers: int = 1, **options: object) -> "SimSource":
    """A simulated flight. scene: with options, as in `hall?seed=3&seconds=20&trajectory=F&mono=1`.

    options: fields of SimConfig. workers > 1 renders ahead in threads, with identical frames. Raises SourceError.
    """
    return SimSource(read_config(scene, **options), workers)


def open_source(scene: str, mono: bool, imu: bool) -> FrameSource:
    """A simulated flight as an entry of the table of sources. Raises SourceError."""
    source = open_sim(scene, mono=True) if mono else open_sim(scene)
    return source if imu and not mono else SourceView(source, mono, imu)


def build_world(config: SimConfig, camera_in_body: F64) -> World:
    """The world for scene, seed and trajectories; it does not depend on which part of them is flown."""
    files = (config.trajectory, *config.also)
    points = []
    for agent, file in enumerate(files):
        if file:
            points.append(read_trajectory(FilePath(file), camera_in_body).positions())
        else:
            points.append(built_in_path(config.scene, lap_s(config.scene), camera_in_body, agent).positions())
    cloud = np.concatenate(points)
    if config.scene == "street":
        world = build_street(cloud, config.seed, config.texture_bits)
    else:
        world = with_floor(build_indoor(config.scene, cloud, config.seed, config.texture_bits), config.floor)
        if config.objects:
            world = with_objects(world, cloud, config.seed)
    return with_difficult_surfaces(world, config.seed, config.texture_bits, config.repeated, config.glossy)


class SimSource:
    """A FrameSource of a simulated flight. `world` is the ground truth of its geometry."""

    def __init__(self, config: SimConfig, workers: int = 1, world: World | None = None) -> None:
        self.config = config
        self.name = f"sim:{config.scene}?seed={config.seed}"
        self.report = SourceReport()  # stays empty
        self.imu = ImuCalibration(rate_hz=1e9 / config.imu_ns) if config.imu else None
        stereo = not (config.mono or config.depth)
        size = config.width or WIDTH_PX, config.height or HEIGHT_PX
        rig = make_rig(Lens(config.lens), stereo, config.depth, config.baseline, config.scale, size, config.fov_deg)
        self.rig: CameraRig = replace(rig, left=replace(rig.left, readout_s=config.readout_s))
        self.worn = _worn_rig(config, self.rig)
        self.path = self._choose_path()
        self.world = world if world is not None else build_world(config, self.rig.T_b_c)
        self._actors = make_actors(
            self.world, self.path, self.rig.T_b_c, config.people, config.cars, config.flight_seed
        )
        seconds = self.path.duration_s if not config.seconds else min(config.seconds, self.path.duration_s)
        self.frame_count = int(seconds * 1e9) // config.frame_ns + (1 if not config.seconds else 0)
        if self.frame_count < 1:
            raise SourceError(f"a flight of {seconds:.2f} s has no frame: expected at least {config.frame_ns * 1e-9} s")
        self._exposed_ns = START_NS + config.frame_ns * np.arange(self.frame_count, dtype=np.int64)
        self._stamps = self.worn.stamps(self._exposed_ns)
        self._has_partner = self.worn.has_partner(self.frame_count)
        self._motion: Motion = self.path.motion(flight_s(self._exposed_ns, START_NS))
        self._gains = _gains(self.frame_count, config)
        self._workers = workers

    def _choose_path(self) -> Path:
        c = self.config
        file = (c.trajectory, *c.also)[c.agent]
        if file:
            path = read_trajectory(FilePath(file), self.rig.T_b_c)
            if c.start >= path.length_s - 0.5:
                raise SourceError(f"start {c.start} s lies behind the end of {file}, which lasts {path.length_s:.1f} s")
        else:
            path = built_in_path(c.scene, (c.seconds or 20.0) + c.start, self.rig.T_b_c, c.agent)
        end = path.length_s if file else (c.seconds or 20.0) + c.start
        return Path(path.coefficients, path.knot_s, end, c.start, c.rest)

    @cached_property
    def ground_truth(self) -> Trajectory:
        """True body poses at the exposures of the frames, with the stamps of the frames."""
        return Trajectory(self._stamps, to_trajectory(self.path, self._exposed_ns, START_NS).T_w_b)

    def imu_samples(self) -> ImuBatch:
        """All inertial samples of the flight."""
        stamps = np.arange(START_NS, int(self._stamps[-1]) + 1, self.config.imu_ns, dtype=np.int64)
        calibration = ImuCalibration(rate_hz=1e9 / self.config.imu_ns)
        seed = self.config.flight_seed
        wear = self.worn.imu if self.config.rig == "worn" else None
        return inertial.measure(self.path, stamps, START_NS, calibration, seed, wear=wear)

    def odometry(self) -> OdometryBatch | None:
        """All odometer samples of the flight, or None without an odometer."""
        if self.config.odometry <= 0.0:
            return None
        stamps = np.arange(START_NS, int(self._stamps[-1]) + 1, round(1e9 / self.config.odometry), dtype=np.int64)
        return odometer.measure(self.path, stamps, START_NS, self.config, self.rig.T_b_c)

    def cameras(self) -> list[SimCamera]:
        """New cameras in the world, left first. Each thread needs its own."""
        rig = self.worn.true
        left = [SimCamera(self.world, rig.left, rig.T_b_c, self._actors)]
        if rig.right is None or rig.T_c_r is None:
            return left
        return [*left, SimCamera(self.world, rig.right, rig.T_b_c @ rig.T_c_r, self._actors)]

    def render(self, k: int, cameras: list[SimCamera]) -> Frame:
        """Frame k of the flight; independent of the frames rendered before."""
        c = self.config
        pose, velocity, rate = self._motion.T_w_b[k], self._motion.velocity[k], self._motion.rate[k]
        noise = (c.read_noise, c.shot_noise)
        t_s = float(self._exposed_ns[k] - START_NS) * 1e-9
        shutter = Shutter(c.exposure_s, c.readout_s, c.flicker, LAMP_HZ * t_s % 1.0)
        images: list[U8] = []
        for side, camera in enumerate(cameras if self._has_partner[k] else cameras[:1]):
            gain = float(self._gains[k]) * (1.0, 0.97)[side]
            key = ((c.flight_seed << 36) + (2 * k + side) * 0xD1342543DE82) & ((1 << 63) - 1)
            images.append(camera.take_image(pose, velocity, rate, shutter, gain, noise, key, t_s))
        right = images[1] if len(images) > 1 else None
        return Frame(int(self._stamps[k]), images[0], right, cameras[0].depth() if c.depth else None)

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        batch, velocities = self.imu_samples() if self.config.imu else None, self.odometry()
        done = velocities_done = 0
        for frame in self._images():
            if batch is not None:
                end = int(np.searchsorted(batch.t_ns, frame.t_ns, side="right"))
                if end > done:
                    yield ImuBatch(batch.t_ns[done:end], batch.gyro[done:end], batch.accel[done:end])
                done = end
            if velocities is not None:
                end = int(np.searchsorted(velocities.t_ns, frame.t_ns, side="right"))
                if end > velocities_done:
                    yield odometry.chosen(velocities, slice(velocities_done, end))
                velocities_done = end
            yield frame

    def _images(self) -> Iterator[Frame]:
        if self._workers <= 1:
            cameras = self.cameras()
            for k in range(self.frame_count):
                yield self.render(k, cameras)
            return
        free = deque(self.cameras() for _ in range(self._workers))

        def work(k: int) -> Frame:
            cameras = free.popleft()
            try:
                return self.render(k, cameras)
            finally:
                free.append(cameras)

        waiting: deque[Future[Frame]] = deque()
        with ThreadPoolExecutor(self._workers) as pool:
            for k in range(self.frame_count):
                waiting.append(pool.submit(work, k))
                if len(waiting) > 2 * self._workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def close(self) -> None:
        """Nothing to release."""


def _worn_rig(config: SimConfig, rig: CameraRig) -> wear.WornRig:
    """The true rig for which `rig` is the calibration."""
    seed = config.flight_seed
    good = perturb(rig, np.random.default_rng([seed, 41]), config.miscalibration)
    chosen = wear.selected(config.wear, wear.WearConfig()) if config.rig == "worn" else wear.NO_WEAR
    own_seed = seed if config.rig_seed < 0 else seed_of_agent(config.rig_seed, config.agent)
    return wear.draw(rig, good, ImuCalibration(rate_hz=1e9 / config.imu_ns), own_seed, chosen)


def _gains(frames: int, config: SimConfig) -> F64:
    """Grey values per unit of radiance: slow drift of the exposure, and steps up or down."""
    rng = np.random.default_rng([config.flight_seed, 29])
    phase = rng.uniform(0, 2 * np.pi, 2)
    frame_s = config.frame_ns * 1e-9
    t = np.arange(frames) * frame_s
    drift = 0.10 * np.sin(2 * np.pi * t / 11.0 + phase[0]) + 0.05 * np.sin(2 * np.pi * t / 3.7 + phase[1])
    draws = rng.random((frames, 2))
    size = np.where(draws[:, 1] < 0.5, -config.exposure_step, config.exposure_step)
    steps = np.where(draws[:, 0] < frame_s / config.exposure_every, size, 0.0)
    level = np.zeros(frames)
    value, kept = 0.0, 0.985 ** (20.0 / config.rate)
    for k in range(frames):
        value = kept * value + steps[k]  # auto-exposure pulls a step back within seconds
        level[k] = value
    return np.asarray(185.0 * np.exp(drift + level))
