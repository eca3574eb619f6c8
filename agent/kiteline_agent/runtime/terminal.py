"""What a person at a terminal is told of a live flight: what changes, and now and then how it stands. No clock."""

from __future__ import annotations

from kiteline_agent.runtime.frame_counts import FrameCounts, live_pose
from kiteline_agent.step import StepOutput

_EVERY_NS = 10_000_000_000  # between two lines while nothing happens
_TOLD = (
    "submap",
    "recovered",
    "mono",
    "disparities",
    "governor: level",
    "odometer",
    "imu",
)  # beginnings of the events worth a line


class StatusMessages:
    """Makes lines of text from steps."""

    def __init__(self) -> None:
        self._tracking: bool | None = None  # None: no pose yet
        self._lost_ns = 0
        self._summary_ns = _EVERY_NS
        self._bytes_up = 0

    def lines(self, output: StepOutput, tally: FrameCounts, flight_ns: int) -> list[str]:
        """What is to be said after a step at a time of the flight."""
        out = [event for event in output.events if event.startswith(_TOLD)]
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
        if flight_ns >= self._summary_ns:
            rate = (tally.bytes_up - self._bytes_up) * 1e9 / (flight_ns - self._summary_ns + _EVERY_NS)
            out.append(f"{summary(tally)}; {rate / 1000:.1f} kB/s up")
            self._summary_ns, self._bytes_up = flight_ns + _EVERY_NS, tally.bytes_up
        return [f"{flight_ns / 1e9:8.1f} s  {line}" for line in out]


def summary(tally: FrameCounts) -> str:
    """The flight so far in one line."""
    return (
        f"{tally.frames} frames: {tally.tracked} tracked, {tally.lost} lost, {tally.dropped} dropped; "
        f"{len(tally.keyframes)} keyframes in {len(tally.submaps)} submap{'s' * (len(tally.submaps) != 1)}"
    )
