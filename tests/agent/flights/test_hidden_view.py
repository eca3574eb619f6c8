"""Real flights in which something hides most of the view for a third of a second: it is no new place, and no end."""

from pathlib import Path

import numpy as np

from kiteline_bench.harness.faults import changed, hidden, hidden_at_times
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import fly_alone
from kiteline_core.geometry import se3


def test_what_is_left_of_a_hidden_view_begins_no_submap(data_dir: Path) -> None:
    """A street without an IMU: a submap of a tenth of the image is lost in the next frame, and the way with it."""
    street = load(str(data_dir / "kitti_straight")).backward().part(0, 51)
    run = fly_alone(hidden_at_times(street, 0.9, 2.5, 0.4, 0), vocabulary=False)
    assert sum("submap: opened" in events for events in run.events) == 1
    assert sum(not e.tracked for e in run.found) == 8  # those in which it is hidden
    assert not any(event.startswith("images:") for events in run.events for event in events)
    first, last = run.truth[0], run.truth[-1]
    assert first is not None and last is not None
    flown = se3.inverse(run.found[0].T_o_b) @ run.found[-1].T_o_b
    assert np.linalg.norm((se3.inverse(first) @ last)[:3, 3] - flown[:3, 3]) < 0.6  # of 60 m


def test_one_camera_knows_its_scale_though_the_view_is_hidden_again_and_again(data_dir: Path) -> None:
    """The parts of the window between are shorter than any that tells a scale."""
    flight = load(str(data_dir / "euroc_mh01_air"), mono=True).seconds(1.0, 5.0)
    for begin in (20, 60):  # half a second each
        flight = changed(flight, begin, begin + 10, hidden(0.9, 1))
    run = fly_alone(flight, vocabulary=False)
    assert run.metric[-1]
