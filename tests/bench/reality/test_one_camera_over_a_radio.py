"""One camera without an IMU over a radio: the base does not bend its map, nor the agent's with it."""

from pathlib import Path

import numpy as np

from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import fly_recording
from kiteline_bench.reality.flown import Flown
from kiteline_core.geometry.cameras import Rectifier
from kiteline_lab.evaluation import metrics
from kiteline_lab.flights.refined_path import refined_path


def test_few_observations_do_not_bend_its_map(data_dir: Path) -> None:
    recording = load(str(data_dir / "room_flight.mcap")).left_only().without_imu().seconds(8.0, 99.0)
    flight = fly_recording(recording, bytes_s=(1000, 500), profile="radio")
    keyframes = {int(k): pose for k, pose in keyframe_poses(flight.station.mapper).items()}
    refined = refined_path(flight.agent.found, keyframes, Rectifier(recording.rig).camera.T_b_c)
    flown = Flown(flight.agent, refined, 0.0)
    for path, most_m in (("base", 0.05), ("live", 0.05)):  # 0.2 and 0.1 where its steps do not count
        found = flown.matched(path, metrics.TrajectoryAlignment.SIM3)
        assert found is not None
        assert np.sqrt(np.mean(metrics.position_errors(found) ** 2)) < most_m
