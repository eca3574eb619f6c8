"""The writer of MCAP files, beside the mcap package's."""

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from kiteline_hw.logs.mcap_write import McapWriter

CHUNK = 400

short = st.text(max_size=4)
data = st.lists(st.binary(max_size=300), max_size=3)
calls = st.lists(
    st.one_of(
        st.tuples(st.just("message"), st.integers(0, 2), st.integers(0, 50), data),
        st.tuples(st.just("channel"), short, st.dictionaries(short, short, max_size=2)),
        st.tuples(st.just("flush")),
    ),
    max_size=30,
)


def written(ours: bool, made: list[tuple[Any, ...]]) -> bytes:
    out = io.BytesIO()
    if ours:
        mine = McapWriter(out, CHUNK, "kiteline")
        add: Any = mine
    else:
        theirs = Writer(out, chunk_size=CHUNK, compression=CompressionType.NONE)
        theirs.start("", "kiteline")
        add = theirs
    add.add_metadata("about", {"a": "b", "c": "é"})
    schema = add.register_schema("S", "jsonschema", b"{}")
    channels, sent = [add.register_channel(f"/{k}", "json", schema, {}) for k in range(3)], dict[int, int]()
    for call in made:
        if call[0] == "flush":
            add.flush()
        elif call[0] == "channel":
            add.register_channel(call[1], "json", schema, call[2])
        elif ours:
            add.add_message(channels[call[1]], call[2], tuple(call[3]))
        else:
            number = sent.get(call[1], 0)
            sent[call[1]] = number + 1
            add.add_message(channels[call[1]], call[2], b"".join(call[3]), call[2], number)
    add.finish()
    return out.getvalue()


@given(calls)
def test_files_are_those_of_the_mcap_package(made: list[tuple[Any, ...]]) -> None:
    assert written(True, made) == written(False, made)


class FullDisk(io.BytesIO):
    room = 1000

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.room:
            raise OSError("no space left")
        return super().write(data)


def test_messages_of_a_chunk_that_is_not_written_are_counted() -> None:
    writer = McapWriter(FullDisk(), CHUNK, "kiteline")
    channel = writer.register_channel("/a", "json", 0, {})
    for k in range(20):
        writer.add_message(channel, k, (b"x",))
    with pytest.raises(OSError, match="no space"):
        writer.add_message(channel, 20, (b"x" * 1000,))
    assert writer.lost > 5
    assert writer._statistics().message_count == 21 - writer.lost
