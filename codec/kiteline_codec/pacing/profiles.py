"""What a keyframe may cost on a wide and on a thin link. A profile concerns only what the agent writes."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_codec.coding import quantise
from kiteline_codec.pacing.sections import split, take
from kiteline_codec.schema import CachedLandmarks, NewLandmarks, Observations
from kiteline_core.arrays import F32, F64
from kiteline_core.imaging.descriptors import narrowed


@dataclass(frozen=True, slots=True)
class Profile:
    """What an agent shares of a keyframe, and at what rate."""

    name: str = "wifi"
    landmarks: int = 2048  # new ones shared of a keyframe, best first; the others stay with the agent
    observations: int = 2048  # shared of a keyframe
    narrow: bool = False  # descriptors of 128 in place of 256 bits
    described: int = 2048  # new landmarks with a descriptor; the others serve the map's geometry alone
    pixel_step: int = 2  # of an observation, in 1/16 px: 1/8 px, a third of the alignment's deviation
    depth_step: int = 4  # of inverse depths, in 1/1024 of an octave: 0.08 px of disparity at 20 px
    angle_step: int = 1  # of a new landmark's direction, in 1/256 turns
    landmarks_bytes: int = 1230  # of a section's code; its residual code fills a packet of 1200 bytes
    observations_bytes: int = 1600  # of a section's code; its residual code takes less than half
    live_gap_ns: int = 95_000_000  # ns between live poses: 10 Hz
    keyframe_bytes: int = 7_500  # on the wire, roughly: with the rate, the pause between two keyframes
    thin: bool = False  # whether landmarks are fewer if keyframes come faster than the link carries them
    landmark_bytes: int = 39  # of a new landmark on the wire, headers included
    undescribed_bytes: int = 9  # the same without a descriptor, with one or two observations
    observations_room_bytes: int = 600  # of a keyframe's header and observations on the wire
    inertial_steps: bool = True  # whether the IMU's steps between keyframes are shared: 110 bytes a second
    packet_bytes: int = 1200  # largest packet: fits an Ethernet frame inside any tunnel
    overhead_bytes: int = 28  # cost of a packet on the wire beyond its own bytes: IPv4 and UDP
    heartbeat_ns: int = 1_000_000_000  # longest silence
    cached_landmarks: int = 96  # of a cached keyframe: with its neighbours' they cover its view
    cached_ahead: int = 6  # cached keyframes on their way at once: later ones may prove useless meanwhile

    def choose(
        self, landmarks: NewLandmarks, strength: F64, observations: Observations
    ) -> tuple[list[NewLandmarks], list[Observations]]:
        """The sections to share, best first. landmarks: their first rows are the best ones. strength: (n,)."""
        n = min(len(landmarks.index), self.landmarks)
        shared = landmarks if n == len(landmarks.index) else take(landmarks, np.arange(n))
        angle = shared.angle.astype(np.int64)
        shared = replace(
            shared,
            inv_depth=_stepped_depths(shared.inv_depth, self.depth_step),
            angle=((angle + self.angle_step // 2) // self.angle_step * self.angle_step & 255).astype(np.uint8),
            descriptor=narrowed(shared.descriptor) if self.narrow else shared.descriptor,
        )
        if len(observations.index) > self.observations:
            # Coarse octaves contribute least: keep an even choice of the finest.
            rank = np.argsort(observations.octave, kind="stable")[: self.observations]
            observations = take(observations, np.sort(rank))
            observations = replace(observations, index=np.arange(n, n + len(rank), dtype=np.uint16))
        step = self.pixel_step / quantise.PIXEL_STEPS
        observations = replace(
            observations,
            uv=(np.rint(observations.uv / step) * step).astype(np.float32),
            inv_depth=_stepped_depths(observations.inv_depth, self.depth_step),
        )
        observed = split(observations, np.zeros(len(observations.index)), self.observations_bytes)
        if n <= self.described:
            return split(shared, strength[:n], self.landmarks_bytes), observed
        best = np.argsort(-strength[:n], kind="stable")
        described, undescribed = np.sort(best[: self.described]), np.sort(best[self.described :])
        parts = split(take(shared, described), strength[described], self.landmarks_bytes)
        blank = take(shared, undescribed)
        blank = replace(blank, descriptor=np.zeros_like(blank.descriptor))
        for part in split(blank, strength[undescribed], self.landmarks_bytes):
            parts.append(replace(part, part=len(parts)))
        return parts, observed

    def cached_sections(self, landmarks: CachedLandmarks, strength: F64) -> list[CachedLandmarks]:
        """The sections of a cached keyframe, best first. strength: (n,)."""
        best = np.sort(np.argsort(-strength, kind="stable")[: self.cached_landmarks])
        chosen = take(landmarks, best)
        if self.narrow:
            chosen = replace(chosen, descriptor=narrowed(chosen.descriptor))
        return split(chosen, strength[best], self.landmarks_bytes)


WIFI = Profile()
RADIO = Profile(
    name="radio",
    landmarks=96,
    described=48,  # 16 + 6 bytes each
    observations=110,  # 2 bytes each
    narrow=True,
    pixel_step=4,
    depth_step=8,
    angle_step=4,
    landmarks_bytes=190,
    observations_bytes=400,
    live_gap_ns=195_000_000,  # 5 Hz, so that three lost poses still leave one a second
    keyframe_bytes=2_000,
    thin=True,
    inertial_steps=False,
    landmark_bytes=25,
    undescribed_bytes=11,
    observations_room_bytes=220,
    packet_bytes=220,  # holds a section of landmarks and a pose
    cached_landmarks=40,  # a kilobyte: two seconds of the whole link
    cached_ahead=1,
    overhead_bytes=7,  # two zeros, COBS and CRC-32 of a frame on a serial line
)
EXACT = Profile(name="exact", pixel_step=1, depth_step=1, live_gap_ns=0)  # the codes' own rounding only
PROFILES = {p.name: p for p in (WIFI, RADIO)}


def _stepped_depths(inv_depth: F32, step: int) -> F32:
    """To the nearest step, ties to the even one: always upwards, they would make the whole map 0.03 % too small."""
    codes = quantise.inverse_depth_codes(inv_depth)
    stepped = np.clip(np.rint(codes / step).astype(np.int64) * step, step, quantise.DEPTH_CODES - step)
    return quantise.inverse_depths(np.where(codes > 0, stepped, 0))
