"""What every kind of camera gives: captures with a stamp, and errors that say whether waiting mends them."""

from dataclasses import dataclass
from typing import Protocol

from kiteline_core.frame import EncodedImage
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.raw_pixels import RawPixels


class CameraError(SourceError):
    """A camera that gives no images. passing: it may come back by itself or by a hand, so it is tried again."""

    def __init__(self, text: str, passing: bool = True) -> None:
        super().__init__(text)
        self.passing = passing


@dataclass(frozen=True, slots=True)
class Capture:
    """One image of one camera.

    t_ns: on the monotonic clock; None if the device does not tell: then its arrival counts. sequence: the number that
    the driver gave it, with gaps where the driver lost images; None if it does not count.
    """

    t_ns: int | None
    sequence: int | None
    image: EncodedImage | RawPixels


class Camera(Protocol):
    """One device. Only `close` may be called from another thread than `open` and `read`."""

    @property
    def name(self) -> str: ...
    @property
    def start_s(self) -> float:
        """How long it may take from `open` to the first image, in s."""
        ...

    def open(self) -> str:
        """Open the device and begin; what was chosen, for the user. Raises CameraError."""
        ...

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises CameraError if the device is gone, BadImage."""
        ...

    def close(self) -> None:
        """Release the device; it may be opened again."""
        ...
