"""Senders that mean harm. With a sound key: packets are well formed, what they say is drawn at random; and without."""

import random
from collections.abc import Sequence

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.jobs import JobDone, set_aside
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import RECORD_TYPES, IdOf, Key
from kiteline_codec.transport.packet import Header, Item, add_checksum, write_header, write_item
from kiteline_codec.transport.seal import Direction, Sealer, Suite
from kiteline_core.ids import MAX_AGENTS, MAX_BOOTS, MAX_KEYFRAMES, MAX_SUBMAPS, AgentId, keyframe_id, submap_id

_AGENT, _OTHER = AgentId(3), AgentId(4)
_HUGE = (1 << 31, 1 << 32, (1 << 62) - 1, (1 << 63) - 1, 1 << 63, 1 << 64)
_STEP_NS = 50_000_000


def forged_packets(draw: random.Random, number: int) -> list[tuple[int, bytes]]:
    """Packets of a sender without a key, each with the agent that it claims to be: without seals, and with wrong ones
    that look like those of an agent that just started; short, as long as agents send them, and as long as may be.
    """
    out = []
    for _ in range(number):
        agent = draw.choice((0, 0, 3, draw.randrange(MAX_AGENTS)))
        size = draw.choice((20, 200, 1200, 1200, 1200, 1200, 60_000 if draw.random() < 0.1 else 1200))
        if draw.random() < 0.2:
            data = Writer()
            write_header(data, Header(draw.getrandbits(40) + 1, 0, values=(1, 0)))
            data.raw(draw.randbytes(size))
            out.append((agent, add_checksum(data)))
        else:
            sealer = Sealer(draw.randbytes(32), agent, draw.choice((1, 2, 1000, 1 << 47)), Direction.UP,
                            Suite.ENCRYPTED)  # fmt: skip
            out.append((agent, sealer.seal(draw.randbytes(size))))
    return out


class KeyedSender:
    """A station, and an agent that sends it anything. What comes of it is in the station; nothing may be raised."""

    def __init__(self, codes: Sequence[tuple[Key, bytes]]) -> None:
        """codes: valid ones, that are sent under any keys, whole, mutated or in pieces."""
        self._codes = codes
        self.station = Station(BaseConfig(), lambda agent: coded_channel(7, peer=agent))
        self.station.track_changes()
        self._session, self._number, self._version, self._now_ns = 1, 0, 0, 0
        self._done: tuple[JobDone, ...] = ()

    def send(self, mutated: bytes, draw: random.Random) -> int:
        """Send one packet, and step the station. Returns how many values it took in so far."""
        self._now_ns += _STEP_NS
        self._session += draw.random() < 0.002
        packet = self._packet(mutated, draw)
        output = self.station.step({_AGENT: (packet,)}, self._done, self._now_ns)
        self._done = tuple(set_aside(job, "not done here") for job in output.jobs)
        if self.station.changed is not None:
            self.station.changed.clear()
        channel = self.station.channels[_AGENT]
        assert isinstance(channel, CodedChannel)
        return channel.stats.values

    def _packet(self, mutated: bytes, draw: random.Random) -> bytes:
        self._number += draw.choice((1, 1, 1, 0, 2, 100))
        channel = self.station.channels.get(_AGENT)
        ours = channel.endpoint.session if isinstance(channel, CodedChannel) else 7
        watermark = draw.choice((0, 0, 0, max(0, self._version - draw.randrange(400)), draw.choice(_HUGE[:3])))
        if draw.random() < 0.98:
            watermark = min(watermark, self._version)
        header = Header(
            self._session, ours if draw.random() < 0.99 else draw.choice((0, ours - 1, ours + 1, *_HUGE[:4])),
            (draw.randrange(100), draw.getrandbits(64)) if draw.random() < 0.5 else None,
            (draw.choice((0, self._version, *_HUGE[:4])), draw.randbytes(16)) if draw.random() < 0.05 else None,
            draw.choice((0, 5, *_HUGE[:4])) if draw.random() < 0.05 else None,
            draw.choice((0, 5, *_HUGE[:4])) if draw.random() < 0.05 else None,
            draw.choice((0, self._version, *_HUGE[:4])) if draw.random() < 0.005 else None,
            (max(1, self._number), watermark),
        )  # fmt: skip
        out, last_id = Writer(), 0
        write_header(out, header)
        for _ in range(draw.choice((1, 2, 4, 12))):
            item = self._item(mutated, watermark, draw)
            write_item(out, item, last_id, watermark)
            last_id = item.key.id
        return add_checksum(out)

    def _item(self, mutated: bytes, watermark: int, draw: random.Random) -> Item:
        known, code = draw.choice(self._codes)
        key = self._key(known, draw)
        if draw.random() < 0.2:
            code = mutated
        self._version += 1
        version = max(watermark + 1, self._version if draw.random() < 0.99 else draw.choice(_HUGE))
        form = draw.random()
        if form < 0.05:
            return Item(key, version, None, 0, b"")
        if form < 0.15:
            return Item(key, version, len(code), 0, code, residual=True)
        if form < 0.3 and len(code) > 1:
            total = draw.choice((len(code) + 1, 1 << 20, 2 + len(code)))
            return Item(key, version, total, draw.randrange(total - len(code)), code)
        return Item(key, version, len(code), 0, code)

    @staticmethod
    def _key(known: Key, draw: random.Random) -> Key:
        agent = _AGENT if draw.random() < 0.9 else _OTHER
        submap = submap_id(agent, draw.choice((0, 1, MAX_BOOTS - 1)), draw.choice((0, 1, 2, MAX_SUBMAPS - 1)))
        id_of = RECORD_TYPES[known.kind].ID
        number = known.id
        if id_of is IdOf.AGENT:
            number = int(agent)
        elif id_of is IdOf.SUBMAP:
            number = int(submap)
        elif id_of in (IdOf.KEYFRAME, IdOf.PASSING_KEYFRAME):
            number = int(keyframe_id(submap, draw.choice((0, 1, 2, draw.randrange(MAX_KEYFRAMES)))))
        return Key(known.kind if draw.random() < 0.98 else draw.randrange(64), number, draw.choice((0, 0, 1, 255)))
