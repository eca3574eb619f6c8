"""Forced losses: turned into a wall and out again, black for seconds, the old place seen again, and places alike."""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, LocalMapConfig
from kiteline_agent.covariance.pose_quality import FLAGGED_BELOW, LOST_BELOW
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_codec.schema import KeyframeHeader, Record
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import MAX_SUBMAPS, NO_KEYFRAME, AgentId, KeyframeId, submap_of_keyframe
from kiteline_core.places.place_index import Vocabulary
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.vocabulary import shipped_vocabulary

PERIOD_NS = 50_000_000


class Listening(NoBaseChannel):
    """Keeps the heads of the keyframes that were shared."""

    def __init__(self) -> None:
        self.heads: list[KeyframeHeader] = []

    def put(self, record: Record) -> Record:
        if isinstance(record, KeyframeHeader):
            self.heads.append(record)
        return record


@dataclass
class Flown:
    """What came of a flight, frame by frame."""

    agent: Agent
    estimates: list[Estimate]
    events: list[tuple[str, ...]]
    heads: list[KeyframeHeader]

    @property
    def submaps(self) -> list[int]:
        return [e.submap % MAX_SUBMAPS for e in self.estimates]

    def said(self, word: str) -> list[int]:
        """Frames in which an event begins with a word."""
        return [k for k, events in enumerate(self.events) if any(e.startswith(word) for e in events)]


def fly(rig: CameraRig, frames: Iterable[Frame], words: Vocabulary | None, config: AgentConfig | None = None) -> Flown:
    return fly_on(begun(rig, words, config), frames)


def begun(rig: CameraRig, words: Vocabulary | None, config: AgentConfig | None = None) -> Flown:
    """An agent before its first frame."""
    channel = Listening()
    agent = Agent(rig, None, config or AgentConfig(), Identity(AgentId(0), 0), channel, words)
    return Flown(agent, [], [], channel.heads)


def fly_on(flown: Flown, frames: Iterable[Frame]) -> Flown:
    """Go on with a flight, and check what holds for all of them."""
    for k, frame in enumerate(frames, len(flown.estimates)):
        output = flown.agent.step(StepInput(replace(frame, t_ns=k * PERIOD_NS)), k * PERIOD_NS)
        assert output.estimate is not None
        flown.estimates.append(output.estimate)
        flown.events.append(output.events)
    assert len({h.keyframe for h in flown.heads}) == len(flown.heads), "a keyframe's id was used twice"
    for k, (a, b) in enumerate(pairwise(flown.estimates)):
        found_again = b.tracked and not a.tracked and odometry_follows_map(flown.estimates[: k + 2])
        assert found_again or np.linalg.norm(b.T_o_b[:3, 3] - a.T_o_b[:3, 3]) < 0.15, "odometry jumped"
    return flown


def odometry_follows_map(estimates: Sequence[Estimate]) -> bool:
    """True if the last frame lies to the last one that was tracked before it as the map of both says."""
    end = estimates[-1]
    last = next((e for e in reversed(estimates[:-1]) if e.tracked), None)
    if last is None or last.T_m_b is None or end.T_m_b is None or last.submap != end.submap:
        return False
    in_o, in_m = se3.inverse(last.T_o_b) @ end.T_o_b, se3.inverse(last.T_m_b) @ end.T_m_b
    return bool(np.allclose(in_o, in_m, atol=1e-6))


def wall(like: Frame, level: float, frames: int) -> list[Frame]:
    """A blank wall of some brightness, with sensor noise."""
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(level, 1.2, like.left.shape), 0, 255).astype(np.uint8)
    return [Frame(0, image, image)] * frames


@pytest.fixture(scope="module")
def words() -> Vocabulary:
    return shipped_vocabulary()


@dataclass
class Recording:
    """Frames of a rendered flight and where the body truly was at each."""

    rig: CameraRig
    frames: list[Frame]
    truth: list[np.ndarray]

    def error_m(self, flown: Flown, shown: Sequence[int | None], submap: int) -> float:
        """Largest error of a submap's poses relative to its first, over the frames shown."""
        known = [
            (e.T_m_b, self.truth[k])
            for e, k in zip(flown.estimates, shown)
            if k is not None and e.T_m_b is not None and e.submap % MAX_SUBMAPS == submap
        ]
        first, true_first = known[0]
        return max(
            float(np.linalg.norm((se3.inverse(se3.inverse(true_first) @ true) @ se3.inverse(first) @ T)[:3, 3]))
            for T, true in known
        )

    def show(self, shown: Sequence[int | None], blank: float) -> list[Frame]:
        """The frames of some numbers; None shows a wall."""
        nothing = wall(self.frames[0], blank, 1)[0]
        return [nothing if k is None else self.frames[k] for k in shown]


