"""What an agent holds beside its map does not grow with the keyframes of a flight."""

import io
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.local_map.held_corrections import HeldCorrections
from kiteline_agent.runtime.frame_counts import FrameCounts
from kiteline_core.ids import KeyframeId, keyframe_id, submap_id
from kiteline_hw.logs.mcap_write import McapWriter
from tests.agent.test_flight_parts import estimate
from tests.entries import entries_of

HELD = 48  # keyframes in the local map


def test_keyframes_are_counted_without_their_ids() -> None:
    counts, held = FrameCounts(), list[Counter[str]]()
    for n in range(200):
        submap = submap_id(0, 1, n // 100)
        for keyframe in (n % 100, max(0, n % 100 - 30)):  # an older one after a relocalisation
            counts.count(replace(estimate(keyframe=keyframe_id(submap, keyframe)), submap=submap))
        held.append(entries_of(counts))
    assert counts.keyframes == 200 and len(counts.submaps) == 2
    assert held[199] == held[100] and held[99] == held[0]


@pytest.mark.parametrize("placed", [True, False])
def test_of_keyframes_that_left_the_map_long_ago_nothing_is_known(placed: bool) -> None:
    """A changed disparity offset moves keyframes: which of them the base has set matters as long as they are held."""
    held, submap = HeldCorrections(), submap_id(0, 1, 0)
    for n in range(1, 1400):
        here = np.array([keyframe_id(submap, k) for k in range(max(1, n - HELD), n + 1)])
        parent = here - 1
        held.note_motion(submap, here[-2:], parent[-2:], np.tile(np.eye(4), (2, 1, 1)))
        if placed:
            held.set_pose(KeyframeId(int(here[-1])), np.eye(4), stored=True)
        held.forget(KeyframeId(int(here[0]) - 1))
        held.forget_evicted(here, parent)
        known = held.placed if placed else held.moved
        assert known.issuperset(here[1:].tolist())
        assert n <= HELD + 1 or int(parent[0]) in known
    assert sum(entries_of(held).values()) < 1400


def test_the_index_of_a_log_takes_bytes_not_objects() -> None:
    writer, held = McapWriter(io.BytesIO(), 100, "test"), list[Counter[str]]()
    channel = writer.register_channel("topic", "json", writer.register_schema("name", "jsonschema", b"{}"), {})
    for n in range(200):
        writer.add_message(channel, n, (bytes(200),))
        held.append(entries_of(writer))
    assert held[199] == held[100]
