"""Processes that share a modelled core."""

import pytest

from kiteline_hw.lockstep.shared_core import SharedCore

MS = 1_000_000


def test_a_process_alone_gets_what_is_available() -> None:
    core = SharedCore(25.0)
    agent, base = core.process(), core.process()
    first, second = agent.spend(10 * MS, 100 * MS), agent.spend(5 * MS, 110 * MS)
    assert agent.free_ns == 160 * MS
    assert agent.done(139 * MS) < first
    assert agent.done(141 * MS) == first
    assert agent.busy(159 * MS)
    assert not base.busy(159 * MS)
    assert agent.done(161 * MS) == second
    assert agent.spend(1 * MS, 500 * MS) == second + 1
    assert agent.free_ns == 504 * MS  # idle time is not saved up


def test_processes_with_work_share_evenly_and_none_gets_more_than_a_core() -> None:
    for percent, shared_ms, long_ms in ((100.0, 20, 40), (200.0, 10, 30), (50.0, 40, 80)):
        core = SharedCore(percent)
        agent, worker = core.process(), core.process()
        worker.spend(30 * MS, 0)
        agent.spend(10 * MS, 0)
        assert (agent.free_ns, worker.free_ns) == (shared_ms * MS, long_ms * MS)
        assert agent.busy(shared_ms * MS - 1)
        assert not agent.busy(shared_ms * MS + 1)
        assert worker.done(long_ms * MS + 1) == 1


def test_a_frame_is_dropped_where_another_process_keeps_the_core() -> None:
    core = SharedCore(10.0)
    agent, base = core.process(), core.process()
    agent.spend(4 * MS, 0)
    assert not agent.newest_wins(0, 50 * MS)  # 40 ms alone
    base.spend(20 * MS, 0)
    assert agent.newest_wins(0, 50 * MS)  # 80 ms beside the base
    assert not agent.newest_wins(50 * MS, 50 * MS)
    assert not agent.newest_wins(0, 0)


def test_times_of_the_day_in_nanoseconds_are_no_obstacle() -> None:
    core = SharedCore(100.0)
    agent, base = core.process(), core.process()
    now_ns = 1_700_000_000 * 1000 * MS  # floating-point numbers of this size are 256 apart
    agent.spend(20, now_ns)
    base.spend(10 * MS, now_ns)
    assert not agent.busy(now_ns + 1 * MS)
    assert base.busy(now_ns + 9 * MS)
    assert not base.busy(now_ns + 11 * MS)


def test_a_core_without_time_is_refused() -> None:
    with pytest.raises(ValueError, match="0 %"):
        SharedCore(0.0)