@pytest.fixture(scope="module")
def room(data_dir: Path) -> Recording:
    source = open_source(str(data_dir / "room_flight.mcap"), imu=False)
    frames = []
    for item in source:
        if isinstance(item, Frame):
            frames.append(item)
        if len(frames) == 226:
            break
    truth = source.ground_truth
    assert truth is not None
    nearest = [int(np.argmin(np.abs(truth.t_ns - f.t_ns))) for f in frames]
    return Recording(source.rig, frames, [truth.T_w_b[k] for k in nearest])


BEFORE = range(30, 61)
WALL = [None] * 10
Start = Callable[[], Flown]


@pytest.fixture(scope="module")
def start(room: Recording, words: Vocabulary) -> Iterator[Start]:
    """Gives copies of a flight along BEFORE, with which the flights of many tests begin."""
    flown = fly(room.rig, room.show([*BEFORE], 0.0), words)
    monkeypatch = pytest.MonkeyPatch()
    # OpenCV's matchers cannot be copied, and hold nothing from one image to the next.
    monkeypatch.setattr(cv2.StereoSGBM, "__deepcopy__", lambda matcher, _: matcher, raising=False)
    yield lambda: copy.deepcopy(flown, {id(words): words})
    monkeypatch.undo()


def test_a_flight_that_begins_with_a_copy_is_the_same(room: Recording, words: Vocabulary, start: Start) -> None:
    frames = room.show([*BEFORE, *WALL[:3], 61, 62], 120.0)
    ours, theirs = fly_on(start(), frames[len(BEFORE) :]), fly(room.rig, frames, words)
    assert [e.T_o_b.tobytes() for e in ours.estimates] == [e.T_o_b.tobytes() for e in theirs.estimates]
    assert len(start().estimates) == len(BEFORE)


def back_after(flown: Flown, back: int) -> int:
    """How many frames after texture came back a pose came back."""
    return next(k for k, e in enumerate(flown.estimates[back:]) if e.tracked)


@pytest.mark.parametrize("resume", [61, 75, 200], ids=["same place", "a little further", "seen before"])
def test_out_of_the_wall_at_a_known_place(room: Recording, start: Start, resume: int) -> None:
    shown = [*BEFORE, *WALL, *range(resume, resume + 12)]
    flown = fly_on(start(), room.show(shown[len(BEFORE) :], 120.0))
    assert back_after(flown, 41) <= 2 and all(e.tracked for e in flown.estimates[43:])
    assert set(flown.submaps) == {0}
    assert not any(e.tracked or e.quality > 0 for e in flown.estimates[31:41])
    assert room.error_m(flown, shown, 0) < 0.04


@pytest.mark.parametrize("resume", [110, 150])
def test_out_of_the_wall_at_another_place(room: Recording, start: Start, resume: int) -> None:
    shown = [*BEFORE, *WALL, *range(resume, resume + 24)]
    flown = fly_on(start(), room.show(shown[len(BEFORE) :], 120.0))
    assert back_after(flown, 41) <= 2 and all(e.tracked for e in flown.estimates[43:])
    assert flown.submaps[-1] == 1 and flown.submaps[30] == 0
    assert flown.said("submap: joined") == []
    assert room.error_m(flown, shown, 1) < 0.04
    young = [e.quality for e in flown.estimates if e.tracked and e.submap % MAX_SUBMAPS == 1]
    assert max(young) < LOST_BELOW, "nobody knows how it lies to where the flight began"
    opened = next(h for h in flown.heads if submap_of_keyframe(h.keyframe) == flown.estimates[-1].submap)
    assert opened.parent == NO_KEYFRAME


def test_two_seconds_of_black(room: Recording, start: Start) -> None:
    shown = [*BEFORE, *[None] * 40, *range(101, 113)]
    flown = fly_on(start(), room.show(shown[len(BEFORE) :], 0.0))
    assert back_after(flown, 71) <= 2 and all(e.tracked for e in flown.estimates[73:])
    assert all(e.quality == -1 and e.T_m_b is None for e in flown.estimates[31:71])


def test_a_young_submap_is_joined_where_the_old_place_comes_back(room: Recording, start: Start) -> None:
    shown = [*BEFORE, *WALL, *range(90, 60, -1), *range(61, 71)]
    flown = fly_on(start(), room.show(shown[len(BEFORE) :], 120.0))
    joined = flown.said("submap: joined")
    assert len(joined) == 1
    assert set(flown.submaps[43 : joined[0]]) == {1} and set(flown.submaps[joined[0] :]) == {0}
    assert all(e.tracked for e in flown.estimates[43:])
    assert room.error_m(flown, shown, 0) < 0.04
    # Two keyframes of one instant tell how the submaps lie.
    twins = [h for h in flown.heads if h.t_ns == joined[0] * PERIOD_NS]
    assert sorted(submap_of_keyframe(h.keyframe) % MAX_SUBMAPS for h in twins) == [0, 1]
    T_m_k = {submap_of_keyframe(h.keyframe) % MAX_SUBMAPS: pose_of(flown.agent, h) for h in twins}
    T_0_1 = T_m_k[0] @ se3.inverse(T_m_k[1])
    young = next(k for k in range(43, joined[0]) if shown[k] is not None)
    T_1_b = flown.estimates[young].T_m_b
    start = flown.estimates[0].T_m_b
    expected = start @ se3.inverse(room.truth[30]) @ room.truth[shown[young] or 0]
    assert np.linalg.norm((T_0_1 @ T_1_b)[:3, 3] - expected[:3, 3]) < 0.05


