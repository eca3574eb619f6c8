"""How a map of one camera begins, by which sensors speak."""

from types import SimpleNamespace
from typing import Any

from kiteline_agent.mapping.start_choice import StartChoice


def choice(
    *,
    odometer: bool = True,
    any_map: bool = False,
    samples: bool = True,
    imu: bool = True,
    has_time: bool = True,
    contradicts: bool = False,
) -> StartChoice:
    motion = SimpleNamespace(odometer=SimpleNamespace(has_recent=lambda _t_ns: odometer))
    camera: Any = SimpleNamespace(motion=motion, submaps=SimpleNamespace(any=any_map))
    inertial: Any = (
        SimpleNamespace(has_samples=samples, odometry=SimpleNamespace(contradicts=contradicts)) if imu else None
    )
    return StartChoice(camera, inertial, has_time=has_time)


def test_images_and_imu_begin_a_map_and_an_odometer_helps_them() -> None:
    assert choice().awaits_window(0)
    assert choice(odometer=False).awaits_window(0)
    assert not choice(imu=False).awaits_window(0)


def test_an_imu_that_has_not_spoken_is_not_waited_for_where_an_odometer_speaks() -> None:
    assert not choice(samples=False).awaits_window(0)
    assert choice(samples=False, odometer=False).awaits_window(0)


def test_an_odometer_leads_over_a_loss_by_itself() -> None:
    assert not choice(any_map=True).awaits_window(0)
    assert choice(any_map=True, odometer=False).awaits_window(0)


def test_under_a_cpu_budget_an_odometer_is_sooner_than_a_window() -> None:
    assert not choice(has_time=False).awaits_window(0)
    assert choice(has_time=False, odometer=False).awaits_window(0)


def test_two_views_begin_the_map_if_no_window_tells_the_scale() -> None:
    waits, second = choice(), 1_000_000_000
    assert [waits.awaits_window(k * second) for k in (1, 4, 5, 6, 7)] == [True, True, True, False, False]


def test_an_odometer_that_contradicts_the_imu_is_not_taken_in_its_place_at_once() -> None:
    waits, second = choice(contradicts=True), 1_000_000_000
    assert [waits.awaits_window(k * second) for k in (1, 7, 15, 17)] == [True, True, True, False]
