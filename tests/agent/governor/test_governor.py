"""The governor: within its budget over every second, evenly, frames before tracking, no haste."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, GovernorConfig
from kiteline_agent.governor.effort import ALONE, CARRIED, FULL, Effort, governed
from kiteline_agent.governor.governor import Extra, Governor

PERIOD_NS = 50_000_000
FRAME_NS, KEYFRAME_NS = 3_500_000, 5_000_000


class Flight:
    """A governor in closed loop with an agent of known cost."""

    def __init__(self, percent: float, every_s: float = 0.4, dearer: float = 1.0, carried: bool = True) -> None:
        self.governor = Governor(GovernorConfig(cpu_percent=percent))
        self.every_s, self.dearer, self.carried = every_s, dearer, carried
        self.cost_ns: list[int] = []
        self.tracked: list[bool] = []
        self.levels: list[int] = []
        self.efforts: list[Effort] = []
        self.events: list[str] = []
        self.keyframe_ns = 0
        self.waits: list[int] = []  # ns by which keyframes were late

    def fly(self, frames: int) -> "Flight":
        for _ in range(frames):
            k = len(self.cost_ns)
            now_ns = k * PERIOD_NS
            decision = self.governor.frame(now_ns, self.cost_ns[-1] if k else 0, carried=self.carried)
            cost = 20_000.0
            if decision.track:
                cost = FRAME_NS * decision.effort.frame_cost * self.dearer
                due_ns = self.keyframe_ns + self.every_s * decision.effort.keyframes * 1e9
                if now_ns >= due_ns and self.governor.may(Extra.KEYFRAME):
                    self.waits.append(now_ns - round(due_ns))
                    self.keyframe_ns = now_ns
                    cost += KEYFRAME_NS * decision.effort.keyframe_cost * self.dearer
            self.cost_ns.append(round(cost))
            self.tracked.append(decision.track)
            self.levels.append(self.governor.level)
            self.efforts.append(decision.effort)
            self.events.extend(decision.events)
        return self

    def windows(self, after: int = 60) -> list[float]:
        """Percent of a core over each second that ends at a frame from `after` on."""
        n = 1_000_000_000 // PERIOD_NS
        return [sum(self.cost_ns[max(k - n + 1, 0) : k + 1]) / 1e7 for k in range(after, len(self.cost_ns))]


LOAD = (FRAME_NS + KEYFRAME_NS / 8) / PERIOD_NS * 100.0  # percent of a core without a governor


@pytest.mark.parametrize("share", [1.0, 0.5, 0.25, 0.12])
@pytest.mark.parametrize("dearer", [0.8, 1.0, 1.3])
@pytest.mark.parametrize("carried", [True, False])
def test_budget_holds_in_every_second_after_the_third(share: float, dearer: float, carried: bool) -> None:
    flight = Flight(share * LOAD, dearer=dearer, carried=carried).fly(600)
    assert max(flight.windows()) <= share * LOAD * 1.001
    assert max(flight.windows()) > 0.6 * share * LOAD  # it is used, too


def test_without_a_budget_nothing_is_decided() -> None:
    flight = Flight(0.0).fly(100)
    assert all(flight.tracked) and set(flight.levels) == {0} and not flight.events


def test_ample_budget_costs_nothing() -> None:
    flight = Flight(2.0 * LOAD).fly(300)
    assert all(flight.tracked) and set(flight.levels) == {0}


def test_no_frame_is_skipped_that_can_be_paid_for() -> None:
    assert np.mean(Flight(0.97 * LOAD).fly(600).tracked[60:]) > 0.85
    assert all(Flight(1.2 * LOAD).fly(600).tracked[60:])
    assert not all(Flight(0.5 * LOAD).fly(600).tracked[60:])


def test_with_an_imu_frames_go_before_pixels_and_without_it_pixels_before_frames() -> None:
    carried, alone = Flight(0.3 * LOAD).fly(600), Flight(0.3 * LOAD, carried=False).fly(600)
    assert sum(carried.tracked[60:]) < sum(alone.tracked[60:])
    row = CARRIED[carried.levels[-1]]
    assert row == replace(FULL, every=row.every, keyframes=row.keyframes)
    assert ALONE[alone.levels[-1]].first == 1


def test_images_alone_keep_room_for_keyframes_that_come_early() -> None:
    """Without an IMU the track is lost while a keyframe waits."""
    intervals_s = np.random.default_rng(1).choice([0.1, 0.1, 0.2, 0.6, 0.8], 1000)
    flight = Flight(0.8 * LOAD, carried=False)
    for _ in range(800):
        flight.every_s = float(intervals_s[len(flight.waits)])
        flight.fly(1)
    assert np.mean(flight.waits[10:]) < 0.06e9


@pytest.mark.parametrize("carried", [True, False])
def test_frames_are_let_through_evenly(carried: bool) -> None:
    flight = Flight(0.25 * LOAD, every_s=1.0, carried=carried).fly(600)
    skips = [len(run) for run in "".join("x" if t else "." for t in flight.tracked[60:]).split("x")][1:-1]
    assert max(skips) <= 8 and max(skips) - min(skips) <= 6


def test_an_imu_that_starts_or_stops_changes_the_ladder_within_the_budget() -> None:
    flight = Flight(0.3 * LOAD, carried=False).fly(300)
    assert flight.efforts[-1] in ALONE and flight.efforts[-1] not in CARRIED
    flight.carried = True
    flight.fly(300)
    assert flight.efforts[-1] in CARRIED and flight.efforts[-1] not in ALONE
    flight.carried = False
    flight.fly(100)
    assert flight.efforts[-1] in ALONE
    assert max(flight.windows()) <= 0.3 * LOAD * 1.001


def test_the_first_frame_is_not_at_an_effort_that_cannot_be_borne() -> None:
    assert Governor(GovernorConfig(cpu_percent=1.0)).frame(0, 0).effort.corners < 0.7
    assert Governor(GovernorConfig(cpu_percent=30.0)).frame(0, 0).effort == FULL


@pytest.mark.parametrize("period_ns", [33_000_000, 100_000_000, 200_000_000])
def test_cameras_of_other_rates(period_ns: int) -> None:
    governor, cost_ns, spent = Governor(GovernorConfig(cpu_percent=3.0)), 0, []
    for k in range(300):
        decision = governor.frame(k * period_ns, cost_ns, carried=True)
        cost_ns = round(3_500_000 * decision.effort.frame_cost) if decision.track else 20_000
        spent.append(cost_ns)
    n = 1_000_000_000 // period_ns
    sums = [sum(spent[k - n + 1 : k + 1]) for k in range(4 * n, 300)]
    assert 17_000_000 < max(sums) <= 30_000_000  # 5 Hz at full effort take 17.5 ms


def test_effort_does_not_swing() -> None:
    flight = Flight(0.6 * LOAD).fly(1200)
    changes = sum(a != b for a, b in zip(flight.levels[100:], flight.levels[101:]))
    assert changes <= 6  # in 55 s


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


@pytest.mark.parametrize("carried", [True, False])
def test_track_is_kept_alive_over_budget(carried: bool) -> None:
    governor, track = Governor(GovernorConfig(cpu_percent=0.01)), []
    for k in range(200):
        track.append(governor.frame(k * PERIOD_NS, 2_000_000, carried=carried).track)
    later = track[60:]
    assert any(later) and max(len(run) for run in "".join("x" if t else "." for t in later).split("x")) <= 20


@pytest.mark.parametrize("percent", [0.8, 1.2])
def test_a_new_map_does_not_wait_for_ever_behind_the_search_for_the_old_one(percent: float) -> None:
    governor, cost_ns, opened = Governor(GovernorConfig(cpu_percent=percent)), 0, 0
    for k in range(400):
        decision = governor.frame(k * PERIOD_NS, cost_ns, lost=k > 20)
        cost_ns = 60_000
        if decision.track:
            cost_ns = 1_500_000
            if k > 20 and governor.may(Extra.SEARCH):
                cost_ns += 5_000_000
            if k > 20 and governor.may(Extra.SUBMAP):
                cost_ns += 7_000_000
                opened += 1
    assert opened > 3


@pytest.mark.parametrize("ladder", [CARRIED, ALONE])
def test_ladder_leads_down(ladder: tuple[Effort, ...]) -> None:
    config = AgentConfig()
    costs = [(row.frame_cost + row.keyframe_cost, row.frame_cost / row.every) for row in ladder]
    assert costs == sorted(costs, reverse=True) and len(set(costs)) == len(costs)
    assert ladder[0] == FULL and governed(config, FULL) == config
    for row in ladder:
        made = governed(config, row)
        assert made.align.points <= config.align.points and made.detector.max_corners <= config.detector.max_corners
        assert made.keyframe.min_inliers < made.align.points  # else every frame were a keyframe
        assert made.align.cell_px >= config.align.cell_px


def test_effort_scales_what_the_user_has_chosen() -> None:
    chosen = replace(AgentConfig(), align=replace(AgentConfig().align, points=120, fine_from=0))
    assert governed(chosen, FULL).align.points == 120
    assert governed(chosen, CARRIED[-1]).align.points == round(120 * CARRIED[-1].points)
    assert governed(chosen, FULL).align.fine_from == 0
    halved = replace(
        chosen, pyramid=replace(chosen.pyramid, first=1), detector=replace(chosen.detector, first=1),
        keyframe=replace(chosen.keyframe, rotation_rad=0.2),
    )  # fmt: skip
    assert governed(halved, FULL) == halved
    turned_rad = governed(halved, ALONE[-1]).keyframe.rotation_rad
    assert turned_rad == pytest.approx(0.2 * ALONE[-1].keyframes)


@pytest.mark.parametrize(("every_s", "first"), [(3.0, 0), (1.0, 1)])
def test_at_an_eighth_images_are_halved_only_where_keyframes_are_frequent(every_s: float, first: int) -> None:
    """A whole keyframe takes most of a second's budget, so that only every second one has room for one."""
    flight = Flight(0.12 * LOAD, every_s).fly(1200)
    assert np.mean([effort.first == first for effort in flight.efforts[400:]]) > 0.8
    assert len(flight.waits) > 10
    assert max(flight.windows()) <= 0.12 * LOAD * 1.001


