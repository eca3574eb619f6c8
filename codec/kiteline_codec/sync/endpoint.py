"""The endpoint: keeps what two sides share in agreement over a link that loses, repeats or reorders packets.

State synchronisation (K. Winstein, H. Balakrishnan, "Mosh: an interactive remote shell for mobile clients", 2012): a
packet is filled, when it may be sent, with the values of highest priority that the peer lacks, at their newest version.
No message is queued. Packets are described in SPEC.md, states in `agreement`.
"""

from collections.abc import Callable, Mapping, Sequence

from kiteline_codec.coding.packing import Writer
from kiteline_codec.pacing.budget import SlidingBudget
from kiteline_codec.pacing.congestion_window import CongestionWindow
from kiteline_codec.pacing.throughput import Throughput
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import PREDICTOR_KINDS, Key, Priority, WireError
from kiteline_codec.sync import resumption
from kiteline_codec.sync.agreement import OwnState, OwnValues, PeerValues
from kiteline_codec.sync.archive import Spill
from kiteline_codec.sync.config import MIN_PACKET_BYTES, SyncConfig, SyncStats, Traffic
from kiteline_codec.sync.inbox import Inbox, Update
from kiteline_codec.sync.outbox import Known, Outbox
from kiteline_codec.sync.received import Received
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.sync.send_queue import Order
from kiteline_codec.transport.packet import (
    CRC_BYTES,
    MAX_KIND,
    Header,
    Item,
    VersionError,
    add_checksum,
    parse,
    write_header,
)


