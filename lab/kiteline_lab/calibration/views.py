"""Collects views of the board: which are new, which parts of the image they cover, and what is wanted next."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from kiteline_core.arrays import F64, I64, U8
from kiteline_lab.calibration.boards import Board, Corners, same_order

GRID = (8, 6)  # cells of an image, columns and rows
_PER_CELL = 3  # corners that make a cell covered
_NOVEL = 0.05  # of the image's width that an edge of the board must have moved
_SIDE_SHARE = 0.6  # of the cells at a side
_TILTED = 1.12  # ratio of opposite sides of the board's outline in the image
_NEEDED_TILTED = 4  # views turned about each axis
ENOUGH_VIEWS = 15
MOST_VIEWS = 80  # more cost time and tell nothing

SIDES = {"left edge": (slice(None), slice(0, 1)), "right edge": (slice(None), slice(-1, None)),
         "top edge": (slice(0, 1), slice(None)), "bottom edge": (slice(-1, None), slice(None))}  # fmt: skip


@dataclass(frozen=True, slots=True)
class View:
    """What one frame shows of the board. eyes: corners by camera, None where it is not seen."""

    t_ns: int
    eyes: tuple[Corners | None, ...]


@dataclass(slots=True)
class Coverage:
    """Corners seen in each cell of a camera's image."""

    size: tuple[int, int]  # width, height in px
    counts: I64 = field(default_factory=lambda: np.zeros(GRID[::-1], np.int64))

    def add(self, corners: Corners) -> None:
        """Count the corners of a view."""
        columns, rows = GRID
        x = np.clip((corners.px[:, 0] + 0.5) / self.size[0] * columns, 0, columns - 1).astype(np.int64)
        y = np.clip((corners.px[:, 1] + 0.5) / self.size[1] * rows, 0, rows - 1).astype(np.int64)
        np.add.at(self.counts, (y, x), 1)

    @property
    def share(self) -> float:
        """Share of the cells that are covered."""
        return float((self.counts >= _PER_CELL).mean())

    def bare_sides(self) -> list[str]:
        """Sides of the image with too few corners, the barest first. Corners count less: a lens may leave them dark."""
        covered = self.counts >= _PER_CELL
        shares = {name: float(covered[part].mean()) for name, part in SIDES.items()}
        return sorted((n for n, share in shares.items() if share < _SIDE_SHARE), key=lambda n: shares[n])


class ViewCollector:
    """Takes frames one by one and keeps the views that say something new."""

    def __init__(self, board: Board, cameras: int) -> None:
        self._board, self._cameras = board, cameras
        self.views: list[View] = []
        self.coverage: list[Coverage] = []
        self.tilted = np.zeros(2, np.int64)  # views turned about the image's y, and about its x
        self.seen = self.frames = 0
        self._outlines: list[F64] = []

    def add(self, t_ns: int, images: tuple[U8 | None, ...]) -> bool:
        """Look for the board in a frame's images; True if the view was kept."""
        self.frames += 1
        if not self.coverage:
            first = [image for image in images[: self._cameras] if image is not None]
            if len(first) < self._cameras:  # the size of each camera's images is needed
                return False
            self.coverage = [Coverage((image.shape[1], image.shape[0])) for image in first]
        eyes = [None if image is None else self._board.find(image) for image in images[: self._cameras]]
        if len(eyes) == 2 and eyes[0] is not None and eyes[1] is not None and not self._board.is_charuco:
            eyes[1] = same_order(eyes[0], eyes[1])
        if all(corners is None for corners in eyes):
            return False
        self.seen += 1
        outlines = [self._outline(corners, k) for k, corners in enumerate(eyes)]
        outline = np.concatenate(outlines)
        if len(self.views) >= MOST_VIEWS or not self._is_new(outline):
            return False
        self._outlines.append(outline)
        self.views.append(View(t_ns, tuple(eyes)))
        for k, corners in enumerate(eyes):
            if corners is not None:
                self.coverage[k].add(corners)
        shown = next(o for o, corners in zip(outlines, eyes) if corners is not None).reshape(4, 2)
        self.tilted += _ratios(shown) > _TILTED
        return True

    def wanted(self) -> str:
        """What to show next, "" if nothing is missing."""
        for k, coverage in enumerate(self.coverage):
            bare = coverage.bare_sides()
            if bare:
                eye = f" of the {('left', 'right')[k]} camera" if len(self.coverage) > 1 else ""
                return f"the board at the {bare[0]}{eye}"
        if self.tilted[0] < _NEEDED_TILTED:
            return "the board turned about the upright axis"
        if self.tilted[1] < _NEEDED_TILTED:
            return "the board tipped forward and back"
        return "" if len(self.views) >= ENOUGH_VIEWS else "more views at other distances"

    @property
    def is_complete(self) -> bool:
        """True if nothing is missing."""
        return bool(self.coverage) and not self.wanted()

    def _outline(self, corners: Corners | None, camera: int) -> F64:
        """The board's four outer corners (8,) as shares of the image's width, by the corners seen; NaN if not seen."""
        points = self._board.points_m
        if corners is None:
            return np.full(8, np.nan)
        # the homography that OpenCV's stubs promise is missing for degenerate corners
        found = np.asarray(cv2.findHomography(points[corners.ids, :2], corners.px)[0], np.float64)
        if found.shape != (3, 3):
            return np.full(8, np.nan)
        low, high = points.min(0)[:2], points.max(0)[:2]
        box = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        px = cv2.perspectiveTransform(box[:, None].astype(np.float64), found).reshape(4, 2)
        return np.clip(px / self.coverage[camera].size[0], -1.0, 2.0).ravel()

    def _is_new(self, outline: F64) -> bool:
        for other in self._outlines:
            both = np.isfinite(outline) & np.isfinite(other)
            if both.any() and (np.isfinite(outline) == np.isfinite(other)).all():
                if np.abs(outline - other)[both].max() < _NOVEL:
                    return False
        return True


def _ratios(outline: F64) -> F64:
    """How unlike opposite sides are: upright ones, lying ones."""
    sides = np.linalg.norm(np.roll(outline, -1, 0) - outline, axis=1) + 1e-9
    # a board held on its side has its columns lying
    turned = abs(outline[1, 1] - outline[0, 1]) > abs(outline[1, 0] - outline[0, 0])
    pairs = np.array([max(sides[1] / sides[3], sides[3] / sides[1]), max(sides[0] / sides[2], sides[2] / sides[0])])
    return pairs[::-1] if turned else pairs
