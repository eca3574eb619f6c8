"""The states of agreement, event by event, and what is counted against a limit."""

import pytest

from kiteline_codec.schema import CameraIntrinsics, Key, KeyframeHeader
from kiteline_codec.sync.agreement import OwnState, OwnValues, PeerState, PeerValues
from kiteline_codec.sync.resident import ResidentValues


def test_old_values_are_void_until_the_peer_has_received_that_they_are() -> None:
    own = OwnValues()
    own.new_session()
    assert own.must_void(5)
    own.found_different(void_up_to=7, next_packet=3)
    assert own.state is OwnState.VOIDING and not own.must_void(7) and own.must_void(8)
    own.acknowledged(2)
    own.found_equal(6)  # compared before: it proves nothing
    assert own.state is OwnState.VOIDING and own.equal_at is None
    own.acknowledged(3)
    assert own.state is OwnState.UNCOMPARED
    own.found_equal(9)
    assert own.state is OwnState.EQUAL and own.equal_at == 9


def test_a_difference_is_news_once_and_lasts_until_it_is_void() -> None:
    peer = PeerValues()
    peer.found_equal(2)
    assert peer.take_verdict() == 2 and peer.take_verdict() is None
    assert peer.found_different(4) and not peer.found_different(4)
    peer.found_equal(5)
    assert peer.state is PeerState.DIFFERENT
    peer.voided(3)
    assert peer.state is PeerState.DIFFERENT
    peer.voided(4)
    assert peer.state is PeerState.UNCOMPARED


@pytest.mark.parametrize("limit", [1000, None])
def test_values_of_keyframes_count_against_the_limit(limit: int | None) -> None:
    held = ResidentValues(limit, 100)
    assert not held.full and held.roomy
    held.count(Key(CameraIntrinsics.KIND, 0), 5000)  # of no keyframe
    for k in range(10):
        held.count(Key(KeyframeHeader.KIND, k), 0)
    assert held.bytes == (1000 if limit else 0) and not held.full
    assert held.roomy == (limit is None)
    held.count(Key(KeyframeHeader.KIND, 10), 1)
    assert held.full == (limit is not None)
    held.uncount(Key(KeyframeHeader.KIND, 10), 1)
    held.uncount(Key(KeyframeHeader.KIND, 11), 1)  # was never counted
    assert not held.full
    held.remove_limit()
    assert held.roomy and held.bytes == 0 and held.ids() == []