class Endpoint:
    """One end of a relation between two sessions. Pure: time and packets are handed in, packets are handed out."""

    def __init__(
        self, config: SyncConfig, session: int, coder: ResidualCoder | None = None, spill: Spill | None = None,
        may_write: Callable[[Key], bool] = lambda key: True,
        claimed_bytes: Callable[[Key, bytes], int] = lambda key, code: 0,
    ) -> None:  # fmt: skip
        """session: above 0, and higher than any earlier one of this side. coder: makes values shorter on the wire; both
        ends have one, or none. spill: keeps values of keyframes beyond `resident_bytes`; without one, those that the
        peer holds are forgotten and others dropped. may_write: tells whether a key is one of the peer's; values under
        others are ignored. claimed_bytes: memory that a code of the peer claims for good where it is used.
        """
        if not 0 < session < resumption.MAX_SESSION:
            raise ValueError(f"session is {session}, expected 1..2^56-1")
        self.config, self._coder = config, coder
        self.session, self._overtaking = session, resumption.Overtaking()  # it rises where the peer knows a later one
        self._out = Outbox(
            config.order, config.oldest_every, self._compress if coder else None, config.resident_bytes, spill
        )
        self.received = Received(config, spill, claimed_bytes)
        self._budget = SlidingBudget(config.budget_bytes, config.burst_bytes)
        self.peer_session: int | None = None  # None before the first packet of the peer
        self._own_values = OwnValues()
        self._peer_values = PeerValues()
        self._may_write = may_write
        self._resumable = resumption.Resumable()
        self._overtaken_below = 0  # packets with lower numbers have been overtaken by enough acknowledged ones
        self._unanswered = 0  # packets to acknowledge, and news to send
        self._unanswered_since_ns = 0
        self._sent_ns: int | None = None  # when the last packet left
        self._digest_sent: tuple[int, int] | None = None  # version of the last digest, and when it left
        self._round_trip = RoundTrip(config)
        self._window = CongestionWindow(config.window_packets)
        self._throughput = Throughput()
        self.throughput_bytes_s: int | None = None  # what the link delivers; None while nothing has to wait
        self._traffic = Traffic(config.overhead_bytes)

    # ---- values

    def put(self, key: Key, code: bytes, priority: Order | None = None) -> None:
        """Share a value, or a new version of it. Raises ValueError for a key or code that cannot be sent."""
        if not (0 <= key.kind <= MAX_KIND and 0 <= key.id < 1 << 62 and 0 <= key.part <= 0xFFFF):
            raise ValueError(f"{key} does not fit a packet")
        if len(code) > self.config.max_value_bytes:
            raise ValueError(f"{key}: {len(code)} bytes, expected at most {self.config.max_value_bytes}")
        self._out.put(key, code, self.config.order(key) if priority is None else priority)
        self._resumable.replaced(key)

    def remove(self, key: Key) -> None:
        """Remove a value, also one that the peer holds of an earlier session of this side; others are ignored."""
        self._out.remove(key, is_held=self._resumable.removed(key))

    @property
    def standing(self) -> Sequence[Key]:
        """Placements of earlier sessions of this side that the peer holds, and this one has not shared since."""
        return tuple(self._resumable.standing)

    def arrived(self, key: Key) -> bool:
        """True if the peer is known to hold the newest version of an own value, or if there is none."""
        return self._out.arrived(key)

    def own_values(self) -> dict[Key, bytes]:
        """What this side shares, by key; a copy."""
        return {key: code for key, code in self._out.codes().items() if key.kind != resumption.SUMMARY_KIND}

    def peer_values(self) -> dict[Key, bytes]:
        """What the peer's session wrote, by key; a copy."""
        return self.received.codes()

    def own_value(self, key: Key) -> bytes | None:
        """The code of a value that this side shares; None if there is none."""
        held = self._out.held(key)
        return None if held is None else held[1]

    def peer_value(self, key: Key) -> bytes | None:
        """The code of a value that the peer's session wrote; None if there is none."""
        held = self._in.held(key)
        return None if held is None else held[1]

    def earlier_values(self) -> dict[Key, bytes]:
        """What earlier sessions of the peer wrote and its present one has not replaced, by key; a copy."""
        return dict(self.received.earlier.codes)

    def resume(self, values: Mapping[Key, bytes]) -> None:
        """Take over values of earlier sessions of the peer from a store; the peer need not send them again."""
        self.received.earlier.resume(values)

    # ---- agreement

    @property
    def quiet(self) -> bool:
        """True if the peer is known to hold all that was put, and no value has arrived in part."""
        state = self._own_values.state
        return state in (OwnState.UNCOMPARED, OwnState.EQUAL) and self._out.clean and not self._in.assembling

    @property
    def digest_equal(self) -> bool:
        """True if, in both directions, the newest state has been compared and found equal."""
        own, peer = self._own_values, self._peer_values
        return self.quiet and own.equal_at == self._out.newest and peer.equal_at == self._in.newest

    @property
    def digests(self) -> tuple[bytes, bytes]:
        """Digests of what this side and the peer wrote."""
        return self._out.digest.bytes(), self._in.digest.bytes()

    @property
    def stats(self) -> SyncStats:
        """A snapshot of the numbers."""
        out, packets, traffic = self._out, self._out.packets, self._traffic
        reasons = tuple(sorted(traffic.reasons.items()))
        return SyncStats(
            traffic.bytes_sent, traffic.packets_sent, traffic.bytes_received, packets.lost, traffic.duplicates,
            sum(n for _, n in reasons), reasons, self._round_trip.mean_ns, out.pending, packets.in_flight,
            len(self._in), traffic.restarts, traffic.mismatches, self.backlog_bytes, out.resident_bytes,
            out.archive.values, out.dropped,
        )  # fmt: skip

    @property
    def given_up(self) -> int:
        """Own values that were dropped for want of memory."""
        return self._out.dropped

    @property
    def backlog_bytes(self) -> int:
        """Bytes of own values that the peer is not known to hold."""
        return self._out.pending_bytes

    # ---- receiving

    @property
    def _in(self) -> Inbox:
        """What the peer's present session wrote."""
        return self.received.present

    def receive(self, packet: bytes, now_ns: int) -> list[Update]:
        """Take in a packet. Returns the values that changed. Never raises: bad packets are counted."""
        self._traffic.received(packet)
        try:
            header, items = parse(packet, self.config.max_value_bytes)
        except VersionError as e:
            return self._refuse(str(e))
        except WireError:
            return self._refuse("damaged or no packet of this protocol")
        if self.peer_session is not None and header.session < self.peer_session:
            return self._refuse("from an earlier session of the peer")
        if (session := self._overtaking.above(self.session, header.peer)) is None:
            return self._refuse("the peer knows a later session of this side: does another one run with its number?")
        if session != self.session:
            self.session, self.peer_session = session, None  # all is sent again
        if self.peer_session is None or header.session > self.peer_session:
            self._begin_session(header.session)
            self._owe_answer(now_ns)
        if header.peer != self.session:
            # A greeting, or the peer has not noticed yet that this side restarted: answer, so that it learns.
            self._owe_answer(now_ns)
            return self._refuse("for an earlier session of this side") if header.peer else []
        self._take_control(header, now_ns)
        updates = self._void(header.reset)
        if header.values is not None:
            number, watermark = header.values
            if not self._in.packets.is_new(number):
                self._traffic.duplicates += 1
                self._owe_answer(now_ns)
                return updates
            try:
                items = self._own_items(self._expanded(items))
            except WireError as e:
                return self._refuse(str(e))
            if not self.received.room_for(items):
                self._refuse("no memory left for it")
                return updates
            self._in.packets.mark(number)
            self._owe_answer(now_ns)
            self._in.raise_watermark(watermark)
            changed, usable = self.received.take(items)
            self._note_received(changed)
            updates += usable
        updates += self.received.due(now_ns)
        self._compare(header, now_ns)
        return updates

    def _compress(self, key: Key, code: bytes, known: Known) -> bytes | None:
        """A shorter form of an own value. The peer holds what it wrote, and what of ours is `known` to have arrived."""
        assert self._coder is not None
        reference = self._resumable.reference_to(key, code)
        if reference is not None:
            return reference
        return self._coder.compress(key, code, lambda k: self._in.held(k) or known(k), self._out.held)

    def _expanded(self, items: list[Item]) -> list[Item]:
        """The items with codes in place of residual codes. Raises WireError if their predictors are not held."""
        if not any(item.residual for item in items):
            return items
        if self._coder is None:
            raise WireError("a residual code, which this side does not read")
        return resumption.expand_items(items, self._coder, self._held, self.received.earlier.codes)

    def _own_items(self, items: list[Item]) -> list[Item]:
        """The items without those of values that the peer may not write, which are counted."""
        own = [item for item in items if item.key.kind == resumption.SUMMARY_KIND or self._may_write(item.key)]
        if len(own) < len(items):
            self._refuse("a value that the peer may not write")
        return own

    def _held(self, key: Key) -> tuple[int, bytes] | None:
        """Version and code of a value of either side."""
        return self._in.held(key) or self._out.held(key)

    def _note_received(self, changed: Sequence[Update]) -> None:
        """Let own values be coded by what the peer holds now."""
        for update in changed:
            if update.key.kind in PREDICTOR_KINDS:
                self._out.predictors_changed()
            if update.key.kind == resumption.SUMMARY_KIND and self._resumable.take(update.code or b""):
                self._out.predictors_changed()

    def _refuse(self, reason: str) -> list[Update]:
        self._traffic.refuse(reason)
        return []

    def _begin_session(self, session: int) -> None:
        """Begin with a new session of the peer, which holds nothing of ours; what the last one wrote stays readable."""
        if self.peer_session is not None:
            self._traffic.restarts += 1
        self.peer_session = session
        self.received.begin_session()
        self._resumable.clear()
        self._out.restart(resumption.outlived(self.received.earlier.is_gone, session))
        if self._coder is not None:
            self._coder.restart()
            for key, code in resumption.summaries(self.received.earlier.codes, session).items():
                self._out.put(key, code, self.config.order(key))
        self._own_values.new_session()
        self._peer_values.new_session()
        self._digest_sent = None
        self._round_trip.doublings = self._overtaken_below = 0
        self._window = CongestionWindow(self.config.window_packets)

    def _owe_answer(self, now_ns: int) -> None:
        """Note that a packet must leave soon."""
        if not self._unanswered:
            self._unanswered_since_ns = now_ns
        self._unanswered += 1

    def _take_control(self, header: Header, now_ns: int) -> None:
        """Take in acknowledgements, and how the peer's copy of our values compared."""
        own, packets = self._own_values, self._out.packets
        if header.ack is not None:
            bytes_before, in_flight = packets.acked_bytes, packets.in_flight
            acknowledged = self._out.acknowledge(*header.ack)
            self._throughput.acked(packets.acked_bytes - bytes_before, now_ns)
            if acknowledged is not None:
                rtt_ns = now_ns - acknowledged.oldest_sent_ns
                self._round_trip.measured(rtt_ns)
                self._window.measured(rtt_ns, in_flight - packets.in_flight, in_flight, now_ns)
                overtaken_below = acknowledged.newest - self.config.reorder_packets
                self._overtaken_below = max(self._overtaken_below, overtaken_below)
                own.acknowledged(acknowledged.newest)
        if header.verified is not None:
            own.found_equal(min(header.verified, self._out.newest))
        if header.resync is not None and header.resync <= self._out.newest and own.must_void(header.resync):
            own.found_different(self._out.renumber(), packets.next_number)

    def _void(self, reset: int | None) -> list[Update]:
        """Drop what the peer voided because digests differed."""
        if reset is None:
            return []
        self._peer_values.voided(reset)
        return [Update(key, None) for key in self._in.void(reset)]

    def _compare(self, header: Header, now_ns: int) -> None:
        """Compare the peer's digest with that of what has arrived, unless newer values have arrived since."""
        if header.digest is None:
            return
        version, digest = header.digest
        if self._in.newest > version:
            return
        if digest == self._in.digest.bytes():
            self._in.raise_watermark(version)
            self._in.newest = version
            self._peer_values.found_equal(version)
            self.received.earlier.compared = True
        elif self._peer_values.found_different(version):
            self._traffic.mismatches += 1
        self._owe_answer(now_ns)

    # ---- sending

    def poll(self, now_ns: int) -> bytes | None:
        """The next packet to send now, or None. Call until None."""
        c = self.config
        urgency = self._out.urgency()
        self._throughput.busy(urgency is not None, now_ns)
        self.throughput_bytes_s = self._throughput.bytes_s(now_ns)
        if self._out.give_up(now_ns, self._round_trip, self._overtaken_below, idle=urgency is None):
            urgency = self._out.urgency()
        left = self._budget.left(now_ns) - c.overhead_bytes
        unheard = self._own_values.state is OwnState.UNHEARD
        waited_ns = now_ns - self._unanswered_since_ns
        answer = self._unanswered > 0 and (self._unanswered >= c.ack_packets or waited_ns >= c.ack_delay_ns)
        if not unheard and self._window_open() and self._due(urgency, answer, now_ns):
            if left < c.filled_bytes:
                return None
            return self._packet(now_ns, values=True, digest=False)
        digest = self._digest_due(now_ns)
        silence_ns = c.hello_ns if unheard else c.heartbeat_ns
        silent = self._sent_ns is None or now_ns - self._sent_ns >= silence_ns
        sends = left >= MIN_PACKET_BYTES and (answer or digest or silent)
        return self._packet(now_ns, values=False, digest=digest) if sends else None

    def _due(self, urgency: int | None, answers: bool, now_ns: int) -> bool:
        """True if values wait, and these are not so few and little urgent that they wait for a packet of others."""
        if urgency is None or urgency < Priority.GRID or answers or self._sent_ns is None:
            return urgency is not None
        return self.backlog_bytes >= self.config.filled_bytes // 2 or now_ns - self._sent_ns >= self.config.gather_ns

    def _window_open(self) -> bool:
        """True if another packet may be in flight. A budget limits the rate by itself."""
        budgeted = self.config.budget_bytes is not None
        packets = self.config.window_packets if budgeted else self._window.packets
        return self._out.packets.window_open(max(1, packets >> self._round_trip.doublings))

    def _digest_due(self, now_ns: int) -> bool:
        """True if all has arrived, the peer has not found it equal, and no digest was sent lately."""
        out = self._out
        if self._own_values.state is OwnState.UNHEARD or not out.clean or self._own_values.equal_at == out.newest:
            return False
        if self._digest_sent is None:
            return True
        version, sent_ns = self._digest_sent
        gap_ns = self._round_trip.timeout_ns if version == out.newest else self.config.digest_gap_ns
        return now_ns - sent_ns >= gap_ns

    def _packet(self, now_ns: int, values: bool, digest: bool) -> bytes:
        out, own = self._out, self._own_values
        watermark = out.watermark()
        header = Header(
            self.session,
            self.peer_session or 0,
            None if own.state is OwnState.UNHEARD else self._in.acknowledgement(),
            (out.newest, out.digest.bytes()) if digest else None,
            self._peer_values.take_verdict(),
            self._peer_values.different_at,
            own.void_up_to if own.state is OwnState.VOIDING else None,
            (out.packets.next_number, watermark) if values else None,
        )
        data = Writer()
        write_header(data, header)
        if values:
            out.fill(data, self.config.filled_bytes - CRC_BYTES, watermark, now_ns)
        packet = add_checksum(data)
        if digest:
            self._digest_sent = (out.newest, now_ns)
        self._unanswered = 0
        self._sent_ns = now_ns
        self._budget.spend(now_ns, self._traffic.sent(packet))
        return packet
