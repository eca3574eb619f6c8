"""The virtual CPU's prices: what a step costs, from operations counted while it ran. Pure and reproducible."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(slots=True)
class Work:
    """Operations of one step, counted where they are done; see PRICES_NS for what each stands for."""

    steps: int = 0
    frames: int = 0
    rectified_px: int = 0
    pyramid_px: int = 0
    projected: int = 0
    coarse_points: int = 0
    fine_points: int = 0
    stereo_points: int = 0
    posed_points: int = 0
    inertial_samples: int = 0
    keyframes: int = 0
    detected_px: int = 0
    births: int = 0
    sightings: int = 0
    searches: int = 0

    def clear(self) -> None:
        """Begin a new step."""
        for field in fields(self):
            setattr(self, field.name, 0)


# ns each on the modelled core: an x86 laptop's, fitted to measured steps at every level of effort, and rounded.
PRICES_NS = Work(
    steps=60_000,  # endpoint and log
    frames=420_000,  # what does not grow with anything: arrays, motion model, estimate
    rectified_px=3,  # a pixel that was remapped
    pyramid_px=1,  # a pixel of the image on which a pyramid was built
    projected=9,  # a point of the local map that was looked at, twice a frame
    coarse_points=2_500,  # a template aligned on the two small levels
    fine_points=3_600,  # a template aligned to sub-pixels
    stereo_points=1_000,  # a row looked along
    posed_points=700,  # a point in the motion-only optimisation
    inertial_samples=15_000,  # preintegration and its share of the smoother
    keyframes=700_000,  # coding and bookkeeping
    detected_px=5,  # a pixel of the image searched for corners
    births=26_000,  # row search, descriptor, template, code
    sightings=1_500,  # code
    searches=5_000_000,  # a look for a lost place
)


def cost_ns(work: Work) -> int:
    """CPU time in ns that the modelled core takes for a step."""
    return sum(getattr(work, field.name) * getattr(PRICES_NS, field.name) for field in fields(work))
