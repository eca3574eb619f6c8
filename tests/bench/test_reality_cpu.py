"""The yardstick of the agent's CPU."""

from pathlib import Path

from kiteline_bench.reality.cpu import over_yardstick, yardstick_ms


def test_the_unit_is_the_median_around_the_flight() -> None:
    unit_ms, mean, p95 = over_yardstick({"mean": 4.0, "p50": 3.0, "p95": 9.0}, [5.0, 5.0, 90.0], [4.0, 4.0])
    assert (unit_ms, mean, p95) == (5.0, 0.8, 1.8)


def test_every_fourth_image_is_measured(data_dir: Path) -> None:
    spent = yardstick_ms(str(data_dir / "kitti_straight"))
    assert len(spent) > 3
    assert all(ms > 0.0 for ms in spent)