def test_at_an_eighth_a_keyframe_waits_for_a_second_of_its_own() -> None:
    """Frames that are tracked while it waits would keep it waiting: no two frames and a keyframe fit in a second."""
    flight = Flight(0.12 * LOAD, every_s=1.0).fly(1200)
    assert max(flight.waits[5:]) <= 1.05e9


@pytest.mark.parametrize("carried", [True, False])
@pytest.mark.parametrize("share", [0.5, 0.25])
def test_a_keyframe_that_is_wanted_does_not_starve_behind_frames(carried: bool, share: float) -> None:
    governor, cost_ns, asked, waited = Governor(GovernorConfig(cpu_percent=share * LOAD)), 0, 0, []
    for k in range(600):
        decision = governor.frame(k * PERIOD_NS, cost_ns, carried=carried)
        cost_ns = 20_000
        if decision.track:
            cost_ns = round(FRAME_NS * decision.effort.frame_cost)
            if k >= asked:
                if governor.may(Extra.KEYFRAME):
                    cost_ns += round(KEYFRAME_NS * decision.effort.keyframe_cost)
                    waited.append(k - asked)
                    asked = k + 22  # not more often than the budget bears
    assert max(waited[2:]) <= 16 and len(waited) > 18


def test_a_clock_that_says_nothing_is_borne() -> None:
    governor = Governor(GovernorConfig(cpu_percent=2.0))
    tracked = [governor.frame(k * PERIOD_NS, 0).track and governor.may(Extra.KEYFRAME) for k in range(100)]
    assert sum(tracked) > 40


