"""Which of the last numbered packets have been received."""


class SequenceWindow:
    """The highest number received, and which of the `size` numbers below it."""

    __slots__ = ("_received", "_size", "highest")

    def __init__(self, size: int) -> None:
        self.highest: int | None = None
        self._size = size
        self._received = 0  # bit i: number highest - 1 - i

    def is_new(self, number: int) -> bool:
        """True if a number was not received before and is not too old to tell."""
        if self.highest is None or number > self.highest:
            return True
        behind = self.highest - number
        return 0 < behind <= self._size and not self._received >> behind - 1 & 1

    def mark(self, number: int) -> None:
        """Mark a new number as received."""
        ahead = 0 if self.highest is None else number - self.highest
        if self.highest is None or ahead > self._size:
            self.highest, self._received = number, 0
        elif ahead > 0:
            self._received = (self._received << ahead | 1 << ahead - 1) & (1 << self._size) - 1
            self.highest = number
        else:
            self._received |= 1 << -ahead - 1

    def missing(self) -> int:
        """Bit i is set if number highest - 1 - i, counted from 1, was not received."""
        highest = self.highest or 1
        return ~self._received & (1 << min(self._size, highest - 1)) - 1
