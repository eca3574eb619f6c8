"""One agent in flight: source, agent, log and modelled link, driven step by step."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import cost_ns
from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.onboard import onboard_agent
from kiteline_agent.runtime.camera_reader import CameraReader
from kiteline_agent.runtime.flight_log import STEP
from kiteline_agent.runtime.flight_record import FlightRecord, metadata
from kiteline_agent.runtime.frame_counts import CpuAccount, FrameCounts
from kiteline_agent.runtime.frame_reader import SAMPLES, FrameReader
from kiteline_agent.runtime.options import LOG_STEM, AgentOptions, agent_config, channel_for, is_filter
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import Identity, StepInput, StepOutput
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, RecordChannel, settled
from kiteline_core.config import ConfigError
from kiteline_core.ids import AgentId
from kiteline_core.wording import counted
from kiteline_hw.durable_files import link_newest
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.lockstep.messages import Down, Phase, Up
from kiteline_hw.lockstep.shared_core import CoreProcess
from kiteline_hw.logs.image_encoder import EncodingPolicy, ImageEncoder
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.machine import MACHINE, machine
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.logs.whole_file import LineFile
from kiteline_hw.ports import FrameSource, SourceError, is_live
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.memory import release_memory, rss_mib
from kiteline_hw.system.notices import Notices
from kiteline_hw.system.vocabulary import shipped_vocabulary

SAVE_FRAMES = 200  # frames between two looks at whether the rig file is up to date
PROGRESS_FRAMES = 10  # frames between two reports of progress, and between two readings of the memory in use
# events that begin so are noted in the report, as many at most
_WARNING, _MOST_WARNINGS = ("imu:", "images:", "odometer: no samples"), 10
_SAVE_S = 5.0  # s that the disk may take for the rig file at the end
_IMAGES_WAITING = 12  # images that wait to be encoded, 9 MB; then live flights store images, others wait


class AgentRuntime:
    """Drives one agent step by step, in lock-step or live: reads frames, logs, counts, and models link and CPU.

    whole_process: the agent is alone in this process. Then all CPU time between two frames but for decoding counts as
    the agent's, else only that of its steps. config: in place of what the options name. core: its process on a computer
    that it shares with others in modelled time; None: one of its own.
    """

    def __init__(
        self, options: AgentOptions, source: FrameSource, channel: RecordChannel, whole_process: bool,
        config: AgentConfig | None = None, core: CoreProcess | None = None,
    ) -> None:  # fmt: skip
        cv2.setNumThreads(1)
        self.options = options
        self.source = source
        self.channel = channel
        self.counts = FrameCounts()
        self._warnings: list[str] = []
        self._own_unit: set[int] = set()  # submaps with poses whose lengths are not metres
        self.flight_counts: dict[str, int | float] | None = None  # when the last frame had been flown
        self.rss_mib = 0.0
        grid = "agent" if options.grid == "base" and isinstance(channel, NoBaseChannel) else options.grid
        config = config or agent_config(options.config, options.cpu_percent, options.rig, grid, options.tracker)
        if options.with_others:
            config = replace(config, keyframe=replace(config.keyframe, earlier=True))
        self._rig_file = RigFile(options.rig) if options.rig else None
        self._saving: threading.Thread | None = None  # what writes the rig file
        self._rig_waits = False  # it did not come to an end
        begin_ns = time.process_time_ns()
        codec_warm.warm()
        warm(config)
        if whole_process:
            release_memory()
        self.warm_s = (time.process_time_ns() - begin_ns) / 1e9
        until_ns = options.start_ns + round(options.seconds * 1e9) if options.seconds > 0 else None
        self.camera = source if is_live(source) else None
        self.reader: FrameReader | CameraReader = (
            FrameReader(source, until_ns, time.process_time_ns) if self.camera is None else CameraReader(self.camera)
        )
        self._log_shift_ns = options.start_ns  # log time minus the time handed to the agent: log times are source times
        self._log_config = config.log
        self._encoder = ImageEncoder(EncodingPolicy(config.log.compressed, _IMAGES_WAITING))
        self._log: LogWriter | None = None
        self._budget: LogBudget | None = None
        self._lines: tuple[LineFile, ...] = ()
        self._notices = Notices()
        self._record = self._open_record(config) if options.log_name else None
        self.agent = onboard_agent(
            source.rig,
            source.imu,
            config,
            Identity(AgentId(options.agent), options.boot, options.submap),
            channel,
            shipped_vocabulary(),
        )
        if self._rig_file is not None and isinstance(self.agent, Agent) and self.agent.rig_is_of_another:
            line = self._rig_file.put_aside()
            self._warnings.append(line)
            self._notices.say("another rig", line)
        disorder = LinkModelConfig(
            loss=options.loss, duplicate=options.disorder, reorder=options.disorder,
            delay_ns=round(options.delay_s * 1e9)
        )  # fmt: skip
        self._wire = LinkModel(disorder, options.seed)
        self._overhead_bytes = channel.endpoint.config.overhead_bytes if isinstance(channel, CodedChannel) else 0
        self._account = CpuAccount(time.process_time_ns, self.reader, whole_process)
        self._last_cpu_ns = 0  # of the last frame: modelled in lock-step, measured in a live flight
        self._live_clock = False
        self._core: VirtualCpu | CoreProcess = VirtualCpu(options.cpu_percent) if core is None else core
        self._tracking_ms: deque[float] = deque(maxlen=SAMPLES)  # until the pose: by the clock, or as modelled
        self.output: StepOutput | None = None  # of the last step

    def _open_record(self, config: AgentConfig) -> FlightRecord | None:
        """Begin log and trajectories; None where a vehicle flies without, as its disk takes none."""
        options, source = self.options, self.source
        folder = Path(options.folder)
        about = {**metadata(options, source.name, config, self.channel), MACHINE: machine()}
        budget = LogBudget(folder, LOG_STEM, options.log_mib << 20) if options.log_mib > 0 else None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            log = LogWriter(
                folder / options.log_name, about, budget=budget, part_topic=STEP, encoder=self._encoder,
                beside=options.log_optional,
            )  # fmt: skip
        except (OSError, SourceError) as error:
            if not options.log_optional:
                raise
            why = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
            self._notices.say("log", f"no log of this flight: {why}; --log names its folder")
            return None
        self._log, self._budget = log, budget
        log.rig(self._log_shift_ns, source.rig, source.imu)
        log.flush()  # an agent that dies at once leaves a log that can be read
        paths = [folder / f"{options.trajectory_prefix}{name}" for name in ("live.tum", "odometry.tum")]
        live, odometry = [LineFile(path, beside=options.log_optional) for path in paths]
        self._lines = live, odometry
        for path in paths if options.trajectory_prefix else ():
            link_newest(folder / path.name.removeprefix(options.trajectory_prefix), path)
        return FlightRecord(log, live, odometry, options.agent, self.channel, config.log.every)

    @property
    def next_ns(self) -> int | None:
        """Flight time of the next frame; None after the last."""
        stamp = self.reader.next_ns
        return None if stamp is None else stamp - self.options.start_ns

    @property
    def session(self) -> int:
        """Session of the channel; 0 without a base."""
        return self.channel.endpoint.session if isinstance(self.channel, CodedChannel) else 0

    def first_message(self) -> Up:
        """The first message at the barrier."""
        return Up(self.next_ns, False, False, ())

    def tick(self, down: Down) -> Up:
        """One tick of a lock-step flight: take the base's packets, and the next frame if it is due."""
        if down.phase is not Phase.FLY:
            self.end_of_frames()
        given = StepInput(packets=tuple(down.packets))
        if self.next_ns is not None and self.next_ns <= down.now_ns:
            if self._core.newest_wins(self.next_ns, self.reader.period_ns):
                self.reader.drop()
                self.counts.dropped += 1
            else:
                frame, imu, odometry = self.reader.take()
                given = replace(given, frame=frame, imu=imu, odometry=odometry)
        sent = self.step(given, down.now_ns)
        quiet, equal = settled(self.channel)
        return Up(self.next_ns, quiet, equal, tuple(sent))

    def begin_at(self, begin_ns: int) -> None:
        """Begin a live flight: `begin_ns` of its clock is flight time 0."""
        self._live_clock = True
        self._encoder.stores = True
        self._encoder.apart = self._log_config.apart
        first_ns = begin_ns if self.camera is not None else self.reader.next_ns  # a camera's stamps are on our clock
        assert first_ns is not None
        self.options = replace(self.options, start_ns=first_ns)
        self._log_shift_ns = self.options.start_ns - begin_ns

    def await_frame(self, until_ns: int) -> list[str]:
        """Wait for a camera's frame until a time of the clock at most. Returns messages of the camera."""
        if self.camera is None or not isinstance(self.reader, CameraReader):
            return []
        self.reader.poll(until_ns)
        self.counts.dropped += self.camera.take_dropped()
        messages = self.camera.take_messages()
        if self._record is not None:
            for text in messages:
                self._record.text(text, time.monotonic_ns() + self._log_shift_ns)
        return messages

    @property
    def over(self) -> bool:
        """True after the last frame of a recording; a camera has none."""
        return self.camera is None and self.next_ns is None

    def drop_stale(self, flight_ns: int, in_time: Callable[[], bool]) -> bool:
        """Drop frames until the next one is the newest at a flight time, or none is left. False if it took too long."""
        if self.camera is not None:
            return True  # a camera itself drops what newer frames replaced
        while self.next_ns is not None and 0 < self.reader.period_ns <= flight_ns - self.next_ns:
            if not in_time():
                return False
            self.reader.drop()
            self.counts.dropped += 1
        return True

    def end_of_frames(self) -> None:
        """The last frame was flown: what follows is draining, which is reported apart."""
        if self.flight_counts is None:
            self.flight_counts = self.counts.as_report()

    def step(self, given: StepInput, now_ns: int, publish: Callable[[StepOutput], None] | None = None) -> list[bytes]:
        """One step of the agent, logged and counted, with the CPU time of its last frame. Returns the packets to send.

        publish: gets the output before it is logged, since a flight controller waits for its pose.
        """
        self._account.begin()
        begin_ns = time.monotonic_ns()
        frame, packets = given.frame, given.packets
        step_input = replace(given, cpu_ns=self._last_cpu_ns)
        self.output = output = self.agent.step(step_input, now_ns)
        if publish is not None:
            publish(output)
        tracking_ns = time.monotonic_ns() - begin_ns
        if self._record is not None:
            self._record.step(step_input, output, now_ns, now_ns + self._log_shift_ns)
        if frame is not None:
            self.counts.count(output.estimate, output.predicted)
            if output.estimate is not None and output.estimate.tracked and not self.agent.in_metres:
                self._own_unit.add(output.estimate.submap)
            if len(self._warnings) < _MOST_WARNINGS:
                self._warnings += [event for event in output.events if event.startswith(_WARNING)]
            if self._record is not None:
                self._record.pose(output)
            if not self._live_clock:
                ops = cost_ns(self.agent.work)
                self._core.spend(ops, now_ns)
                self._last_cpu_ns = ops
                tracking_ns = max(self._core.free_ns - now_ns, ops)
            if output.estimate is not None:
                self._tracking_ms.append(tracking_ns * 1e-6)
        sent_ns = now_ns if self._live_clock else max(now_ns, self._core.free_ns)
        for packet in output.packets:
            self._wire.send(packet, sent_ns)
        sent = self._wire.deliver(now_ns)
        self.counts.bytes_up += sum(map(len, output.packets)) + len(output.packets) * self._overhead_bytes
        self.counts.bytes_down += sum(map(len, packets)) + len(packets) * self._overhead_bytes
        self._account.end(frame is not None)
        if frame is not None and self._live_clock:
            self._last_cpu_ns = self._account.last_ns
        if frame is not None and self._account.frames % PROGRESS_FRAMES == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())
        if frame is not None and self._account.frames % SAVE_FRAMES == 0:
            self._save_rig()  # a vehicle's power may be cut at any time
        return sent

    def report(self) -> dict[str, Any]:
        """The agent's part of report.json, with raw samples in place of statistics."""
        self.end_of_frames()
        assert self.flight_counts is not None
        total = self.counts.as_report()
        skipped, notes = self.source.report.skipped, list(self.source.report.notes)
        if self._encoder.stored:
            notes.append(f"log: {counted(self._encoder.stored, 'image')} stored uncompressed, as encoding fell behind")
        notes += [*self._warnings, *self.log_notes()]
        return {
            "source": self.source.name,
            **self.flight_counts,
            "link": self.channel.report() if isinstance(self.channel, CodedChannel) else {},
            "skipped": dict(sorted(skipped.items())),
            "notes": notes,
            "scale": "metric" if self.agent.in_metres else "own",
            "own_unit_submaps": sorted(self._own_unit),
            **self.agent.motion_reports(),
            "drain": {key: total[key] - self.flight_counts[key] for key in ("bytes_up", "bytes_down")},
            "timing": {
                "cpu_ms_per_frame": list(self._account.ms),
                "tracking_ms": list(self._tracking_ms),
                "decode_ms": list(self.reader.decode_ms),
                "warm_up_s": round(self.warm_s, 3),
                "rss_mib": round(self.rss_mib, 1),
            },
        }

    def log_notes(self) -> list[str]:
        """A line for each file that is not whole."""
        files = [] if self._log is None else [("log", self._log.dropped, "messages", self._log.why)]
        files += [("trajectory", file.lost, "poses", file.why) for file in self._lines]
        notes = [f"{name}: {lost} {what} were not written: {why}" for name, lost, what, why in files if lost]
        return notes + ["rig: what this flight found is not written: the disk does not answer"] * self._rig_waits

    def take_notices(self) -> list[str]:
        """Messages about files that cannot be written: each kind of trouble once in a flight."""
        if self._log is not None and self._log.why:
            self._notices.say("log", f"log: messages are lost: {self._log.why}; the flight goes on")
        elif self._log is not None and self._log.waits_for:
            self._notices.say("disk", f"log: it waits for the disk: {self._log.waits_for}; the flight goes on")
        for why in [file.why for file in self._lines if file.why][:1]:
            self._notices.say("lines", f"trajectory: poses are not written: {why}; the flight goes on")
        if self._budget is not None and self._budget.deleted:
            limit = f"--log-mib {self.options.log_mib}, or a disk that is nearly full"
            self._notices.say("budget", f"log: the oldest logs are deleted: {limit}")
        if isinstance(self.channel, CodedChannel) and self.channel.endpoint.given_up:
            self._notices.say("spill", "link: old values wait for the base, and neither memory nor disk takes more: it "
                              "will lack some; the flight goes on")  # fmt: skip
        return self._notices.take()

    def _save_rig(self) -> None:
        """Write the rig file in a thread, for a flight cannot wait for a disk; nothing while the last one writes."""
        if self._rig_file is not None and not (self._saving and self._saving.is_alive()):
            known = self.agent.known_rig()
            self._saving = threading.Thread(target=self._write_rig, args=(known,), name="rig-file", daemon=True)
            self._saving.start()

    def _write_rig(self, known: KnownRigConfig | None) -> None:
        assert self._rig_file is not None
        try:
            self._rig_file.save(known)
        except ConfigError as error:
            self._notices.say("rig", f"rig: {error}")

    def close(self) -> None:
        """Finish the files. A disk that does not answer is awaited for some seconds, for all of them at once."""
        beside = [self._finish_rig, *(file.close for file in self._lines)]
        threads = [threading.Thread(target=finish, name="closing", daemon=True) for finish in beside]
        for thread in threads:
            thread.start()
        if self._log is not None:
            self._log.close()
        for thread in threads:
            thread.join()

    def _finish_rig(self) -> None:
        """Write the rig file once more, after the save that may be under way."""
        until_s = time.monotonic() + _SAVE_S
        if self._saving is not None:
            self._saving.join(_SAVE_S)
        self._save_rig()
        if self._saving is not None:
            self._saving.join(max(0.0, until_s - time.monotonic()))
            self._rig_waits = self._saving.is_alive()


def opened(options: AgentOptions) -> FrameSource:
    """The source of a flight. Raises SourceError, ConfigError."""
    mono = options.mono or is_filter(options.config, options.tracker)
    return open_source(options.source, mono=mono, imu=options.imu, calibration=options.calibration)


def channel_with_spill(options: AgentOptions) -> RecordChannel:
    """The channel to the base; beside a log, values that wait while the link is down are moved to a file."""
    spill = SpillFile(Path(options.folder), beside=options.log_optional) if options.log_name else None
    return channel_for(options, link_traits(options.link), spill)
