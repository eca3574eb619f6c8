"""Lets a `with` block close what it opened."""

from typing import Self


class Closing:
    """Base class of context managers that are closed at the end of the block."""

    def close(self) -> None:
        """Release what is held. May be called twice."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
