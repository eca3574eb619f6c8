"""A link whose incoming packets and messages a test hands in."""


class HandedLink:
    """A ByteLink that sends into nothing. inbox, messages: what it gives next."""

    def __init__(self) -> None:
        self.inbox: list[bytes] = []
        self.messages: list[str] = []

    def take_messages(self) -> list[str]:
        messages, self.messages = self.messages, []
        return messages

    def send(self, packet: bytes) -> bool:
        return True

    def receive(self) -> list[bytes]:
        packets, self.inbox = self.inbox, []
        return packets

    def close(self) -> None:
        self.inbox = []
