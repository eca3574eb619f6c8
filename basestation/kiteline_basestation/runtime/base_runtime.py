"""The base in flight: the station with its store, its log and a modelled link to each agent."""

import importlib.util
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.runtime.flight_log import RESTORED, STEP, metadata_of, station_of, write_step
from kiteline_basestation.runtime.flight_summary import FlightSummary, counts, flight_summary, timings
from kiteline_basestation.runtime.imports import read_imports
from kiteline_basestation.runtime.map_files import map_files
from kiteline_basestation.runtime.options import LOG_STEM, BaseOptions, base_config
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.runtime.worker import SAMPLES, LockstepJobs, Workers
from kiteline_basestation.station import Import, Station, StationOutput
from kiteline_basestation.step_cost import StepCost
from kiteline_basestation.store.keeper import Keeper
from kiteline_basestation.store.restore import Restored, restore
from kiteline_basestation.store.saved_map import SavedMap, pack
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import RecordChannel, settled
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary
from kiteline_core.wording import counted
from kiteline_hw.durable_files import write_atomically
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.lockstep.messages import Down, Phase, Up
from kiteline_hw.lockstep.shared_core import SharedCore
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.machine import MACHINE, machine
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.links.link_model import LinkModelConfig, LinkModels, link_seed
from kiteline_hw.system import process
from kiteline_hw.system.memory import rss_mib
from kiteline_hw.system.notices import Notices
from kiteline_hw.system.vocabulary import shipped_vocabulary

_DRAIN_TICK_NS = 50_000_000  # ns of flight time between two ticks after the last frame: acknowledgements go at once
_DRAIN_NS = 30_000_000_000  # ns of flight time after which a link that is not quiet yet is given up
_RSS_STEPS = 10  # steps between two readings of the resident memory


def missing_extras() -> list[str]:
    """What a base goes without, as the plain install leaves it out; a line each with the mend."""
    if importlib.util.find_spec("gtsam") is None:
        return ["gtsam is not installed: no loop closing, no map merging; pip install 'kiteline[base]'"]
    return []


def load_vocabulary() -> Vocabulary | None:
    """The shipped visual vocabulary; None if gtsam, which loop closing needs, is not installed."""
    return None if missing_extras() else shipped_vocabulary()


