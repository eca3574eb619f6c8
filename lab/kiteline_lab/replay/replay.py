"""`kiteline replay LOG`: run an agent or a base again from its log, and compare its outputs with the logged ones."""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kiteline_agent.onboard import OnboardAgent
from kiteline_agent.runtime import flight_log as agent_log
from kiteline_agent.runtime.frame_counts import FrameCounts, live_line, odometry_line
from kiteline_agent.runtime.warm import WARMING as AGENT_WARMING
from kiteline_agent.runtime.warm import warm as agent_warm
from kiteline_basestation.jobs import Job
from kiteline_basestation.runtime import flight_log as base_log
from kiteline_basestation.runtime.base_runtime import load_vocabulary, missing_extras
from kiteline_basestation.runtime.warm import WARMING as BASE_WARMING
from kiteline_basestation.runtime.warm import warm as base_warm
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import unpack
from kiteline_core.arguments import limit
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_core.wording import counted
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.logs.log_parts import WholeLog
from kiteline_hw.logs.machine import MACHINE, apart, machine
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.ports import SourceError
from kiteline_hw.system import kernel_cache, process
from kiteline_lab.flights.progress import Progress
from kiteline_lab.outputs.out_file import write_whole
from kiteline_lab.replay.logged_steps import Step, agent_input, agent_of_log, check_replayable, steps


@dataclass(slots=True)
class ReplayResult:
    """Outcome of a replay. difference: the first one in words, None without any. station: the base at the end.

    apart_m, apart_rad: largest distances between odometry poses and the logged ones.
    """

    steps: int = 0
    difference: str | None = None
    apart_m: float = 0.0
    apart_rad: float = 0.0
    counts: FrameCounts = field(default_factory=FrameCounts)
    live: list[str] = field(default_factory=list)
    odometry: list[str] = field(default_factory=list)
    station: Station | None = None

    def note_difference(self, step: Step, what: str) -> None:
        """Keep the first difference."""
        if self.difference is None:
            self.difference = f"step {step.number} at {step.head['now_ns'] / 1e9:.3f} s: {what}"

    def compare_pose(self, step: Step, topic: str, name: str, made: dict[str, Any] | None) -> None:
        """Note a difference between a pose, if the step made one, and the logged one."""
        logged = [m.json() for m in step.of(topic)]
        if len(logged) != (made is not None):
            self.note_difference(step, f"{int(made is not None)} {name}s, {len(logged)} in the log")
        elif made is not None:
            wrong = [key for key in logged[0].keys() | made.keys() if logged[0].get(key) != made.get(key)]
            if wrong:
                self.note_difference(step, f"the {name} has another {', '.join(sorted(wrong))}")
            if "T_o_b" in wrong and {len(pose["T_o_b"]) for pose in (logged[0], made)} == {16}:
                was, now = (np.reshape(pose["T_o_b"], (4, 4)) for pose in (logged[0], made))
                shift_m, turn_rad = se3.shift_and_turn(se3.inverse(was) @ now)
                self.apart_m, self.apart_rad = max(self.apart_m, shift_m), max(self.apart_rad, turn_rad)

    def compare_packets(self, step: Step, topic: str, sent: tuple[bytes, ...]) -> None:
        """Note a difference between packets and the logged ones."""
        logged = step.blobs(topic)
        if logged != sent:
            pairs = enumerate(zip(logged, sent))
            first = next((i for i, (a, b) in pairs if a != b), min(len(logged), len(sent)))
            counts = f"{len(sent)} packets, {len(logged)} in the log"
            self.note_difference(step, f"{topic}: {counts}, the first that differs is {first}")


def replay_agent(
    log: LogReader,
    progress: Progress | None = None,
    stop_at_first: bool = True,
    watch: Callable[[Step, OnboardAgent], None] | None = None,
) -> ReplayResult:
    """Run an agent again. watch: called after each step. Raises SourceError for a log that cannot be replayed."""
    agent = agent_of_log(log)
    out = ReplayResult()
    for step in steps(log):
        given = agent_input(step)
        output = agent.step(given, step.head["now_ns"])
        if watch is not None:
            watch(step, agent)
        made = None if output.estimate is None else agent_log.estimate_to_json(output.estimate)
        out.compare_pose(step, agent_log.ESTIMATE, "estimate", made)
        made = None if output.predicted is None else agent_log.predicted_to_json(output.predicted)
        out.compare_pose(step, agent_log.PREDICTED, "predicted pose", made)
        out.compare_packets(step, agent_log.PACKETS_OUT, output.packets)
        if given.frame is not None:
            out.counts.count(output.estimate, output.predicted)
            out.live.append(live_line(output.estimate))
            out.odometry.append(odometry_line(output.estimate or output.predicted))
        if _finish_step(out, progress, stop_at_first=stop_at_first):
            break
    return out


