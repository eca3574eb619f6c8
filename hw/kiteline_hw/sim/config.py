"""The options of a simulated flight, and their parser."""

import math
from dataclasses import dataclass, fields

from kiteline_core.geometry.cameras import Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.sensors.wear import KINDS
from kiteline_hw.sim.world.floors import FLOORS
from kiteline_hw.sim.world.path import REST_S
from kiteline_hw.sim.world.scenes import SCENES

RIGS = ("true", "worn")


@dataclass(frozen=True, slots=True)
class SimConfig:
    """The options of a simulated flight, which determine every measurement."""

    scene: str = "room"
    seed: int = 0
    trajectory: str = ""  # file to fly, "" for the scene's built-in path
    also: tuple[str, ...] = ()  # trajectories of the other agents in the same world, in order
    agent: int = 0  # number of this agent
    seconds: float = 0.0  # 0: to the end of the file, or 20 s of the built-in path
    start: float = 0.0  # s into the trajectory
    rest: float = REST_S  # s at rest before the flight; 0 starts in full motion
    mono: bool = False
    depth: bool = False  # depth in place of the right image, like an RGB-D camera
    imu: bool = True
    odometry: float = 0.0  # Hz of an odometer; 0: none
    odometry_noise: float = 0.05  # m/s a sample, white
    odometry_turn_noise: float = 0.01  # rad/s a sample, white
    odometry_scale: float = 1.0  # factor on the true speed: tyres wear, flow sensors misjudge their height
    odometry_slip: float = 0.0  # share of the time in which it reads up to 2.5 times the true speed
    odometry_wheels: bool = False  # measures only along the optical axis and about the camera's vertical axis
    lens: str = "radtan"  # or equidistant, none
    baseline: float = 0.11  # m
    scale: float = 1.0  # of image size and focal length
    width: int = 0  # px, before scale; 0: 752
    height: int = 0  # px, before scale; 0: 480
    fov_deg: float = 0.0  # angle of view along the width, without what distortion adds; 0: that of 752 px
    rate: float = 20.0  # Hz of the frames
    imu_rate: float = 200.0  # Hz of the inertial samples
    exposure_s: float = 0.010  # indoor exposure of a small drone camera
    readout_s: float = 0.0  # from the first row's exposure to the last row's: a rolling shutter; 0: a global one
    exposure_step: float = 0.18  # logarithm of the factor by which the exposure steps up or down
    exposure_every: float = 10.0  # s, mean time between two steps
    flicker: float = 0.0  # amplitude of the lamps' brightness over its mean; exposures average most of it out
    read_noise: float = 1.2  # grey values
    shot_noise: float = 0.02  # variance per grey value
    miscalibration: float = 0.5  # error of the stated calibration, see rig.perturb; 0: none
    rig: str = "true"  # or worn: it differs from its calibration by more than a good one does, see sensors/wear.py
    rig_seed: int = -1  # of a worn rig; -1: that of the scene
    wear: tuple[str, ...] = KINDS  # kinds of wear of a worn rig
    people: int = 0  # who walk through the view of the camera
    cars: int = 0  # that drive ahead of the camera or towards it
    repeated: float = 0.0  # share of the surfaces with a pattern that repeats every 0.3 m
    glossy: float = 0.0  # share of the surfaces that reflect lights
    objects: bool = False  # chairs, a table, cylinders, a half-open door and pillars beside the path, indoors
    floor: str = "flat"  # or ramp, wave, pits, steps, bare (without texture), indoors
    texture_bits: int = 11  # log2 of a texture's side; less only for tests

    @property
    def frame_ns(self) -> int:
        """Time between two frames."""
        return round(1e9 / self.rate)

    @property
    def imu_ns(self) -> int:
        """Time between two inertial samples."""
        return round(1e9 / self.imu_rate)

    @property
    def flight_seed(self) -> int:
        """Seed of what is drawn for this agent's flight alone."""
        return seed_of_agent(self.seed, self.agent)


