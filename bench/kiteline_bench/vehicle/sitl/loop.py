"""The closed loop: physics, autopilot, rendered images, agent and pilot, step by step in simulated time."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from kiteline_bench.vehicle.sitl.arducopter import STEP_S, ArduCopter
from kiteline_bench.vehicle.sitl.copter import Copter
from kiteline_bench.vehicle.sitl.ground_station import GroundStation
from kiteline_bench.vehicle.sitl.onboard import Onboard, Setting, SimulatedClock
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.sensors.camera import Shutter
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sim.world.scenes import build_indoor
from kiteline_hw.system.closing import Closing

AXES = "urf"  # of the simulated rig's body
_START_NS = 1_000_000_000_000  # clock at simulated time zero
_LEGS_M = 0.15  # of the controller above the ground
_PACE = 1.0  # simulated over wall time, at most: threads of the connection need their turn
_POLL_STEPS = 8  # between two looks at the ground station
_SEED = 1  # of world, rig and wind
_SCALE = 0.5  # of a 752x480 image: a quarter of the rendering
_GAIN = 185.0  # grey values per unit of radiance
_R_W_N = np.diag([1.0, -1.0, -1.0])  # from NED to the world, whose z is up


@dataclass(slots=True)
class Truth:
    """The true state at the exposures: simulated time in s, position (3,) in NED, heading in rad."""

    t_s: list[float] = field(default_factory=list)
    position_m: list[F64] = field(default_factory=list)
    heading_rad: list[float] = field(default_factory=list)

    def at(self, t_s: F64) -> tuple[F64, F64]:
        """Positions (n, 3) and headings (n,) at times (n,)."""
        t, p = np.array(self.t_s), np.array(self.position_m)
        heading = np.interp(t_s, t, np.unwrap(self.heading_rad))
        return np.stack([np.interp(t_s, t, p[:, k]) for k in range(3)], 1), heading


class Loop(Closing):
    """Everything that flies. program: a built ArduCopter."""

    def __init__(self, program: Path, folder: Path, *, tunnel: bool = False) -> None:
        self._files = ExitStack()
        self.copter = Copter(_SEED)
        self.autopilot = self._files.enter_context(ArduCopter(program, folder / "autopilot", self.copter))
        self.pilot = self._files.enter_context(GroundStation(self.autopilot.serial[0]))
        self.clock = SimulatedClock(_START_NS)
        self.truth = Truth()
        source = SimSource(
            SimConfig("room", _SEED, seconds=1.0, scale=_SCALE), world=build_indoor("room", _volume(), _SEED, 10)
        )
        self._cameras, self._noise = source.cameras(), (source.config.read_noise, source.config.shot_noise)
        self._shutter, self._frame_ns = Shutter(source.config.exposure_s), source.config.frame_ns
        self._T_f_b = se3.inverse(mounting(AXES))
        self.setting = Setting(source.rig, self.autopilot.url(1), folder / "agent", AXES, tunnel=tunnel)
        self.onboard: Onboard | None = None
        self.boots = 0
        self._steps, self._frames, self._due_s = 0, 0, time.monotonic()

    @property
    def t_s(self) -> float:
        """Simulated time."""
        return self.copter.t_s

    def simulated_s(self, clock_s: float) -> float:
        """Simulated time at a time of the agent's clock."""
        return clock_s - _START_NS * 1e-9

    def start_agent(self) -> Onboard:
        """Start an agent, another one each time."""
        self.onboard = self._files.enter_context(Onboard(self.setting, self.clock, self.boots))
        self.boots += 1
        return self.onboard

    def sign(self, key: Path) -> None:
        """Agents from now on sign, and have no tunnel: their base would have to sign too."""
        self.setting = replace(self.setting, key=str(key), tunnel=False)

    def kill_agent(self) -> None:
        """End the agent."""
        if self.onboard is not None:
            self.onboard.close()
        self.onboard = None

    def fly(
        self, seconds: float, until: Callable[[], bool] | None = None, each: Callable[[], None] | None = None
    ) -> bool:  # fmt: skip
        """Go on for some simulated time, or until something is true; False if it did not become true.

        each: called ten times a second.
        """
        end_s = self.t_s + seconds
        while self.t_s < end_s:
            self._step()
            if each is not None and self._steps % round(0.1 / STEP_S) == 0:
                each()
            if until is not None and self._steps % _POLL_STEPS == 0 and until():
                return True
        return until is None

    def _step(self) -> None:
        self.autopilot.step()
        self._steps += 1
        self.clock.t_ns = _START_NS + round(self.t_s * 1e9)
        if self._steps % _POLL_STEPS == 0:
            self.pilot.poll(self.t_s)
        if self.t_s * 1e9 >= self._frames * self._frame_ns:
            self._frames += 1
            self.truth.t_s.append(self.t_s)
            self.truth.position_m.append(self.copter.position_m.copy())
            self.truth.heading_rad.append(self.copter.heading_rad)
            if self.onboard is not None:
                self.onboard.see(self._expose())
        if self.onboard is not None:
            self.onboard.tick()
        self._due_s = max(self._due_s + STEP_S / _PACE, time.monotonic() - 0.05)
        ahead_s = self._due_s - time.monotonic()
        if ahead_s > 0.002:
            time.sleep(ahead_s)

    def _expose(self) -> Frame:
        c = self.copter
        R_w_b = _R_W_N @ c.R_n_f @ self._T_f_b[:3, :3]
        T_w_b = se3.from_rt(R_w_b, _R_W_N @ c.position_m + [0.0, 0.0, _LEGS_M])
        velocity, rate = _R_W_N @ c.velocity_m_s, self._T_f_b[:3, :3].T @ c.rate_rad_s
        images = [
            camera.take_image(T_w_b, velocity, rate, self._shutter, _GAIN, self._noise, 2 * self._frames + side)
            for side, camera in enumerate(self._cameras)
        ]
        return Frame(self.clock.now_ns(), images[0], images[1])

    def close(self) -> None:
        """End agent, pilot and autopilot."""
        self._files.close()


def _volume() -> F64:
    """Points (n, 3) in the world where it may fly: nothing stands there."""
    x, y, z = np.meshgrid(np.arange(-1.6, 1.7, 0.2), np.arange(-1.6, 1.7, 0.2), np.arange(0.6, 1.7, 0.2))
    return np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
