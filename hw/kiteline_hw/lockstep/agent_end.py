"""The agent's end of a lock-step flight, which outlives the base."""

from kiteline_hw.lockstep.messages import Down, Up
from kiteline_hw.lockstep.zenoh_lockstep import LockstepClient
from kiteline_hw.ports import LinkError
from kiteline_hw.system.kernel_cache import COMPILE_S
from kiteline_hw.system.process import Parent

_ANSWER_S = 120.0  # s that the base may take for one tick before it counts as lost


class AgentBarrier:
    """Exchanges messages with the base each tick; after the base was lost, every answer is None."""

    def __init__(self, endpoint: str, agent: int, parent: Parent) -> None:
        """parent: is informed if the base is lost. Raises LinkError if there is no base."""
        self._endpoint, self._agent, self._parent = endpoint, agent, parent
        self._client: LockstepClient | None = self._connected()
        self.times_lost = 0

    @property
    def lost(self) -> bool:
        """True if the base was lost."""
        return self._client is None

    def exchange(self, up: Up) -> Down | None:
        """The base's answer; None if there is no base."""
        if self._client is None:
            return None
        try:
            return Down.decode(self._client.exchange(up.encode(), _ANSWER_S))
        except LinkError as error:
            self.times_lost += 1
            self._parent.send_event("base_lost", text=str(error))
            self.close()
            return None

    def reconnect(self) -> None:
        """Connect to a base at the same endpoint. Raises LinkError if none comes."""
        self._client = self._connected()

    def _connected(self) -> LockstepClient:
        """Wait for a base as long as it may compile its kernels."""
        return LockstepClient(self._endpoint, self._agent, connect_timeout_s=COMPILE_S)

    def close(self) -> None:
        """Disconnect."""
        if self._client is not None:
            self._client.close()
            self._client = None
