"""How much a keyframe may cost, and how often one may be: what crosses a wide and a thin link.

Both sides read every profile's values: a profile only says what the agent writes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.pacing.sections import split_births, split_copied, split_sightings, take
from kiteline_codec.schema import CachedLandmarks, NewLandmarks, Observations
from kiteline_core.imaging.descriptors import narrowed

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Profile:
    """What an agent shares of a keyframe, and at what rate."""

    name: str = "wifi"
    births: int = 2048  # shared of a keyframe's births, best first; the agent keeps the others for itself
    sightings: int = 2048  # shared of a keyframe's sightings
    narrow: bool = False  # descriptors of 128 in place of 256 bits
    described: int = 2048  # births with a descriptor; the others help the map's geometry alone
    pixel_step: int = 2  # of a sighting, in 1/16 px: 1/8 px, a third of the alignment's deviation
    depth_step: int = 4  # of inverse depths, in 1/1024 of an octave: 0.08 px of disparity at 20 px
    angle_step: int = 1  # of a birth's direction, in 1/256 turns
    births_bytes: int = 1080  # of a section, plain; its tight form fills a packet of 1200 bytes with headers and pose
    sightings_bytes: int = 1600  # of a section, plain; tight, it takes less than half
    live_gap_ns: int = 95_000_000  # ns between live poses: 10 Hz
    keyframe_bytes: int = 7_500  # what a keyframe takes of the link, roughly: with the rate, the pause between two
    thin: bool = False  # whether births are fewer where keyframes come faster than the link carries them
    birth_bytes: int = 39  # what a birth takes of the link, headers included
    blank_bytes: int = 9  # the same without a descriptor, with what it takes to sight it once or twice
    sightings_room_bytes: int = 600  # what a keyframe's header and sightings take
    packet_bytes: int = 1200  # largest packet: fits an Ethernet frame inside any tunnel
    overhead_bytes: int = 28  # a packet costs on the wire beyond its own bytes: IPv4 and UDP
    heartbeat_ns: int = 1_000_000_000  # longest silence
    copied: int = 96  # points of a copied keyframe: with its neighbours' they cover what it saw
    copies_ahead: int = 6  # copied keyframes on their way at once: the rest may prove to be of no use meanwhile

    def choose(
        self, births: NewLandmarks, strength: F64, sightings: Observations
    ) -> tuple[list[NewLandmarks], list[Observations]]:
        """The sections to share, best first. births: their first `births` rows are the best ones. strength: (n,)."""
        n = min(len(births.index), self.births)
        shared = take(births, np.arange(n))
        angle = shared.angle.astype(np.int64)
        shared = replace(
            shared,
            inv_depth=_stepped_depths(shared.inv_depth, self.depth_step),
            angle=((angle + self.angle_step // 2) // self.angle_step * self.angle_step & 255).astype(np.uint8),
            descriptor=narrowed(shared.descriptor) if self.narrow else shared.descriptor,
        )
        if len(sightings.index) > self.sightings:
            # Coarse octaves and recent points say least: keep an even choice of the finest.
            rank = np.argsort(sightings.octave, kind="stable")[: self.sightings]
            sightings = take(sightings, np.sort(rank))
            sightings = replace(sightings, index=np.arange(n, n + len(rank), dtype=np.uint16))
        step = self.pixel_step / quantise.PIXEL_STEPS
        seen = replace(
            sightings,
            uv=(np.rint(sightings.uv / step) * step).astype(np.float32),
            inv_depth=_stepped_depths(sightings.inv_depth, self.depth_step),
        )
        best = np.argsort(-strength[:n], kind="stable")
        named, nameless = np.sort(best[: self.described]), np.sort(best[self.described :])
        parts = split_births(take(shared, named), strength[named], self.births_bytes)
        blank = take(shared, nameless)
        blank = replace(blank, descriptor=np.zeros_like(blank.descriptor))
        for part in split_births(blank, strength[nameless], self.births_bytes):
            parts.append(replace(part, part=len(parts)))
        return parts, split_sightings(seen, np.zeros(len(seen.index)), self.sightings_bytes)

    def copies(self, points: CachedLandmarks, strength: F64) -> list[CachedLandmarks]:
        """The sections of a copied keyframe, best first. strength: (n,)."""
        best = np.sort(np.argsort(-strength, kind="stable")[: self.copied])
        chosen = take(points, best)
        if self.narrow:
            chosen = replace(chosen, descriptor=narrowed(chosen.descriptor))
        return split_copied(chosen, strength[best], self.births_bytes)


WIFI = Profile()
RADIO = Profile(
    name="radio",
    births=96,
    described=48,  # 16 + 6 bytes each
    sightings=110,  # 2 bytes each
    narrow=True,
    pixel_step=4,
    depth_step=8,
    angle_step=4,
    births_bytes=190,
    sightings_bytes=400,
    live_gap_ns=245_000_000,  # 4 Hz, so that two lost poses still leave one a second
    keyframe_bytes=2_000,
    thin=True,
    birth_bytes=25,
    blank_bytes=11,
    sightings_room_bytes=220,
    packet_bytes=220,  # a quarter of a second at 1000 B/s: a pose waits no longer
    copied=40,  # a kilobyte: two seconds of the whole link
    copies_ahead=1,
    overhead_bytes=7,  # two zeros, COBS and CRC-32 of a frame on a serial line
)
EXACT = Profile(name="exact", pixel_step=1, depth_step=1, live_gap_ns=0)  # nothing but the codes' own rounding
PROFILES = {p.name: p for p in (WIFI, RADIO)}


def _stepped_depths(inv_depth: F32, step: int) -> F32:
    """To the nearest step, ties to the even one: always upwards, they would make the whole map 0.03 % too small."""
    codes = quantise.inverse_depth_codes(inv_depth)
    stepped = np.clip(np.rint(codes / step).astype(np.int64) * step, step, quantise.DEPTH_CODES - step)
    return quantise.inverse_depths(np.where(codes > 0, stepped, 0))
