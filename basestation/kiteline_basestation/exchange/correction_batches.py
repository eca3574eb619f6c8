"""Corrections for one agent in batches: the next one is made when the one before has arrived, or a moment later.

What changes meanwhile waits at the base, at its newest value. So a batch is never overtaken by the next one, and the
agent can wait for all of it. On a thin link a batch is as large as the link carries in a few seconds; a large one is
coded over several steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeGuard

from kiteline_basestation.config import PublishConfig
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import (
    CorrectionBatch,
    DisparityCalibration,
    Key,
    KeyframePose,
    Record,
    RefinedLandmarks,
    SubmapPlacement,
    messages,
)
from kiteline_core.ids import AgentId

MEMBERS = (KeyframePose, RefinedLandmarks, SubmapPlacement, DisparityCalibration)  # what moves the agent's map
_REFINED = (KeyframePose, RefinedLandmarks)  # of these, what each full bundle changes: the gap counts from them on
_UNSAVED = 100  # batches that an earlier process may have made after its store was written last; many in 0.25 s


class CorrectionBatches:
    """Numbers the batches of one agent, and computes the room for the next one."""

    def __init__(self, agent: AgentId, config: PublishConfig) -> None:
        self._agent = agent
        self._config = config
        # Whether a value is sent to the agent. Others, as of keyframes of its earlier starts, are of no batch.
        self.shares: Callable[[Key], bool] = lambda key: True
        self._session: int | None = None  # of the agent
        self._number = 0
        self._members: dict[Key, None] = {}  # of the newest batch
        self._missing: Key | None = None  # a member that had not arrived at the last check: it is checked first
        self._made_ns = 0
        self._refined_ns = -1 << 62  # when keyframes or landmarks were last in one
        self._open = False  # more values of the newest batch come with the next steps
        self._closed = 0  # number of the newest batch whose record was made
        self._overdue = False  # the newest batch does not arrive: later values join it, and wait for no other ones

    def room_bytes(self, channel: RecordChannel, now_ns: int, gap_s: float = 0.0) -> int | None:
        """Bytes of corrections that may be shared now; None without a limit. 0 while a batch is on its way, and for
        gap_s after the last one that moved keyframes or landmarks.
        """
        arrived = channel.arrived(self._key) and self._all_arrived(channel)
        self._overdue = not arrived and now_ns - self._made_ns >= self._config.batch_wait_s * 1e9
        if self._overdue:
            return None  # the agent is out of reach: the values go to the store, and to the agent when it returns
        if not arrived or (now_ns - self._refined_ns < gap_s * 1e9 and not self._open):
            return 0
        rate = channel.rate_bytes_s()
        return None if rate is None else round(rate * self._config.batch_s)

    def _all_arrived(self, channel: RecordChannel) -> bool:
        """True if all members have arrived. A batch holds hundreds, and this is asked in every step."""
        missing = self._missing
        if missing is not None and missing in self._members and not channel.arrived(missing):
            return False
        self._missing = next((key for key in reversed(self._members) if not channel.arrived(key)), None)
        return self._missing is None

    @property
    def is_open(self) -> bool:
        """True while `numbered` is to be called in each step, since more values of the batch come."""
        return self._open

    def numbered(self, records: Sequence[Record], now_ns: int, *, unfinished: bool = False) -> list[Record]:
        """Records with the number of their batch, and the record of the batch; as they are if none moves the map.

        unfinished: more values of this batch come with a later step; its record comes with the last ones.
        """
        keys = [messages.key(record) for record in records if self._is_member(record)]
        if not keys and (unfinished or not self._open):
            return list(records)
        if self._overdue and self._number:
            self._members.update(dict.fromkeys(keys))
            self._open = False
            batch = [CorrectionBatch.of(self._agent, self._number, [])]
        else:
            if not self._open:
                self._number, self._made_ns, self._members = self._number + 1, now_ns, {}
            self._members.update(dict.fromkeys(keys))
            if any(isinstance(record, _REFINED) for record in records):
                self._refined_ns = now_ns
            self._open = unfinished
            batch = [] if unfinished else [CorrectionBatch.of(self._agent, self._number, list(self._members))]
        if batch:
            self._closed = self._number
        return [replace(r, batch=self._number) if self._is_member(r) else r for r in records] + batch

    def _is_member(self, record: Record) -> TypeGuard[KeyframePose]:  # or another one of MEMBERS
        return isinstance(record, MEMBERS) and self.shares(messages.key(record))

    def without(self, key: Key) -> CorrectionBatch | None:
        """The record that replaces that of the newest batch if a value of it is removed; None if none was."""
        if key not in self._members:
            return None
        del self._members[key]
        return CorrectionBatch.of(self._agent, self._number, [])

    def follow_session(self, session: int | None) -> CorrectionBatch | None:
        """The record that replaces that of the newest batch if the agent has started anew, and values of the batch are
        sent no more; None otherwise. session: of the agent.
        """
        if session == self._session:
            return None
        self._session = session
        left = {key: None for key in self._members if self.shares(key)}
        if len(left) == len(self._members):
            return None
        self._members = left
        return CorrectionBatch.of(self._agent, self._number, [])

    def restore(self, record: Record) -> None:
        """Continue behind the batches of an earlier process. record: one that it had put."""
        number = record.number if isinstance(record, CorrectionBatch) else getattr(record, "batch", 0)
        if number > self._number:
            self._number, self._members = number, {}
        if isinstance(record, CorrectionBatch):
            self._closed = max(self._closed, number)
        if isinstance(record, MEMBERS) and number and number == self._number:
            self._members[messages.key(record)] = None

    def release(self) -> CorrectionBatch | None:
        """Number the next batch after `restore`. Returns the record that lets the agent wait for no more of a batch
        that the earlier process did not finish, if any.

        Numbers are skipped: an agent may hold values of batches that the store lacks, and would wait for ever for a
        whole batch of the same number.
        """
        number, is_cut_off = self._number, self._closed != self._number
        self._closed = self._number = number + _UNSAVED
        return CorrectionBatch.of(self._agent, number, []) if is_cut_off else None

    @property
    def _key(self) -> Key:
        return Key(CorrectionBatch.KIND, int(self._agent))
