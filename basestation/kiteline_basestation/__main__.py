"""The base station as a process: the mapper, its log, its links and its files, put together.

`Ground` drives the station step by step and serves every kind of flight: lock-step in this process (lab), lock-step
behind a barrier (`fly_lockstep`), and live on real clocks (`fly_live`).
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.runtime.flight_log import RESTORED, metadata_of, station_of, write_step
from kiteline_basestation.runtime.options import (
    BaseOptions,
    base_config,
    coded_channels,
    options_of,
    parser,
)
from kiteline_basestation.runtime.outputs import counts, map_files
from kiteline_basestation.runtime.summary import FlightSummary, flight_summary, timings
from kiteline_basestation.runtime.terminal import TerminalReporter
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.runtime.worker import SAMPLES, LockstepJobs, Worker
from kiteline_basestation.station import Import, Station, StationOutput
from kiteline_basestation.store.combine import combine
from kiteline_basestation.store.keeper import Keeper, read_imports
from kiteline_basestation.store.restore import Restored, restore
from kiteline_basestation.store.saved_map import SavedMap, pack
from kiteline_basestation.store.store import StoreError
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import RecordChannel, settled
from kiteline_codec.schema import WireError
from kiteline_codec.transport.framing import StreamFramer
from kiteline_codec.transport.seal import Direction, Opener, Sealer, suite_for
from kiteline_core import config as configuration
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary
from kiteline_hw.links.open import open_link
from kiteline_hw.links.sealed_link import SealedHub
from kiteline_hw.links.zenoh_link import ZenohHub
from kiteline_hw.links.zenoh_queries import QueryServer
from kiteline_hw.lockstep.messages import NO_MORE_FRAMES_NS, Down, Phase, Up
from kiteline_hw.lockstep.zenoh_lockstep import LockstepServer
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import LinkError, LinkHub, SourceError
from kiteline_hw.sim.links.link_model import LinkModelConfig, LinkModels
from kiteline_hw.system import process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.cpu import return_large_arrays, rss_mib
from kiteline_hw.system.key_store import read_keys
from kiteline_hw.system.vocabulary import shipped_words

if TYPE_CHECKING:
    from kiteline_basestation.web.status_page import StatusPage

_COLLECT_S = 120.0  # s that an agent may take for one tick of a lock-step flight before it counts as gone
_DRAIN_TICK_NS = 50_000_000  # ns of flight time between two ticks after the last frame: acknowledgements go at once
_DRAIN_NS = 30_000_000_000  # ns of flight time after which a link that is still not quiet is given up
_LIVE_WAIT_S = 0.005  # s between two looks at the links of a live base: small beside the camera's period
_LIVE_STEP_NS = 50_000_000  # ns between two steps without news: keeps acknowledgements and heartbeats moving
_SESSION_S = 1_735_689_600  # s of Unix time at which 2025 began: sessions are counted in seconds since then
_MEMORY_STEPS = 10  # steps between two looks at the memory


class Ground:
    """The base in flight: a station, and to each agent a modelled link.

    open_channel: our end of the codec; plain: there is no codec, so that no packets are logged.
    """

    def __init__(
        self,
        spec: BaseOptions,
        open_channel: Callable[[AgentId], RecordChannel],
        jobs: Worker | None = None,
        plain: bool = False,
    ) -> None:
        cv2.setNumThreads(1)
        self.spec = spec
        self.config = base_config(spec.config)
        codec_warm.warm()
        words = place_words()
        warm(self.config, words)
        if jobs is None and words is not None:
            warm_graphs()
        self.station = Station(self.config, open_channel, words)
        self.jobs: LockstepJobs | Worker = LockstepJobs() if jobs is None else jobs
        self.phase = Phase.FLY
        self.now_ns = -1
        self.rss_mib = 0.0
        self.steps = 0
        self.step_ms: deque[float] = deque(maxlen=SAMPLES)
        self.drained_ns = 0
        self.digest_equal = False
        self.flown: FlightSummary | None = None  # the base when the last frame had come
        self.agents_lost: set[int] = set()
        self._last_frame_ns = 0
        self._folder = Path(spec.folder)
        self._log: LogWriter | None = None
        if spec.log_name:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._log = LogWriter(self._folder / spec.log_name, metadata_of(spec, self.config, plain))
            self._log.text("/log", spec.start_ns, "info", f"base, session {spec.session}")
            self._log.flush()  # a base that dies at once leaves a log that can be read
        self._log_shift_ns = spec.start_ns
        disorder = LinkModelConfig(
            loss=spec.loss, duplicate=spec.disorder, reorder=spec.disorder, delay_ns=round(spec.delay_s * 1e9)
        )  # fmt: skip
        self._wires = LinkModels(disorder, spec.seed * 64 + 32)
        self.keeper: Keeper | None = None
        self._imports: list[Import] = []

    def compare(self, here: Collection[int]) -> None:
        """Note whether the agents that are here hold what we hold; once they are gone, what was seen last counts."""
        ends = [settled(channel) for agent, channel in self.station.channels.items() if agent in here]
        if ends:
            self.digest_equal = all(equal for _, equal in ends)

    def begin(self, now_ns: int) -> Restored | None:
        """Go on from what the store holds and from what is imported; None where there is nothing. Raises StoreError,
        SourceError, WireError.
        """
        self.keeper = Keeper(Path(self.spec.store)) if self.spec.store else None
        held = kept = SavedMap() if self.keeper is None else self.keeper.load()
        maps, self._imports = read_imports(self.spec.imports, lambda metadata: station_of(metadata, place_words()))
        for other in maps:
            kept = combine(kept, other)
        restored = None
        if not kept.empty:
            if self._log is not None:
                self._log.blob(RESTORED, now_ns + self._log_shift_ns, pack(kept))
            restored = restore(self.station, kept, now_ns)
            kept = restored.kept
        if self.keeper is not None:
            self.keeper.begin(self.station, kept, held)
        return restored

    def turn(self, ups: Mapping[int, Up]) -> dict[int, Down]:
        """One tick of a lock-step flight: every agent's message in, the next tick and the packets for it out.

        The first call brings greetings only: nothing is stepped, the first tick is set.
        """
        if self.now_ns >= 0:
            packets = {agent: up.packets for agent, up in ups.items()}
            self.step(packets, self.jobs.done(self.now_ns), self.now_ns)
        frames = [up.next_ns for up in ups.values() if up.next_ns != NO_MORE_FRAMES_NS]
        if frames:
            self.now_ns = min(frames)
        else:
            self._drain(ups)
        sent = self.outgoing(self.now_ns)
        return {agent: Down(self.now_ns, self.phase, sent.get(AgentId(agent), ())) for agent in sorted(ups)}

    def _drain(self, ups: Mapping[int, Up]) -> None:
        if self.phase is Phase.FLY:
            self.phase = Phase.DRAIN
            self._last_frame_ns = self.now_ns
            self.frames_are_over()
        ends = [settled(channel) for agent, channel in self.station.channels.items() if agent in ups]
        ends += [(up.quiet, up.digest_equal) for up in ups.values()]
        self.digest_equal = bool(ends) and all(equal for _, equal in ends)
        self.drained_ns = self.now_ns - self._last_frame_ns
        still = self.digest_equal and all(quiet for quiet, _ in ends) and self.station.mapper.idle and self.jobs.idle
        if not ups or still or self.drained_ns >= _DRAIN_NS:
            self.phase = Phase.END
        self.now_ns += _DRAIN_TICK_NS

    def frames_are_over(self) -> None:
        """What follows is draining: the map is written, and kept in mind, as it stands now."""
        if self.flown is None:
            self.flown = self.snapshot()
            if self._log is not None:
                for name, content in map_files(self.station.mapper).items():
                    (self._folder / name).write_bytes(content)

    def snapshot(self) -> FlightSummary:
        """The base as it stands."""
        return flight_summary(self.station.mapper)

    def step(
        self,
        packets: Mapping[int, Sequence[bytes]],
        done: Sequence[JobDone],
        now_ns: int,
        commands: Sequence[Command] = (),
    ) -> StationOutput:
        """One step of the station, logged and kept; in lock-step what it sends waits on the modelled wires."""
        begin_ns = time.process_time_ns()
        arrived = {AgentId(agent): tuple(packets[agent]) for agent in sorted(packets)}
        orders: list[Import | Command] = [*self._imports[:1], *commands]
        self._imports = self._imports[1:]
        output = self.station.step(arrived, done, now_ns, orders)
        if self._log is not None:
            write_step(self._log, arrived, done, output, now_ns, now_ns + self._log_shift_ns, orders)
        if self.keeper is not None:
            self.keeper.keep_at_times(self.station, now_ns)
        for agent, out in output.packets:
            self._wires.send(agent, out, now_ns)
        self.step_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        self.jobs.add(output.jobs, now_ns)
        self.steps += 1
        if self.steps % _MEMORY_STEPS == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())
        return output

    def outgoing(self, now_ns: int) -> dict[AgentId, tuple[bytes, ...]]:
        """What leaves the modelled links by now."""
        return {AgentId(agent): packets for agent, packets in self._wires.deliver(now_ns).items()}

    def report(self) -> dict[str, Any]:
        """The base's part of report.json, with raw samples in place of statistics."""
        self.frames_are_over()
        assert self.flown is not None
        rss = max(self.rss_mib, rss_mib())
        timing = {**timings(self.jobs.cpu_ms, self.step_ms), "rss_mib": round(rss, 1)}
        drained = {"flight_ms": self.drained_ns // 1_000_000, **counts(self.station.mapper)}
        lost = sorted(self.agents_lost)
        return {
            **self.flown.counts, "digest_equal": self.digest_equal, "agents_lost": lost, "drain": drained,
            "timing": timing,
        }  # fmt: skip

    def close(self) -> None:
        """Finish the store and the log."""
        if self.keeper is not None:
            self.keeper.close(self.station)
        if self._log is not None:
            self._log.close()


def place_words() -> Vocabulary | None:
    """The words by which places are recognised; None where what loops need is not installed."""
    if importlib.util.find_spec("gtsam") is None:
        print(
            "gtsam is not installed: no loops are closed, no maps joined; pip install 'kiteline[base]'", file=sys.stderr
        )
        return None
    return shipped_words()


def fly_lockstep(spec: BaseOptions, parent: process.Parent) -> None:
    """Keep the barrier: step once all agents have handed in their messages. An agent that ends is left out."""
    return_large_arrays()
    ground = Ground(spec, coded_channels(spec))
    _tell(ground.begin(0), parent)
    server = LockstepServer(spec.link.removeprefix("lockstep:"))
    try:
        parent.tell("ready")
        here, dying = set(spec.agents), False
        while ground.phase is not Phase.END:
            ups = _collect(server, here, ground, parent)
            if 0 <= spec.kill_at_s * 1e9 <= ground.now_ns and not dying:
                dying = True
                threading.Timer(spec.kill_delay_s, os.kill, (os.getpid(), signal.SIGKILL)).start()
            over = ground.flown is not None
            for agent, down in ground.turn(ups).items():
                with contextlib.suppress(LinkError):  # an agent that has ended is found missing at the next tick
                    server.answer(agent, down.encode())
            if ground.flown is not None and not over:
                parent.tell("flown", keyframes=ground.flown.keyframes)
        report = ground.report()
        parent.tell("result", report=report, keyframes=ground.snapshot().keyframes)
    finally:
        server.close()
        ground.close()


def _collect(server: LockstepServer, here: set[int], ground: Ground, parent: process.Parent) -> dict[int, Up]:
    """The messages of all agents that are still here; those that ended are taken out of `here`."""
    while here:
        try:
            return {agent: Up.decode(message) for agent, message in server.collect(here, _COLLECT_S).items()}
        except LinkError as error:
            gone = server.lost() & here or here
            here -= gone
            ground.agents_lost |= gone
            parent.tell("agents_lost", agents=sorted(gone), text=str(error))
    return {}


def fly_live(spec: BaseOptions, parent: process.Parent | None, stop: process.StopSignal) -> None:
    """Serve any number of agents on real clocks until told to stop; long work is done by a process beside."""
    return_large_arrays()
    clock = MonotonicClock()
    with contextlib.ExitStack() as stack:
        plain = hub = open_link(spec.link, "base", framer=StreamFramer, required=False)
        stack.callback(hub.close)
        if spec.key:
            hub = _sealed(spec, hub)
        worker = Worker()
        stack.callback(worker.close)
        ground = Ground(spec, coded_channels(spec), worker)
        stack.callback(ground.close)
        _tell(ground.begin(clock.now_ns()), parent)
        questions = _questions(spec, plain, stack)
        page: StatusPage | None = None
        if spec.web:
            from kiteline_basestation.web.status_page import open_page

            page = open_page(spec.web, clock.now_ns())
            stack.callback(page.close)
            print(f"status page: {page.url}", file=sys.stderr)
        if parent is not None:
            parent.tell("ready")
        process.notify("READY=1")
        narrator = TerminalReporter(ground.station) if parent is None and not spec.quiet else None
        begin_ns, stepped_ns = clock.now_ns(), 0
        if narrator is not None:
            kept = f", store {spec.store}" if spec.store else ", nothing is kept: no --store"
            process.print_lines([f"base on {spec.link}, session {spec.session}{kept}"])
        while not stop:
            now_ns = clock.now_ns()
            packets = {agent: received for agent, link in hub.links().items() if (received := link.receive())}
            done = worker.done(now_ns)
            asked = [Command(q.number, q.verb, q.text) for q in questions.questions()] if questions else []
            if packets or done or asked or now_ns - stepped_ns >= _LIVE_STEP_NS:
                output = ground.step(packets, done, now_ns, asked)
                for answer in output.answers:
                    if questions is not None:
                        questions.answer(answer.id, answer.ok, answer.text)
                stepped_ns = now_ns
                _send(hub, ground.outgoing(now_ns))
                ground.compare(hub.alive())
                if narrator is not None:
                    stored = None if ground.keeper is None else ground.keeper.idle
                    process.print_lines(narrator.lines(hub.alive(), now_ns - begin_ns, ground.rss_mib, stored))
            if page is not None:
                page.renew(ground.station, now_ns)
            if parent is not None and parent.said() == "frames_over":
                ground.frames_are_over()
            process.notify("WATCHDOG=1")
            stop.wait(_LIVE_WAIT_S)
        if narrator is not None:
            process.print_lines([f"over: {narrator.summary()}"])
        ground.frames_are_over()
        if parent is not None and ground.flown is not None:
            parent.tell("flown", keyframes=ground.flown.keyframes)
            parent.tell("result", report=ground.report(), keyframes=ground.snapshot().keyframes)


def _sealed(spec: BaseOptions, hub: LinkHub) -> LinkHub:
    """The hub with its packets sealed; agents without a key are not heard. Raises LinkError."""
    keys = read_keys(Path(spec.key))

    def sealer(agent: int) -> Sealer | None:
        key = keys.get(agent)
        return None if key is None else Sealer(key, agent, spec.session, Direction.DOWN, suite_for(spec.link))

    return SealedHub(hub, sealer, Opener(keys, Direction.UP))


def _send(hub: LinkHub, packets: Mapping[AgentId, Sequence[bytes]]) -> None:
    links = hub.links()
    for agent, out in packets.items():
        link = links.get(agent)
        if link is not None:
            for packet in out:
                link.send(packet)


def _tell(restored: Restored | None, parent: process.Parent | None) -> None:
    """Say with what the base began, and what in it was wrong."""
    if restored is None:
        return
    print(f"store: {restored.keyframes} keyframes, {restored.awaited} values awaited", file=sys.stderr)
    for fault in restored.faults:
        print(f"store: mended: {fault}", file=sys.stderr)
    if parent is not None:
        parent.tell(
            "restored", keyframes=restored.keyframes, faults=list(restored.faults), awaited=restored.awaited
        )  # fmt: skip


def _questions(spec: BaseOptions, hub: LinkHub, stack: contextlib.ExitStack) -> QueryServer | None:
    """Where other programs ask for maps: --maps, else the agents' link, where it is Zenoh and not sealed."""
    if spec.maps:
        server = QueryServer("maps", endpoint=spec.maps.removeprefix("zenoh:"))
    elif isinstance(hub, ZenohHub) and not spec.key:
        server = QueryServer("maps", session=hub.session)
    else:
        return None
    stack.callback(server.close)
    return server


def main(argv: Sequence[str] | None = None) -> int:
    """`kiteline base`, and a child of `kiteline fly` (with --spec); the exit status."""
    p = parser()
    a = p.parse_args(argv)
    if a.spec:
        options = configuration.from_json(BaseOptions, a.spec)
        expected = (LinkError, SourceError, StoreError, WireError, ValueError)
        process.leave(
            process.run_child(options.link, partial(fly_lockstep, options), partial(fly_live, options), expected)
        )
    if not a.link:
        p.error("a --link is needed, such as zenoh:tcp/0.0.0.0:7447")
    # Seconds since a fixed date: a base on another machine, without this one's files, still begins a later session.
    folder = Path(a.store) if a.store else process.state_folder() / "base"
    session = process.next_number(folder / "session", int(time.time()) - _SESSION_S)
    fly_live(options_of(a, session), None, process.StopSignal())
    process.leave(0)


if __name__ == "__main__":
    raise SystemExit(main())
