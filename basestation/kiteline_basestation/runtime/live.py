"""A live base: real clocks, any number of agents; jobs are done by worker processes."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kiteline_basestation.runtime.base_runtime import BaseRuntime, missing_extras, report_restored
from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_basestation.runtime.questions import Questions
from kiteline_basestation.runtime.seals import BaseSeals, logins_of
from kiteline_basestation.runtime.terminal import TerminalReporter
from kiteline_basestation.runtime.warm import WARMING
from kiteline_basestation.runtime.worker import Workers
from kiteline_basestation.station import Station
from kiteline_basestation.web.messages import status
from kiteline_basestation.web.snapshot import take_numbers
from kiteline_codec.channel import CodedChannel
from kiteline_codec.transport.framing import StreamFramer
from kiteline_codec.transport.seal import Sealer
from kiteline_core.ids import AgentId
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.links.open import open_link
from kiteline_hw.ports import LinkHub
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.long_work import StoppedError, long_work, starting
from kiteline_hw.system.memory import return_large_arrays

if TYPE_CHECKING:
    from kiteline_basestation.web.status_page import StatusPage

_POLL_S = 0.005  # s between two polls of the links: small beside the camera's period
_STEP_NS = 50_000_000  # ns between two steps without input: keeps acknowledgements and heartbeats moving


def fly_live(options: BaseOptions, parent: process.Parent | None, stop: process.StopSignal) -> bool:
    """Serve agents until `stop`. parent: the process that started this one, if it is a child of `kiteline fly`.

    False if the store does not hold all of the map.
    """
    return_large_arrays()
    if parent is None:
        process.print_lines(missing_extras())
    if options.web:
        importlib.import_module("kiteline_basestation.web.status_page")  # what it needs and lacks is told at once
    if not kernel_cache.filled():
        with starting():
            kernel_cache.fill(WARMING, stop, parent)
    if stop:
        return True
    clock, closed = MonotonicClock(), list[bool]()
    with process.without_waiting_for_terminal(), contextlib.ExitStack() as stack:
        logins = logins_of(Path(options.key)) if options.paired_only else {}
        link = open_link(options.link, "base", LinkOptions(framer=StreamFramer, required=False, logins=logins))
        stack.callback(link.close)
        seals = BaseSeals(options, link)
        page = _open_page(options, clock.now_ns(), stack)
        workers = Workers(options.workers)
        stack.callback(workers.close)
        try:
            with starting(), long_work(stop, "compiling kernels"):
                base = BaseRuntime(options, coded_channels(options, link_traits(options.link)), workers)
            stack.callback(lambda: process.print_lines(base.take_notices()))
            stack.callback(lambda: closed.append(base.close()))
            process.notify("READY=1")  # a store or an import that takes minutes is no failed start
            with long_work(stop, "reading the map"):
                restored = base.restore_maps(clock.now_ns())
        except StoppedError:
            return True
        report_restored(restored, parent)
        begin_ns = clock.now_ns()

        def report() -> dict[str, Any]:
            return {**status(take_numbers(base.station, clock.now_ns(), begin_ns)), **base.state()}

        questions = Questions(options, link, stack, report, lambda: seals.maps_key, logins)
        if parent is not None:
            parent.send_event("ready")
        terminal = TerminalReporter(base.station) if parent is None and not options.quiet else None
        if terminal is not None:
            store = f"store {options.store}" if options.store else "no --store: the map is not saved"
            process.print_lines([f"base on {options.link}, session {options.session}, {store}", *options.told])
        loop = _Loop(base, seals, workers, questions, clock, parent, terminal)
        while not stop:
            now_ns = loop.turn()
            if page is not None:
                page.update(base.station, now_ns, base.troubles)
            process.notify("WATCHDOG=1")
            stop.wait(_POLL_S)
        loop.end()
    return all(closed)


class _Loop:
    """The loop of a live base: a step where something has arrived, or none was for _STEP_NS."""

    def __init__(
        self, base: BaseRuntime, seals: BaseSeals, workers: Workers, questions: Questions, clock: MonotonicClock,
        parent: process.Parent | None, terminal: TerminalReporter | None,
    ) -> None:  # fmt: skip
        """parent: the process that started this one. terminal: what people are told; None with a parent or --quiet."""
        self._base, self._seals, self._workers, self._questions = base, seals, workers, questions
        self._clock, self._parent, self._terminal = clock, parent, terminal
        self._begin_ns, self._stepped_ns = clock.now_ns(), 0

    def turn(self) -> int:
        """Take in what has arrived, step if that is due, and send; the time of the turn."""
        now_ns, hub = self._clock.now_ns(), self._seals.hub
        packets = {agent: received for agent, end in hub.links().items() if (received := end.receive())}
        done = self._workers.done(now_ns)
        process.print_lines([*self._workers.take_notes(), *self._seals.lines(now_ns)])
        commands = self._questions.commands()
        if packets or done or commands or now_ns - self._stepped_ns >= _STEP_NS:
            output = self._base.step(packets, done, now_ns, commands)
            self._questions.answer(output.answers)
            self._stepped_ns = now_ns
            _raise_boots(self._seals.sealers, self._base.station)
            _send(hub, self._base.outgoing(now_ns))
            self._base.compare_digests(hub.alive())
            self._tell(hub, now_ns)
        if self._parent is not None and self._parent.next_line() == "frames_over":
            self._base.end_of_frames()
        return now_ns

    def end(self) -> None:
        """Tell how it ended: the terminal, or the parent."""
        base, parent = self._base, self._parent
        if self._terminal is not None:
            process.print_lines([f"stopped: {self._terminal.summary()}"])
        base.end_of_frames()
        if parent is not None and base.at_last_frame is not None:
            parent.send_event("flown", keyframes=base.at_last_frame.keyframes)
            parent.send_event("result", report=base.report(), keyframes=base.summary().keyframes)
        process.print_lines(base.take_notices())

    def _tell(self, hub: LinkHub, now_ns: int) -> None:
        base = self._base
        if self._parent is None:
            process.print_lines(base.take_notices())
        if self._terminal is not None:
            stored = None if base.keeper is None else base.keeper.idle
            process.print_lines(self._terminal.lines(hub.alive(), now_ns - self._begin_ns, base.rss_mib, stored))


def _raise_boots(sealers: Mapping[int, Sealer], station: Station) -> None:
    """Let seals follow sessions that rose, as an agent knew a later one of another base."""
    for agent, sealer in sealers.items():
        channel = station.channels.get(AgentId(agent))
        if isinstance(channel, CodedChannel):
            sealer.raise_to(channel.endpoint.session)


def _open_page(options: BaseOptions, now_ns: int, stack: contextlib.ExitStack) -> StatusPage | None:
    """The status page on --web. Raises LinkError."""
    if not options.web:
        return None
    from kiteline_basestation.web.status_page import open_page  # imports a web server

    page = open_page(options.web, now_ns)
    stack.callback(page.close)
    process.print_lines([f"status page: {page.url}"])
    return page


def _send(hub: LinkHub, packets: Mapping[AgentId, Sequence[bytes]]) -> None:
    links = hub.links()
    for agent, out in packets.items():
        if agent in links:
            for packet in out:
                links[agent].send(packet)
