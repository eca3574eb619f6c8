"""One camera without an IMU over a radio: the base does not bend its map, nor the agent's with it."""

from pathlib import Path

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.recording import load
from kiteline_bench.reality.flown import flown
from kiteline_lab.evaluation.metrics import TrajectoryAlignment


def test_few_observations_do_not_bend_its_map(data_dir: Path, tmp_path: Path) -> None:
    recording = load(str(data_dir / "room_flight.mcap")).left_only().without_imu().seconds(8.0, 99.0)
    bench = Bench(data_dir, tmp_path, lambda _: None)
    flight = flown(bench, "room_flight", recording, bytes_s=(1000, 500), profile="radio")
    for path, most_m in (("base", 0.05), ("live", 0.05)):  # 0.2 and 0.1 where its steps do not count
        assert flight.ate_m(path, alignment=TrajectoryAlignment.SIM3) < most_m