def pose_of(agent: Agent, head: KeyframeHeader) -> np.ndarray:
    slot = agent.map.slot_of(head.keyframe)
    assert slot >= 0
    return agent.map.T_m_k[slot]


def test_without_a_vocabulary_the_reference_keyframe_is_still_found(room: Recording) -> None:
    shown = [*BEFORE, *WALL, *range(62, 68)]
    flown = fly(room.rig, room.show(shown, 120.0), None)
    assert all(e.tracked for e in flown.estimates[43:]) and set(flown.submaps) == {0}


def test_a_full_map_gives_up_old_submaps_first_and_still_flies(room: Recording, words: Vocabulary) -> None:
    config = AgentConfig(local_map=LocalMapConfig(keyframes=6))
    shown = [*BEFORE, *WALL, *range(110, 150), *WALL, *range(58, 63)]
    flown = fly(room.rig, room.show(shown, 120.0), words, config)
    held = {submap_of_keyframe(k) for k in flown.agent.map.keyframe if k != NO_KEYFRAME}
    assert np.count_nonzero(flown.agent.map.keyframe != NO_KEYFRAME) <= 6
    assert flown.submaps[-1] in (0, 1, 2) and flown.estimates[-1].submap in held
    assert all(e.tracked for e in flown.estimates[-3:])


def simulated(scene: str, seed: int, frames: int) -> tuple[CameraRig, list[Frame]]:
    source = open_sim(f"{scene}?seed={seed}&seconds=3&scale=0.5&rest=0", imu=False, texture_bits=9)
    eyes = source.cameras()
    return source.rig, [source.render(k, eyes) for k in range(0, 2 * frames, 2)]


def test_rooms_of_the_same_textures_are_kept_apart(words: Vocabulary) -> None:
    rig, here = simulated("room", 3, 20)
    _, there = simulated("hall", 3, 22)
    gap = wall(here[0], 110.0, 6)
    flown = fly(rig, [*here[:16], *gap, *there], words)
    assert back_after(flown, 22) <= 2 and all(e.tracked for e in flown.estimates[24:])
    assert flown.said("submap: joined") == [] and set(flown.submaps[24:]) == {1}
    again = fly(rig, [*here[:16], *gap, *here[12:20]], words)
    assert back_after(again, 22) <= 2 and set(again.submaps) == {0}


def test_a_place_that_the_map_shows_twice_is_not_believed(room: Recording, start: Start) -> None:
    frames = room.show([*[None] * 20, *range(200, 206)], 120.0)
    for twice in (False, True):
        flown = start()
        if twice:
            copy_map(flown.agent, np.array([30.0, 0.0, 0.0]))
        estimate = fly_on(flown, frames).estimates[-1]
        assert estimate.tracked
        assert estimate.submap % MAX_SUBMAPS == int(twice)


def copy_map(agent: Agent, shift_m: np.ndarray) -> None:
    """All keyframes once more, somewhere else."""
    m = agent.map
    for slot in np.flatnonzero(m.keyframe != NO_KEYFRAME).tolist():
        n = int(m.counts[slot])
        rows = slice(slot * m.slot_size, slot * m.slot_size + n)
        T_m_k = m.T_m_k[slot].copy()
        T_m_k[:3, 3] += shift_m
        copy = KeyframeId(int(m.keyframe[slot]) + 1000)
        landmarks = KeyframeLandmarks(
            m.uv[slot, :n].copy(), m.rho[slot, :n].copy(), m.sigma_rho[slot, :n].copy(), m.octave[rows].copy(),
            m.angle[rows].copy(), m.descriptor[rows].copy(), m.templates[rows].copy(),
        )  # fmt: skip
        m.add(KeyframeHeader(copy, 0, NO_KEYFRAME, T_m_k, n), T_m_k, landmarks, 0)
        agent._relocaliser.add_keyframe(copy)


def test_a_place_out_of_reach_is_rejected(room: Recording, start: Start) -> None:
    frames = room.show([*[None] * 4, *range(200, 226)], 120.0)  # 2.5 m within a quarter of a second
    flown = fly_on(start(), frames)
    assert all(e.tracked for e in flown.estimates[37:]) and flown.submaps[-1] == 1
    frames = room.show([*WALL, *range(200, 226)], 120.0)  # within half a second: nearly one g
    flown = fly_on(start(), frames)
    assert set(flown.submaps) == {0} and all(0 < e.quality < LOST_BELOW for e in flown.estimates[41:60])
    assert flown.estimates[-1].quality >= FLAGGED_BELOW
