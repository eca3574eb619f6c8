"""A stranger floods a base over loopback, from a process of its own, while an agent with a key flies; once over UDP.

The base is sealed as by default and listens on all interfaces. `--seconds` sets how long (600 for the promise).
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, environment, is_true
from kiteline_lab.flights.processes import free_endpoint

SECONDS = 30.0  # of flood by default
BYTES_S = 50e6
_AGENT_S = 200.0  # s that a flight may take, its start included
_LONGEST_S = 60.0  # s that a word of a process is awaited
_GROWN_MIB = 32.0
_KEYFRAMES = re.compile(r"stopped: (\d+) keyframe")
_FLOWN = re.compile(r"over: (\d+) frames: (\d+) tracked.*?; (\d+) keyframe")


@dataclass(slots=True)
class _Processes:
    """What the bench started, with what each says in a file."""

    out: Path
    running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, name: str, *words: object) -> subprocess.Popen[bytes]:
        state = {"XDG_STATE_HOME": str(self.out / "state"), "XDG_CONFIG_HOME": str(self.out / "config")}
        with (self.out / f"{name}.txt").open("wb") as said:
            process = subprocess.Popen(
                [sys.executable, "-m", *map(str, words)], stdout=said, stderr=said, env=environment(**state)
            )
        self.running.append(process)
        return process

    def said(self, name: str) -> str:
        return (self.out / f"{name}.txt").read_text(errors="replace")

    def until(self, name: str, text: str) -> float:
        """Seconds until a process has said a text; _LONGEST_S if it did not."""
        begin_s = time.monotonic()
        while text not in self.said(name) and time.monotonic() - begin_s < _LONGEST_S:
            time.sleep(0.05)
        return time.monotonic() - begin_s

    def end(self) -> None:
        for process in self.running:
            with contextlib.suppress(OSError):
                process.kill()
                process.wait(5)


def _rss_mib(pid: int) -> float:
    """Resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def _most_rss_mib(pid: int, until: subprocess.Popen[bytes]) -> float:
    """The most memory of a process while another one runs, MiB."""
    most = 0.0
    while until.poll() is None:
        most = max(most, _rss_mib(pid))
        time.sleep(0.2)
    return most


def _fly(processes: _Processes, name: str, endpoint: str, recording: str) -> tuple[int, int, int]:
    """Fly an agent as agent 3: frames, frames tracked, keyframes."""
    agent = processes.start(name, "kiteline_cli", "agent", recording, "--agent", 3, "--link", f"zenoh:{endpoint}")
    with contextlib.suppress(subprocess.TimeoutExpired):
        agent.wait(_AGENT_S)
    found = _FLOWN.search(processes.said(name))
    return (0, 0, 0) if found is None else (int(found[1]), int(found[2]), int(found[3]))


def run(bench: Bench) -> list[Bar]:
    """Fly, flood the base alone, fly again under the flood."""
    out, seconds = bench.folder / "stranger", bench.seconds or SECONDS
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    recording, processes = bench.source("room_flight.mcap"), _Processes(out)
    endpoint = free_endpoint()
    try:
        return [*_with_agent(bench, processes, endpoint, recording, seconds), *_over_udp(bench, processes, seconds)]
    finally:
        processes.end()


def _over_udp(bench: Bench, processes: _Processes, seconds: float) -> list[Bar]:
    """The memory of a base without agents, whose link takes datagrams."""
    endpoint = free_endpoint().replace("tcp/", "udp/")
    link = endpoint.replace("127.0.0.1", "0.0.0.0")
    base = processes.start("base_udp", "kiteline_cli", "base", "--link", f"zenoh:{link}")
    processes.until("base_udp", "base on")
    time.sleep(2.0)
    before_mib = _rss_mib(base.pid)
    bench.say(f"flooding over UDP for {seconds:g} s")
    stranger = processes.start("stranger_udp", "kiteline_bench.trust.flooder", endpoint, seconds, BYTES_S)
    grown_mib = _most_rss_mib(base.pid, stranger) - before_mib
    found = json.loads(processes.said("stranger_udp").splitlines()[-1])
    bench.more.append(f"Over UDP: {found['bytes'] / found['seconds'] / 1e6:.1f} MB/s for {found['seconds']:.0f} s.")
    return [at_most("the same of a base on UDP, without agents", grown_mib, _GROWN_MIB, "MiB", 1)]


def _with_agent(bench: Bench, processes: _Processes, endpoint: str, recording: str, seconds: float) -> list[Bar]:
    port = endpoint.rpartition(":")[2]
    base = processes.start("base", "kiteline_cli", "base", "--link", f"zenoh:tcp/0.0.0.0:{port}")
    processes.until("base", "base on")
    bench.say("flying without a stranger")
    alone = _fly(processes, "alone", endpoint, recording)
    time.sleep(2.0)
    before_mib = _rss_mib(base.pid)
    flood = ("kiteline_bench.trust.flooder", endpoint)
    bench.say(f"flooding for {seconds:g} s at {BYTES_S / 1e6:g} MB/s")
    stranger = processes.start("stranger", *flood, seconds, BYTES_S)
    grown_mib = _most_rss_mib(base.pid, stranger) - before_mib
    bench.say("flying under the flood")
    other = processes.start("another", *flood, _AGENT_S, BYTES_S)
    time.sleep(2.0)
    flooded = _fly(processes, "flooded", endpoint, recording)
    other.kill()
    time.sleep(1.0)
    base.send_signal(signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        base.wait(30)
    kept = _KEYFRAMES.search(processes.said("base"))
    found = json.loads(processes.said("stranger").splitlines()[-1])
    bench.more.append(
        f"Sent {found['bytes'] / 1e6:.0f} MB in {found['packets']} packets in {found['seconds']:.0f} s "
        f"({found['bytes'] / found['seconds'] / 1e6:.1f} MB/s), with a name and a question every 50 ms; it heard "
        f"{found['heard']} sealed packets of the base. The agent flew "
        f"{alone[0]} frames, {alone[1]} of them tracked, with {alone[2]} keyframes without, {flooded[0]} frames, "
        f"{flooded[1]} of them tracked, with {flooded[2]} under the flood."
    )
    return [
        at_most("memory of the base, grown under the flood", grown_mib, _GROWN_MIB, "MiB", 1),
        is_true("keyframes of an agent with a key, without and under the flood", "all arrive",
                kept is not None and int(kept[1]) >= alone[2] + flooded[2] > alone[2] > 0,
                f"{kept[1] if kept else 0} of {alone[2]} and {flooded[2]}"),
        at_most("packets of others that the stranger could read", found["readable"], 0, "", 0),
        is_true("questions of the stranger", "all refused", found["answers"] == 0 < found["refusals"],
                f"{found['answers']} answered, {found['refusals']} refused"),
        at_most("tracebacks", sum("Traceback" in processes.said(name) for name in ("base", "alone", "flooded")), 0, "",
                0),
    ]  # fmt: skip
