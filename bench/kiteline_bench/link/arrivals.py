"""Traffic of a link, from the logs of a flight: bytes in any second, delays of headers, gaps between poses."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from kiteline_agent.runtime import flight_log as agent_log
from kiteline_basestation.runtime import flight_log as base_log
from kiteline_codec.schema import KeyframeHeader, LivePose, Record, WireError, messages
from kiteline_codec.transport.packet import parse
from kiteline_hw.logs.mcap_log_read import LogReader
from kiteline_hw.ports import SourceError
from kiteline_lab.replay.logged_steps import steps

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LinkUse:
    """Traffic of one agent, upwards. Times in s of flight."""

    most_bytes_s: int  # in any one-second window, overhead included
    header_delays_s: list[float]  # from capture to arrival of each keyframe's header, before the flight's last second
    pose_gaps_s: list[float]  # between arrivals of live poses, until the last frame


def most_in_a_second(log: Path, topic: str, overhead_bytes: int) -> int:
    """The most bytes that left in any window of one second, both ends included."""
    window: deque[tuple[int, int]] = deque()
    most = total = 0
    with LogReader(log) as reader:
        for step in steps(reader):
            now_ns = int(step.head["now_ns"])
            sent = sum(len(packet) + overhead_bytes for packet in step.blobs(topic))
            window.append((now_ns, sent))
            total += sent
            while now_ns - window[0][0] > _SECOND_NS:
                total -= window.popleft()[1]
            most = max(most, total)
    return most


def live_shift_ns(agent_log_path: Path) -> int:
    """Stamp of a frame less the time on this machine's clock at which it was taken, of a live flight."""
    with LogReader(agent_log_path) as reader:
        frames = [(int(s.head["frame_ns"]), int(s.head["now_ns"])) for s in steps(reader) if s.head["frame_ns"]]
    if not frames:
        raise SourceError(f"{agent_log_path}: no frames in this log")
    return max(t_ns - now_ns for t_ns, now_ns in frames)


def _last_frame_ns(agent_log_path: Path) -> int:
    """When the last frame was taken in, on the clock of the flight: later poses are repeats of the last one."""
    with LogReader(agent_log_path) as reader:
        return max((int(s.head["now_ns"]) for s in steps(reader) if s.head["frame_ns"]), default=0)


def arrivals(base_folder: Path, shift_ns: int, end_ns: int) -> tuple[list[float], list[float]]:
    """Delays of headers of the first agent, and gaps between its live poses, in s.

    shift_ns: stamps less the clock. end_ns: on the clock, when the flight's frames end; the last gap does, too.
    """
    headers: dict[int, float] = {}
    poses_ns: list[int] = []
    for now_ns, record in _headers_and_poses(base_folder):
        if isinstance(record, KeyframeHeader):
            headers.setdefault(record.keyframe, (now_ns + shift_ns - record.t_ns) / 1e9)
        elif now_ns < end_ns:
            poses_ns.append(now_ns)
    gaps = [(b - a) / 1e9 for a, b in pairwise([*poses_ns, end_ns])] if poses_ns else []
    return list(headers.values()), gaps


def _headers_and_poses(base_folder: Path) -> Iterator[tuple[int, Record]]:
    """Headers of keyframes and live poses of the first agent, with the time on the base's clock when they came."""
    with LogReader(base_folder / "log.mcap") as reader:
        for step in steps(reader):
            for packet in step.blobs(base_log.packets_in(0)):
                try:
                    _, items = parse(packet, 1 << 20)
                except WireError:
                    continue
                for item in items:
                    if item.key.kind in (KeyframeHeader.KIND, LivePose.KIND) and item.whole:
                        yield int(step.head["now_ns"]), messages.decode(item.key, item.data)


def link_use(folder: Path, shift_ns: int, overhead_bytes: int) -> LinkUse:
    """The traffic of the first agent. shift_ns: stamps of frames less the clock of the flight."""
    log = folder / "agent0" / "log.mcap"
    delays, gaps = arrivals(folder / "base", shift_ns, _last_frame_ns(log))
    most = most_in_a_second(log, agent_log.PACKETS_OUT, overhead_bytes)
    return LinkUse(most, delays, gaps)
