"""Values in an agent's log come back as they were written."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.schema import Key, WireError
from kiteline_codec.schema.record_log import read_record, write_record
from kiteline_core.ids import AgentId

keys = st.builds(Key, st.integers(0, 255), st.integers(0, 2**62), st.integers(0, 65535))


@given(st.integers(0, 255).map(AgentId), keys, st.binary(max_size=40))
def test_what_was_written_is_read(agent: AgentId, key: Key, code: bytes) -> None:
    assert read_record(write_record(agent, key, code)) == (agent, key, code)


@given(st.binary(max_size=11))
def test_what_is_too_short_is_refused(noise: bytes) -> None:
    with pytest.raises(WireError):
        read_record(noise)
