"""The real flight of one camera beside an odometer that is true to a percent: its map must not keep another size."""

from pathlib import Path

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity, StepInput
from kiteline_bench.harness.odometer import SCALE, measured_along, with_odometer_between
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_bench.reality.flown import Flown
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, OdometryBatch
from kiteline_core.ids import AgentId
from kiteline_hw.sources.open import open_source
from tests.agent.mono_room import similar


def test_a_map_whose_unit_the_odometer_told_is_scaled_when_it_drifts(data_dir: Path) -> None:
    source = open_source(str(data_dir / "euroc_mh01_air"), mono=True, imu=False)
    truth = source.ground_truth
    assert truth is not None
    driven, done = measured_along(truth), 0
    agent = Agent(source.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    found: list[tuple[int, F64]] = []
    words: list[str] = []
    frames = [item for item in source if isinstance(item, Frame)][40:440]  # 20 s, in which the map grows by a quarter
    for frame in frames:
        end = int(np.searchsorted(driven.t_ns, frame.t_ns, side="right"))
        part = OdometryBatch(*(getattr(driven, name)[done:end] for name in OdometryBatch.__dataclass_fields__))
        done = end
        output = agent.step(StepInput(frame, odometry=part), frame.t_ns)
        words += output.events
        if output.estimate is not None and output.estimate.tracked:
            found.append((frame.t_ns, output.estimate.T_o_b))
    source.close()
    assert any(word.startswith("mono: metric") for word in words)
    late = [(t, T) for t, T in found if t > frames[0].t_ns + 12_000_000_000]
    at = np.clip(np.searchsorted(truth.t_ns, [t for t, _ in late]), 0, len(truth.t_ns) - 1)
    scale, _ = similar(np.array([T[:3, 3] for _, T in late]), truth.T_w_b[at][:, :3, 3])
    assert abs(1.0 / scale - SCALE) < 0.035, words


def test_beside_an_imu_it_helps_images_and_imu_to_begin_the_map(data_dir: Path) -> None:
    """From here a map of two views is 10 % too long for seconds, though the odometer told its unit."""
    whole = load(str(data_dir / "euroc_mh01_air"), mono=True).seconds(1.0, 8.0)
    flight = with_odometer_between(whole, ((-np.inf, np.inf),))
    agent = FlyingAgent(flight.rig, flight.imu)
    for item in flight.items:
        agent.step(item)
    run = Flown(agent.run, [], 0.0)
    assert run.metric_after_s < 4.0
    assert run.scale_error("odometry") < 0.03
    assert not any(event.startswith("odometer: lengths") for events in agent.run.events for event in events)
