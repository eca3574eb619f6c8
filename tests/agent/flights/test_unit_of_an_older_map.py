"""One camera that is relocalised in an older map measures in that map's unit again."""

from pathlib import Path

import numpy as np

from kiteline_bench.harness.faults import dark_between, rearranged
from kiteline_bench.harness.odometer import with_odometer_between
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import FlyingAgent


def test_a_map_in_metres_is_in_metres_after_another_unit(data_dir: Path) -> None:
    """Nothing tells the way to the second map; images are lost again, and show the first map's place."""
    whole = load(str(data_dir / "room_flight.mcap")).left_only().without_imu().seconds(6.0, 12.5)
    path = rearranged(whole, [*range(80), *[None] * 30, *range(110, 124), *[None] * 6, *range(40, 70)])
    flight = dark_between(with_odometer_between(path, ((-np.inf, 3.9),)), ((4.0, 5.5), (6.2, 6.5)))
    agent = FlyingAgent(flight.rig, None)
    for item in flight.items:
        agent.step(item)
    metric = dict(zip([e.submap for e in agent.run.found], agent.run.metric, strict=True))
    first, second = sorted(metric)[1:]  # after the one that began in a unit of its own
    assert agent.box.submap == first and not metric[second]
    back = [e for e in agent.run.found if e.submap == first and e.t_ns > flight.items[130].frame.t_ns]
    assert len(back) > 20 and all(e.tracked for e in back) and metric[first] and agent.box.metric
