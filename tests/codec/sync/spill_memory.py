"""A spill in memory that can be full or lose data."""


class Memory:
    """A Spill. Of what was put it loses every `forgets`-th; it takes no more than `room` bytes."""

    def __init__(self, forgets: int = 0, room: int = 1 << 40) -> None:
        self.data: list[bytes] = []
        self.freed: set[int] = set()
        self.forgets = forgets
        self.room = room

    def put(self, data: bytes) -> int | None:
        if sum(map(len, self.data)) + len(data) > self.room:
            return None
        self.data.append(data)
        return len(self.data) - 1

    def get(self, where: int, n_bytes: int) -> bytes | None:
        if self.forgets and where % self.forgets == 0:
            return None
        assert where not in self.freed and len(self.data[where]) == n_bytes
        return self.data[where]

    def free(self, where: int, n_bytes: int) -> None:
        assert where not in self.freed and len(self.data[where]) == n_bytes
        self.freed.add(where)
        self.data[where] = b""