def replay_base(
    log: LogReader,
    progress: Progress | None = None,
    stop_at_first: bool = True,
    watch: Callable[[Station], None] | None = None,
) -> ReplayResult:
    """Run a base again. watch: called after each step. Raises SourceError for a log that cannot be replayed."""
    check_replayable(log, "base")
    station = base_log.station_of(log.metadata, load_vocabulary(), link_traits)
    start_ns = int(json.loads(log.metadata["spec"])["start_ns"])
    jobs: dict[int, Job] = {}
    out = ReplayResult(station=station)
    for saved in log.messages((base_log.RESTORED,)):
        restore(station, unpack(saved.blob()), saved.t_ns - start_ns)
    for step in steps(log):
        _replay_base_step(out, station, step, jobs)
        if watch is not None:
            watch(station)
        if _finish_step(out, progress, stop_at_first=stop_at_first):
            break
    return out


def _replay_base_step(out: ReplayResult, station: Station, step: Step, jobs: dict[int, Job]) -> None:
    """Run one step; jobs: those under way, by id."""
    packets = {AgentId(int(a)): step.blobs(base_log.packets_in(int(a))) for a in step.head["agents"]}
    done = []
    for number, logged in zip(step.head["done"], step.of(base_log.JOB)):
        done.append(base_log.done_again(jobs.pop(number), logged))
        if base_log.fingerprint(done[-1]) != logged.json()["result"]:
            out.note_difference(step, f"job {number} has another result")
    orders = base_log.read_orders([*step.of(base_log.IMPORT), *step.of(base_log.COMMAND)])
    output = station.step(packets, done, step.head["now_ns"], orders)
    jobs.update({job.id: job for job in output.jobs})
    if [[job.id, job.kind] for job in output.jobs] != step.head["jobs"]:
        out.note_difference(step, "other jobs")
    answers = [{"id": a.id, "ok": a.ok, "text": a.text} for a in output.answers]
    if answers != [message.json() for message in step.of(base_log.ANSWER)]:
        out.note_difference(step, "other answers")
    for agent, sent in output.packets:
        out.compare_packets(step, base_log.packets_out(agent), sent)


def _finish_step(out: ReplayResult, progress: Progress | None, *, stop_at_first: bool) -> bool:
    """Count a step; whether the replay ends here."""
    out.steps += 1
    if progress is not None:
        progress.update(out.steps)
    return out.difference is not None and stop_at_first


def main(argv: list[str]) -> int:
    """Run `kiteline replay`; 1 when --verify found a difference."""
    p = argparse.ArgumentParser(
        prog="kiteline replay",
        description="Run an agent or a base again from its log: the same inputs go through the same steps.",
    )
    p.add_argument("log", metavar="LOG", type=Path, help="agentN/log.mcap or base/log.mcap of a flight")
    p.add_argument(
        "--verify", action="store_true", help="compare all packets and estimates bit for bit; exit 1 where one differs"
    )
    p.add_argument(
        "--cpu", metavar="PERCENT", type=limit, default=0.0, help="fly the log's frames anew with so much of one core"
    )
    p.add_argument(
        "--virtual", action="store_true", help="with --cpu: the modelled core, also where the kernel could limit us"
    )
    p.add_argument("--out", metavar="DIR", type=Path, help="leave trajectories here")
    a = p.parse_args(argv)
    if a.cpu and a.verify:
        p.error("--cpu goes without --verify: its flight is a new one")
    if a.virtual and not a.cpu:
        p.error("--virtual is the kind of the limit that --cpu sets: it goes with --cpu")
    if a.cpu:
        from kiteline_lab.replay.replay_cpu import refly

        return refly(a.log, a.cpu, a.out, a.virtual)
    cv2.setNumThreads(1)
    with WholeLog(a.log) as log:
        is_agent = log.metadata.get("role") == "agent"
        if a.out is not None and not is_agent:
            raise SourceError(f"{a.log}: --out leaves an agent's trajectories, and this is a base's log")
        if a.out is not None:
            a.out.mkdir(parents=True, exist_ok=True)  # what cannot be made is told before minutes of replay
        if not is_agent:
            process.print_lines(missing_extras())
        kernel_cache.fill((*AGENT_WARMING, *BASE_WARMING))
        agent_warm()
        base_warm()
        made_on = log.metadata.get(MACHINE, machine())
        elsewhere = made_on != machine()
        with Progress("replaying", log.topics.get(agent_log.STEP), "steps") as progress:
            stop = a.verify and not elsewhere
            done = (replay_agent if is_agent else replay_base)(log, progress, stop_at_first=stop)
        cut = log.cut
    if a.out is not None and is_agent:
        write_whole(a.out / "live.tum", "".join(done.live).encode())
        write_whole(a.out / "odometry.tum", "".join(done.odometry).encode())
    if cut is not None:
        print(f"the log was {cut}; what stands before was replayed")
    if done.difference is not None:
        print(f"differs: {done.difference}")
        if elsewhere:
            print(_of_another_machine(made_on, done if is_agent else None))
        return 1 if a.verify else 0
    frames = f", {counted(done.counts.frames, 'frame')}" if is_agent else ""
    print(f"{counted(done.steps, 'step')}{frames}: every output as in the log")
    return 0


def _of_another_machine(made_on: str, agent: ReplayResult | None) -> str:
    """Why outputs differ that were made elsewhere, and by how much an agent's do."""
    there, here = apart(made_on, machine())
    text = f"last digits do, as the log was made with {there}, and this is {here}"
    if agent is None:
        return text
    return f"{text}; odometry is up to {1e3 * agent.apart_m:.1f} mm and {np.degrees(agent.apart_rad):.2f}° apart"
