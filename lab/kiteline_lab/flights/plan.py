"""The plan of a flight: opened sources, flight time 0, and the options of each process."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_agent.runtime.options import AgentOptions, agent_config, is_filter
from kiteline_basestation.runtime.options import BaseOptions, base_config
from kiteline_codec.channel import coded_channel
from kiteline_core.config import ConfigError
from kiteline_core.frame import Frame
from kiteline_core.ids import MAX_BOOTS
from kiteline_hw.durable_files import next_number
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_hw.sim.links.link_model import link_seed
from kiteline_hw.sources.kinds import is_camera
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.process import told_if_slow

_BASE_PERCENT = 200.0  # of a core: the computer of a base beside agents with a limit, one core for steps, one for jobs


@dataclass(frozen=True, slots=True)
class Options:
    """Options of `kiteline fly`."""

    sources: tuple[str, ...]
    out: Path
    mode: str = "distributed"
    link: str = ""
    profile: str = ""
    delay_s: float = 0.0
    up_bytes_s: int = 0
    down_bytes_s: int = 0
    loss: float = 0.0
    cpu_percent: float = 0.0
    mono: bool = False
    imu: bool = True
    realtime: bool = False
    config: str = ""
    rig: str = ""
    seed: int = 0
    seconds: float = 0.0
    store: str = ""
    kill_base_at_s: float | None = None
    restart_base_at_s: float | None = None
    kill_agent_at_s: float | None = None
    # when each base in turn is killed, s of flight time and s of real time after it; the next base follows
    base_kills: tuple[tuple[float, float], ...] = ()
    calibration: str = ""  # FILE[,FILE…] in place of the sources'
    tracker: str = ""  # map, or ekf; "": what the configuration says
    grid: str = "agent"  # who makes scans of ground and obstacles: agent, base, or off


@dataclass(slots=True)
class FlightPlan:
    """A flight about to begin. base: None without one. frames: how many in all, None if unknown."""

    sources: list[FrameSource] = field(default_factory=list)
    agents: list[AgentOptions] = field(default_factory=list)
    base: BaseOptions | None = None
    frames: int | None = None
    quiet: bool = False  # no progress is shown
    base_kills: Sequence[tuple[float, float]] = ()  # as in Options

    def close(self) -> None:
        """Close the sources."""
        for source in self.sources:
            source.close()


def plan(o: Options, quiet: bool = False) -> FlightPlan:
    """Open the sources, so that a bad one is reported before anything starts, and make the options of each process.

    Raises SourceError; ConfigError and BudgetError for options with which a process would not begin.
    """
    _check(o)
    made = FlightPlan(quiet=quiet, base_kills=o.base_kills)
    mono = o.mono or is_filter(o.config, o.tracker)
    try:
        for text in o.sources:
            if is_camera(text):
                raise SourceError(f"{text}: a camera is flown with `kiteline agent`: expected a recording or sim:SCENE")
            with contextlib.nullcontext() if quiet else told_if_slow(f"opening {text}"):
                made.sources.append(open_source(text, mono=mono, imu=o.imu, calibration=o.calibration))
        starts = flight_starts(made.sources)
    except BaseException:
        made.close()
        raise
    counts = [source.frame_count for source in made.sources]
    number = next_number(Path(o.store) / "session") if o.store else 0  # ids in a store stay unique
    made.frames = None if o.seconds > 0 or None in counts else sum(count or 0 for count in counts)
    for k, text in enumerate(o.sources):
        made.agents.append(
            AgentOptions(
                source=text, folder=str(o.out / f"agent{k}"), agent=k,
                boot=number % MAX_BOOTS, order=number + 1, mono=o.mono, imu=o.imu,
                config=o.config, rig=o.rig, calibration=o.calibration, grid=o.grid, tracker=o.tracker,
                with_others=len(o.sources) > 1, start_ns=starts[k], seconds=o.seconds,
                up_bytes_s=o.up_bytes_s, profile=o.profile,
                delay_s=o.delay_s, loss=o.loss, disorder=o.loss,
                seed=link_seed(o.seed, k, up=True), cpu_percent=o.cpu_percent,
                kill_at_s=o.kill_agent_at_s if k == 0 else None,
                await_base_at_s=o.restart_base_at_s, await_bases=bool(o.base_kills),
            )
        )  # fmt: skip
    if o.mode != "tracker":
        made.base = BaseOptions(
            folder=str(o.out / "base"), agents=tuple(range(len(o.sources))), config=o.config, start_ns=starts[0],
            down_bytes_s=o.down_bytes_s, profile=o.profile, delay_s=o.delay_s, loss=o.loss, disorder=o.loss,
            seed=o.seed, session=max(1, number), store=o.store, kill_at_s=o.kill_base_at_s,
            cpu_percent=_BASE_PERCENT if o.cpu_percent > 0.0 else 0.0,
        )  # fmt: skip
    return made


def _check(o: Options) -> None:
    """Raise ConfigError or BudgetError for options with which an agent or the base would not begin."""
    agent_config(o.config, o.cpu_percent, o.rig, o.grid, o.tracker)
    if o.grid == "base" and is_filter(o.config, o.tracker):
        raise ConfigError("--tracker ekf uses no --grid base: leave it out, or fly --tracker map")
    if o.mode != "tracker":
        base_config(o.config)
    for budget_bytes in (o.up_bytes_s, o.down_bytes_s):
        coded_channel(1, budget_bytes, o.profile)


def flight_starts(sources: list[FrameSource]) -> list[int]:
    """Each source's stamp of flight time 0: sources that overlap in time share a clock, others begin together."""
    spans = [_span_ns(source, several=len(sources) > 1) for source in sources]
    if max(first for first, _ in spans) < min(last for _, last in spans):
        return [min(first for first, _ in spans)] * len(spans)
    return [first for first, _ in spans]


def _span_ns(source: FrameSource, *, several: bool) -> tuple[int, int]:
    """First and (nearly) last stamp of a source; the last only where there are several sources."""
    stamps: list[int] = []
    for item in source:
        if isinstance(item, Frame):
            stamps.append(item.t_ns)
            if len(stamps) == 1 + several:
                break
    if not stamps:
        raise SourceError(f"{source.name}: not one usable frame")
    period_ns = stamps[-1] - stamps[0]
    return stamps[0], stamps[0] + period_ns * max(1, source.frame_count or 1)
