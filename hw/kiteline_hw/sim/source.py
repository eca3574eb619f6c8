"""`sim:SCENE[?key=value&…]`: a flight through a simulated world, rendered while it is read."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from kiteline_core.cameras import CameraRig, Lens
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from numpy.typing import NDArray

from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sim import imu as inertial
from kiteline_hw.sim.lens import make_rig
from kiteline_hw.sim.paths import built_in, course_length_s
from kiteline_hw.sim.render import Eye
from kiteline_hw.sim.scenes import SCENES, build_indoor
from kiteline_hw.sim.trajectory import REST_S, Motion, Path, read_trajectory, to_trajectory
from kiteline_hw.sim.world import World

F64 = NDArray[np.float64]

START_NS = 1_000_000_000  # stamp of flight time zero
FRAME_NS = 50_000_000  # 20 Hz
IMU_NS = 5_000_000  # 200 Hz


@dataclass(frozen=True, slots=True)
class SimConfig:
    """How a flight is simulated. Everything that is seen follows from these values."""

    scene: str = "room"
    seed: int = 0
    trajectory: str = ""  # file to fly, "" for the scene's own course
    also: tuple[str, ...] = ()  # what the other agents fly in the same world, in order
    agent: int = 0  # which of them this is
    seconds: float = 0.0  # 0: to the end of the file, or 20 of the built-in course
    start: float = 0.0  # s into the trajectory
    rest: float = REST_S  # s of standing still before the flight; 0 starts in full motion
    mono: bool = False
    depth: bool = False  # depth in place of the right eye, like an RGB-D camera
    imu: bool = True
    lens: str = "radtan"  # or equidistant, none
    baseline: float = 0.11  # m
    scale: float = 1.0  # of image size and focal length
    exposure_s: float = 0.006  # indoor exposure of a small drone camera
    read_noise: float = 1.0  # grey values
    shot_noise: float = 0.012  # variance per grey value
    texture_bits: int = 11  # log2 of a texture's side; less only for tests


def open_sim(scene: str, workers: int = 1, **options: object) -> SimSource:
    """A simulated flight. `scene` may carry options as in `hall?seed=3&seconds=20&trajectory=F&mono=1`.

    options: fields of SimConfig. workers > 1 renders ahead in threads; the frames stay the same. Raises SourceError.
    """
    name, _, query = scene.partition("?")
    values: dict[str, object] = {"scene": name}
    for item in filter(None, query.split("&")):
        key, sign, text = item.partition("=")
        values[key] = _parse(key, text if sign else "1")
    values.update(options)
    for key in values:
        _default(key)
    config = SimConfig(**values)  # type: ignore[arg-type]
    if config.scene not in SCENES:
        raise SourceError(f"unknown scene {config.scene!r}: expected one of {', '.join(SCENES)}")
    return SimSource(config, workers)


def _default(key: str) -> object:
    if key not in SimConfig.__dataclass_fields__:
        known = ", ".join(SimConfig.__dataclass_fields__)
        raise SourceError(f"unknown option {key!r} of a simulated scene: expected one of {known}")
    return SimConfig.__dataclass_fields__[key].default


def _parse(key: str, text: str) -> object:
    default = _default(key)
    try:
        if isinstance(default, bool):
            return {"1": True, "true": True, "0": False, "false": False}[text.lower()]
        if isinstance(default, tuple):
            return tuple(text.split(","))
        return type(default)(text)  # type: ignore[call-arg]
    except (KeyError, ValueError) as error:
        raise SourceError(f"option {key}={text!r} of a simulated scene: expected a {type(default).__name__}") from error


def build_world(config: SimConfig, camera_in_body: F64) -> World:
    """The world of a configuration: it depends on the scene, the seed and whole trajectories, not on what is flown of them."""
    files = (config.trajectory, *config.also)
    points = []
    for agent, file in enumerate(files):
        if file:
            points.append(read_trajectory(FilePath(file), camera_in_body).positions())
        else:
            points.append(built_in(config.scene, course_length_s(config.scene), camera_in_body, agent).positions())
    cloud = np.concatenate(points)
    if config.scene == "street":
        from kiteline_hw.sim.street import build_street

        return build_street(cloud, config.seed, config.texture_bits)
    return build_indoor(config.scene, cloud, config.seed, config.texture_bits)


class SimSource:
    """A FrameSource of a simulated flight. `world` holds the truth about the solids."""

    def __init__(self, config: SimConfig, workers: int = 1, world: World | None = None) -> None:
        self.config = config
        try:
            kind = Lens(config.lens)
        except ValueError as error:
            raise SourceError(f"unknown lens {config.lens!r}: expected radtan, equidistant or none") from error
        stereo = not (config.mono or config.depth)
        self._rig = make_rig(kind, stereo, config.depth, config.baseline, config.scale)
        self.path = self._choose_path()
        self.world = world if world is not None else build_world(config, self._rig.T_b_c)
        seconds = self.path.duration_s if not config.seconds else min(config.seconds, self.path.duration_s)
        self._frames = int(seconds * 1e9) // FRAME_NS + (1 if not config.seconds else 0)
        if self._frames < 1:
            raise SourceError(f"a flight of {seconds:.2f} s has no frame: expected at least {FRAME_NS * 1e-9} s")
        self._stamps = START_NS + FRAME_NS * np.arange(self._frames, dtype=np.int64)
        self._motion: Motion = self.path.motion((self._stamps - START_NS) * 1e-9)
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

    def eyes(self) -> list[Eye]:
        """Fresh cameras in the world, left first."""
        left = [Eye(self.world, self._rig.left, self._rig.T_b_c)]
        if self._rig.right is None or self._rig.T_c_r is None:
            return left
        return [*left, Eye(self.world, self._rig.right, self._rig.T_b_c @ self._rig.T_c_r)]

    def render(self, k: int, eyes: list[Eye]) -> Frame:
        """Frame k of the flight, whatever was rendered before."""
        c = self.config
        images = []
        for side, eye in enumerate(eyes):
            images.append(
                eye.see(
                    self._motion.T_w_b[k], self._motion.velocity[k], self._motion.rate[k], c.exposure_s,
                    float(self._gains[k] * (1.0, 0.97)[side]), (c.read_noise, c.shot_noise),
                    ((c.seed * 64 + c.agent) << 36) + (2 * k + side) * 0xD1342543DE82 & (1 << 63) - 1,
                )  # fmt: skip
            )
        return Frame(
            int(self._stamps[k]),
            images[0],
            images[1] if len(images) > 1 else None,
            eyes[0].depth() if c.depth else None,
        )

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        batch = self.inertial() if self.config.imu else None
        done = 0
        for frame in self._images():
            if batch is not None:
                end = int(np.searchsorted(batch.t_ns, frame.t_ns, side="right"))
                yield ImuBatch(batch.t_ns[done:end], batch.gyro[done:end], batch.accel[done:end])
                done = end
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
