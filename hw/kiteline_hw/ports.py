"""What the edge promises to the rest: small protocols, one per kind of device."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kiteline_core.errors import KitelineError
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig


class SourceError(KitelineError):
    """A source that cannot be read. The text says what was found, what was expected and how to mend it."""


class LinkError(KitelineError):
    """A link that cannot be opened. Loss and silence are no errors: they are what links do."""


@dataclass(slots=True)
class SourceReport:
    """What a source passed over, by reason; it grows while the source is read. `notes` holds a few examples."""

    skipped: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def skip(self, reason: str, note: str) -> None:
        """Count one skipped item; keep the first ten notes."""
        self.skipped[reason] = self.skipped.get(reason, 0) + 1
        if len(self.notes) < 10:
            self.notes.append(f"{reason}: {note}")


class FrameSource(Protocol):
    """A camera or a recording. Iterating yields samples in order of time; an ImuBatch holds all inertial samples
    since the last one up to and including the time of the Frame that follows it, and an OdometryBatch those of an
    odometer, where there is one.
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
        """How many frames will come, for a progress bar; None when unknown."""
        ...

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]: ...
    def close(self) -> None: ...


class ByteLink(Protocol):
    """A way to carry packets, unreliable and unordered. Neither call ever blocks."""

    def send(self, packet: bytes) -> bool:
        """Hand over one packet; False when it was dropped at once (full buffer, no peer)."""
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


class Framer(Protocol):
    """Puts packets on a byte stream and finds them again. Holds the state of one stream."""

    def encode(self, packet: bytes) -> bytes:
        """The bytes of one framed packet."""
        ...

    def feed(self, data: bytes) -> list[bytes]:
        """Take what the stream delivered, any bytes in any pieces; the whole and sound packets completed by it."""
        ...


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A pose for a flight controller. T_o_b: (4,4) body in the continuous odometry frame, z up. t_ns: capture time on
    the clock whose times are handed to the sink. quality: -1 failed, 0 unknown, 1..100. epoch: bumped only when the
    odometry frame itself began anew (a restart of the agent), never for a map correction. cov: (6,6) of T_o_b,
    [translation in o in m, rotation about the body's axes in rad], or None where nobody knows.
    """

    t_ns: int
    T_o_b: NDArray[np.float64]
    tracked: bool
    quality: int
    epoch: int = 0
    cov: NDArray[np.float64] | None = None


class PoseSink(Protocol):
    """Somebody who wants poses as they come. `push` never blocks and never raises for a peer that is away."""

    def push(self, pose: PoseSample, now_ns: int) -> None: ...
    def close(self) -> None: ...


class ControllerLink(PoseSink, Protocol):
    """A flight controller that is told of poses and may tell of its own velocity and of what it feels."""

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """What it said of its velocity since the last call, up to an instant of our clock; None for nothing."""
        ...

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """What its inertial unit felt since the last call, likewise."""
        ...


class Clock(Protocol):
    """A monotonic clock."""

    def now_ns(self) -> int: ...
