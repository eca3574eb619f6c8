"""Which agents share their maps with each other."""

from kiteline_core.ids import AgentId


class SharingPolicy:
    """Groups of agents whose maps may be merged: "all", "none", or groups such as "0 1, 1 2". Raises ValueError."""

    def __init__(self, text: str) -> None:
        self._all = text.strip() == "all"
        self._groups: list[set[int]] = []
        if not self._all and text.strip() not in ("", "none"):
            try:
                self._groups = [{int(a) for a in group.split()} for group in text.split(",")]
            except ValueError as error:
                raise ValueError(f'share {text!r}: expected "all", "none", or groups such as "0 1, 1 2"') from error

    def allows(self, a: AgentId, b: AgentId) -> bool:
        """True if two agents share their maps; an agent always shares with itself."""
        return a == b or self._all or any(a in group and b in group for group in self._groups)
