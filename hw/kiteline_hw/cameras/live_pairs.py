"""Pairs the images of two live cameras by their stamps, and measures how far apart they are. No clock."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage

_SKEWS = 100  # pairs over which the skew is told
_FIRST_SKEWS = 20  # pairs after which it is told first
_GOOD_SKEW_NS = 1_000_000  # ns; at 1 m/s and 2 m distance a later right image is a quarter of a pixel off
_UNPAIRED = 20  # left images in succession without a right one, while right ones come, that are told


@dataclass(frozen=True, slots=True)
class LiveImage:
    """One decoded image. encoded: the bytes that it was decoded from, or None."""

    t_ns: int
    pixels: U8
    encoded: EncodedImage | None


Pair = tuple[LiveImage, LiveImage | None]


class LivePairs:
    """The nearest right image for each left one.

    tolerance_ns: half the frame period at most; then an image that is near enough has no nearer rival, and a pair is
    complete with its second image. A left image is given alone once its partner can no longer come.
    """

    def __init__(self, tolerance_ns: int, tell: Callable[[str], None]) -> None:
        self._tolerance_ns = tolerance_ns
        self._tell = tell
        self._waiting: tuple[deque[tuple[LiveImage, int]], deque[tuple[LiveImage, int]]] = (
            deque(maxlen=4),
            deque(maxlen=4),
        )
        self._skews: deque[int] = deque(maxlen=_SKEWS)
        self._pairs = 0
        self._apart: deque[int] = deque(maxlen=_UNPAIRED)  # of left images that found no partner
        self._told_apart = self._told_skew = False
        self.alone = 0  # left images without a right one

    @property
    def skew_ns(self) -> tuple[int, int] | None:
        """Right stamp minus left stamp over the last pairs: median, and the largest deviation from it."""
        if not self._skews:
            return None
        middle = round(median(self._skews))
        return middle, max(abs(skew - middle) for skew in self._skews)

    def add(self, side: int, image: LiveImage, now_ns: int) -> list[Pair]:
        """Add an image of the left (0) or right (1) camera; what is complete now, in order of time."""
        self._waiting[side].append((image, now_ns))
        return self._match()

    def expire(self, now_ns: int, patience_ns: int) -> list[Pair]:
        """Left images that have waited for so long that their partner will not come."""
        left, out = self._waiting[0], []
        while left and now_ns - left[0][1] >= patience_ns:
            out.append(self._single(left.popleft()[0]))
        return out

    def _match(self) -> list[Pair]:
        left, right = self._waiting
        out: list[Pair] = []
        while left and right:
            skew_ns = right[0][0].t_ns - left[0][0].t_ns
            if abs(skew_ns) <= self._tolerance_ns:
                out.append((left.popleft()[0], right.popleft()[0]))
                self._measure(skew_ns)
            elif skew_ns > 0:
                self._apart.append(skew_ns)
                out.append(self._single(left.popleft()[0]))
                self._tell_apart()
            else:
                right.popleft()
        return out

    def _single(self, image: LiveImage) -> Pair:
        self.alone += 1
        return image, None

    def _measure(self, skew_ns: int) -> None:
        self._apart.clear()
        self._skews.append(skew_ns)
        self._pairs += 1
        found = self.skew_ns
        if found is None or self._told_skew or self._pairs < _FIRST_SKEWS:
            return
        self._told_skew = True
        middle, spread = found
        text = f"cameras: right image {middle / 1e6:+.1f} ms after the left one, give or take {spread / 1e6:.1f} ms"
        if abs(middle) + spread > _GOOD_SKEW_NS:
            text += ": in motion stereo depths are wrong by it; trigger both cameras by one signal"
        self._tell(text)

    def _tell_apart(self) -> None:
        if self._told_apart or len(self._apart) < _UNPAIRED:
            return
        self._told_apart = True
        self._tell(
            f"cameras: left and right images are {median(self._apart) / 1e6:.1f} ms apart, expected at most "
            f"{self._tolerance_ns / 1e6:.1f} ms: the left camera flies alone; trigger both cameras by one signal"
        )
