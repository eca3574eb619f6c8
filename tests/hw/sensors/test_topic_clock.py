"""Stamps of topics on the monotonic clock: of this computer's wall clock, of other clocks, wrong ones and none."""

import time

import pytest

from kiteline_hw.sensors.topic_clock import TopicClocks, wall_less_monotonic_ns

MS, S = 1_000_000, 1_000_000_000
DAY = 86400 * S


@pytest.fixture
def now_ns() -> int:
    return time.monotonic_ns()


def wall(t_ns: int) -> int:
    return t_ns + wall_less_monotonic_ns()


def test_stamps_of_the_wall_clock_keep_their_times(now_ns: int) -> None:
    clocks = TopicClocks()
    topic = clocks.topic("camera /image tells no capture times")
    for k, delay_ms in enumerate([20, 900, 1, 2500]):  # the last one was held up on its way
        arrival_ns = now_ns + k * S
        t_ns = topic.to_ours(wall(arrival_ns - delay_ms * MS), arrival_ns)
        assert t_ns == pytest.approx(arrival_ns - delay_ms * MS, abs=MS)
    assert clocks.take_messages() == []


def test_topics_of_another_clock_share_the_least_delay(now_ns: int) -> None:
    clocks = TopicClocks()
    camera, imu = clocks.topic("camera"), clocks.topic("imu")
    camera.to_ours(now_ns - DAY, now_ns + 60 * MS)
    assert imu.to_ours(now_ns + 59 * MS - DAY, now_ns + 60 * MS) == now_ns + 60 * MS
    assert camera.to_ours(now_ns + 50 * MS - DAY, now_ns + 110 * MS) == pytest.approx(now_ns + 51 * MS, abs=MS)
    assert [line.split()[0] for line in clocks.take_messages()] == ["camera", "imu"]
    assert clocks.take_messages() == []


def test_a_topic_of_a_third_clock_has_an_offset_of_its_own(now_ns: int) -> None:
    clocks = TopicClocks()
    camera, imu = clocks.topic("camera"), clocks.topic("imu")
    assert camera.to_ours(now_ns - DAY, now_ns) == now_ns
    assert imu.to_ours(now_ns + DAY, now_ns + MS) == now_ns + MS
    assert camera.to_ours(now_ns + 50 * MS - DAY, now_ns + 80 * MS) == pytest.approx(now_ns + 50 * MS, abs=MS)


@pytest.mark.parametrize("ahead_ns", [0, -DAY])
@pytest.mark.parametrize("wrong_ns", [-3 * DAY, 3 * DAY])
def test_one_wrong_stamp_moves_no_other(now_ns: int, ahead_ns: int, wrong_ns: int) -> None:
    clocks = TopicClocks()
    topic = clocks.topic("imu")
    times = []
    for k in range(600):
        arrival_ns = now_ns + 5 * MS * k
        stamp_ns = (wall(arrival_ns) if ahead_ns == 0 else arrival_ns + ahead_ns) - MS * (k > 0)
        times.append(topic.to_ours(stamp_ns + wrong_ns * (k == 300), arrival_ns) - arrival_ns)
    del times[300]
    assert max(abs(t + MS) for t in times[1:]) < MS
    assert len(clocks.take_messages()) == (ahead_ns != 0)


def test_a_recording_that_begins_again_gets_a_new_offset(now_ns: int) -> None:
    clocks = TopicClocks()
    topics = [clocks.topic("camera"), clocks.topic("imu")]
    for k in range(100):
        arrival_ns = now_ns + 50 * MS * k
        stamp_ns = 50 * MS * (k % 50)  # begins anew after 2.5 s
        ours = [topic.to_ours(stamp_ns + 1, arrival_ns) for topic in topics]
        assert max(ours) <= arrival_ns
        if not 50 <= k <= 70:
            assert min(ours) >= arrival_ns - 5 * MS
    assert len(clocks.take_messages()) == 2


def test_messages_without_stamps_count_from_their_arrival(now_ns: int) -> None:
    clocks = TopicClocks()
    topic = clocks.topic("imu /imu tells no sample times")
    assert [topic.to_ours(0, now_ns + k) for k in range(3)] == [now_ns, now_ns + 1, now_ns + 2]
    (line,) = clocks.take_messages()
    assert line.startswith("imu /imu tells no sample times") and "header.stamp" in line
