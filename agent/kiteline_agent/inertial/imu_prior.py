"""What is known of an IMU before a map begins."""

from collections.abc import Callable
from dataclasses import dataclass

from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.preintegration import BiasPrior, Samples, TimeOffset


@dataclass(frozen=True, slots=True)
class ImuPrior:
    """Values that are applied, and what tracking so far has found.

    bias: None before any was estimated. correct: gives samples with the scales and axes that are applied. clock: tells
    when frames were taken, by the camera's stamps; offset is added to that.
    """

    bias: BiasPrior | None
    offset: TimeOffset
    correct: Callable[[Samples], Samples]
    clock: FrameClock
