"""An agent without a base: its records are collected for the log alone, and only when it is asked for."""

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_codec.schema import KeyframeHeader, LivePose, messages
from kiteline_core.ids import NO_KEYFRAME, keyframe_id, submap_id
from tests.codec.schema.some_records import some_records

KEYFRAME = keyframe_id(submap_id(0, 0, 0), 3)


def test_records_are_collected_while_they_are_noted() -> None:
    channel = NoBaseChannel()
    header = KeyframeHeader(KEYFRAME, 5, NO_KEYFRAME, np.eye(4), 7)
    live = next(r for r in some_records(0, 1) if isinstance(r, LivePose))
    assert channel.put(header) is header
    assert channel.take_noted() == {}  # of a flight that notes nothing, records would pile up
    channel.noting = True
    for record in (header, live):
        channel.put(record)
    assert channel.take_noted() == {messages.key(header): messages.encode(header)}
    assert channel.take_noted() == {}
