"""The virtual CPU's prices: every kind of work has one, and flights cost the same wherever they are flown."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, GovernorConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import PRICES_NS, Work, cost_ns
from kiteline_agent.governor.effort import CARRIED, FULL, governed
from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_agent.step import Identity, StepInput
from kiteline_core.frame import Frame
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.vocabulary import shipped_vocabulary
from tests.agent.room_flight import RoomFlight


def costs_of(path: Path, config: AgentConfig, frames: int = 12) -> tuple[list[int], list[Work], list[bool]]:
    source = open_source(str(path))
    agent = Agent(source.rig, None, config, Identity(AgentId(0), 0), NoBaseChannel())
    costs: list[int] = []
    works: list[Work] = []
    tracked: list[bool] = []
    for frame in [item for item in source if isinstance(item, Frame)][:frames]:
        output = agent.step(StepInput(frame, cpu_ns=costs[-1] if costs else 0), frame.t_ns)
        costs.append(cost_ns(agent.work))
        works.append(replace(agent.work))
        tracked.append(output.estimate is not None)
    return costs, works, tracked


def test_every_work_has_a_price() -> None:
    assert {field.name for field in fields(Work)} == set(PRICES_NS)
    assert all(price > 0 for price in PRICES_NS.values())
    for name in PRICES_NS:
        assert cost_ns(Work(**{name: 1_000})) == round(1_000 * PRICES_NS[name])


def test_a_flight_costs_what_was_counted(recording: Path) -> None:
    costs, works, _ = costs_of(recording, AgentConfig())
    assert costs_of(recording, AgentConfig())[0] == costs
    assert works[0].keyframes == 1 and works[0].new_landmarks > 20 and works[0].alignments == 0
    usual = [work for work in works[1:] if not work.keyframes]
    assert usual and all(work.alignments > 100 and work.stereo_points > 20 for work in usual)
    assert all(work.detected_px == 0 for work in usual)
    assert costs[0] > max(cost for cost, work in zip(costs[1:], works[1:]) if not work.keyframes)


def test_a_search_counts_the_keyframes_that_it_enters(recording: Path) -> None:
    source = open_source(str(recording))
    agent = Agent(source.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel(), shipped_vocabulary())
    relocaliser = agent._relocaliser
    for frame in [item for item in source if isinstance(item, Frame)][:12]:
        agent.step(StepInput(frame), frame.t_ns)
    held = np.count_nonzero(agent.map.keyframe != NO_KEYFRAME)
    for entered in (held, 0):
        agent.work.clear()
        relocaliser.enter_keyframes()
        assert agent.work.places == entered
    slots = len(agent.map.keyframe)
    for k in range(5 * slots):  # a long flight without a search: evicted keyframes do not wait
        relocaliser.add_keyframe(KeyframeId(1_000 + k))
        assert len(relocaliser._waiting) <= 2 * slots


def test_a_search_enters_a_few_keyframes_the_newest_first(recording: Path) -> None:
    source = open_source(str(recording))
    config = AgentConfig()
    config = replace(config, relocalisation=replace(config.relocalisation, indexed_per_frame=1))
    agent = Agent(source.rig, None, config, Identity(AgentId(0), 0), NoBaseChannel(), shipped_vocabulary())
    relocaliser = agent._relocaliser
    for frame in [item for item in source if isinstance(item, Frame)][:12]:
        agent.step(StepInput(frame), frame.t_ns)
    held = sorted(agent.map.keyframe[agent.map.keyframe != NO_KEYFRAME].tolist(), reverse=True)
    assert len(held) > 1
    for entered in range(1, len(held) + 2):
        agent.work.clear()
        relocaliser.enter_keyframes()
        assert agent.work.places == (entered <= len(held))
        assert relocaliser._index.keys == held[:entered]


def test_less_effort_is_counted_as_less(recording: Path) -> None:
    """Frames and keyframes apart: how many keyframes there are depends on what is seen, too."""
    frames, keyframes = [], []
    for row in (FULL, replace(CARRIED[-1], first=0), CARRIED[-1]):
        costs, works, _ = costs_of(recording, governed(AgentConfig(), row))
        frames.append(np.mean([cost for cost, work in zip(costs, works, strict=True) if not work.keyframes]))
        keyframes.append(np.mean([work.detected_px for work in works if work.keyframes]))
    assert frames[0] > frames[1] > frames[2]
    assert keyframes[0] == keyframes[1] > 2.0 * keyframes[2]


def test_an_agent_under_a_budget_skips_frames_and_keeps_to_it(recording: Path) -> None:
    config = AgentConfig()
    config = replace(config, governor=replace(config.governor, cpu_percent=0.5, grace_s=0.0))
    costs, works, tracked = costs_of(recording, config, frames=30)
    assert not all(tracked) and any(tracked[5:])
    skipped = [cost for cost, was_tracked in zip(costs, tracked) if not was_tracked]
    assert max(skipped) == PRICES_NS["steps"]
    assert all(work.frames == was_tracked for work, was_tracked in zip(works, tracked))


def test_newest_frame_wins_on_a_busy_core() -> None:
    core = VirtualCpu(50.0)
    core.spend(40_000_000, 0)
    assert core.free_ns == 80_000_000
    assert core.newest_wins(10_000_000, 50_000_000) and not core.newest_wins(50_000_000, 50_000_000)
    assert not VirtualCpu(0.0).newest_wins(0, 50_000_000)


def test_halved_images_are_not_compared_for_the_disparity_offset(room_flight: RoomFlight) -> None:
    """They hardly tell it, and a comparison costs a sixth of such a frame."""
    pairs = {}
    for percent in (0.0, 1.0):
        config = AgentConfig(governor=GovernorConfig(cpu_percent=percent))
        agent = Agent(room_flight.rig, None, config, Identity(AgentId(0), 0), NoBaseChannel())
        cost, found, halved = 0, 0, 0
        for frame in room_flight.first(4.0).frames:
            agent.step(StepInput(frame, cpu_ns=cost), frame.t_ns)
            cost = cost_ns(agent.work)
            found += agent.work.pairs
            halved += agent.work.frames if agent._effort.first else 0
        pairs[percent] = found
        assert percent == 0.0 or halved > 5
    assert pairs[0.0] > 5 and pairs[1.0] == 0
