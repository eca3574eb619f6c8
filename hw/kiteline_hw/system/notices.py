"""What a process has to tell its user about files and devices: each trouble once."""


class Notices:
    """Lines for the user, from any thread; one of each subject."""

    def __init__(self) -> None:
        self._said: set[str] = set()
        self._new: list[str] = []

    def say(self, subject: str, line: str) -> None:
        """Keep a line, if it is the first on its subject."""
        if subject not in self._said:
            self._said.add(subject)
            self._new.append(line)

    def take(self) -> list[str]:
        """The lines since the last call."""
        new = self._new[:]
        del self._new[: len(new)]  # the list stays: another thread may be adding a line to it
        return new