def seed_of_agent(seed: int, agent: int) -> int:
    """A seed for each agent of a scene, different for all seeds below 2^19; the 27 bits of a frame's key hold it."""
    return seed * 64 + agent % 64 + (agent // 64 << 25)


def read_config(scene: str, **options: object) -> SimConfig:
    """The options of `SCENE[?key=value&…]`; `options`, fields of SimConfig, override the text.

    Raises SourceError for an unknown scene, option or value.
    """
    name, _, query = scene.partition("?")
    values: dict[str, object] = {"scene": name}
    for item in filter(None, query.split("&")):
        key, sign, text = item.partition("=")
        values[key] = _parse(key, text if sign else "1")
    for key, value in options.items():
        _default(key)
        values[key] = value
    config = SimConfig(**values)  # type: ignore[arg-type]
    for field in fields(SimConfig):
        if isinstance(value := getattr(config, field.name), float) and not math.isfinite(value):
            raise SourceError(f"{field.name} of a simulated scene is {value}: expected a finite number")
    if config.scene not in SCENES:
        raise SourceError(f"unknown scene {config.scene!r}: expected one of {', '.join(SCENES)}")
    if config.floor not in FLOORS:
        raise SourceError(f"unknown floor {config.floor!r}: expected one of {', '.join(FLOORS)}")
    if config.scene == "street" and (config.objects or config.floor != "flat"):
        raise SourceError("objects and floors are options of indoor scenes")
    if config.lens not in [kind.value for kind in Lens]:
        raise SourceError(f"unknown lens {config.lens!r}: expected radtan, equidistant or none")
    if config.rig not in RIGS:
        raise SourceError(f"unknown rig {config.rig!r}: expected {' or '.join(RIGS)}")
    if config.rig != "worn" and (config.rig_seed >= 0 or config.wear != KINDS):
        raise SourceError("wear and rig_seed are options of a worn rig: add --rig worn (rig=worn in the scene)")
    if unknown := [kind for kind in config.wear if kind not in KINDS]:
        raise SourceError(f"unknown wear {', '.join(unknown)}: expected some of {', '.join(KINDS)}")
    if not 0 <= config.agent <= len(config.also):
        raise SourceError(f"agent {config.agent} has no trajectory: {1 + len(config.also)} are given")
    if config.seed < 0 or config.seconds < 0 or config.start < 0 or not 0.05 <= config.scale <= 4:
        raise SourceError("seed, seconds and start of a simulated scene cannot be negative; scale must be 0.05 to 4")
    _check_camera(config)
    if not 0 <= config.readout_s < 0.05 or not 0 <= config.flicker <= 1 or config.exposure_every <= 0:
        raise SourceError(
            "readout_s of a simulated scene must be 0 to 0.05, flicker 0 to 1, exposure_every larger than 0"
        )
    if not 0 <= config.repeated <= 1 or not 0 <= config.glossy <= 1 or config.people < 0 or config.cars < 0:
        raise SourceError("repeated and glossy of a simulated scene must be 0 to 1, people and cars not negative")
    if not 0 <= config.odometry <= 1000 or config.odometry_noise < 0 or not 0 <= config.odometry_slip < 1:
        raise SourceError(
            "odometry of a simulated scene must be 0 to 1000 Hz, its noise not negative, its slip below 1"
        )
    return config


def _check_camera(config: SimConfig) -> None:
    """Raise SourceError for a camera or rates that cannot be simulated."""
    if any(side and not 64 <= side <= 4096 for side in (config.width, config.height)):
        raise SourceError("width and height of a simulated scene must be 64 to 4096 px")
    most_deg = 200.0 if config.lens == Lens.EQUIDISTANT.value else 130.0
    if config.fov_deg and not 10.0 <= config.fov_deg <= most_deg:
        raise SourceError(f"fov_deg of a simulated {config.lens} lens must be 10 to {most_deg:g}")
    if not 1.0 <= config.rate <= 200.0 or not 10.0 <= config.imu_rate <= 4000.0:
        raise SourceError("rate of a simulated scene must be 1 to 200 Hz, imu_rate 10 to 4000 Hz")


def _default(key: str) -> object:
    known = {field.name: field.default for field in fields(SimConfig)}
    if key not in known:
        raise SourceError(f"unknown option {key!r} of a simulated scene: expected one of {', '.join(known)}")
    return known[key]


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