class BaseRuntime:
    """The base in flight, in lock-step (`tick`) or live (`step`)."""

    def __init__(
        self,
        options: BaseOptions,
        open_channel: Callable[[AgentId], RecordChannel],
        jobs: Workers | None = None,
        plain: bool = False,
        core: SharedCore | None = None,
    ) -> None:
        """open_channel: makes the base's end of a channel. plain: no codec, so no packets are logged.

        core: computer that the base shares with others in modelled time; None: one of its own, as the options say.
        """
        cv2.setNumThreads(1)
        self.options = options
        self.config = base_config(options.config)
        codec_warm.warm()
        vocabulary = load_vocabulary()
        warm(self.config)
        if jobs is None and vocabulary is not None:
            warm_graphs()
        self.station = Station(self.config, open_channel, vocabulary)
        self.station.mapper.cpu_ns = time.process_time_ns
        if core is None and options.cpu_percent > 0.0 and jobs is None:
            core = SharedCore(options.cpu_percent)
        self._process = None if core is None else core.process()
        self._held: dict[int, list[bytes]] = {}  # packets that wait until the step before is done
        lockstep = LockstepJobs(None if core is None else core.process())
        self.jobs: LockstepJobs | Workers = lockstep if jobs is None else jobs
        self._cost = StepCost(self.station)
        self.phase = Phase.FLY
        self.now_ns: int | None = None  # flight time of the next tick in lock-step
        self.rss_mib = 0.0
        self.digest_equal = False
        self.at_last_frame: FlightSummary | None = None
        self.agents_lost: set[int] = set()
        self.keeper: Keeper | None = None
        self._steps = 0
        self._step_ms: deque[float] = deque(maxlen=SAMPLES)
        self._drained_ns = 0
        self._last_frame_ns = 0
        self._folder = Path(options.folder)
        self._notices = Notices()
        self._budget: LogBudget | None = None
        self._log = self._open_log({**metadata_of(options, self.config, plain_channels=plain), MACHINE: machine()})
        disorder = LinkModelConfig(
            loss=options.loss, duplicate=options.disorder, reorder=options.disorder,
            delay_ns=round(options.delay_s * 1e9),
        )  # fmt: skip
        self._links = LinkModels(disorder, partial(link_seed, options.seed, up=False))
        self._imports: list[Import] = []

    def _open_log(self, about: Mapping[str, str]) -> LogWriter | None:
        """Begin the log; None where there is to be none, or a live base's disk takes none."""
        options = self.options
        if not options.log_name:
            return None
        if options.log_mib > 0:
            self._budget = LogBudget(self._folder, LOG_STEM, options.log_mib << 20)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            log = LogWriter(
                self._folder / options.log_name, about, budget=self._budget, part_topic=STEP,
                beside=options.log_optional,
            )  # fmt: skip
        except (OSError, SourceError) as error:
            if not options.log_optional:
                raise
            why = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
            self._notices.say("log", f"no log of this start: {why}; --log names its folder")
            return None
        log.text("/log", options.start_ns, "info", f"base, session {options.session}")
        log.flush()  # a base that dies at once leaves a log that can be read
        return log

    def take_notices(self) -> list[str]:
        """Messages about files that cannot be written: each kind of trouble once."""
        if self._log is not None and self._log.why:
            self._notices.say("log", f"log: messages are lost: {self._log.why}; the base goes on")
        elif self._log is not None and self._log.waits_for:
            self._notices.say("disk", f"log: it waits for the disk: {self._log.waits_for}; the base goes on")
        if self._budget is not None and self._budget.deleted:
            limit = f"--log-mib {self.options.log_mib}, or a disk that is nearly full"
            self._notices.say("budget", f"log: the oldest logs are deleted: {limit}")
        return self._notices.take()

    def state(self) -> dict[str, Any]:
        """The process as JSON types: its link, memory and store, and what is wrong now, a line each."""
        options, keeper = self.options, self.keeper
        return {
            "link": options.link,
            "session": options.session,
            "memory_mib": round(self.rss_mib, 1),
            "store": None if keeper is None else {"folder": options.store, "up_to_date": keeper.idle},
            "troubles": self.troubles(),
        }

    def troubles(self) -> list[str]:
        """What is wrong now, a line each."""
        options, keeper, troubles = self.options, self.keeper, missing_extras()
        if keeper is not None and keeper.fault is not None:
            troubles.append(f"store {options.store}: not written: {keeper.fault}")
        if options.log_name and self._log is None:
            troubles.append("log: there is none of this start")
        elif self._log is not None and self._log.why:
            troubles.append(f"log: messages are lost: {self._log.why}")
        elif self._log is not None and self._log.waits_for:
            troubles.append(f"log: it waits for the disk: {self._log.waits_for}")
        for kind, why in sorted(self.station.mapper.failures.items()):
            troubles.append(f"job {kind}: the last one failed, and its part of the map stays as it was: {why}")
        return troubles

    def restore_maps(self, now_ns: int) -> Restored | None:
        """Load the map of the store and the imported ones; None if there are none.

        Raises StoreError, SourceError, WireError.
        """
        self.keeper = Keeper(Path(self.options.store)) if self.options.store else None
        stored = SavedMap() if self.keeper is None else self.keeper.load()
        saved, logs = read_imports(
            self.options.imports, stored, lambda data: station_of(data, load_vocabulary(), link_traits)
        )
        self._imports = list(logs.pieces)
        process.print_lines(f"import: {fault}" for fault in logs.faults)
        restored = None
        if not saved.empty:
            if self._log is not None:
                self._log.blob(RESTORED, now_ns + self.options.start_ns, pack(saved))
            restored = restore(self.station, saved, now_ns)
            saved = restored.saved
        if self.keeper is not None:
            self.keeper.begin(self.station, saved, stored)
        return restored

    def tick(self, ups: Mapping[int, Up]) -> dict[int, Down]:
        """One tick of a lock-step flight: takes each agent's message, returns the next tick and packets for it.

        The first call only sets the time of the first tick.
        """
        if self.now_ns is not None:
            for agent, up in ups.items():
                self._held.setdefault(agent, []).extend(up.packets)
            if self._process is None or not self._process.busy(self.now_ns):
                packets, self._held = self._held, {}
                self.step(packets, self.jobs.done(self.now_ns), self.now_ns)
        frames = [up.next_ns for up in ups.values() if up.next_ns is not None]
        self.now_ns = min(frames) if frames else self._drain(ups, self.now_ns or 0)
        sent = self.outgoing(self.now_ns)
        return {agent: Down(self.now_ns, self.phase, sent.get(AgentId(agent), ())) for agent in sorted(ups)}

    def _drain(self, ups: Mapping[int, Up], now_ns: int) -> int:
        """After the last frame, wait until links are quiet and digests equal. Returns the time of the next tick."""
        if self.phase is Phase.FLY:
            self.phase = Phase.DRAIN
            self._last_frame_ns = now_ns
            self.end_of_frames()
        ends = [settled(channel) for agent, channel in self.station.channels.items() if agent in ups]
        ends += [(up.quiet, up.digest_equal) for up in ups.values()]
        self.digest_equal = bool(ends) and all(equal for _, equal in ends)
        self._drained_ns = now_ns - self._last_frame_ns
        quiet = self.digest_equal and all(q for q, _ in ends) and self.station.mapper.idle and self.jobs.idle
        if not ups or quiet or self._drained_ns >= _DRAIN_NS:
            self.phase = Phase.END
        return now_ns + _DRAIN_TICK_NS

    def step(
        self,
        packets: Mapping[int, Sequence[bytes]],
        done: Sequence[JobDone],
        now_ns: int,
        commands: Sequence[Command] = (),
    ) -> StationOutput:
        """Step the station once, log the step and store its changes; packets wait in the modelled links."""
        begin_ns = time.process_time_ns()
        arrived = {AgentId(agent): tuple(packets[agent]) for agent in sorted(packets)}
        orders: list[Import | Command] = [*self._imports[:1], *commands]
        self._imports = self._imports[1:]
        output = self.station.step(arrived, done, now_ns, orders)
        if self._log is not None:
            write_step(self._log, arrived, done, output, now_ns, now_ns + self.options.start_ns, orders)
        if self.keeper is not None:
            self.keeper.write_changes(self.station, now_ns)
        sent_ns = now_ns
        if self._process is not None:
            sent = [packet for _, out in output.packets for packet in out]
            cost_ns = self._cost.take_ns([p for several in arrived.values() for p in several], done, sent)
            self._process.spend(cost_ns, now_ns)
            sent_ns = self._process.free_ns
        for agent, out in output.packets:
            self._links.send(agent, out, sent_ns)
        self._step_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        self.jobs.add(output.jobs, now_ns)
        self._steps += 1
        if self._steps % _RSS_STEPS == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())
        return output

    def outgoing(self, now_ns: int) -> dict[AgentId, tuple[bytes, ...]]:
        """Packets that leave the modelled links by now."""
        return {AgentId(agent): packets for agent, packets in self._links.deliver(now_ns).items()}

    def compare_digests(self, reachable: Collection[int]) -> None:
        """Note whether reachable agents hold equal values; without any, the last comparison stands."""
        ends = [settled(channel) for agent, channel in self.station.channels.items() if agent in reachable]
        if ends:
            self.digest_equal = all(equal for _, equal in ends)

    def end_of_frames(self) -> None:
        """Write the map and remember the counts as they stand at the last frame; draining follows."""
        if self.at_last_frame is None:
            self.at_last_frame = self.summary()
            if self._log is not None:
                self._write_map()

    def _write_map(self) -> None:
        """Write the map's files. Raises OSError, but for a base that goes on without them."""
        for name, content in map_files(self.station.mapper).items():
            try:
                write_atomically(self._folder / name, content)
            except OSError as error:
                if not self.options.log_optional:
                    raise
                self._notices.say("map", f"{self._folder / name}: not written: {error.strerror}")

    def summary(self) -> FlightSummary:
        """Counts and keyframe poses now."""
        return flight_summary(self.station.mapper)

    def report(self) -> dict[str, Any]:
        """The base's part of report.json, with raw samples in place of statistics."""
        self.end_of_frames()
        assert self.at_last_frame is not None
        rss = max(self.rss_mib, rss_mib())
        grid_ms = [ns / 1e6 for ns in self.station.mapper.grid_ns]
        return {
            **self.at_last_frame.counts,
            "digest_equal": self.digest_equal,
            "agents_lost": sorted(self.agents_lost),
            "drain": {"flight_ms": self._drained_ns // 1_000_000, **counts(self.station.mapper)},
            "timing": {**timings(self.jobs.cpu_ms, grid_ms, self._step_ms), "rss_mib": round(rss, 1)},
        }

    def close(self) -> bool:
        """Close the store and the log. False if the store does not hold all of the map; a message was printed."""
        stored = self.keeper is None or self.keeper.close(self.station)
        if self._log is not None:
            self._log.close()
        return stored


def report_restored(restored: Restored | None, parent: process.Parent | None) -> None:
    """Print what was restored and repaired, and send it to the parent process."""
    if restored is None:
        return
    process.print_lines(
        [
            f"store: {counted(restored.keyframes, 'keyframe')}, {counted(restored.awaited, 'value')} awaited",
            *(f"store: repaired: {fault}" for fault in restored.faults),
        ]
    )
    if parent is not None:
        faults = list(restored.faults)
        parent.send_event("restored", keyframes=restored.keyframes, faults=faults, awaited=restored.awaited)
