"""The interfaces of sources, links, flight controllers and clocks, and the errors that they raise."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeGuard

from kiteline_core.arrays import F64
from kiteline_core.errors import KitelineError
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig


class SourceError(KitelineError):
    """A source that cannot be read. The text says what was found, what was expected and how to mend it."""


class LinkError(KitelineError):
    """A link that cannot be opened. Packet loss and silence are no errors: links have them."""


@dataclass(slots=True)
class SourceReport:
    """Counts of what a source skipped, by reason, while it is read; `notes` holds a few examples."""

    skipped: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def skip(self, reason: str, note: str) -> None:
        """Count one skipped item; keep the first note of each reason, and ten notes in all."""
        self.skipped[reason] = self.skipped.get(reason, 0) + 1
        if self.skipped[reason] == 1 or len(self.notes) < 10:
            self.notes.append(f"{reason}: {note}")

    def clear(self) -> None:
        """Start a new reading."""
        self.skipped.clear()
        self.notes.clear()


class FrameSource(Protocol):
    """A camera or a recording. Iterating yields samples in order of time.

    An ImuBatch holds all inertial samples after the previous one, up to and including the time of the Frame that
    follows it; an OdometryBatch likewise those of an odometer.
    """

    @property
    def name(self) -> str: ...
    @property
    def rig(self) -> CameraRig: ...
    @property
    def imu(self) -> ImuCalibration | None: ...
    @property
    def ground_truth(self) -> Trajectory | None: ...
    @property
    def report(self) -> SourceReport: ...
    @property
    def frame_count(self) -> int | None:
        """How many frames will come, for a progress bar; None if unknown."""
        ...

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]: ...
    def close(self) -> None: ...


class LiveSource(FrameSource, Protocol):
    """A camera, or several: a FrameSource whose frames come when they come, stamped by CLOCK_MONOTONIC.

    None of its calls raises because a device is away: it is tried again, and `take_messages` says so.
    """

    @property
    def decode_ns(self) -> int:
        """CPU time that its threads spent on decoding so far."""
        ...

    @property
    def skew_ns(self) -> tuple[int, int] | None:
        """Right stamp minus left stamp over the last pairs: median, and the largest deviation; None without pairs."""
        ...

    def poll(self, until_ns: int) -> Frame | ImuBatch | OdometryBatch | None:
        """The next sample, awaited until a time of the monotonic clock at most; None if none has come."""
        ...

    def take_dropped(self) -> int:
        """Number of frames since the last call that newer ones replaced before they were taken."""
        ...

    def take_messages(self) -> list[str]:
        """What is to be told since the last call: what failed with the mend, what works again, what was measured."""
        ...


def is_live(source: FrameSource) -> TypeGuard[LiveSource]:
    """True if a source is a camera, whose frames are polled."""
    return hasattr(source, "poll")


class ByteLink(Protocol):
    """Carries packets, unreliably and unordered. Neither call ever blocks."""

    def send(self, packet: bytes) -> bool:
        """Send one packet; False if it was dropped at once (full buffer, no peer)."""
        ...

    def receive(self) -> list[bytes]:
        """All packets that have arrived since the last call."""
        ...

    def close(self) -> None: ...


class LinkHub(Protocol):
    """The base's end of the links of any number of agents."""

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents that have appeared so far, by agent number."""
        ...

    def alive(self) -> frozenset[int]:
        """The agents whose process is known to be reachable now."""
        ...

    def close(self) -> None: ...


def link_messages(end: ByteLink | LinkHub) -> list[str]:
    """What is to be told of an end of a link since the last call: a serial line that is gone, or back."""
    take: Callable[[], list[str]] | None = getattr(end, "take_messages", None)
    return [] if take is None else take()


class Framer(Protocol):
    """Puts packets on a byte stream and finds them again. Holds the state of one stream."""

    def encode(self, packet: bytes) -> bytes:
        """The bytes of one framed packet."""
        ...

    def feed(self, data: bytes) -> list[bytes]:
        """Add stream bytes, in pieces of any size; the valid packets that they complete."""
        ...


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A pose for a flight controller.

    t_ns: capture time, on the clock whose times are handed to the sink. T_o_b: (4,4) body in the continuous odometry
    frame, z up. quality: -1 failed, 0 unknown, 1..100. epoch: incremented only when the odometry frame itself was reset
    (a restart of the agent), never for a map correction. cov: (6,6) of T_o_b, [translation in o in m, rotation about
    the body's axes in rad]; None if unknown. velocity: (3,) m/s of the body's origin in o, and rate: (3,) rad/s in b,
    at t_ns; None: taken from the poses before.
    """

    t_ns: int
    T_o_b: F64
    tracked: bool
    quality: int
    epoch: int = 0
    cov: F64 | None = None
    velocity: F64 | None = None
    rate: F64 | None = None


class PoseSink(Protocol):
    """Receives poses as they are estimated. `push` never blocks and never raises for a peer that is away."""

    def push(self, pose: PoseSample, now_ns: int) -> None: ...
    def close(self) -> None: ...


class ControllerFinding(Protocol):
    """Something that was found about a flight controller."""

    @property
    def line(self) -> str:
        """The finding and what to do about it, in one line."""
        ...


class ControllerLink(PoseSink, Protocol):
    """A flight controller that receives poses and may send its own velocity and inertial samples."""

    def push_obstacles(self, distance_m: Sequence[float], reach_m: float, now_ns: int) -> None:
        """Send distances to obstacles around the vehicle, the first ahead, clockwise; inf: none up to reach_m, nan:
        unknown. Never blocks.
        """
        ...

    @property
    def T_b_f(self) -> F64:
        """(4,4) flight controller (forward, right, down) in the body."""
        ...

    def tunnel_link(self) -> ByteLink | None:
        """The tunnel to the base on the same connection; None if the link to the base is another one."""
        ...

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """Its velocities since the last call, up to a time on our clock; None if there are none."""
        ...

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """Its inertial samples since the last call, up to a time on our clock; None if there are none."""
        ...

    def take_findings(self) -> Sequence[ControllerFinding]:
        """What was found about it since the last call, each once."""
        ...


class Clock(Protocol):
    """A monotonic clock."""

    def now_ns(self) -> int: ...
