"""The agent's place at the barrier of a lock-step flight, whatever becomes of the base."""

from __future__ import annotations

from kiteline_hw.lockstep.messages import Down, Up
from kiteline_hw.lockstep.zenoh_lockstep import LockstepClient
from kiteline_hw.ports import LinkError
from kiteline_hw.system.process import Parent

_ANSWER_S = 120.0  # s that the base may take for one tick before it counts as gone


class Barrier:
    """The agent's side of the barrier, that turns a base which has ended into silence."""

    def __init__(self, endpoint: str, agent: int, parent: Parent) -> None:
        """parent: told when the base is gone."""
        self._endpoint, self._agent, self._parent = endpoint, agent, parent
        self._client: LockstepClient | None = LockstepClient(endpoint, agent)
        self.times_lost = 0

    @property
    def lost(self) -> bool:
        """There was a base, and there is none now."""
        return self._client is None

    def exchange(self, up: Up) -> Down | None:
        """The base's answer; None when there is no base."""
        if self._client is None:
            return None
        try:
            return Down.decode(self._client.exchange(up.encode(), _ANSWER_S))
        except LinkError as error:
            self.times_lost += 1
            self._parent.tell("base_lost", text=str(error))
            self.close()
            return None

    def meet_again(self) -> None:
        """Look for a base where the last one was. Raises LinkError when none comes."""
        self._client = LockstepClient(self._endpoint, self._agent)

    def close(self) -> None:
        """Leave the barrier."""
        if self._client is not None:
            self._client.close()
            self._client = None
