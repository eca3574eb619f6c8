"""The governor: within its budget over every second, quality before frames, frames before tracking, no haste."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.config import AgentConfig, GovernorConfig
from kiteline_agent.governor import LADDER, Extra, Governor, governed

PERIOD_NS = 50_000_000
FRAME_NS, KEYFRAME_NS = 3_500_000, 5_000_000


class Flight:
    """A governor in closed loop with an agent of known cost."""

    def __init__(self, percent: float, keyframe_every: int = 8, dearer: float = 1.0) -> None:
        self.governor = Governor(GovernorConfig(cpu_percent=percent))
        self.keyframe_every, self.dearer = keyframe_every, dearer
        self.cost_ns: list[int] = []
        self.tracked: list[bool] = []
        self.levels: list[int] = []
        self.events: list[str] = []
        self.wanted = 0

    def fly(self, frames: int) -> Flight:
        for _ in range(frames):
            k = len(self.cost_ns)
            decision = self.governor.frame(k * PERIOD_NS, self.cost_ns[-1] if k else 0)
            cost = 20_000.0
            if decision.track:
                cost = FRAME_NS * LADDER[decision.level].cost * self.dearer
                self.wanted += 1
                if self.wanted >= self.keyframe_every and self.governor.may(Extra.KEYFRAME):
                    self.wanted = 0
                    cost += KEYFRAME_NS * LADDER[decision.level].corners * self.dearer
            self.cost_ns.append(round(cost))
            self.tracked.append(decision.track)
            self.levels.append(decision.level)
            self.events.extend(decision.events)
        return self

    def windows(self, after: int = 60) -> list[float]:
        """Percent of a core over each second that ends at a frame from `after` on."""
        n = 1_000_000_000 // PERIOD_NS
        return [sum(self.cost_ns[max(k - n + 1, 0) : k + 1]) / 1e7 for k in range(after, len(self.cost_ns))]


LOAD = (FRAME_NS + KEYFRAME_NS / 8) / PERIOD_NS * 100.0  # percent of a core without a governor


@pytest.mark.parametrize("share", [1.0, 0.5, 0.25, 0.12])
@pytest.mark.parametrize("dearer", [0.8, 1.0, 1.3])
def test_budget_holds_in_every_second_after_the_third(share: float, dearer: float) -> None:
    flight = Flight(share * LOAD, dearer=dearer).fly(600)
    assert max(flight.windows()) <= share * LOAD * 1.001
    assert max(flight.windows()) > 0.4 * share * LOAD  # it is used, too


def test_without_a_budget_nothing_is_decided() -> None:
    flight = Flight(0.0).fly(100)
    assert all(flight.tracked) and set(flight.levels) == {0} and not flight.events


def test_ample_budget_costs_nothing() -> None:
    flight = Flight(2.0 * LOAD).fly(300)
    assert all(flight.tracked) and set(flight.levels) == {0}


def test_quality_goes_before_frames() -> None:
    flight = Flight(0.25 * LOAD).fly(600)
    skipped = [level for level, tracked in zip(flight.levels, flight.tracked) if not tracked]
    assert skipped and set(skipped) == {len(LADDER) - 1}
    assert all(Flight(0.6 * LOAD).fly(600).tracked)


def test_frames_are_let_through_evenly() -> None:
    flight = Flight(0.25 * LOAD).fly(600)
    gap = worst = 0
    for tracked in flight.tracked[60:]:
        gap = 0 if tracked else gap + 1
        worst = max(worst, gap)
    assert worst <= 3


def test_effort_does_not_swing() -> None:
    flight = Flight(0.6 * LOAD).fly(1200)
    changes = sum(a != b for a, b in zip(flight.levels[100:], flight.levels[101:]))
    assert changes <= 12  # in 55 s


def test_effort_comes_back_when_the_load_has_gone() -> None:
    flight = Flight(0.6 * LOAD).fly(200)
    assert flight.levels[-1] > 0
    flight.dearer = 0.3
    flight.fly(400)
    assert flight.levels[-1] == 0


def test_a_lost_vehicle_does_not_overdraw_the_budget() -> None:
    governor, cost_ns, spent = Governor(GovernorConfig(cpu_percent=1.0)), 0, []
    for k in range(400):
        decision = governor.frame(k * PERIOD_NS, cost_ns, lost=k > 20)
        cost_ns = 10_000
        if decision.track:
            cost_ns = 1_000_000
            if k > 20 and governor.may(Extra.SEARCH):
                cost_ns += 5_000_000
        spent.append(cost_ns)
    assert max(sum(spent[k - 19 : k + 1]) for k in range(60, 400)) <= 10_000_000
    assert max(spent[60:]) > 5_000_000  # it goes on searching


def test_track_is_kept_alive_over_budget() -> None:
    governor, track = Governor(GovernorConfig(cpu_percent=0.01, max_skips=4)), []
    for k in range(200):
        track.append(governor.frame(k * PERIOD_NS, 2_000_000).track)
    later = track[60:]
    assert any(later) and max(len(run) for run in "".join("x" if t else "." for t in later).split("x")) <= 4


@given(costs=st.lists(st.integers(0, 40_000_000), min_size=1, max_size=80), percent=st.floats(0.5, 60.0))
@settings(max_examples=40)
def test_two_governors_fed_alike_decide_alike(costs: list[int], percent: float) -> None:
    a, b = Governor(GovernorConfig(cpu_percent=percent)), Governor(GovernorConfig(cpu_percent=percent))
    for k, cost in enumerate(costs):
        assert a.frame(k * PERIOD_NS, cost) == b.frame(k * PERIOD_NS, cost)
        assert a.may(Extra.KEYFRAME) == b.may(Extra.KEYFRAME)


def test_ladder_leads_down() -> None:
    config = AgentConfig()
    costs = [row.cost for row in LADDER]
    assert costs == sorted(costs, reverse=True) and len(set(costs)) == len(costs)
    assert governed(config, LADDER[0]) == config
    for row in LADDER:
        made = governed(config, row)
        assert made.align.points <= config.align.points and made.detector.max_corners <= config.detector.max_corners
        assert made.keyframe.min_inliers < made.align.points  # else every frame were a keyframe
        assert made.align.cell_px >= config.align.cell_px


def test_effort_scales_what_the_user_has_chosen() -> None:
    chosen = replace(AgentConfig(), align=replace(AgentConfig().align, points=120, fine_from=0))
    assert governed(chosen, LADDER[0]).align.points == 120
    assert governed(chosen, LADDER[1]).align.points == round(120 * LADDER[1].points)
    assert governed(chosen, LADDER[0]).align.fine_from == 0
