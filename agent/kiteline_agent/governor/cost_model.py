"""Cost model of the virtual CPU: the time of a step from the operations counted in it."""

from dataclasses import dataclass, fields


@dataclass(slots=True)
class Work:
    """Operations counted in one step; PRICES_NS explains each."""

    steps: int = 0
    frames: int = 0
    rectified_px: int = 0
    pyramid_px: int = 0
    projected: int = 0
    alignments: int = 0
    stereo_points: int = 0
    posed_points: int = 0
    slants: int = 0
    inertial_samples: int = 0
    fused: int = 0
    pairs: int = 0
    keyframes: int = 0
    detected_px: int = 0
    new_landmarks: int = 0
    observations: int = 0
    bearings: int = 0
    searches: int = 0
    places: int = 0
    followed: int = 0
    window_keyframes: int = 0
    matched_px: int = 0
    segmented_px: int = 0
    coded_px: int = 0

    def clear(self) -> None:
        """Reset all counts for a new step."""
        for name in _COUNTS:
            setattr(self, name, 0)


_COUNTS = tuple(field.name for field in fields(Work))


# ns each on the modelled core, an x86 laptop's: fitted to measured steps at every effort, and rounded.
PRICES_NS: dict[str, float] = {
    "steps": 40_000,  # endpoint and log
    "frames": 305_000,  # fixed cost: arrays, motion model, estimate
    "rectified_px": 2.1,  # a remapped pixel
    "pyramid_px": 0.35,  # a pixel of an image whose pyramid was built
    "projected": 60,  # a landmark of the local map in view
    "alignments": 800,  # a template aligned at one level
    "stereo_points": 1_750,  # a searched row
    "posed_points": 1_300,  # a landmark in the motion-only optimisation
    "slants": 800,  # a patch compared with its template
    "inertial_samples": 1_000,  # preintegration
    "fused": 340_000,  # a frame in the smoother
    "pairs": 300_000,  # a frame compared with a keyframe for the disparity offset
    "keyframes": 1_200_000,  # coding and bookkeeping
    "detected_px": 2.1,  # a pixel searched for corners
    "new_landmarks": 11_000,  # row search, descriptor, template, code
    "observations": 1_600,  # code
    "bearings": 7_500,  # an epipolar segment searched for a landmark without depth
    "searches": 5_000_000,  # a relocalisation attempt
    "places": 650_000,  # a keyframe entered into the place index: the first searches enter all
    "followed": 2_800_000,  # a frame into which the corners of the inertial start are followed
    "window_keyframes": 190_000,  # a keyframe of its window in one iteration of the solver
    "matched_px": 75,  # semi-global matching, at the size of disparity images
    "segmented_px": 35,  # ground, labels and scan
    "coded_px": 9,  # a pixel reduced and coded for the base
}


def cost_ns(work: Work) -> int:
    """CPU time in ns of a step on the modelled core."""
    return round(sum([price * int(getattr(work, name)) for name, price in PRICES_NS.items()]))
