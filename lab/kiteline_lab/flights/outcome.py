"""What the processes of a flight left: raw reports, the base's keyframe poses, notes for the user."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kiteline_core.arrays import F64


@dataclass(slots=True)
class FlightOutcome:
    """Outcome of a flight. Reports hold raw samples in place of statistics; None: that process left none.

    at_last_frame, drained: T_w_k of the base's keyframes when the last frame came, and after the link was drained.
    restored: what each base found in its store at its start.
    """

    agents: list[dict[str, Any] | None]
    base: dict[str, Any] | None = None
    at_last_frame: dict[int, F64] = field(default_factory=dict)
    drained: dict[int, F64] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    restored: list[dict[str, Any]] = field(default_factory=list)
    failed: bool = False

    def note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)


def poses_from_json(value: Mapping[str, Sequence[float]]) -> dict[int, F64]:
    """Keyframe poses (4,4) from a base's JSON."""
    return {int(k): np.array(pose, np.float64).reshape(4, 4) for k, pose in value.items()}