def test_where_costs_scatter_more_is_left_free() -> None:
    def dearest(scatter: float) -> float:
        rng, governor, cost_ns, spent = np.random.default_rng(5), Governor(GovernorConfig(cpu_percent=2.0)), 0, []
        for k in range(1200):
            decision = governor.frame(k * PERIOD_NS, cost_ns, carried=True)
            cost_ns = round(3_500_000 * (1.0 + scatter * rng.uniform(-1.0, 1.0))) if decision.track else 20_000
            spent.append(cost_ns)
        return max(sum(spent[k - 19 : k + 1]) for k in range(60, 1200)) / 20e6

    assert 0.85 < dearest(0.0) <= 1.0
    assert dearest(0.3) <= 1.0


def test_the_first_keyframe_is_expected_to_cost_what_the_map_began_with() -> None:
    governor, cost_ns, spent, made = Governor(GovernorConfig(cpu_percent=1.2, grace_s=0.0)), 0, list[int](), 0
    for k in range(100):
        decision = governor.frame(k * PERIOD_NS, cost_ns, carried=True)
        cost_ns = 1_500_000 if decision.track else 20_000
        if k == 0:
            governor.note(Extra.SUBMAP)
            cost_ns = 6_000_000
        elif decision.track and k > 30 and governor.may(Extra.KEYFRAME):
            cost_ns += 6_000_000
            made += 1
        spent.append(cost_ns)
    assert made and max(sum(spent[k - 19 : k + 1]) for k in range(20, 100)) <= 12_000_000


def test_the_first_search_costs_the_same_at_any_effort() -> None:
    governor, cost_ns, spent = Governor(GovernorConfig(cpu_percent=1.6)), 0, list[int]()
    for k in range(200):
        decision = governor.frame(k * PERIOD_NS, cost_ns, lost=k > 60)
        cost_ns = round(2_200_000 * decision.effort.frame_cost) if decision.track else 20_000
        if decision.track and k > 60 and governor.may(Extra.SEARCH):
            cost_ns += 7_000_000
        spent.append(cost_ns)
    assert max(spent) > 7_000_000 and max(sum(spent[k - 19 : k + 1]) for k in range(60, 200)) <= 16_000_000


@pytest.mark.parametrize("max_gap_s", [0.35, 0.15])
def test_images_alone_are_tracked_after_the_longest_gap_while_the_budget_lasts(max_gap_s: float) -> None:
    flight = Flight(0.12 * LOAD, dearer=1.3, carried=False)
    flight.governor = Governor(GovernorConfig(cpu_percent=0.12 * LOAD, max_gap_s=max_gap_s))
    flight.fly(600)
    gaps = np.diff(np.flatnonzero(flight.tracked[200:])) * PERIOD_NS * 1e-9
    assert np.median(gaps) == pytest.approx(max_gap_s)


@pytest.mark.parametrize(("first_frame_ms", "full"), [(0.35, True), (35.0, False)])
def test_what_frames_are_expected_to_cost_decides_the_first_effort(first_frame_ms: float, full: bool) -> None:
    governor = Governor(GovernorConfig(cpu_percent=0.5 * LOAD, first_frame_ms=first_frame_ms))
    assert (governor.frame(0, 0, carried=False).effort == FULL) == full
