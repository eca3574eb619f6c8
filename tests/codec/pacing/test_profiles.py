"""What a profile shares of a keyframe, and how the pace follows the link."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.channel import coded_channel
from kiteline_codec.pacing.pacer import Pacer
from kiteline_codec.pacing.profiles import EXACT, RADIO, WIFI, Profile
from kiteline_codec.pacing.throughput import Throughput
from kiteline_codec.schema import KeyframeHeader, LivePose, NewLandmarks, Observations, messages
from kiteline_core.errors import KitelineError
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from kiteline_core.imaging import descriptors
from kiteline_hw.links.kinds import link_traits

KEYFRAME = keyframe_id(submap_id(1, 2, 3), 40)
SECOND = 1_000_000_000


def a_keyframe(landmarks: int, observations: int, seed: int = 0) -> tuple[NewLandmarks, np.ndarray, Observations]:
    rng = np.random.default_rng(seed)
    new = NewLandmarks(
        KEYFRAME, 0, np.arange(landmarks, dtype=np.uint16), rng.uniform(0, 700, (landmarks, 2)).astype(np.float32),
        rng.uniform(0, 1, landmarks).astype(np.float32), rng.integers(0, 3, landmarks).astype(np.uint8),
        rng.integers(0, 256, landmarks).astype(np.uint8), rng.integers(0, 256, (landmarks, 32)).astype(np.uint8),
    )  # fmt: skip
    point = np.sort(rng.permutation(4000)[:observations]).astype(np.int64)
    seen = Observations(
        KEYFRAME, 0, np.arange(landmarks, landmarks + observations, dtype=np.uint16),
        rng.uniform(0, 700, (observations, 2)).astype(np.float32), rng.uniform(-1, 1, observations).astype(np.float32),
        rng.integers(0, 3, observations).astype(np.uint8), point,
    )  # fmt: skip
    return new, rng.uniform(size=landmarks), seen


@given(st.sampled_from([WIFI, RADIO, EXACT]), st.integers(0, 200), st.integers(0, 250))
def test_what_is_shared(profile: Profile, landmarks: int, observations: int) -> None:
    new, strength, seen = a_keyframe(landmarks, observations)
    n = min(landmarks, profile.landmarks)
    seen = replace(seen, index=np.arange(n, n + observations, dtype=np.uint16))
    parts, sections = profile.choose(new, strength, seen)
    assert [p.part for p in parts] == list(range(len(parts)))
    index = np.sort(np.concatenate([p.index for p in parts])) if parts else np.zeros(0)
    assert np.array_equal(index, np.arange(n))
    rows = np.concatenate([s.index for s in sections]) if sections else np.zeros(0)
    assert np.array_equal(rows, np.arange(n, n + min(observations, profile.observations)))
    named = sum(int(p.descriptor.any(axis=1).sum()) for p in parts)
    assert named == min(n, profile.described)
    for part in parts:
        assert len(messages.encode(part)) <= profile.landmarks_bytes
        assert np.abs(part.uv - new.uv[part.index]).max() == 0
        known = new.inv_depth[part.index] > 0
        assert np.array_equal(part.inv_depth > 0, known)
        assert np.abs(part.inv_depth - new.inv_depth[part.index]).max() < 0.01
        if profile.narrow:
            assert descriptors.is_narrow(part.descriptor).all()
    for section in sections:
        original = {int(p): i for i, p in enumerate(seen.point)}
        at = [original[int(p)] for p in section.point]
        assert np.abs(section.uv - seen.uv[at]).max() <= profile.pixel_step / 32 + 1e-4


@pytest.mark.parametrize("profile", [WIFI, RADIO, EXACT], ids=lambda p: p.name)
def test_coarser_depths_leave_the_scale(profile: Profile) -> None:
    new, strength, seen = a_keyframe(1000, 1000)
    new = replace(new, inv_depth=np.linspace(0.05, 1.0, 1000).astype(np.float32))
    seen = replace(seen, inv_depth=new.inv_depth.copy())
    parts, sections = replace(profile, landmarks=1000, observations=1000).choose(new, strength, seen)
    ours = np.concatenate([np.log(p.inv_depth / new.inv_depth[p.index]) for p in parts])
    theirs = np.concatenate([np.log(s.inv_depth / seen.inv_depth[s.index - 1000]) for s in sections])
    assert len(ours) == len(theirs) == 1000
    assert abs(ours.mean()) < 5e-5 and abs(theirs.mean()) < 5e-5


def test_narrow_descriptors_are_compared_like_wide_ones() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (50, 32)).astype(np.uint8)
    b = a ^ (rng.uniform(size=a.shape) < 0.1).astype(np.uint8)

    def distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = descriptors.comparable(x, y)
        return np.unpackbits(x[:, None] ^ y[None], axis=2).sum(axis=2)

    assert np.array_equal(distance(a, b), np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2))
    narrow = descriptors.narrowed(a)
    assert np.array_equal(distance(narrow, b), distance(narrow, descriptors.narrowed(b)))
    assert np.array_equal(distance(narrow, b).argmin(axis=1), np.arange(50))
    assert np.array_equal(descriptors.unpacked(descriptors.packed(a)), narrow)
    assert len(descriptors.BITS) == 128
    blank = np.zeros((2, 32), np.uint8)
    assert distance(blank, np.concatenate([blank, narrow])).min() > 80


def test_a_radio_keyframe_takes_few_bytes() -> None:
    new, strength, seen = a_keyframe(200, 200)
    parts, sections = RADIO.choose(new, strength, replace(seen, index=seen.index - 200 + 96))
    assert sum(len(messages.encode(s)) for s in (*parts, *sections)) < 3000  # plain; residual codes take a third less


def test_a_budget_chooses_the_profile() -> None:
    assert Pacer(None, 1000).profile is RADIO
    assert Pacer(None, 100_000).profile is WIFI
    assert Pacer(WIFI, 1000).profile is WIFI
    assert coded_channel(1, 800).profile.name == "radio"
    assert coded_channel(1, 0, link=link_traits("serial:/dev/ttyUSB0:57600")).profile.name == "radio"
    assert coded_channel(1).profile is WIFI
    with pytest.raises(ValueError, match="wifi or radio"):
        coded_channel(1, profile="pigeon")
    with pytest.raises(KitelineError, match=r"10 B/s .* at least 270"):  # which command lines print without a traceback
        coded_channel(1, 10)


def test_measured_throughput_chooses_the_profile_with_patience() -> None:
    pacer = Pacer(None, None)
    for tick in range(29):
        pacer.step(2000, tick * SECOND // 10)
    assert pacer.profile is WIFI
    pacer.step(2000, 40 * SECOND // 10)
    assert pacer.profile is RADIO
    pacer.step(50_000, 5 * SECOND)
    pacer.step(50_000, 8 * SECOND)
    assert pacer.profile is RADIO
    pacer.step(50_000, 20 * SECOND)
    assert pacer.profile is WIFI


def test_throughput_is_known_only_while_there_is_more_to_send() -> None:
    meter = Throughput()
    for tick in range(40):
        now_ns = tick * SECOND // 10
        meter.busy(True, now_ns)
        meter.acked(150, now_ns)
    assert meter.bytes_s(now_ns) == pytest.approx(1500, rel=0.1)
    meter.busy(False, now_ns)
    assert meter.bytes_s(now_ns) is None


def test_the_pause_between_keyframes_follows_the_link() -> None:
    assert Pacer(None, None).keyframe_gap_ns(10_000_000, None) == 0
    assert Pacer(RADIO, 1000).keyframe_gap_ns(0, None) == RADIO.keyframe_bytes * SECOND // 1000
    assert Pacer(RADIO, 1000).keyframe_gap_ns(3000, None) == 3 * SECOND
    assert Pacer(RADIO, 300).keyframe_gap_ns(1 << 30, None) == 5 * SECOND


def test_landmarks_follow_the_rate_of_keyframes() -> None:
    pacer = Pacer(RADIO, 1000)
    for i in range(30):
        pacer.keyframe(i * 400_000_000)
    fast = pacer.share(None)
    for i in range(30):
        pacer.keyframe(20 * SECOND + i * 3 * SECOND)
    slow = pacer.share(None)
    assert 7 <= fast.landmarks < slow.landmarks <= RADIO.landmarks
    assert fast.described < slow.described <= RADIO.described
    assert Pacer(WIFI, 1000).share(None) is WIFI


@given(st.integers(300, 5900), st.integers(200, 5000))
def test_a_keyframe_fills_the_room_that_the_link_has(rate: int, interval_ms: int) -> None:
    pacer = Pacer(RADIO, rate)
    for i in range(60):
        pacer.keyframe(i * interval_ms * 1_000_000)
    p = pacer.share(None)
    room = rate * interval_ms / 1000 - p.observations_room_bytes
    took = p.described * p.landmark_bytes + (p.landmarks - p.described) * p.undescribed_bytes
    assert took <= max(room, 7 * p.landmark_bytes) + 1
    # Nothing is left that another landmark, or another descriptor, would fit into.
    assert room - took < p.landmark_bytes or (p.landmarks, p.described) == (RADIO.landmarks, RADIO.described)


def test_poses_take_no_more_than_a_fifth_of_a_budget() -> None:
    assert Pacer(RADIO, None).live_gap_ns == Pacer(RADIO, 1000).live_gap_ns == RADIO.live_gap_ns
    assert Pacer(RADIO, 500).live_gap_ns == SECOND * 38 // 100
    assert Pacer(RADIO, 250).live_gap_ns == SECOND * 3 // 4
    assert Pacer(WIFI, 1_000_000).live_gap_ns == WIFI.live_gap_ns


def test_live_poses_are_thinned_by_their_time() -> None:
    channel = coded_channel(1, 1000)
    sent = set()
    for i in range(100):
        channel.put(LivePose(AgentId(0), i * 50_000_000, KEYFRAME, np.eye(4), 50))
        sent.add(next(iter(channel.endpoint.own_values().values())))
    assert len(sent) == 25  # 5 s at 5 Hz
    channel.put(LivePose(AgentId(0), 0, KEYFRAME, np.eye(4), 50))
    channel.put(KeyframeHeader(KEYFRAME, 0, NO_KEYFRAME, np.eye(4), 0))
    assert channel.report()["profile"] == "radio"
    assert channel.report()["backlog_bytes"] > 0
