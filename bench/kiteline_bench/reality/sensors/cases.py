"""The flights of `reality/sensors`: cameras with IMUs and odometers that come late, have holes or end, and dark images.

Every pair of values of two of the three (IMU, odometer, images) is flown with each camera: 20 flights of the 60 that
there are.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kiteline_bench.agent.rigs import measured_depth
from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.faults import Spans, dark_between, samples_between, within
from kiteline_bench.harness.odometer import with_odometer_between
from kiteline_bench.harness.recording import Recording, items_of, load
from kiteline_core.arrays import F64, Bool
from kiteline_hw.sim.source import open_sim

SECONDS = 22.0
METRE_S = 8.0  # of images with an IMU, or with an odometer, after which lengths are known
_UPRIGHT_S = 1.0  # from the first sample of an IMU until the vertical is told
_TICK_S = 0.05  # of the cameras
_ALWAYS: Spans = ((-np.inf, np.inf),)
_PATH, _START_S, _SEED = "V1_02_medium.txt", 20.0, 11  # of the depth camera's flight


@dataclass(frozen=True, slots=True)
class There:
    """When a sensor measures, or is in the dark: in these spans. name: for people."""

    name: str
    spans: Spans


IMUS = (
    There("no IMU", ()),
    There("IMU", _ALWAYS),
    There("IMU from 5 s on", ((5.0, np.inf),)),
    There("IMU silent from 8 to 13 s", ((-np.inf, 8.0), (13.0, np.inf))),
    There("IMU until 10 s", ((-np.inf, 10.0),)),
)
ODOMETERS = (
    There("no odometer", ()),
    There("odometer", _ALWAYS),
    There("odometer from 6 s on", ((6.0, np.inf),)),
    There("odometer until 12 s", ((-np.inf, 12.0),)),
)
DARK = (
    There("all images", ()),
    There("dark from 10 to 11.5 s", ((10.0, 11.5),)),
    There("dark from 10 to 14 s", ((10.0, 14.0),)),
)


@dataclass(frozen=True, slots=True)
class Case:
    """What the vehicle has besides its camera, and when."""

    imu: There
    odometer: There
    dark: There

    @property
    def name(self) -> str:
        """What is there, for people."""
        return f"{self.imu.name}, {self.odometer.name}, {self.dark.name}"

    @property
    def plain(self) -> bool:
        """True for images alone, all of them."""
        return not (self.imu.spans or self.odometer.spans or self.dark.spans)

    def of(self, whole: Recording) -> Recording:
        """The flight of a whole recording."""
        flight = samples_between(whole, self.imu.spans) if self.imu.spans else whole.without_imu()
        return dark_between(with_odometer_between(flight, self.odometer.spans), self.dark.spans)

    def metre_s(self, to_s: float) -> float:
        """Time until then in which images came with an IMU or an odometer."""
        t_s = np.arange(0.0, min(to_s, SECONDS), _TICK_S)
        either = within(t_s, self.imu.spans) | within(t_s, self.odometer.spans)
        return _TICK_S * int((either & ~within(t_s, self.dark.spans)).sum())

    @property
    def metre_from_s(self) -> float:
        """When one of them has been there with images for METRE_S without a break; infinite if neither ever is."""
        t_s = np.arange(0.0, SECONDS, _TICK_S)
        seen = ~within(t_s, self.dark.spans)
        return min(_first_whole(t_s, within(t_s, sensor.spans) & seen) for sensor in (self.imu, self.odometer))

    @property
    def upright(self) -> Spans:
        """When the world is turned upright: with the first samples of an IMU that comes late."""
        begin_s = self.imu.spans[0][0] if self.imu.spans else 0.0
        return ((begin_s, begin_s + _UPRIGHT_S),) if begin_s > 0.0 else ()

    def through_the_dark(self, sensor: There) -> bool:
        """Whether a sensor measures as long as there are no images."""
        (begin_s, end_s), *_ = self.dark.spans or ((0.0, 0.0),)
        return any(a <= begin_s and end_s <= b for a, b in sensor.spans)


CASES = tuple(
    Case(imu, odometer, DARK[(i + j) % len(DARK)]) for i, imu in enumerate(IMUS) for j, odometer in enumerate(ODOMETERS)
)


def _first_whole(t_s: F64, there: Bool) -> float:
    """The first time before which something was there for METRE_S."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(np.int8)))
    long = [
        t_s[begin] + METRE_S for begin, end in pairwise(edges) if there[begin] and _TICK_S * (end - begin) >= METRE_S
    ]
    return float(min(long, default=np.inf))


def cameras(bench: Bench) -> Mapping[str, Recording]:
    """By name the whole flights: two cameras, a depth camera, one camera rendered and real."""
    room = load(bench.source("room_flight.mcap"))
    real = load(bench.source("euroc_mh01_air"), mono=True)
    flights = {"stereo": room, "depth camera": _depth(bench), "one camera": room.left_only(), "one real camera": real}
    return {name: flight.seconds(0.0, SECONDS) for name, flight in flights.items()}


def _depth(bench: Bench) -> Recording:
    """A rendered flight of a depth camera with the noise, ends and holes of a real one."""
    bench.say("rendering a depth camera")
    source = open_sim(
        "room", os.cpu_count() or 1, seed=_SEED, seconds=SECONDS, trajectory=bench.source(f"trajectories/{_PATH}"),
        start=_START_S, rest=0.0, depth=True,
    )  # fmt: skip
    return Recording(source.rig, source.imu, tuple(measured_depth(item, k) for k, item in enumerate(items_of(source))))
