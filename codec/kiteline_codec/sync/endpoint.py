"""The endpoint: keeps what two sides share in agreement over any link that loses, repeats or reorders packets.

The model is state synchronisation (K. Winstein, H. Balakrishnan, "Mosh: an interactive remote shell for mobile
clients", 2012): a packet is filled, when it may be sent, with the most valuable values that the peer lacks, at their
newest version. Nothing is queued, so nothing grows old in a queue. Packets are described in SPEC.md.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

from kiteline_codec.coding.packing import Writer
from kiteline_codec.pacing.budget import SlidingBudget
from kiteline_codec.pacing.congestion_window import Window
from kiteline_codec.pacing.throughput import Throughput
from kiteline_codec.residuals.residual_coding import Tightener
from kiteline_codec.schema import PREDICTOR_KINDS, Key, WireError
from kiteline_codec.sync import remembered
from kiteline_codec.sync.archive import Spill
from kiteline_codec.sync.config import MIN_PACKET_BYTES, SyncConfig, SyncStats, default_order
from kiteline_codec.sync.entries import Order
from kiteline_codec.sync.expand import grown
from kiteline_codec.sync.inbox import Inbox, Update
from kiteline_codec.sync.outbox import Known, Outbox
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.transport.packet import CRC_BYTES, MAX_KIND, Header, Item, VersionError, parse, seal, write_header

__all__ = ["Endpoint", "SyncConfig", "SyncStats", "Update", "default_order"]


class Endpoint:
    """One end of a relation between two sessions. Pure: time and packets are handed in, packets are handed out."""

    def __init__(
        self,
        config: SyncConfig,
        session: int,
        name: str = "",
        tightener: Tightener | None = None,
        spill: Spill | None = None,
    ) -> None:
        """A session number must be above 0 and larger than that of any earlier endpoint in this place.

        tightener: makes values shorter on the wire. Both ends of a relation have one, or none. spill: where values of
        keyframes go beyond `resident_bytes`; without one those that the peer holds are forgotten, others given up.
        """
        if not 0 < session < 1 << 56:
            raise ValueError(f"session is {session}, expected 1..2^56-1")
        self.config = config
        self.session = session
        self.name = name
        self._tightener = tightener
        self._out = Outbox(
            config.order, config.oldest_every, self._shrink if tightener else None, PREDICTOR_KINDS, config.resident_bytes,
            spill,
        )  # fmt: skip
        self._spill = spill
        self._in = Inbox(config.resident_inbox_bytes, spill)
        self._budget = SlidingBudget(config.budget_bytes, config.burst_bytes)
        self._peer = 0
        self._legacy: dict[Key, bytes] = {}
        self._remembered: dict[Key, int] = {}  # what the peer says to know of earlier sessions of ours
        self._peer_verified = -1  # our version that the peer found equal
        self._verified = -1  # the peer's version that we found equal
        self._resync = -1  # the peer's version that we found different
        self._last_void = -1  # our version up to which all was voided
        self._reset: tuple[int, int] | None = (
            None  # the same while the peer must be told, and the first packet that does
        )
        self._overtaken = 0  # packets before this one have been overtaken by too many acknowledged ones
        self._owed = 0  # packets to acknowledge, or news to tell
        self._owed_since_ns = 0
        self._told_ns = -(1 << 62)  # when a packet last left
        self._digest_sent: tuple[int, int] = (-1, 0)  # version, when
        self._round_trip = RoundTrip(config)
        self._window = Window(config.window_packets)
        self._throughput = Throughput()
        self.throughput_bytes_s: int | None = None  # what the link delivers; None while nothing has to wait
        self._bytes_sent = self._packets_sent = self._bytes_received = self._packets_received = 0
        self._duplicates = self._restarts = self._mismatches = 0
        self._reasons: dict[str, int] = {}

    # ---- values

    def put(self, key: Key, code: bytes, priority: Order | None = None) -> None:
        """Share a value, or a new version of it. Raises ValueError for a key or code that cannot be sent."""
        if not (0 <= key.kind <= MAX_KIND and 0 <= key.id < 1 << 62 and 0 <= key.part <= 0xFFFF):
            raise ValueError(f"{key} does not fit a packet")
        if len(code) > self.config.max_value_bytes:
            raise ValueError(f"{key}: {len(code)} bytes, expected at most {self.config.max_value_bytes}")
        self._out.put(key, code, self.config.order(key) if priority is None else priority)

    def remove(self, key: Key) -> None:
        """Take a value back; unknown keys are ignored."""
        self._out.remove(key)

    def arrived(self, key: Key) -> bool:
        """Whether the peer is known to hold the newest version of a value of ours, or that there is none."""
        return self._out.arrived(key)

    def own_values(self) -> dict[Key, bytes]:
        """What this side shares, by key; a copy."""
        return {key: code for key, code in self._out.codes().items() if key.kind != remembered.KIND}

    def peer_values(self) -> dict[Key, bytes]:
        """What the peer's session wrote, by key; a copy."""
        return {key: code for key, code in self._in.codes().items() if key.kind != remembered.KIND}

    def own_value(self, key: Key) -> bytes | None:
        """The code of a value that this side shares; None where there is none."""
        held = self._out.held(key)
        return None if held is None else held[1]

    def peer_value(self, key: Key) -> bytes | None:
        """The code of a value that the peer's session wrote; None where there is none."""
        held = self._in.held(key)
        return None if held is None else held[1]

    def legacy_values(self) -> dict[Key, bytes]:
        """What earlier sessions of the peer wrote and its present one has not replaced, by key; a copy."""
        return dict(self._legacy)

    def remember(self, values: Mapping[Key, bytes]) -> None:
        """What the peer wrote in earlier sessions, as it was kept somewhere: it need not send that again."""
        self._legacy.update(values)

    def forget_legacy(self) -> None:
        """Drop the values of earlier sessions of the peer."""
        self._legacy.clear()

    # ---- agreement

    @property
    def peer_session(self) -> int:
        """The peer's session, 0 while none has been heard."""
        return self._peer

    @property
    def quiet(self) -> bool:
        """Whether the peer is known to hold all that was put, and no value has arrived in part."""
        return bool(self._peer) and self._out.clean and not self._in.assembling and self._reset is None

    @property
    def digest_equal(self) -> bool:
        """Whether, in both directions, the newest state has been compared and found equal."""
        return self.quiet and self._peer_verified == self._out.newest and self._verified == self._in.newest

    @property
    def digests(self) -> tuple[bytes, bytes]:
        """Digests of what this side wrote and of what the peer wrote."""
        return self._out.digest.bytes(), self._in.digest.bytes()

    @property
    def stats(self) -> SyncStats:
        """A snapshot of the numbers."""
        reasons = tuple(sorted(self._reasons.items()))
        out, flights = self._out, self._out.flights
        return SyncStats(
            self._bytes_sent, self._packets_sent, self._bytes_received, self._packets_received, flights.lost,
            self._duplicates, sum(n for _, n in reasons), reasons, self._round_trip.mean_ns, out.pending,
            flights.in_flight, len(self._in), len(self._legacy), self._peer, self._restarts, self._mismatches,
            self.backlog_bytes, out.resident_bytes, out.archive.values, out.dropped, self.throughput_bytes_s or 0,
            self.config.budget_bytes,
        )  # fmt: skip

    @property
    def backlog_bytes(self) -> int:
        """Of values that the peer is not known to hold."""
        return self._out.pending_bytes

    # ---- receiving

    def receive(self, packet: bytes, now_ns: int) -> list[Update]:
        """Take in a packet. Returns the values that changed by it. Never raises: bad packets are counted."""
        self._bytes_received += len(packet) + self.config.overhead_bytes
        self._packets_received += 1
        try:
            header, items = parse(packet, self.config.max_value_bytes)
        except VersionError as e:
            return self._refuse(str(e))
        except WireError:
            return self._refuse("damaged or no packet of this protocol")
        if header.session < self._peer:
            return self._refuse("from an earlier session of the peer")
        if header.peer > self.session:
            return self._refuse("the peer has heard a later session of this side: the stored session number went back")
        if header.session > self._peer:
            self._greet(header.session)
            self._owe(now_ns)
        if header.peer != self.session:
            # A greeting, or the peer has not yet noticed that this side restarted: let it know.
            self._owe(now_ns)
            return self._refuse("for an earlier session of this side") if header.peer else []
        self._take_control(header, now_ns)
        updates = self._void(header.reset)
        if header.values is not None:
            number, watermark = header.values
            if not self._in.is_new(number):
                self._duplicates += 1
                self._owe(now_ns)
                return updates
            if not self._in.room_for(items, self.config.max_inbox_bytes, self.config.max_assembly_bytes):
                self._refuse("no memory left for it")
                return updates
            try:
                items = self._grown(items)
            except WireError as e:
                return self._refuse(str(e))
            self._in.mark(number)
            self._owe(now_ns)
            self._in.raise_watermark(watermark)
            for item in items:
                update = self._in.apply(item)
                if update is not None:
                    if update.key.kind in PREDICTOR_KINDS:
                        self._out.basis_changed()
                    if update.key.kind == remembered.KIND:
                        self._hear(update)
                        continue
                    self._legacy.pop(update.key, None)
                    updates.append(update)
        self._compare(header, now_ns)
        return updates

    def _shrink(self, key: Key, code: bytes, known: Known) -> bytes | None:
        """A shorter form of a value of ours: the peer holds what it wrote itself, and what of ours is known to it."""
        assert self._tightener is not None
        form = remembered.form_of(key, code, self._remembered)
        if form is not None:
            return form
        return self._tightener.shrink(key, code, lambda k: self._in.held(k) or known(k), self._out.held)

    def _grown(self, items: list[Item]) -> list[Item]:
        """The items with codes in place of tight forms. Raises WireError where a form builds upon what is not held."""
        if not any(item.tight for item in items):
            return items
        if self._tightener is None:
            raise WireError("a tight form, which this side does not read")
        return grown(items, self._tightener, lambda key: self._in.held(key) or self._out.held(key), self._legacy)

    def _hear(self, update: Update) -> None:
        """The peer tells what it remembers."""
        with contextlib.suppress(WireError):  # words that cannot be read say nothing
            self._remembered.update(remembered.heard(update.code or b""))
            self._out.basis_changed()

    def _refuse(self, reason: str) -> list[Update]:
        self._reasons[reason] = self._reasons.get(reason, 0) + 1
        return []

    def _greet(self, session: int) -> None:
        """A new session of the peer: it holds nothing of ours, and what its forerunner wrote becomes legacy."""
        if self._peer:
            self._restarts += 1
        self._peer = session
        self._legacy.update(self.peer_values())
        self._in = Inbox(self.config.resident_inbox_bytes, self._spill)
        self._remembered.clear()
        self._out.restart()
        if self._tightener is not None:
            for key, code in remembered.told(self._legacy, session).items():
                self._out.put(key, code, self.config.order(key))
        self._peer_verified = self._verified = self._resync = -1
        self._reset = None
        self._digest_sent = (-1, 0)
        self._round_trip.doublings = self._overtaken = 0
        self._window = Window(self.config.window_packets)

    def _owe(self, now_ns: int) -> None:
        if not self._owed:
            self._owed_since_ns = now_ns
        self._owed += 1

    def _take_control(self, header: Header, now_ns: int) -> None:
        if header.ack is not None:
            before, on_way = self._out.flights.acked_bytes, self._out.flights.in_flight
            sent_ns, number = self._out.acknowledge(*header.ack)
            self._throughput.acked(self._out.flights.acked_bytes - before, now_ns)
            if number:
                self._round_trip.measured(now_ns - sent_ns)
                self._window.measured(now_ns - sent_ns, on_way - self._out.flights.in_flight, on_way, now_ns)
                self._overtaken = max(self._overtaken, number - self.config.reorder_packets)
                if self._reset is not None and number >= self._reset[1]:
                    self._reset = None
        if header.verified is not None:
            self._peer_verified = max(self._peer_verified, min(header.verified, self._out.newest))
            if self._reset is not None and self._peer_verified >= self._reset[0]:
                self._reset = None
        if header.resync is not None and header.resync <= self._out.newest:
            if header.resync > self._last_void:
                self._last_void = self._out.renumber()
                self._reset = (self._last_void, self._out.flights.next_number)
                self._peer_verified = -1

    def _void(self, reset: int | None) -> list[Update]:
        """The peer voided its values up to a version, since the digests differed."""
        if reset is None:
            return []
        if reset >= self._resync:
            self._resync = -1
        return [Update(key, None) for key in self._in.reset(reset)]

    def _compare(self, header: Header, now_ns: int) -> None:
        """Compare the peer's digest with that of what has arrived, unless newer values have arrived since."""
        if header.digest is None:
            return
        version, digest = header.digest
        if self._in.newest > version:
            return
        if digest != self._in.digest.bytes():
            if self._resync != version:
                self._mismatches += 1
            self._resync = version
        else:
            self._in.raise_watermark(version)
            self._in.newest = version
            self._verified = version
        self._owe(now_ns)

    # ---- sending

    @property
    def _most_packets(self) -> int:
        """That may be on their way: a budget paces by itself."""
        return self.config.window_packets if self.config.budget_bytes else self._window.packets

    def poll(self, now_ns: int) -> bytes | None:
        """The next packet to send now, or None. Call until None."""
        c = self.config
        self._throughput.busy(self._out.has_work(), now_ns)
        self.throughput_bytes_s = self._throughput.bytes_s(now_ns)
        self._out.give_up(now_ns - self._round_trip.overdue_ns, self._overtaken)
        if self._out.give_up(now_ns - self._round_trip.timeout_ns):
            self._round_trip.missed()
        left = self._budget.left(now_ns) - c.overhead_bytes
        if (
            self._peer
            and self._out.flights.window_open(max(1, self._most_packets >> self._round_trip.doublings))
            and self._out.has_work()
        ):
            if left < c.filled_bytes:
                return None
            return self._packet(now_ns, values=True, digest=False)
        silent_ns = now_ns - self._told_ns
        owed = self._owed and (self._owed >= c.ack_packets or now_ns - self._owed_since_ns >= c.ack_delay_ns)
        digest = self._digest_due(now_ns)
        if not (owed or digest or silent_ns >= (c.heartbeat_ns if self._peer else c.hello_ns)):
            return None
        if left < MIN_PACKET_BYTES:
            return None
        return self._packet(now_ns, values=False, digest=digest)

    def _digest_due(self, now_ns: int) -> bool:
        """Whether all has arrived, the peer has not confirmed it, and it was not told so just now."""
        out = self._out
        if not self._peer or not out.clean or self._peer_verified == out.newest:
            return False
        version, sent_ns = self._digest_sent
        return version != out.newest or now_ns - sent_ns >= self._round_trip.timeout_ns

    def _packet(self, now_ns: int, values: bool, digest: bool) -> bytes:
        out = self._out
        watermark = out.watermark()
        header = Header(
            self.session,
            self._peer,
            self._in.acknowledgement() if self._peer else None,
            (out.newest, out.digest.bytes()) if digest else None,
            self._verified if self._verified >= 0 else None,
            self._resync if self._resync >= 0 else None,
            self._reset[0] if self._reset is not None else None,
            (out.flights.next_number, watermark) if values else None,
        )
        data = Writer()
        write_header(data, header)
        if values:
            out.fill(data, self.config.filled_bytes - CRC_BYTES, watermark, now_ns)
        packet = seal(data)
        if digest:
            self._digest_sent = (out.newest, now_ns)
        self._owed = 0
        self._told_ns = now_ns
        self._budget.spend(now_ns, len(packet) + self.config.overhead_bytes)
        self._bytes_sent += len(packet) + self.config.overhead_bytes
        self._packets_sent += 1
        return packet
