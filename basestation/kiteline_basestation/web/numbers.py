"""The numbers that the status page shows; a line here is all that a new one needs.

A number that `Mapper.summary` has is read from `PageSnapshot.counts`; for any other, add a field in `snapshot.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot

T = TypeVar("T", PageSnapshot, AgentStatus)


@dataclass(frozen=True, slots=True)
class Number(Generic[T]):
    """A labelled number. unit: written behind it; "" none."""

    label: str
    unit: str
    value: Callable[[T], float]


def mapped_m2(page: PageSnapshot) -> float:
    """Area of the grid's known cells, m²."""
    return round(page.grid.known_m2(), 1)


# In the header of the page, from left to right.
TOTALS: tuple[Number[PageSnapshot], ...] = (
    Number("Keyframes", "", lambda page: sum(agent.keyframes for agent in page.agents)),
    Number("Landmarks", "", lambda page: sum(agent.landmarks for agent in page.agents)),
    Number("Loops", "", lambda page: page.counts.get("loops", 0)),
    Number("Merges", "", lambda page: page.counts.get("merges", 0)),
    Number("Mapped", "m²", mapped_m2),
    Number("Failed jobs", "", lambda page: page.counts.get("jobs_failed", 0)),
)

# On the card of each agent.
AGENT_COUNTS: tuple[Number[AgentStatus], ...] = (
    Number("Keyframes", "", lambda agent: agent.keyframes),
    Number("Landmarks", "", lambda agent: agent.landmarks),
    Number("Submaps", "", lambda agent: agent.submaps),
)


def as_json(numbers: tuple[Number[T], ...], source: T) -> list[dict[str, Any]]:
    """Labels, values and units of numbers, as JSON types."""
    return [{"label": n.label, "value": n.value(source), "unit": n.unit} for n in numbers]
