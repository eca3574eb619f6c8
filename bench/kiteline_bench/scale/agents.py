"""Many agents on one base: a base process as `kiteline base` starts it, and recorded agents over loopback Zenoh.

Every agent has a Zenoh session, an endpoint and a submap of its own, and shares a keyframe every few seconds, live
poses as often as its link allows. All of them are in this process, whose CPU is not counted.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, environment, is_true, run_command
from kiteline_bench.scale.recorded import Name, RecordedFlight, mask_of, record_flight, renamed
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import KeyframePose, LivePose
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.ids import AgentId, KeyframeId
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.links.open import open_link
from kiteline_hw.ports import ByteLink
from kiteline_lab.flights.processes import free_endpoint

SOURCE = "room_flight.mcap"
_KEYFRAMES = 60  # of the recorded flight
_PERIOD_S = 5.0  # between two keyframes of an agent
_COUNTS, _FULL_COUNTS = (5, 20, 50), (5, 20, 50, 80)
_SECONDS, _FULL_SECONDS = 45.0, 240.0
_SETTLE_S, _MOST_SETTLES, _DRAIN_S = 4.0, 15, 5.0
_TICK_S = 0.02
_LIVE_S = 0.05  # between two frames, whose poses the endpoint takes as its link allows
_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Served:
    """What a base did for so many agents.

    delays_s: from a keyframe shared to its refined pose received. unanswered: keyframes without one when the drain
    ended. cpu_share: of a core, of the base and its workers, without what it takes while no agent is there.
    agents_share: of a core, of the process of all agents: near 1, delays are its own.
    """

    agents: int
    keyframes: int
    delays_s: list[float]
    unanswered: int
    cpu_share: float
    idle_share: float
    agents_share: float
    rss_mib: float
    log: Path

    @property
    def p95_s(self) -> float:
        """95th percentile of the delays; infinite without any."""
        return float(np.percentile(self.delays_s, 95)) if self.delays_s else float("inf")


class RecordedAgent:
    """An agent without images: shares the keyframes of a recorded flight under a name of its own."""

    def __init__(self, flight: RecordedFlight, number: int, link: ByteLink, channel: CodedChannel) -> None:
        self._flight = flight
        self._name = Name(AgentId(number), number, 0, mask_of(number + 1))
        self._link = link
        self._channel = channel
        self._next = 0
        self._live_s = 0.0
        self.sent_s: dict[KeyframeId, float] = {}
        self.delays_s: list[float] = []
        for record in flight.about:
            channel.put(renamed(record, self._name))

    def step(self, now_s: float, due_s: float) -> None:
        """Take in what has arrived, share the keyframes due by `due_s` of its flight, and send."""
        now_ns = round(now_s * 1e9)
        for record in self._channel.receive(self._link.receive(), now_ns):
            if isinstance(record, KeyframePose) and record.keyframe in self.sent_s:
                self.delays_s.append(now_s - self.sent_s.pop(record.keyframe))
        while due_s >= self._next * _PERIOD_S and self._next < len(self._flight.keyframes):
            for record in self._flight.keyframes[self._next]:
                self._channel.put(renamed(record, self._name))
            if self._next:  # the first one of a submap is held
                self.sent_s[self._name.keyframe(self._next)] = now_s
            self._next += 1
        if self._next and now_s - self._live_s >= _LIVE_S:
            self._live_s = now_s
            newest = self._name.keyframe(self._next - 1)
            self._channel.put(LivePose(self._name.agent, now_ns, newest, np.eye(4), 100))
        for packet in self._channel.poll(now_ns):
            self._link.send(packet)

    def close(self) -> None:
        """Leave."""
        self._link.close()


def serve(flight: RecordedFlight, count: int, seconds: float, folder: Path, period_s: float = _PERIOD_S) -> Served:
    """Run a base with so many agents. Raises RuntimeError if the base does not start."""
    folder.mkdir(parents=True, exist_ok=True)
    link = f"zenoh:{free_endpoint()}"
    out = folder / "base.txt"
    with out.open("wb") as said:
        base = subprocess.Popen(
            [sys.executable, "-m", "kiteline_cli", "base", "--link", link, "--insecure",
             "--store", str(folder / "store"), "--log", str(folder / "log")],
            env=environment(XDG_STATE_HOME=str(folder / "state")), stdout=said, stderr=said,
        )  # fmt: skip
    try:
        return _serve(flight, count, seconds, folder, base, link, period_s / _PERIOD_S)
    finally:
        base.send_signal(signal.SIGTERM)
        base.wait(60)


def _serve(
    flight: RecordedFlight, count: int, seconds: float, folder: Path, base: subprocess.Popen[bytes], link: str,
    slower: float,
) -> Served:  # fmt: skip
    _await(folder / "base.txt", "base on", base)
    idle_share = _settled_share(base.pid)
    agents = [
        RecordedAgent(
            flight, n, open_link(link, "agent", LinkOptions(n)),
            coded_channel(agent_session(1, n), link=replace(link_traits(link), profile="wifi")),
        )
        for n in range(count)
    ]  # fmt: skip
    phase = np.random.default_rng(5).permutation(count) * (_PERIOD_S / count)
    begin_s = now_s = time.monotonic()
    before, own_before_s = cpu_s(base.pid), time.process_time()
    stopped_s, spent, own_s, rss_mib, keyframes = begin_s + seconds, 0.0, 0.0, 0.0, 0
    while now_s < stopped_s + _DRAIN_S:
        for n, agent in enumerate(agents):
            due_s = (min(now_s, stopped_s) - begin_s) / slower - float(phase[n])
            agent.step(now_s, due_s)
        if now_s < stopped_s:
            spent, rss_mib = cpu_s(base.pid) - before, rss_mib_of(base.pid)
            own_s = time.process_time() - own_before_s
        ahead_s = _TICK_S - (time.monotonic() - now_s)
        if ahead_s > 0:
            time.sleep(ahead_s)
        now_s = time.monotonic()
    delays = [delay for agent in agents for delay in agent.delays_s]
    unanswered = sum(len(agent.sent_s) for agent in agents)
    keyframes = len(delays) + unanswered
    for agent in agents:
        agent.close()
    share = spent / seconds - idle_share
    return Served(count, keyframes, delays, unanswered, share, idle_share, own_s / seconds, rss_mib, folder / "log")


def _settled_share(pid: int) -> float:
    """CPU of a base without agents, of a core, once its workers have loaded their kernels."""
    shares = [float("inf")]
    while len(shares) < _MOST_SETTLES:
        before = cpu_s(pid)
        time.sleep(_SETTLE_S)
        shares.append((cpu_s(pid) - before) / _SETTLE_S)
        if shares[-1] > 0.8 * shares[-2]:
            break
    return min(shares)


def _await(path: Path, text: str, process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + 200.0
    while text not in path.read_text(errors="replace"):
        if process.poll() is not None or time.monotonic() > end_s:
            raise RuntimeError(f"the base does not start: {path.read_text(errors='replace')[-300:]}")
        time.sleep(0.05)


def _family(pid: int) -> list[int]:
    """A process and its descendants."""
    out = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            out += _family(int(child))
    return out


def cpu_s(pid: int) -> float:
    """CPU time of a process and its descendants."""
    total = 0
    for one in _family(pid):
        fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / _TICKS_A_SECOND


def rss_mib_of(pid: int) -> float:
    """Resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def run(bench: Bench) -> list[Bar]:
    """A base with 5, 20 and 50 agents; and its replay."""
    seconds = _FULL_SECONDS if bench.full else _SECONDS
    bench.say(f"recording {SOURCE}")
    flight = record_flight(bench.source(SOURCE), _KEYFRAMES)
    served = []
    for count in _FULL_COUNTS if bench.full else _COUNTS:
        bench.say(f"{count} agents for {seconds:.0f} s")
        served.append(serve(flight, count, seconds, bench.folder / f"agents{count}"))
    few, most = served[0], served[len(_COUNTS) - 1]
    costs = [1000.0 * s.cpu_share / s.agents for s in (few, most)]
    bench.more.append(_table(served))
    return [
        at_most(f"{most.agents} agents at {1 / _PERIOD_S:g} keyframes a second: keyframe to refined pose, p95",
                most.p95_s, 1.0, "s"),
        at_most("keyframes without a refined pose at the end", max(s.unanswered for s in served), 0, "", 0),
        at_most(f"CPU of the base and its workers for each agent, {most.agents} over {few.agents} agents",
                costs[-1] / costs[0], 1.1, "", 2),
        is_true("the base's log of the fewest agents, again", "bit for bit", *_replayed(bench, few.log)),
    ]  # fmt: skip


