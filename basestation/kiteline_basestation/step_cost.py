"""Cost model of the base's own step on the modelled core: the CPU time of a step from what it did.

Fitted to the measured steps of a rendered drone's flight, with the codec and without (three quarters of the variance),
in units of the modelled core of the agent that flew beside them (`kiteline_agent.governor.cost_model`).
"""

from collections.abc import Sequence
from dataclasses import replace

from kiteline_basestation.jobs import JobDone
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE
from kiteline_basestation.station import Station

# ns each on the modelled core
PRICES_NS: dict[str, float] = {
    "steps": 200_000,  # loop, log and planning
    "packets": 80_000,  # opened or filled
    "packet_bytes": 140,  # coded or decoded
    "received": 84_000,  # a record of an agent
    "published": 63_000,  # a record with corrections
    "keyframes": 6_200_000,  # matching, triangulation, culling
    "matched_keyframes": 15_000,  # a keyframe of the map among which a new one is looked for
    "found": 127_000,  # a landmark that was fused
    "bundles": 835_000,  # a local bundle applied
    "refreshed_keyframes": 90_000,  # a keyframe of the map that a full bundle moved
    "grids": 600_000,  # an update of the grid
}


class StepCost:
    """Counts what a station does from step to step."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._before = replace(station.mapper.counts)

    def take_ns(self, arrived: Sequence[bytes], done: Sequence[JobDone], sent: Sequence[bytes]) -> int:
        """CPU time in ns of the last step. arrived, sent: packets; done: finished jobs."""
        mapper, before = self._station.mapper, self._before
        self._before = counts = replace(mapper.counts)
        keyframes = counts.keyframes - before.keyframes
        full = sum(job.kind == FULL_BUNDLE.name for job in done)
        work = {
            "steps": 1,
            "packets": len(arrived) + len(sent),
            "packet_bytes": sum(map(len, arrived)) + sum(map(len, sent)),
            "received": self._station.received,
            "published": self._station.published,
            "keyframes": keyframes,
            "matched_keyframes": keyframes * len(mapper.map),
            "found": counts.found - before.found,
            "bundles": counts.bundles - before.bundles,
            "refreshed_keyframes": full * len(mapper.map),
            "grids": counts.grids - before.grids,
        }
        return round(sum(price * work[name] for name, price in PRICES_NS.items()))
