"""Who may write a value, and what it is of, by its key alone; also for kinds of a newer schema."""

import pytest

from kiteline_codec.schema import GridTile, Key, KeyframeHeader, SubmapPlacement, SubmapScale, WireError, messages
from kiteline_codec.schema.owners import claimed_bytes, of_agent, submap_of
from kiteline_core.ids import AgentId, keyframe_id, submap_id
from tests.codec.schema.some_records import some_records

NEWER = Key(15, keyframe_id(submap_id(3, 0, 0), 5))


def test_a_kind_of_a_newer_schema_is_of_no_submap_and_refused_to_nobody() -> None:
    with pytest.raises(WireError):
        messages.decode(NEWER, b"")
    assert submap_of(NEWER) is None
    assert claimed_bytes(NEWER, b"\x05") == 0
    assert of_agent(AgentId(7), NEWER) and not of_agent(AgentId(0), Key(16, 1))


def test_values_are_of_the_submap_and_agent_that_their_key_names() -> None:
    submap = submap_id(3, 1, 2)
    keyframe = keyframe_id(submap, 5)
    assert submap_of(Key(KeyframeHeader.KIND, keyframe)) == submap == submap_of(Key(SubmapPlacement.KIND, submap))
    assert submap_of(Key(GridTile.KIND, 1)) is None
    for kind, id_ in ((KeyframeHeader.KIND, keyframe), (SubmapScale.KIND, submap)):
        assert of_agent(AgentId(3), Key(kind, id_)) and not of_agent(AgentId(2), Key(kind, id_))
    header = next(r for r in some_records(1, 4) if isinstance(r, KeyframeHeader))
    assert claimed_bytes(messages.key(header), messages.encode(header)) > 0
