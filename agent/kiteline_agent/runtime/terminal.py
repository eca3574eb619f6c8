"""Status messages of a live flight for a terminal: important events, and a summary every 10 s. No clock."""

from collections.abc import Sequence

from kiteline_agent.runtime.frame_counts import FrameCounts, live_pose
from kiteline_agent.step import StepOutput
from kiteline_core.wording import counted

_SUMMARY_NS = 10_000_000_000  # between two summaries
_SHOWN = (
    "submap",
    "relocalised",
    "mono",
    "disparities",
    "governor: level",
    "odometer",
    "imu",
    "images",
    "camera stamps scatter",
    "camera stamps are right",
)  # beginnings of the events that are shown


class StatusMessages:
    """Makes lines of text from steps."""

    def __init__(self) -> None:
        self._tracking: bool | None = None  # None: no pose yet
        self._lost_ns = 0
        self._next_summary_ns = _SUMMARY_NS
        self._bytes_up = 0

    def lines(
        self, output: StepOutput, counts: FrameCounts, flight_ns: int, findings: Sequence[str] = ()
    ) -> list[str]:  # fmt: skip
        """The lines to print after a step. flight_ns: since the flight began. findings: about the flight controller."""
        out = [*findings, *(event for event in output.events if event.startswith(_SHOWN))]
        estimate = output.estimate
        if estimate is not None:
            tracking = live_pose(estimate) is not None
            if tracking and self._tracking is None:
                out.append("first pose")
            elif tracking and not self._tracking:
                out.append(f"tracking again after {(flight_ns - self._lost_ns) / 1e9:.1f} s")
            elif not tracking and self._tracking:
                out.append("lost: no pose from the images")
                self._lost_ns = flight_ns
            if tracking or self._tracking is not None:
                self._tracking = tracking
        if flight_ns >= self._next_summary_ns:
            rate = (counts.bytes_up - self._bytes_up) * 1e9 / (flight_ns - self._next_summary_ns + _SUMMARY_NS)
            out.append(f"{summary(counts)}; {rate / 1000:.1f} kB/s up")
            self._next_summary_ns, self._bytes_up = flight_ns + _SUMMARY_NS, counts.bytes_up
        return [f"{flight_ns / 1e9:8.1f} s  {line}" for line in out]


def summary(counts: FrameCounts) -> str:
    """The flight so far in one line."""
    return (
        f"{counted(counts.frames, 'frame')}: {counts.tracked} tracked, {counts.lost} lost, {counts.dropped} dropped; "
        f"{counted(counts.keyframes, 'keyframe')} in {counted(len(counts.submaps), 'submap')}"
    )