def _replayed(bench: Bench, folder: Path) -> tuple[bool, str]:
    """Whether the base's log gives the same outputs again."""
    bench.say("replaying the base's log")
    log = sorted(folder.glob("*.mcap"))[-1]
    done = run_command([sys.executable, "-m", "kiteline_cli", "replay", str(log), "--verify"], 600.0)
    lines = (done.stdout + done.stderr).strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else f"status {done.returncode}"


def _table(served: Sequence[Served]) -> str:
    about = (
        "Recorded agents, each over its own loopback Zenoh session, to one base process with store and log. CPU is "
        "that of base and workers, in percent of a core, without what it takes alone. All agents are one process: when "
        "that takes a whole core, delays are its own."
    )
    lines = [
        about,
        "",
        "| agents | keyframes | pose after, median | p95 | most | CPU | an agent | alone | agents' CPU | memory |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for s in served:
        median, worst = (float(f(s.delays_s)) if s.delays_s else float("inf") for f in (np.median, np.max))
        lines.append(
            f"| {s.agents} | {s.keyframes} | {median:.3f} s | {s.p95_s:.3f} s | {worst:.3f} s "
            f"| {100 * s.cpu_share:.1f} % | {100 * s.cpu_share / s.agents:.2f} % | {100 * s.idle_share:.1f} % "
            f"| {100 * s.agents_share:.0f} % | {s.rss_mib:.0f} MiB |"
        )
    return "\n".join(lines)
