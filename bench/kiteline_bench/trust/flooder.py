"""A stranger without a key: sends all that Zenoh lets it send, as fast as it is told, and listens to all it can.

`python -m kiteline_bench.trust.flooder ENDPOINT SECONDS BYTES_S` prints what became of it as JSON.
"""

import json
import random
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from kiteline_bench.trust.keyed_sender import forged_packets
from kiteline_codec.transport.seal_watch import is_plain
from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.links.zenoh_session import close_session, direct, open_session

_PREFIX = "kiteline/1/default"
_BATCH = 64  # packets between two looks at the clock
_QUESTION = b'{"map": "0.1.0"}'
_NAMES_S = 0.05  # s between two names that it announces, and two questions


class _Heard:
    """What others sent, and what the base answered."""

    def __init__(self) -> None:
        self.packets = self.readable = self.answers = self.refusals = 0

    def on_packet(self, sample: Any) -> None:
        self.packets += 1
        self.readable += is_plain(sample.payload.to_bytes())

    def on_reply(self, reply: Any) -> None:
        if reply.ok is None:
            self.refusals += 1
        else:
            self.answers += 1


def flood(endpoint: str, seconds: float, bytes_s: float) -> dict[str, Any]:
    """Flood a base. Returns bytes, packets and questions sent, and what was heard."""
    draw, heard = random.Random(1), _Heard()
    session = open_session(endpoint, "client")
    # What a base answers agents lies on their own keys; a stranger asks for those of others, too.
    kept: list[Any] = [
        session.declare_subscriber(
            f"{_PREFIX}/{key}",
            direct(heard.on_packet),
            allowed_origin=zenoh.Locality.REMOTE,  # not its own packets
        )
        for key in ("*/up", "*/down", "**")
    ]
    packets = forged_packets(draw, 4096)
    put: Callable[[str, bytes], None] = partial(session.put, congestion_control=zenoh.CongestionControl.BLOCK)
    names = threading.Event()
    other = threading.Thread(target=_announce, args=(session, names, heard, kept), daemon=True)
    other.start()
    begin_s, sent, count = time.monotonic(), 0, 0
    while (past_s := time.monotonic() - begin_s) < seconds:
        if sent > bytes_s * past_s:
            time.sleep(0.001)
            continue
        for _ in range(_BATCH):
            agent, packet = packets[count % len(packets)]
            put(f"{_PREFIX}/{agent}/up", packet)
            sent, count = sent + len(packet), count + 1
        put(f"{_PREFIX}/3/down", packets[0][1])
    names.set()
    other.join(2.0)
    close_session(session)
    return {"bytes": sent, "packets": count, "heard": heard.packets, "readable": heard.readable,
            "answers": heard.answers, "refusals": heard.refusals, "seconds": past_s}  # fmt: skip


def _announce(session: Any, over: threading.Event, heard: _Heard, kept: list[Any]) -> None:
    number = 0
    while not over.wait(_NAMES_S):
        number += 1
        kept.append(session.liveliness().declare_token(f"{_PREFIX}/{number % MAX_AGENTS}/alive/stranger{number}"))
        verb = ("list", "delete", "merge")[number % 3]
        session.get(f"{_PREFIX}/maps/{verb}", direct(heard.on_reply), payload=_QUESTION, timeout=5.0)


if __name__ == "__main__":
    print(json.dumps(flood(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))))
    sys.stdout.flush()
