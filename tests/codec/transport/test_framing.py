"""Packets on a byte stream: every split, noise and damage."""

from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.transport.framing import Deframer, StreamFramer, frame, framed_bytes

PACKETS = st.lists(st.one_of(st.binary(max_size=40), st.binary(min_size=250, max_size=600)), max_size=6)


def test_golden() -> None:
    assert frame(b"\x01\x00\x02").hex() == "000201060209d28d1000"


@given(PACKETS, st.data())
def test_any_split_gives_the_packets(packets: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(frame(p) for p in packets)
    assert all(len(frame(p)) <= framed_bytes(len(p)) for p in packets)
    deframer = Deframer(600)
    got = []
    while stream:
        n = data.draw(st.integers(1, len(stream)))
        got += deframer.feed(stream[:n])
        stream = stream[n:]
    assert got == packets
    assert deframer.damaged == 0


@given(st.binary(max_size=300), PACKETS)
def test_in_step_after_noise(noise: bytes, packets: list[bytes]) -> None:
    deframer = Deframer(600)
    deframer.feed(noise)
    assert deframer.feed(b"".join(frame(p) for p in packets))[-len(packets) or None :] == packets


@given(st.binary(min_size=1, max_size=100), st.data())
def test_a_flipped_bit_costs_only_its_packet(packet: bytes, data: st.DataObject) -> None:
    stream = bytearray(frame(packet))
    stream[data.draw(st.integers(0, len(stream) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    deframer = Deframer(600)
    got = deframer.feed(bytes(stream)) + deframer.feed(frame(b"next"))
    assert got in ([b"next"], [packet, b"next"])


def test_memory_is_bounded() -> None:
    deframer = Deframer(100)
    for _ in range(100):
        assert deframer.feed(b"\x01" * 1000) == []
        assert len(deframer._pending) <= framed_bytes(100)
    assert deframer.feed(b"\0" + frame(b"next")) == [b"next"]
    assert deframer.damaged == 1


def test_one_object_for_both_directions() -> None:
    framer = StreamFramer()
    assert framer.feed(framer.encode(b"there and back")) == [b"there and back"]
