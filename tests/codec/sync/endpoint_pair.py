"""Two endpoints and a simulated link between them, for tests."""

import random

from kiteline_codec.schema import Key
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint

MS = 1_000_000
PLAIN = SyncConfig(overhead_bytes=0)


class Pair:
    """Two endpoints and a seeded link between them, in steps of 10 ms."""

    def __init__(self, config: SyncConfig = PLAIN, loss: float = 0.0, delay_ms: tuple[int, int] = (1, 5)) -> None:
        self.config = config
        self.loss = loss
        self.delay_ms = delay_ms
        self.rng = random.Random(1)
        self.now_ns = 0
        self.ends = [Endpoint(config, 1), Endpoint(config, 1)]
        self.wire: list[tuple[int, int, int, bytes]] = []
        self.sent: list[list[tuple[int, bytes]]] = [[], []]
        self.updates: list[list[tuple[Key, bytes | None]]] = [[], []]

    @property
    def a(self) -> Endpoint:
        return self.ends[0]

    @property
    def b(self) -> Endpoint:
        return self.ends[1]

    def restart(self, end: int) -> None:
        self.ends[end] = Endpoint(self.config, self.ends[end].session + 1)

    def step(self) -> None:
        self.now_ns += 10 * MS
        for i in (0, 1):
            while (packet := self.ends[i].poll(self.now_ns)) is not None:
                self.sent[i].append((self.now_ns, packet))
                copies = 0 if self.rng.random() < self.loss else 2 if self.rng.random() < self.loss / 4 else 1
                for _ in range(copies):
                    at = self.now_ns + MS * self.rng.randint(*self.delay_ms)
                    self.wire.append((at, len(self.sent[i]), 1 - i, packet))
        due = sorted(w for w in self.wire if w[0] <= self.now_ns)
        self.wire = [w for w in self.wire if w[0] > self.now_ns]
        for _, _, to, packet in due:
            self.updates[to] += [(u.key, u.code) for u in self.ends[to].receive(packet, self.now_ns)]

    def run(self, ms: int) -> None:
        for _ in range(ms // 10):
            self.step()

    def settle(self, limit_ms: int = 60_000) -> None:
        end_ns = self.now_ns + limit_ms * MS
        while not all(e.digest_equal for e in self.ends):
            assert self.now_ns < end_ns, [e.stats for e in self.ends]
            self.step()
        assert self.a.digests == self.b.digests[::-1]


def fill(end: Endpoint, seed: int, n: int, kind: int, longest: int = 900) -> dict[Key, bytes]:
    rng = random.Random(seed)
    values = {Key(kind, 1000 + i): rng.randbytes(rng.randrange(longest)) for i in range(n)}
    for key, code in values.items():
        end.put(key, code)
    return values
